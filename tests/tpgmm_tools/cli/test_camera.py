"""``tpgmm camera print`` as a user types it."""

import inspect
import json
import subprocess
import sys

import numpy as np

from tests.support.command_line import output, refusal
from tests.support.pdf_pages import pdf_pages
from tpgmm_tools.cli import camera
from tpgmm_vision.printing import print_targets
from tpgmm_vision.targets import target_from


def test_it_writes_the_pages_and_says_what_the_cell_file_says(tmp_path):
    out = tmp_path / "new" / "targets.pdf"
    arguments = ["--tag", "0", "--tag", "1", "--cube", "10,11,12,13,14", "--board"]
    text = output("camera", "print", *arguments, "--size", "40", "--out", out)
    assert len(pdf_pages(out)) == 3
    first, *lines = text.splitlines()
    assert first.startswith(str(out))
    targets = [target_from(json.loads(f"{{{line}}}")["target"]) for line in lines]
    assert [list(one.corners) for one in targets] == [[0], [1], [10, 11, 12, 13, 14]]
    edges = [corners[1] - corners[0] for one in targets for corners in one.corners.values()]
    np.testing.assert_allclose(np.linalg.norm(edges, axis=1), 0.04)


def test_numbers_of_a_cube_that_are_none_are_an_error_of_one_line():
    said = refusal("camera", "print", "--cube", "10;11")
    assert said == "tpgmm: --cube has numbers, as 10,11,12,13,14, got ['10;11']"


def test_tags_are_those_that_are_usual():
    """The name is stated once more, so that the help loads no OpenCV."""
    stated = inspect.signature(camera.print).parameters["family"].default
    assert stated == inspect.signature(print_targets).parameters["family"].default


def test_tpgmm_finds_it_and_names_the_extra_that_it_needs():
    assert "Print tags and boards for cameras." in output("camera", "--help")
    assert "Write tags, nets of cubes" in output("camera", "print", "--help")
    script = """
import sys
sys.modules["cv2"] = None  # as if it were not installed
sys.argv = ["tpgmm", "camera", "print", "--board"]
from tpgmm_tools.cli import main
main()
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    said = "tpgmm: poses from cameras need OpenCV: pip install 'tpgmm-torch[vision]'\n"
    assert (done.returncode, done.stderr) == (2, said)
