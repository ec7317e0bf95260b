"""Directive ``help-of``: what ``tpgmm COMMAND --help`` prints, asked when the page is built."""

from __future__ import annotations

from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from typer.testing import CliRunner

from tpgmm_tools.cli.application import app as tpgmm

__all__ = ["HelpOf", "setup"]

TERMINAL = {"COLUMNS": "88", "TERM": "dumb", "NO_COLOR": "1"}


class HelpOf(SphinxDirective):
    """The help of a command as it looks in a terminal."""

    optional_arguments = 9

    def run(self) -> list[nodes.Node]:
        """Ask for it."""
        result = CliRunner().invoke(tpgmm, [*self.arguments, "--help"], env=TERMINAL)
        if result.exit_code:
            command = " ".join(self.arguments)
            return [self.state.document.reporter.warning(f"no command tpgmm {command}")]
        lines = [line.strip().ljust(1) for line in result.output.strip().splitlines()]
        return [nodes.literal_block("", "\n".join(lines).strip(), language="text")]


def setup(app: Sphinx) -> dict[str, Any]:
    """What Sphinx calls."""
    app.add_directive("help-of", HelpOf)
    return {"parallel_read_safe": True}
