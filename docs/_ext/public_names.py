"""Directive ``public-names``: the names that the API reference documents, module by module."""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

__all__ = ["documented", "exists", "public_names", "setup"]

PACKAGES = (
    "tpgmm_torch", "tpgmm_control", "tpgmm_datasets", "tpgmm_vision", "tpgmm_tools",
    "lerobot_policy_tpgmm", "lerobot_env_bimanual", "tpgmm_evaluation",
)  # fmt: skip
PAGES = Path(__file__).parents[1] / "api"
DIRECTIVE = re.compile(r"^\.\. auto(\w+):: ([\w.]+)\n((?:   .*\n)*)", re.MULTILINE)
CURRENT = re.compile(r"^\.\. currentmodule:: ([\w.]+)$", re.MULTILINE)


def _find(name: str) -> Any:
    """Return what a dotted name leads to, however deep in a class; None if to nothing."""
    parts = name.split(".")
    for split in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:split]))
        except ImportError:
            continue
        for part in parts[split:]:
            found = getattr(found, part, None)
        return found
    return None


def exists(name: str) -> bool:
    """Tell whether a dotted name leads to something."""
    return _find(name) is not None


def _written() -> Iterator[str]:
    """Yield the full names of functions, classes and constants as the pages write them."""
    for page in sorted(PAGES.glob("*.rst")):
        text, module = page.read_text(encoding="utf-8"), ""
        for directive in re.finditer(f"{DIRECTIVE.pattern}|{CURRENT.pattern}", text, re.M):
            kind, name, options, current = directive.groups()
            if current:
                module = current
            elif kind == "module" and (wanted := re.search(r":members:(.*)", options)):
                members = re.findall(r"\w+", wanted[1]) or importlib.import_module(name).__all__
                yield from (f"{name}.{member}" for member in members)
            elif kind not in ("module", "summary"):
                yield name if "." in name else f"{module}.{name}"


def public_names() -> dict[str, str]:
    """Map each public name, as users import it, to where it is defined."""
    return {name: _home(name) for name in _written()}


def documented() -> set[str]:
    """Return the full names that the pages document, as written and as defined."""
    names = public_names()
    return names.keys() | set(names.values())


def _home(name: str) -> str:
    """Return where a name is defined; for constants, where it is asked for."""
    module, _, last = name.rpartition(".")
    home = getattr(_find(name), "__module__", None)
    return f"{home if isinstance(home, str) and home.startswith(PACKAGES) else module}.{last}"


class PublicNames(SphinxDirective):
    """A table of the public names, by the module from which they are imported."""

    def run(self) -> list[nodes.Node]:
        """Write the table."""
        modules: dict[str, list[str]] = {}
        for name in public_names():
            module, _, last = name.rpartition(".")
            modules.setdefault(module, []).append(last)
        lines = [".. list-table::", "   :header-rows: 1", "", "   * - module", "     - names"]
        for module in sorted(
            modules, key=lambda name: (PACKAGES.index(name.split(".")[0]), name)
        ):
            names = ", ".join(f":py:obj:`{last} <{module}.{last}>`" for last in modules[module])
            lines += [f"   * - ``{module}``", f"     - {names}"]
        node = nodes.container()
        self.state.nested_parse(StringList(lines, "public-names"), self.content_offset, node)
        return node.children


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directive."""
    app.add_directive("public-names", PublicNames)
    return {"parallel_read_safe": True}
