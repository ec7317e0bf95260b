"""Summaries of recordings, against what was put into them."""

import numpy as np
import pytest

from tpgmm_datasets.checks.recording_summaries import RecordingSummary
from tpgmm_torch import Demonstration, Frame

TIME = np.arange(200) / 50


def summary(joints, **options):
    return RecordingSummary.of(Demonstration(TIME[: len(joints)], joints, **options))


def motion():
    return np.stack((np.sin(2 * TIME), 0.5 * np.cos(3 * TIME), 0.2 * TIME), axis=1)


def test_speeds_and_paths_are_those_of_the_motion():
    found = summary(motion())
    assert found.gap[0] == pytest.approx(0.02)
    assert found.fastest == pytest.approx([2.0, 1.5, 0.2], rel=1e-2)
    assert np.array_equal(found.path[[0, -1]], motion()[[0, -1]])
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
    assert {plateau[:2] for plateau in summary(joints).plateaus} == {(0, 0.6)}
    share, back = np.clip(TIME - 1, 0, 1), np.clip(TIME - 3, 0, 1)
    joints[:, 0] = share**3 * (10 - 15 * share + 6 * share**2)
    joints[:, 0] -= back**3 * (10 - 15 * back + 6 * back**2)
    assert summary(joints).plateaus == ()


def test_a_frozen_value_is_still_while_others_move():
    joints = motion()
    joints[50:150, 1] = joints[50, 1]
    assert summary(joints).still == pytest.approx([0, 99 / 199, 0], abs=1e-3)
    joints[50:150] = joints[50]  # all stand still: a pause
    assert np.array_equal(summary(joints).still, np.zeros(3))


def test_frames_are_kept_once_or_at_equal_phases():
    positions, turn = np.zeros((200, 3)), np.tile([1.0, 0, 0, 0], (200, 1))
    positions[100:, 0] = 0.4
    found = summary(motion(), frames={"cup": Frame(positions, turn), "box": Frame([1, 2, 3])})
    assert found.leaps["cup"] == (pytest.approx(0.4), 0.0, TIME[100])
    assert found.turns["cup"].shape == (21, 4) and found.turns["box"].shape == (1, 4)


@pytest.mark.parametrize("length", [1, 2])
def test_very_short_recordings_have_summaries(length):
    found = summary(motion()[:length])
    assert np.isfinite(found.fastest).all() and found.jumps == ()
