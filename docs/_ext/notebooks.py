"""Notebooks of the gallery: their first cell installs the package, and buttons open them.

Their Markdown has no roles of Sphinx.

Where the site is built from a repository with a public address (``GITHUB_REPOSITORY``, which
GitHub's own runners set), its pages have buttons that open their notebooks in hosted services.
These read them from the branch that the site is published on (``.github/workflows/site.yml``).
"""

from __future__ import annotations

import os
import re
import shutil
from importlib.metadata import version
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx
from sphinx_gallery import notebook

__all__ = ["buttons", "first_cell", "setup"]

BRANCH = "gh-pages"
#: Where a notebook is opened, by service.
SERVICES = {
    "Colab": "https://colab.research.google.com/github/{at}/blob/{branch}/notebooks/{name}.ipynb",
    "Binder": "https://mybinder.org/v2/gh/{at}/{branch}?labpath=notebooks%2F{name}.ipynb",
    "Kaggle": "https://kaggle.com/kernels/welcome?src=https://github.com/{at}/blob/{branch}"
    "/notebooks/{name}.ipynb",
}
#: What Binder installs; PyTorch without CUDA, for it has no graphics processor.
BINDER = """\
--extra-index-url https://download.pytorch.org/whl/cpu
{package}
"""
ROLE = re.compile(r":(?:attr|class|func|meth|mod):`(~?)([\w.]+)`")
_rst2md = notebook.rst2md


def repository() -> str | None:
    """Owner and name of the public repository, ``owner/name``; None where there is none."""
    return os.environ.get("GITHUB_REPOSITORY")


def package(at: str | None) -> str:
    """The requirement that pip installs: this version, as an archive or a release.

    GitHub's runners name the commit in ``GITHUB_SHA``.
    """
    if at is None:
        return f"tpgmm-torch[cli]=={version('tpgmm-torch')}"
    commit = os.environ.get("GITHUB_SHA", "HEAD")
    return f"tpgmm-torch[cli] @ https://github.com/{at}/archive/{commit}.tar.gz"


def first_cell(at: str | None) -> str:
    """The cell that installs the package where it is missing."""
    return (
        "from importlib.util import find_spec\n\n"
        'if find_spec("tpgmm_torch") is None:\n'
        f"    %pip install --quiet '{package(at)}'\n"
    )


def buttons(at: str, name: str) -> str:
    """HTML of the buttons that open the notebook ``name``."""
    links = (
        f'<a class="btn btn-sm btn-outline-primary" href="'
        f'{address.format(at=at, branch=BRANCH, name=name)}">Open in {service}</a>'
        for service, address in SERVICES.items()
    )
    return f'<p class="open-in">{" ".join(links)}</p>'


def rst2md(text: str, *settings: Any) -> str:
    """The gallery's own, after names of the API became code: ``:class:`~tpgmm_torch.Robot```.

    A name with ``~`` is shown by its last part, as on the site.
    """
    named = ROLE.sub(
        lambda role: f"`{role[2].rpartition('.')[2] if role[1] else role[2]}`", text
    )
    return _rst2md(named, *settings)


def _add_buttons(
    app: Sphinx, page: str, _template: str, context: dict[str, Any], _doctree: object
) -> None:
    """Below the heading of a page of the gallery."""
    folder, _, name = page.rpartition("/")
    if (at := repository()) and folder == "gallery" and name.startswith("plot_"):
        body: str = context["body"]
        context["body"] = body.replace("</h1>", f"</h1>\n{buttons(at, name)}", 1)


def _publish(app: Sphinx, failure: Exception | None) -> None:
    """Put notebooks where the buttons look for them, and what Binder is to install."""
    if failure is None and (at := repository()):
        site = Path(app.outdir)
        (site / "notebooks").mkdir(exist_ok=True)
        for path in sorted(Path(app.srcdir, "gallery").glob("plot_*.ipynb")):
            shutil.copy(path, site / "notebooks")
        (site / "binder").mkdir(exist_ok=True)
        text = BINDER.format(package=package(at))
        (site / "binder" / "requirements.txt").write_text(text, encoding="utf-8")


def setup(app: Sphinx) -> dict[str, Any]:
    """What Sphinx calls."""
    notebook.rst2md = rst2md
    app.connect("html-page-context", _add_buttons)
    app.connect("build-finished", _publish)
    return {"parallel_read_safe": True}
