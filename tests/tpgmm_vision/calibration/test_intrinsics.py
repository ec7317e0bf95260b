"""A camera's intrinsics by rendered pictures of a board, and pictures that do not tell."""

import numpy as np
import pytest

from tests.support.rendered_boards import BoardCamera, ray_error
from tests.support.simulated_cells import CAMERA
from tpgmm_torch.exceptions import DataError
from tpgmm_vision.calibration.intrinsics import calibrate_camera
from tpgmm_vision.targets import Board


@pytest.fixture(scope="module")
def eye():
    return BoardCamera(CAMERA, Board())


@pytest.fixture(scope="module")
def pictures(eye):
    return eye.pictures(14, np.random.default_rng(1))


def test_rays_are_right_and_the_error_is_said(pictures):
    found = calibrate_camera(pictures, Board())
    assert ray_error(found.camera, CAMERA) < 0.0003
    assert np.abs(np.subtract(found.camera.principal_point, CAMERA.principal_point)).max() < 1
    assert found.camera.distortion[4] == 0
    assert 0.01 < found.pixel_error < 0.15
    assert not found.problems
    assert str(found).startswith("focal length 55") and "from 14 pictures" in str(found)


def test_what_is_missing_is_said(eye, pictures):
    rng, some = np.random.default_rng(0), dict(list(pictures.items())[:7])
    blank = {f"blank {k}.png": np.full((480, 640), 90, np.uint8) for k in range(3)}
    with pytest.raises(
        DataError, match=r"7 of 10 .* it is missing in \['blank 0.png', 'blank 1"
    ):
        calibrate_camera(some | blank, Board())
    with pytest.raises(DataError, match="one size"):
        calibrate_camera(some | {"small.png": np.zeros((240, 320), np.uint8)}, Board())
    frontal = eye.pictures(9, rng, tilt=(0, 3))
    with pytest.raises(DataError, match=r"do not tell the focal length .* differ by . deg"):
        calibrate_camera(frontal, Board())
    with pytest.raises(DataError, match=r"of the picture.s 4 x 4 fields, .* near the edges"):
        calibrate_camera(dict.fromkeys("abcdefgh", eye.picture(eye.pose(rng), rng)), Board())


def test_a_stretched_print_and_pictures_without_a_board_are_said():
    stretched = BoardCamera(CAMERA, Board(), stretch=1.01)
    shown = stretched.pictures(12, np.random.default_rng(1))
    found = calibrate_camera(shown | {"blank.png": np.zeros((480, 640), np.uint8)}, Board())
    left_out, stretch = found.problems
    assert "['blank.png']" in left_out
    assert "is the print stretched" in stretch
