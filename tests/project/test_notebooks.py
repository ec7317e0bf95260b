"""Notebooks of the gallery install the package, run to their last cell, and can be read."""

import json
import os
import re
import subprocess
import sys
import tarfile
import tomllib
from copy import deepcopy
from importlib.metadata import version
from pathlib import Path
from unittest.mock import patch
from urllib.parse import unquote

import nbformat
import pytest
from IPython.core.interactiveshell import InteractiveShell
from nbclient import NotebookClient
from sphinx.application import Sphinx
from sphinx_gallery.gen_gallery import DEFAULT_GALLERY_CONF
from sphinx_gallery.notebook import jupyter_notebook
from sphinx_gallery.py_source_parser import split_code_and_text_blocks

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
#: One of each kind: a robot, two hands, a data set in files, alignment, what matters.
EXECUTED = (
    "plot_01_planar_arm",
    "plot_04_competing_constraints",
    "plot_07_lerobot_dataset",
    "plot_08_alignment",
    "plot_11_what_matters",
)
PACKAGES = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["hatch"][
    "build"
]["targets"]["wheel"]["packages"]
#: The line of a first cell that installs, and the requirement in it.
PIP = re.compile(r"^    %pip install --quiet '([^']+)'$", re.MULTILINE)
SCRIPTS = sorted((ROOT / "examples").glob("plot_*.py"))


@pytest.fixture
def extension(monkeypatch):
    """What the site changes of the gallery's conversion."""
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "_ext"))
    import notebooks

    monkeypatch.setattr("sphinx_gallery.notebook.rst2md", notebooks.rst2md)
    return notebooks


def converted(script: Path, extension) -> nbformat.NotebookNode:
    """A script as a notebook, by the gallery's own converter."""
    settings = deepcopy(DEFAULT_GALLERY_CONF) | {
        "first_notebook_cell": extension.first_cell(None)
    }
    _, cells = split_code_and_text_blocks(script)
    text = json.dumps(jupyter_notebook(cells, settings, script.parent))
    return nbformat.reads(text, as_version=4)


@pytest.mark.parametrize("name", EXECUTED)
def test_a_notebook_runs_and_shows_a_picture(name, extension, tmp_path, monkeypatch):
    for folder in (
        "JUPYTER_RUNTIME_DIR",
        "JUPYTER_CONFIG_DIR",
        "JUPYTER_DATA_DIR",
        "IPYTHONDIR",
    ):
        monkeypatch.setenv(folder, str(tmp_path / folder.lower()))
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel's own is to draw
    # a checkout comes before what is installed, as in the tests' own process
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
    notebook = converted(ROOT / "examples" / f"{name}.py", extension)
    resources = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=120, kernel_name="python3", resources=resources).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert any("image/png" in output.get("data", ()) for output in outputs)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_a_notebook_can_be_read(script, extension):
    install, title, *cells = converted(script, extension).cells
    assert PIP.search(install.source)[1] == f"tpgmm-torch[cli]=={version('tpgmm-torch')}"
    assert title.source.strip().startswith("# ")
    texts = [cell.source for cell in (title, *cells) if cell.cell_type == "markdown"]
    assert sum(text.strip().startswith("## ") for text in texts) >= 2
    for text in texts:
        assert not re.search(r":[a-z]+:`|^\.\. |^[-=]{4,}$", text, re.MULTILINE), text


@pytest.fixture
def site(tmp_path, monkeypatch):
    """Builds a site of one page of the gallery and another one, as from a public repository."""
    source = tmp_path / "docs"
    (source / "gallery").mkdir(parents=True)
    (source / "conf.py").write_text("extensions = ['notebooks']\n")
    (source / "index.rst").write_text("Home\n====\n\n.. toctree::\n\n   gallery/plot_arm\n")
    (source / "gallery" / "plot_arm.rst").write_text("Arm\n===\n\nOf two links.\n")
    (source / "gallery" / "plot_arm.ipynb").write_text("{}")
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "_ext"))
    monkeypatch.setattr("sphinx_gallery.notebook.rst2md", None)  # the extension replaces it

    def build(address: str | None) -> Path:
        if address is None:
            monkeypatch.delenv("GITHUB_REPOSITORY", raising=False)
        else:
            monkeypatch.setenv("GITHUB_REPOSITORY", address)
        out = tmp_path / f"html-{address is None}"
        Sphinx(source, source, out, tmp_path / "doctrees", "html", status=None).build()
        return out

    return build


def test_buttons_open_what_the_site_publishes(site):
    out = site("someone/tpgmm")
    page = (out / "gallery" / "plot_arm.html").read_text()
    links = re.findall(r'<a class="btn[^"]*" href="([^"]+)">Open in (\w+)</a>', page)
    assert [service for _, service in links] == ["Colab", "Binder", "Kaggle"]
    for address, _ in links:
        opened = unquote(address)
        assert "someone/tpgmm" in opened and "gh-pages" in opened
        assert (out / re.search(r"notebooks/\w+\.ipynb$", opened)[0]).is_file()
    assert "Open in" not in (out / "index.html").read_text()
    requirements = (out / "binder" / "requirements.txt").read_text()
    assert "github.com/someone/tpgmm/archive/" in requirements


def test_without_a_public_address_there_are_no_buttons(site):
    out = site(None)
    assert "Open in" not in (out / "gallery" / "plot_arm.html").read_text()
    assert not (out / "notebooks").exists()


@pytest.mark.parametrize("at", [None, "someone/tpgmm"])
def test_a_first_cell_installs_nothing_where_the_package_is(extension, at):
    shell = InteractiveShell.instance()
    with patch.object(shell, "run_line_magic", side_effect=AssertionError) as magic:
        shell.run_cell(extension.first_cell(at)).raise_error()
        absent = extension.first_cell(at).replace('"tpgmm_torch"', '"not_there"')
        with pytest.raises(AssertionError):
            shell.run_cell(absent, silent=True).raise_error()
    magic.assert_called_once()


def test_pip_installs_the_archive_that_a_hosted_notebook_names(
    extension, tmp_path, monkeypatch
):
    """The archive is of this tree, in the layout of GitHub's, and on this machine."""
    monkeypatch.setenv("GITHUB_SHA", "0123abc")
    requirement = PIP.search(extension.first_cell("someone/tpgmm"))[1]
    address = "https://github.com/someone/tpgmm/"
    assert requirement == f"tpgmm-torch[cli] @ {address}archive/0123abc.tar.gz"
    (tmp_path / "archive").mkdir()
    with tarfile.open(tmp_path / "archive" / "0123abc.tar.gz", "w:gz") as archive:
        for path in ("LICENSE", "README.md", "hatch_build.py", "pyproject.toml", *PACKAGES):
            archive.add(ROOT / path, f"tpgmm-0123abc/{path}")
    here = requirement.replace(address, f"{tmp_path.as_uri()}/")
    options = ("--no-deps", "--no-index", "--no-build-isolation", "--target", tmp_path / "site")
    command = [sys.executable, "-m", "pip", "install", "--quiet", *options, here]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for path in PACKAGES:
        assert (tmp_path / "site" / Path(path).name / "__init__.py").is_file()
