import numpy as np
import pytest

from tests.support.drawn_tags import CAMERA
from tpgmm_torch.exceptions import DataError
from tpgmm_vision.camera import Camera


def test_rays_are_where_points_come_from():
    rng = np.random.default_rng(0)
    points = np.column_stack((rng.uniform(-0.5, 0.5, (50, 2)), np.ones(50)))
    np.testing.assert_allclose(CAMERA.rays(CAMERA.project(points)), points[:, :2], atol=1e-6)


def test_pixels_move_with_points_as_finite_differences_say():
    points = np.array([[0.1, -0.2, 0.8], [0.0, 0.1, 1.5]])
    pixels, rates = CAMERA.project_with_rates(points)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        moved = (CAMERA.project(points + step) - CAMERA.project(points - step)) / 2e-6
        np.testing.assert_allclose(rates[:, :, axis], moved, rtol=1e-5, atol=1e-4)
    np.testing.assert_array_equal(pixels, CAMERA.project(points))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((640, 480, (0.0, 5.0), (1.0, 1.0)), "above 0"),
        ((640, 480, (5.0,), (1.0, 1.0)), "focal_length of a camera is 2"),
        ((640, 480, (5.0, 5.0), (1.0, np.nan)), "principal_point"),
        ((640, 480, (5.0, 5.0), (1.0, 1.0), (0.0,)), "distortion"),
    ],
)
def test_what_is_no_camera_is_refused(arguments, message):
    with pytest.raises(DataError, match=message):
        Camera(*arguments)
