"""Lens distortion and what else spoils pictures."""

import cv2
import numpy as np
import pytest

from lerobot_env_bimanual.eyes.lens import OVERSAMPLING, Imperfections, Lens, usual_camera
from tpgmm_torch.exceptions import DataError
from tpgmm_vision.camera import Camera

GREY = np.full((120, 160, 3), 128, np.uint8)


def centroid(picture):
    """Of what is bright [pixels]."""
    rows, columns = np.indices(picture.shape)
    weights = picture / picture.sum()
    return np.array(((columns * weights).sum(), (rows * weights).sum()))


def test_a_point_of_the_ideal_picture_is_where_the_camera_projects_it():
    camera = usual_camera(320, 240)
    lens = Lens(camera)
    focal_length = lens.size[1] / 2 / np.tan(np.radians(lens.fovy / 2))
    for x, y in ((0.0, 0.0), (-0.45, 0.3), (0.5, -0.35), (0.4, 0.36)):
        ideal = np.zeros((*lens.size[::-1], 3), np.float64)
        place = np.array((x, y)) * focal_length + (np.array(lens.size) - 1) / 2
        rows, columns = np.indices(ideal.shape[:2])
        away = ((columns - place[0]) ** 2 + (rows - place[1]) ** 2) / (2 * 3.0**2)
        spot = (255 * np.exp(-away)).astype(np.uint8)
        seen = lens(np.repeat(spot[..., None], 3, axis=2))[..., 0].astype(float)
        [wanted] = camera.project([[x, y, 1.0]])
        np.testing.assert_allclose(centroid(seen), wanted, atol=0.03)


def test_each_pixel_is_the_mean_over_its_area():
    lens = Lens(Camera(160, 120, (150.0, 150.0), (79.5, 59.5)))
    stripes = np.zeros((*lens.size[::-1], 3), np.uint8)
    stripes[:, ::OVERSAMPLING] = 200
    assert set(np.unique(lens(stripes))) <= {99, 100, 101}


def test_a_lens_that_needs_a_wider_picture_is_refused():
    with pytest.raises(DataError, match="cannot be drawn"):
        Lens(Camera(160, 120, (150.0, 150.0), (79.5, 59.5), (-0.4, 0.0, 0.0, 0.0, 0.0)))


def test_pictures_follow_from_the_seed():
    spoil = Imperfections()
    one, same, other = (spoil(GREY, np.random.default_rng(seed)) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()


def test_noise_is_what_it_says():
    rng = np.random.default_rng(0)
    noisy = Imperfections(noise=3.0)(GREY, rng).astype(float)
    assert noisy.std() == pytest.approx(3.0, rel=0.03)
    assert noisy.mean() == pytest.approx(128, abs=0.1)


def test_blur_spreads_a_point_by_so_much():
    point = np.zeros((61, 61, 3), np.uint8)
    point[30, 30] = 250
    large = cv2.resize(point, (305, 305), interpolation=cv2.INTER_NEAREST)
    blurred = Imperfections(blur=4.0, noise=0)(large, np.random.default_rng(0))[..., 0]
    rows = np.arange(305)
    weights = blurred.sum(axis=1) / blurred.sum()
    variance = (weights * rows**2).sum() - (weights * rows).sum() ** 2
    assert variance == pytest.approx(4.0**2 + 25 / 12, rel=0.1)
