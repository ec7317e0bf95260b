"""Readings that are accepted, and those that are not."""

import numpy as np
import pytest

from tpgmm_control.sensing.trust import (
    ACCEPTED,
    FLIPPED,
    IMPOSSIBLE,
    JUMPED,
    LOST,
    OTHER_UNIT,
    JointReading,
    PoseReading,
    Trust,
)
from tpgmm_torch.exceptions import DataError

DEGREES = np.degrees(1.0)
DT = 0.02
TRUST = Trust()
UPPER = np.array([2.0, 1.0])
LIMITS = {"lower": -UPPER, "upper": UPPER, "velocity": np.array([1.0, 2.0])}
START = np.array([0.5, -0.3])
POSE = np.array([0.4, 0.1, 0.2, 1.0, 0.0, 0.0, 0.0])


def joints(value=START) -> JointReading:
    return JointReading.first(TRUST, value, **LIMITS)


def turned(angle: float) -> np.ndarray:
    return np.array([*POSE[:3], np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0])


def test_what_moves_as_a_robot_can_is_accepted():
    reading = joints()
    for k in range(50):
        seen = START + np.array([0.03, -0.01]) * (k + 1)
        reading = reading.update(seen, DT)
        assert reading.accepted
        assert reading.value.tolist() == seen.tolist()
        assert reading.age == 0


@pytest.mark.parametrize(
    ("seen", "fault"),
    [
        (None, LOST),
        ([np.nan, -0.3], LOST),
        ([np.inf, -0.3], LOST),
        ([0.5, -1.6], IMPOSSIBLE),
        ([0.9, -0.3], JUMPED),
        (DEGREES * START, IMPOSSIBLE),
    ],
)
def test_what_cannot_be_is_not_used(seen, fault):
    seen = None if seen is None else np.array(seen)
    reading = joints().update(seen, DT).update(seen, DT)
    assert reading.fault == fault
    assert reading.value.tolist() == START.tolist()
    assert reading.age == pytest.approx(2 * DT)
    back = reading.update(START + 0.01, DT)
    assert back.accepted
    assert back.age == 0


def test_a_jump_is_accepted_once_it_stays():
    reading, there = joints(), START + np.array([0.3, 0.45])
    for k in range(20):
        reading = reading.update(there + 0.001 * k, DT)
        # the first one begins the time for which it stays
        settled = k * DT >= TRUST.settling_time - 1e-9
        assert bool(reading.accepted) == settled
        assert bool(reading.jumped) == (settled and (k - 1) * DT < TRUST.settling_time - 1e-9)
    assert reading.age == 0
    assert np.abs(reading.value - there).max() < 0.02


@pytest.mark.parametrize("there", [[0.0, 0.0], START + 0.4, START + np.array([1.2, 0.6])])
def test_dead_frozen_and_far_readings_are_not_accepted_because_they_last(there):
    reading, pending = joints(), 0
    moves = np.array([1e-6, 0.0]) * (np.abs(there - START).max() > 1)
    for k in range(200):
        reading = reading.update(np.asarray(there) + k * moves, DT)
        assert not reading.accepted
        pending += int(reading.pending)
    assert reading.age == pytest.approx(200 * DT)
    if reading.fault == JUMPED:  # whoever knows that it may be there is asked now and then
        assert pending == pytest.approx(200 * DT / (2 * TRUST.settling_time), abs=2)
        assert reading.accept(np.asarray(True)).value.tolist() == reading.rival.tolist()
    assert reading.update(START, DT).accepted


def test_what_was_lost_for_long_may_be_elsewhere():
    reading, there = joints(), START + np.array([0.7, 0.6])
    assert not reading.update(there, DT).accepted
    for _ in range(50):
        reading = reading.update(None, DT)
    assert reading.update(there, DT).accepted


def test_a_reading_that_jumps_about_is_never_accepted():
    reading = joints()
    for k in range(50):
        reading = reading.update(START + (0.5 if k % 2 else -0.5), DT)
        assert not reading.accepted
    assert reading.age == pytest.approx(50 * DT)


def test_a_change_to_degrees_is_never_accepted():
    small = np.array([0.02, -0.015])
    wide = {"lower": np.full(2, -9.0), "upper": np.full(2, 9.0), "velocity": np.ones(2)}
    reading = JointReading.first(TRUST, small, **wide)
    for _ in range(50):
        reading = reading.update(DEGREES * small, DT)
        assert reading.fault == OTHER_UNIT
    assert reading.value.tolist() == small.tolist()


def test_a_robot_of_a_batch_does_not_know_of_the_others():
    start = np.stack([START, START, START])
    batch, alone = joints(start), [joints(), joints(), joints()]
    rng = np.random.default_rng(0)
    for k in range(60):
        seen = start + 0.02 * rng.standard_normal(start.shape)
        seen[1] += 0.7 if 10 < k < 40 else 0.0
        seen[2, 0] = np.nan if 20 < k < 35 else seen[2, 0]
        batch = batch.update(seen, DT)
        for robot in range(3):
            alone[robot] = alone[robot].update(seen[robot], DT)
            assert batch.value[robot].tolist() == alone[robot].value.tolist()
            assert batch.age[robot] == alone[robot].age
            assert batch.fault[robot] == alone[robot].fault


@pytest.mark.parametrize(
    ("seen", "fault"),
    [
        (POSE + 0.01, ACCEPTED),
        (turned(0.5), ACCEPTED),
        (turned(0.1 + 2 * np.pi), ACCEPTED),
        (turned(1.2), FLIPPED),
        (POSE + np.array([0.3, 0, 0, 0, 0, 0, 0]), JUMPED),
        (POSE * 1000, IMPOSSIBLE),
        (POSE * np.nan, LOST),
        (np.zeros(7), IMPOSSIBLE),
    ],
)
def test_poses(seen, fault):
    if fault == ACCEPTED:
        seen = np.concatenate((seen[:3], seen[3:] / np.linalg.norm(seen[3:])))
    reading = PoseReading.first(TRUST, POSE).update(seen, DT)
    assert reading.fault == fault
    if fault == ACCEPTED:
        return
    assert reading.value.tolist() == POSE.tolist()


def test_an_object_that_was_moved_is_found_where_it_stays():
    reading, there = PoseReading.first(TRUST, POSE), POSE + np.array([0.5, 0, 0, 0, 0, 0, 0])
    for _ in range(10):
        reading = reading.update(there, DT)
    assert reading.value.tolist() == there.tolist()


@pytest.mark.parametrize("axis", [4, 5, 6])
def test_a_flip_is_not_accepted_however_long_it_lasts_and_the_object_moves(axis):
    reading, flipped = PoseReading.first(TRUST, POSE), np.array(POSE)
    flipped[3:] = 0
    flipped[axis] = 1
    step = np.array([0.01, 0, 0, 0, 0, 0, 0])
    for k in range(100):
        reading = reading.update(flipped + k * step, DT)
        assert reading.fault == FLIPPED
        assert reading.age == pytest.approx((k + 1) * DT)
    assert reading.value[3:].tolist() == POSE[3:].tolist()
    assert reading.update(POSE + 100 * step, DT).accepted


def test_what_was_lost_while_it_was_turned_is_accepted():
    reading = PoseReading.first(TRUST, POSE)
    for _ in range(50):
        reading = reading.update(None, DT)
    assert reading.update(turned(2.0), DT).accepted


@pytest.mark.parametrize("name", vars(TRUST))
def test_settings_are_positive(name):
    with pytest.raises(DataError, match=f"{name} of Trust is a positive number"):
        Trust(**{name: 0.0})
