"""Summaries of recordings, against what was put into them."""

import numpy as np
import pytest

from tpgmm_datasets.checks.recording_summaries import RecordingSummary
from tpgmm_torch import Demonstration

TIME = np.arange(200) / 50


def summary(joints, **options):
    return RecordingSummary.of(Demonstration(TIME[: len(joints)], joints, **options))


def motion():
    return np.stack((np.sin(2 * TIME), 0.5 * np.cos(3 * TIME), 0.2 * TIME), axis=1)


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


@pytest.mark.parametrize("length", [1, 2])
def test_very_short_recordings_have_summaries(length):
    found = summary(motion()[:length])
    assert np.isfinite(found.fastest).all() and found.jumps == ()
