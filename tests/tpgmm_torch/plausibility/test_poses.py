"""Frames: units, order of quaternions, and what is unlike the others."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tpgmm_torch import Demonstration, Frame, Poses
from tpgmm_torch.plausibility.check import summarize
from tpgmm_torch.plausibility.poses import (
    angles_to,
    check_poses,
    mean_orientation,
    other_order,
)

TIME = np.arange(40) / 20
HAND = Poses(("hand",))


def scene(places, turns=None):
    turns = np.tile([1.0, 0, 0, 0], (len(places), 1)) if turns is None else turns
    path = np.tile([1.0, 0, 0, 0], (40, 1))
    return [
        Demonstration(
            TIME, np.hstack((p + 0.3 * np.cos(TIME)[:, None], path)), {"cup": Frame(p, q)}
        )
        for p, q in zip(places, turns, strict=True)
    ]


def found(items, robot=None):
    return [f.check for f in check_poses(summarize(items, robot), robot)]


def box(n, seed=0):
    return np.random.default_rng(seed).uniform([0.2, -0.2, 0.0], [0.5, 0.2, 0.1], (n, 3))


def about_z(n, seed=0, spread=0.5):
    angles = np.random.default_rng(seed).uniform(-spread, spread, n)
    return Rotation.from_rotvec(np.outer(angles, [0, 0, 1])).as_quat(scalar_first=True)


@pytest.mark.parametrize("seed", range(20))
def test_random_scenes_are_plausible(seed):
    n = 4 + seed % 7
    anyhow = Rotation.random(n, np.random.default_rng(seed)).as_quat()[:, [3, 0, 1, 2]]
    for turns in (about_z(n, seed), about_z(n, seed, np.pi), anyhow):
        assert found(scene(box(n, seed), turns), HAND) == []


def test_objects_too_far_for_the_robot_are_in_another_unit():
    items = scene(box(5))
    far = [
        Demonstration(d.time, d.joints, {"cup": Frame(100 * d.frames["cup"].position)})
        for d in items
    ]
    [finding] = check_poses(summarize(far, HAND), HAND)
    assert finding.check == "units" and "every link" in finding.message
    assert found(far) == ["units"]


def test_w_last_is_known_where_objects_turn_about_the_vertical():
    turns = about_z(8)
    assert found(scene(box(8), turns)) == []
    assert found(scene(box(8), np.roll(turns, -1, axis=1))) == ["quaternions"]
    assert np.allclose(other_order(np.roll(turns, -1, axis=1)), turns)


@pytest.mark.parametrize("wrong", [1, 2])
def test_up_to_a_fifth_of_bad_places_is_named(wrong):
    places = box(10)
    places[:wrong] += [0.0, 1.5, 0.0]
    [finding] = check_poses(summarize(scene(places), None), None)
    assert finding.episodes == tuple(range(wrong))


def test_two_places_in_turn_are_no_outliers():
    places = box(10)
    places[::2] += [0.0, 1.5, 0.0]
    assert found(scene(places)) == []


def test_the_mean_orientation_knows_no_signs():
    turns = about_z(9, spread=0.8)
    mean = mean_orientation(turns)
    flipped = turns * np.where(np.arange(9) % 2, -1, 1)[:, None]
    assert angles_to(mean_orientation(flipped), mean) == pytest.approx(0, abs=1e-6)
    reference = Rotation.from_quat(turns, scalar_first=True).mean().as_quat(scalar_first=True)
    assert angles_to(mean, reference) == pytest.approx(0, abs=1e-6)
