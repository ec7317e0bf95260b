"""``tpgmm camera print`` as a user types it."""

import json
import tomllib
from importlib import import_module
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from tests.support.pdf_pages import pdf_pages
from tpgmm_tools.cli.application import explain
from tpgmm_tools.cli.camera import app
from tpgmm_vision.targets import target_from

ROOT = Path(__file__).parents[3]


def test_it_writes_the_pages_and_says_what_the_cell_file_says(tmp_path):
    out = tmp_path / "new" / "targets.pdf"
    arguments = ["--tag", "0", "--tag", "1", "--cube", "10,11,12,13,14", "--board"]
    done = CliRunner().invoke(app, ["print", *arguments, "--size", "40", "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert len(pdf_pages(out)) == 3
    first, *lines = done.output.splitlines()
    assert first.startswith(str(out))
    targets = [target_from(json.loads(f"{{{line}}}")["target"]) for line in lines]
    assert [list(one.corners) for one in targets] == [[0], [1], [10, 11, 12, 13, 14]]
    edges = [corners[1] - corners[0] for one in targets for corners in one.corners.values()]
    np.testing.assert_allclose(np.linalg.norm(edges, axis=1), 0.04)


def test_numbers_of_a_cube_that_are_none_are_an_error_of_one_line():
    done = CliRunner().invoke(app, ["print", "--cube", "10;11"])
    assert explain(done.exception) == "--cube has numbers, as 10,11,12,13,14, got ['10;11']"


def test_tpgmm_finds_it():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    module, _, name = project["entry-points"]["tpgmm.commands"]["camera"].partition(":")
    assert getattr(import_module(module), name) is app
