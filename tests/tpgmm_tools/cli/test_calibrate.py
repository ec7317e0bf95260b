"""``tpgmm calibrate`` as a user types it: from pictures and a recorded set to a cell file."""

import json
import re

import cv2
import numpy as np
import pytest

from tests.support.command_line import output, refusal
from tests.support.rendered_boards import BoardCamera
from tests.support.simulated_cells import CAMERA, HAND, record, so101_cell
from tpgmm_vision.cell import camera_content, read_cell, write_cell
from tpgmm_vision.poses import angle_between
from tpgmm_vision.targets import Board

pytestmark = pytest.mark.slow

KEY = "observation.images.front"
CUBE = "cube:10,11,12,13,14:0.03"


@pytest.fixture(scope="module")
def waving(tmp_path_factory):
    rng = np.random.default_rng(5)
    cell = so101_cell(1.0, rng, pixels=0.0)
    root = tmp_path_factory.mktemp("waving") / "set"
    return cell, record(root, cell, cell.postures(16, rng), rng)


@pytest.fixture
def written(tmp_path):
    path = tmp_path / "cell.json"
    cup = {"target": {"tag": 3, "size": 0.04}, "upright": True}
    front = camera_content(CAMERA, KEY)
    write_cell({"cameras": {"front": front}, "objects": {"cup": cup}}, path)
    return path


def test_a_cell_is_calibrated_by_a_recorded_set(waving, written, tmp_path):
    cell, path = waving
    out = tmp_path / "pictures"
    arguments = ["--robot", "so101", "--units", "deg", "--hand", f"{HAND}={CUBE}"]
    text = output("calibrate", "cell", path, "--cell", written, *arguments, "--out", out)
    assert re.search(r"1[56] postures; error between object and hand", text)
    found = read_cell(written)
    pose, true = found.cameras["front"].pose, cell.cameras["front"][0]
    assert np.linalg.norm(pose[:3, 3] - true[:3, 3]) < 0.02
    assert angle_between(pose, true) < np.radians(3)
    assert found.joints == cell.robot.joint_names
    assert "shoulder_lift" in found.joint_offsets
    assert found.objects["cup"].upright  # what was written by hand stays
    pictures = [cv2.imread(str(one)) for one in sorted(out.iterdir())]
    assert len(pictures) in (15, 16)
    orange, green = (
        sum(((one.astype(int) * sign).sum(-1) > 100).sum() for one in pictures)
        for sign in ((-1, 0, 1), (-1, 2, -1))
    )
    assert orange > 100 and green > 100


def test_what_the_options_get_wrong_is_said_and_nothing_is_written(waving, written, tmp_path):
    _, path = waving
    before = written.read_text()
    place = "--cell", written, "--out", tmp_path / "none"
    arguments = "calibrate", "cell", path, *place, "--robot", "so101"
    for options, said in (
        (["--hand", f"{HAND}=cube"], "tags are described as"),
        (["--units", "deg"], "tags in its hand (--hand)"),
        (["--units", "deg", "--hand", f"hand={CUBE}"], "'hand'"),
        (["--units", "deg", "--hand", f"{HAND}={CUBE}", "--camera", "side"], "'side'"),
        (["--units", "deg", "--hand", f"{HAND}=tag:7:0.04"], "sees tags of"),
        (["--units", "deg", *2 * ["--hand", f"{HAND}={CUBE}"]], "each target once"),
    ):
        assert said in refusal(*arguments, *options)
    other = json.loads(before) | {"joints": ["a", "b"]}
    write_cell(other, written)
    message = refusal(*arguments, "--units", "deg", "--hand", f"{HAND}={CUBE}")
    assert "is of a robot with joints ['a', 'b']" in message
    assert json.loads(written.read_text()) == other
    assert not (tmp_path / "none").exists()


def test_a_camera_is_calibrated_by_a_folder_of_pictures(written, tmp_path):
    folder, rng = tmp_path / "board", np.random.default_rng(1)
    folder.mkdir()
    for name, picture in BoardCamera(CAMERA, Board()).pictures(10, rng).items():
        cv2.imwrite(str(folder / name), picture)
    given = "--name", "wrist", "--cell", written
    text = output("calibrate", "camera", folder, *given, "--link", HAND)
    assert "wrist: focal length 55" in text
    found = read_cell(written)
    assert found.cameras["wrist"].key == "observation.images.wrist"
    assert found.cameras["wrist"].link == HAND
    assert list(found.objects) == ["cup"]
    message = refusal("calibrate", "camera", tmp_path / "none.mp4", *given)
    assert "none.mp4 is no folder of pictures and no video" in message
