"""Frames: units, order of quaternions, and places unlike the others."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tpgmm_datasets import check
from tpgmm_torch import Demonstration, Frame
from tpgmm_torch.robots import Poses

TIME = np.arange(40) / 20


def scene(places, turns=None):
    turns = np.tile([1.0, 0, 0, 0], (len(places), 1)) if turns is None else turns
    straight, names, shown = np.tile([1.0, 0, 0, 0], (40, 1)), Poses(("hand",)).joint_names, []
    for n, (place, turn) in enumerate(zip(places, turns, strict=True)):
        path = np.hstack((box(1, n) + 0.3 * np.cos(TIME)[:, None], straight))
        shown.append(Demonstration(TIME, path, {"cup": Frame(place, turn)}, names))
    return shown


def found(items, robot=None):
    return [(f.check, f.episodes) for f in check(items, robot)]


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
        assert found(scene(box(n, seed), turns), Poses(("hand",))) == []


def test_w_last_is_known_where_objects_turn_about_the_vertical():
    turns = about_z(8)
    assert found(scene(box(8), turns)) == []
    assert found(scene(box(8), np.roll(turns, -1, axis=1))) == [("quaternions", ())]


@pytest.mark.parametrize("wrong", [1, 2])
def test_up_to_a_fifth_of_bad_places_is_named(wrong):
    places = box(10)
    places[:wrong] += [0.0, 1.5, 0.0]
    assert found(scene(places)) == [("frames", tuple(range(wrong)))]
    places = box(10)
    places[:wrong] = 0.0  # as trackers say that they see nothing
    assert found(scene(places)) == [("frames", tuple(range(wrong)))]


def test_two_places_in_turn_are_no_outliers():
    places = box(10)
    places[::2] += [0.0, 1.5, 0.0]
    assert found(scene(places)) == []
