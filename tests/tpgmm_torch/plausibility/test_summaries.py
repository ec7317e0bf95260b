"""What is kept of a demonstration, against what was put into it."""

import numpy as np
import pytest

from tpgmm_torch import Affine, Demonstration, Frame
from tpgmm_torch.plausibility.summaries import (
    PHASES,
    EpisodeSummary,
    PoseSummary,
    quaternion_columns,
)

TIME = np.arange(200) / 50


def summary(joints, **options):
    return EpisodeSummary.of(Demonstration(TIME, joints, **options))


def motion():
    return np.stack((np.sin(2 * TIME), 0.5 * np.cos(3 * TIME), 0.2 * TIME), axis=1)


def test_ranges_speeds_and_paths_are_those_of_the_motion():
    found = summary(motion(), events={"grasp": 1.99}, joint_names=("a", "b", "c"))
    assert (found.begin, found.duration, found.n_steps) == (0.0, pytest.approx(3.98), 200)
    assert found.step == pytest.approx(0.02) and found.longest == pytest.approx(0.02)
    assert np.array_equal(found.low, motion().min(0))
    assert np.array_equal(found.high, motion().max(0))
    assert found.fastest == pytest.approx([2.0, 1.5, 0.2], rel=1e-2)
    assert found.path.shape == (PHASES, 3)
    assert np.array_equal(found.path[[0, -1]], motion()[[0, -1]])
    assert found.events == {"grasp": pytest.approx(0.5)}
    assert (found.wraps, found.jumps, found.plateaus) == ((), (), ())
    assert np.array_equal(found.still, np.zeros(3))


def test_wraps_and_jumps_are_found_where_they_are():
    joints = motion()
    joints[80:, 0] += 2 * np.pi
    joints[120, 1] += 0.8
    found = summary(joints)
    [(joint, at, size)] = found.wraps
    assert (joint, at) == (0, TIME[80]) and size == pytest.approx(2 * np.pi, abs=0.05)
    assert [(j, t) for j, t, _ in found.jumps] == [(1, TIME[120]), (1, TIME[121])]


def test_a_commanded_gripper_may_jump():
    joints = motion()
    joints[:, 2] = np.where(TIME > 2, 0.8, 0.0)
    assert summary(joints).jumps == ()


def test_a_cut_is_a_plateau_and_a_rest_is_none():
    joints = motion()
    joints[:, 0] = np.minimum(joints[:, 0], 0.6)
    assert set(summary(joints).plateaus) == {(0, 0.6)}
    share = np.clip(TIME - 1, 0, 1)
    rest = share**3 * (10 - 15 * share + 6 * share**2)
    back = np.clip(TIME - 3, 0, 1)
    joints[:, 0] = rest - back**3 * (10 - 15 * back + 6 * back**2)
    assert summary(joints).plateaus == ()


def test_a_frozen_value_is_still_while_others_move():
    joints = motion()
    joints[50:150, 1] = joints[50, 1]
    found = summary(joints)
    assert found.still == pytest.approx([0, 99 / 199, 0], abs=1e-3)
    joints[50:150] = joints[50]  # all stand still: a pause
    assert np.array_equal(summary(joints).still, np.zeros(3))


def test_frames_are_kept_once_or_at_equal_phases():
    positions = np.zeros((200, 3))
    positions[100:, 0] = 0.4
    turn = np.tile([1.0, 0, 0, 0], (200, 1))
    found = PoseSummary.of(Frame(positions, turn), TIME)
    assert found.positions.shape == (PHASES, 3)
    assert found.jump == (pytest.approx(0.4), 0.0, TIME[100])
    assert PoseSummary.of(Frame([1.0, 2, 3]), TIME).positions.tolist() == [[1.0, 2.0, 3.0]]


def test_general_task_parameters_are_no_poses():
    frames = {"cup": Frame([0, 0, 0]), "rail": Affine([[2.0]], [0.1])}
    assert list(summary(motion(), frames=frames).frames) == ["cup"]


def test_one_instant_and_two_have_summaries():
    for length in (1, 2):
        found = EpisodeSummary.of(Demonstration(TIME[:length], motion()[:length]))
        assert np.isfinite(found.fastest).all() and found.jumps == ()


def test_quaternions_among_the_columns():
    names = ["elbow", *(f"hand.{part}" for part in ("x", "y", "z", "qw", "qx", "qy", "qz"))]
    assert quaternion_columns(names, 8).tolist() == [False] * 4 + [True] * 4
    assert quaternion_columns(None, 8, (3,)).tolist() == [False] * 3 + [True] * 4 + [False]
