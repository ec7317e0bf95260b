"""Every link inside the built site leads somewhere: a page, a file, an anchor.

Sphinx checks what it resolves itself; this also sees links written as HTML, in templates and
in included files. Run after the build, a broken link is a warning, and warnings are errors.
"""

from __future__ import annotations

from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from sphinx.application import Sphinx
from sphinx.util import logging

__all__ = ["broken_links", "setup"]

LINKS = {"a": "href", "link": "href", "img": "src", "script": "src", "source": "src"}


class _Page(HTMLParser):
    """The links and the anchors of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = {""}
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value for name, value in attrs if value}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        if LINKS.get(tag) in given:
            self.links.append(given[LINKS[tag]])


def broken_links(root: Path) -> Iterator[str]:
    """Links from the pages below ``root`` to what is not there, as ``page: link``."""
    root = root.resolve()
    # the theme keeps templates among its files
    files = [path for path in root.rglob("*.html") if "_static" not in path.parts]
    pages = {path: _Page(path) for path in sorted(files)}
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = path if not parts.path else (path.parent / unquote(parts.path)).resolve()
            anchor = unquote(parts.fragment)
            other = pages.get(target)
            missing = not target.exists() or target.is_dir()
            if missing or (other is not None and anchor not in other.anchors):
                yield f"{path.relative_to(root)}: {link}"


def _check(app: Sphinx, error: Exception | None) -> None:
    if error is None and app.builder.format == "html":
        for link in broken_links(Path(app.outdir)):
            logging.getLogger(__name__).warning("link to nowhere: %s", link)


def setup(app: Sphinx) -> dict[str, Any]:
    """What Sphinx calls."""
    app.connect("build-finished", _check, priority=900)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
