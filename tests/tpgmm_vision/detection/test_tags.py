import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.support.drawn_tags import CAMERA, drawn
from tpgmm_torch.exceptions import DataError
from tpgmm_vision.detection.tags import TagDetector, grey
from tpgmm_vision.poses import rigid, transform
from tpgmm_vision.targets import FAMILIES, tag

FRONT = np.diag([1.0, -1, -1])  # of a tag that faces the camera


def poses(n, rng, distance):
    """Of tags that face the camera, tilted by up to 60 degrees."""
    for _ in range(n):
        axis = rng.normal(size=3) * [1, 1, 0.2]
        turn = Rotation.from_rotvec(
            np.radians(rng.uniform(10, 60)) * axis / np.linalg.norm(axis)
        )
        place = distance * np.array([rng.uniform(-0.3, 0.3), rng.uniform(-0.2, 0.2), 1])
        yield rigid(turn.as_matrix() @ FRONT, place)


@pytest.mark.parametrize(("blur", "noise"), [(0.5, 3.0), (0.9, 1.0), (0.6, 8.0)])
def test_corners_are_found_within_a_tenth_of_a_pixel(blur, noise):
    rng, errors = np.random.default_rng(0), []
    target = tag(7, 0.05)
    for pose in poses(20, rng, 0.7):
        picture = drawn(CAMERA, np.eye(4), [(target, pose)], rng, blur=blur, noise=noise)
        found = TagDetector(magnify=2)(picture)
        assert found.corners.keys() <= {7}
        if found.corners:
            expected = CAMERA.project(transform(pose, target.corners[7]))
            errors.append(np.linalg.norm(found.corners[7] - expected, axis=1))
            said = np.sqrt(np.trace(found.covariances[7]) / 4)
            assert said < 0.5
    assert len(errors) >= 17
    assert np.median(errors) < 0.06 and np.quantile(errors, 0.95) < 0.2


@pytest.mark.parametrize("family", FAMILIES)
def test_each_family_is_found_by_its_number(family):
    target, rng = tag(5, 0.08, family), np.random.default_rng(1)
    picture = drawn(CAMERA, np.eye(4), [(target, rigid(FRONT, (0.0, 0.0, 0.6)))], rng)
    assert list(TagDetector(family)(picture).corners) == [5]


def test_a_number_that_is_seen_twice_has_no_corners():
    rng, target = np.random.default_rng(2), tag(5, 0.06)
    places = [(target, rigid(FRONT, (x, 0.0, 0.6))) for x in (-0.1, 0.1)]
    found = TagDetector()(drawn(CAMERA, np.eye(4), places, rng))
    assert found.twice == {5} and not found.corners


def test_tags_are_found_in_boxes_as_in_the_whole_picture():
    rng, target = np.random.default_rng(3), tag(5, 0.06)
    picture = drawn(CAMERA, np.eye(4), [(target, rigid(FRONT, (0.05, 0.0, 0.6)))], rng)
    detector = TagDetector()
    whole = detector(picture).corners[5]
    low, high = whole.min(0).astype(int) - 20, whole.max(0).astype(int) + 20
    np.testing.assert_allclose(detector(picture, [(*low, *high)]).corners[5], whole, atol=0.02)
    assert not detector(picture, [(0, 0, 100, 100), (-20, -20, 5, 5)]).corners


def test_what_covers_a_part_of_a_tag_does_not_shift_its_corners():
    rng, target, pose = np.random.default_rng(4), tag(5, 0.06), rigid(FRONT, (0.0, 0.0, 0.7))
    expected, worst = CAMERA.project(transform(pose, target.corners[5])), 0.0
    for _ in range(40):
        picture = drawn(CAMERA, np.eye(4), [(target, pose)], rng)
        x, y = rng.uniform(expected.min(0), expected.max(0)).astype(int).tolist()
        cv2.circle(picture, (x, y), 9, (190, 140, 120), -1)
        if found := TagDetector(magnify=2)(picture).corners:
            worst = max(worst, np.abs(found[5] - expected).max())
    assert worst < 1.0


def test_an_empty_picture_has_no_tags_and_what_is_no_picture_is_refused():
    assert not TagDetector()(np.full((48, 64, 3), 120, np.uint8)).corners
    for wrong in (np.zeros((4, 4), float), np.zeros((0, 4), np.uint8), np.zeros(4, np.uint8)):
        with pytest.raises(DataError, match="a picture has shape"):
            grey(wrong)
