import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.support.drawn_tags import CAMERA, look_at
from tpgmm_vision.detection.estimation import View, estimate_pose
from tpgmm_vision.poses import angle_between, inverse, rigid, transform
from tpgmm_vision.targets import cube, tag

EYE = look_at((0.9, 0.3, 0.6), (0.2, 0.0, 0.1))
SIDE = look_at((0.3, -0.9, 0.5), (0.2, 0.0, 0.1))
CUBE = cube([10, 11, 12, 13, 14], 0.04)


def seen(target, pose, rng, base_from_camera=EYE, std=0.05, numbers=None):
    """Corners of those tags that face the camera."""
    corners = {}
    for number, points in target.corners.items():
        there = transform(inverse(base_from_camera) @ pose, points)
        normal = np.cross(there[1] - there[0], there[3] - there[0])
        facing = normal @ there.mean(0) / np.linalg.norm(normal) / np.linalg.norm(there.mean(0))
        if facing > 0.3 and (numbers is None or number in numbers):
            corners[number] = CAMERA.project(there) + std * rng.standard_normal((4, 2))
    covariances = dict.fromkeys(corners, max(std, 0.01) ** 2 * np.eye(8))
    return View(CAMERA, base_from_camera, corners, covariances)


def upright(rng):
    """A pose on the table."""
    return rigid((0, 0, rng.uniform(-3, 3)), (*rng.uniform(0.1, 0.3, 2), 0.1))


def test_exact_corners_give_the_pose():
    rng = np.random.default_rng(0)
    for _ in range(20):
        pose = rigid(rng.normal(size=3), (0.2, 0.0, 0.1))
        views = [seen(CUBE, pose, rng, std=0.0)]
        if not views[0].corners:
            continue
        found = estimate_pose(views, CUBE)
        np.testing.assert_allclose(found.pose, pose, atol=1e-6)
        assert found.residual < 1e-6


def test_errors_are_as_large_as_the_covariance_says():
    rng, squares = np.random.default_rng(1), []
    for _ in range(200):
        pose = upright(rng)
        found = estimate_pose([seen(CUBE, pose, rng)], CUBE)
        turn = Rotation.from_matrix(found.pose[:3, :3] @ pose[:3, :3].T).as_rotvec()
        error = np.concatenate((found.pose[:3, 3] - pose[:3, 3], turn))
        squares.append(error @ np.linalg.solve(found.covariance, error))
    assert 4.5 < np.mean(squares) < 7.5  # of six numbers


def test_a_second_camera_and_what_is_known_make_it_more_certain():
    rng, pose = np.random.default_rng(2), rigid((0, 0, 0.4), (0.2, 0.0, 0.1))
    one, two = seen(CUBE, pose, rng), seen(CUBE, pose, rng, SIDE)
    alone = estimate_pose([one], CUBE)
    both = estimate_pose([one, two], CUBE)
    known = estimate_pose([one], CUBE, upright=True, height=0.1)
    for better in (both, known):
        assert np.trace(better.covariance[:3, :3]) < np.trace(alone.covariance[:3, :3])
    assert known.pose[2, 2] > np.cos(np.radians(0.5)) and abs(known.pose[2, 3] - 0.1) < 1e-3


def test_what_is_known_does_not_count_while_somebody_holds_it():
    rng, pose = np.random.default_rng(3), rigid((0.5, 0.2, 0), (0.2, 0.0, 0.25))
    found = estimate_pose([seen(CUBE, pose, rng)], CUBE, upright=True, height=0.1)
    assert found.valid and np.linalg.norm(found.pose[:3, 3] - pose[:3, 3]) < 0.003


def test_a_flat_tag_is_ambiguous_from_the_front_and_never_flipped_where_it_is_valid():
    rng, target, ambiguous = np.random.default_rng(4), tag(3, 0.05), 0
    for _ in range(200):
        tilt = rng.uniform(0, 70)
        axis = rng.normal(size=2)
        turn = Rotation.from_rotvec(
            np.radians(tilt) * np.append(axis / np.linalg.norm(axis), 0)
        )
        pose = EYE @ rigid(turn.as_matrix() @ np.diag([1.0, -1, -1]), (0.0, 0.0, 1.0))
        found = estimate_pose([seen(target, pose, rng, std=0.05)], target)
        if found.valid:
            assert angle_between(found.pose, pose) < np.radians(15)
        elif found.alternative is not None:
            ambiguous += 1
            nearest = min(angle_between(one, pose) for one in (found.pose, found.alternative))
            assert nearest < np.radians(15)
    assert 5 < ambiguous < 120


def test_a_tag_that_contradicts_the_others_is_left_out():
    rng, pose = np.random.default_rng(5), rigid((0, 0, -0.38), (0.2, 0.0, 0.1))
    view = seen(CUBE, pose, rng)
    assert len(view.corners) >= 3
    wrong = next(iter(view.corners))
    view.corners[wrong][:] += 8
    found = estimate_pose([view], CUBE)
    assert wrong not in found.tags and np.linalg.norm(found.pose[:3, 3] - pose[:3, 3]) < 0.004


@pytest.mark.parametrize("shift", [6.0, 20.0])
def test_corners_that_fit_no_square_are_not_valid(shift):
    rng, pose = np.random.default_rng(6), rigid((0, 0, 0.8), (0.2, 0.0, 0.1))
    view = seen(CUBE, pose, rng, numbers=[14])
    view.corners[14][2] += shift
    found = estimate_pose([view], CUBE)
    assert not found.valid and found.reason


def test_small_tags_are_too_uncertain_and_none_is_none():
    rng = np.random.default_rng(7)
    small, pose = tag(3, 0.012), rigid((0, 0, 0.8), (0.2, 0.0, 0.1))
    found = estimate_pose([seen(small, pose, rng, std=0.2)], small)
    assert not found.valid
    assert estimate_pose([View(CAMERA, EYE, {})], CUBE) is None
