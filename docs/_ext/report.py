"""Directive ``report``: includes a file that a program writes, or notes that it lacks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

__all__ = ["Report", "setup"]

INCLUDE = "```{{include}} {0}\n:heading-offset: 1\n:relative-images:\n:relative-docs: {1}\n```"


class Report(SphinxDirective):
    """The contents of the file, with its pictures and links, one heading deeper."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Include it."""
        relative, path = self.env.relfn2path(self.arguments[0])
        self.env.note_dependency(path)
        if not Path(path).is_file():
            text = f"{relative} has not been made yet."
            return [nodes.note("", nodes.paragraph("", text))]
        text = INCLUDE.format(self.arguments[0], Path(relative).parent.as_posix())
        return self.parse_text_to_nodes(text, allow_section_headings=True)


def setup(app: Sphinx) -> dict[str, Any]:
    """What Sphinx calls."""
    app.add_directive("report", Report)
    return {"parallel_read_safe": True}
