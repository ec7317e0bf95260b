"""Notebooks of the gallery: how to install comes first, and Markdown has no roles of Sphinx."""

from __future__ import annotations

import re
from typing import Any

from sphinx.application import Sphinx
from sphinx_gallery import notebook

__all__ = ["FIRST_CELL", "setup"]

FIRST_CELL = """\
# Where the package is not installed, remove the sign # of the next line, and run the cell.
# %pip install 'tpgmm-torch[cli]'
"""
ROLE = re.compile(r":(?:attr|class|func|meth|mod):`(~?)([\w.]+)`")
_rst2md = notebook.rst2md


def rst2md(text: str, *settings: Any) -> str:
    """The gallery's own, after names of the API became code: ``:class:`~tpgmm_torch.Robot```.

    A name with ``~`` is shown by its last part, as on the site.
    """
    named = ROLE.sub(
        lambda role: f"`{role[2].rpartition('.')[2] if role[1] else role[2]}`", text
    )
    return _rst2md(named, *settings)


def setup(app: Sphinx) -> dict[str, Any]:
    """What Sphinx calls."""
    notebook.rst2md = rst2md
    return {"parallel_read_safe": True}
