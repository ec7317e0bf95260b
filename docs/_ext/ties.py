"""Directive ``ties``: what computes a formula, and the tests that hold it there.

    ```{ties}
    :code: tpgmm_torch.gaussians.information
    :tests: tpgmm_torch/test_gaussians.py::test_information_takes_dependent_rows
    ```

Code is linked to the API reference; a test that does not exist is a warning.
"""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.parsers.rst import directives
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

__all__ = ["Ties", "setup", "test_exists"]

TESTS = Path(__file__).parents[2] / "tests"


@cache
def _tree(file: str) -> ast.Module | None:
    path = TESTS / file
    return ast.parse(path.read_text(encoding="utf-8")) if path.is_file() else None


def test_exists(identifier: str) -> bool:
    """Whether ``file.py::name`` or ``file.py::Class::name`` is defined there."""
    file, *names = identifier.split("::")
    scope: Any = _tree(file)
    for name in names:
        kinds = ast.FunctionDef | ast.ClassDef
        inside = () if scope is None else scope.body
        scope = next((n for n in inside if isinstance(n, kinds) and n.name == name), None)
    return bool(names) and scope is not None


test_exists.__test__ = False  # type: ignore[attr-defined]  # pytest: it only sounds like one


class Ties(SphinxDirective):
    """A line of links below a formula."""

    option_spec = {  # noqa: RUF012
        "code": directives.unchanged_required,
        "tests": directives.unchanged_required,
    }

    def run(self) -> list[nodes.Node]:
        """Build the line."""
        line = nodes.paragraph(classes=["ties"])
        for number, target in enumerate(_items(self.options["code"])):
            line += nodes.Text(", " if number else "Computed by ")
            line += self._reference(target)
        for number, identifier in enumerate(_items(self.options["tests"])):
            if not test_exists(identifier):
                message = f"there is no test {identifier} in tests/"
                line += self.state.document.reporter.warning(message, line=self.lineno)
            line += nodes.Text(", " if number else "; held by ")
            line += nodes.literal("", identifier)
        line += nodes.Text(".")
        return [line]

    def _reference(self, target: str) -> nodes.Node:
        short = target.removeprefix("tpgmm_torch.")
        reference = addnodes.pending_xref(
            "",
            nodes.literal("", short, classes=["xref", "py", "py-obj"]),
            refdomain="py",
            reftype="obj",
            reftarget=target,
            refwarn=self.config.nitpicky,
        )
        reference["refdoc"] = self.env.docname
        return reference


def _items(text: str) -> list[str]:
    return text.replace(",", " ").split()


def setup(app: Sphinx) -> dict[str, Any]:
    """What Sphinx calls."""
    app.add_directive("ties", Ties)
    return {"parallel_read_safe": True}
