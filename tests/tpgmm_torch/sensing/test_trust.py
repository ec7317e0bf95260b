"""Readings that are believed, and those that are not."""

import numpy as np
import pytest

from tpgmm_torch.exceptions import DataError
from tpgmm_torch.sensing.trust import (
    BELIEVED,
    DEGREES,
    IMPOSSIBLE,
    JUMPED,
    LOST,
    OTHER_UNIT,
    JointReading,
    PoseReading,
    Trust,
)

DT = 0.02
TRUST = Trust()
LIMITS = (np.array([-2.0, -1.0]), np.array([2.0, 1.0]), np.array([1.0, 2.0]))
START = np.array([0.5, -0.3])
POSE = np.array([0.4, 0.1, 0.2, 1.0, 0.0, 0.0, 0.0])


def joints(value=START) -> JointReading:
    return JointReading.of(TRUST, value, LIMITS)


def turned(angle: float) -> np.ndarray:
    return np.array([*POSE[:3], np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0])


def test_what_moves_as_a_robot_can_is_believed():
    reading = joints()
    for k in range(50):
        heard = START + np.array([0.03, -0.01]) * (k + 1)
        reading = reading.hear(heard, DT)
        assert reading.believed
        assert reading.value.tolist() == heard.tolist()
        assert reading.age == 0


@pytest.mark.parametrize(
    ("heard", "why"),
    [
        (None, LOST),
        ([np.nan, -0.3], LOST),
        ([np.inf, -0.3], LOST),
        ([0.5, -1.6], IMPOSSIBLE),
        ([0.9, -0.3], JUMPED),
        (DEGREES * START, IMPOSSIBLE),
    ],
)
def test_what_cannot_be_is_not_used(heard, why):
    heard = None if heard is None else np.array(heard)
    reading = joints().hear(heard, DT).hear(heard, DT)
    assert reading.why == why
    assert reading.value.tolist() == START.tolist()
    assert reading.age == pytest.approx(2 * DT)
    back = reading.hear(START + 0.01, DT)
    assert back.believed
    assert back.age == 0


def test_a_jump_is_believed_once_it_stays():
    reading, there = joints(), START + np.array([0.9, 0.6])
    for k in range(20):
        reading = reading.hear(there + 0.001 * k, DT)
        # the first one begins the time for which it stays
        settled = k * DT >= TRUST.settling - 1e-9
        assert bool(reading.believed) == settled
    assert reading.age == 0
    assert np.abs(reading.value - there).max() < 0.02


def test_a_reading_that_jumps_about_is_never_believed():
    reading = joints()
    for k in range(50):
        reading = reading.hear(START + (0.5 if k % 2 else -0.5), DT)
        assert not reading.believed
    assert reading.age == pytest.approx(50 * DT)


def test_a_change_to_degrees_is_never_believed():
    small = np.array([0.02, -0.015])
    wide = (np.full(2, -9.0), np.full(2, 9.0), np.ones(2))
    reading = JointReading.of(TRUST, small, wide)
    for _ in range(50):
        reading = reading.hear(DEGREES * small, DT)
        assert reading.why == OTHER_UNIT
    assert reading.value.tolist() == small.tolist()


def test_a_robot_of_a_batch_does_not_know_of_the_others():
    start = np.stack([START, START, START])
    batch, alone = joints(start), [joints(), joints(), joints()]
    rng = np.random.default_rng(0)
    for k in range(60):
        heard = start + 0.02 * rng.standard_normal(start.shape)
        heard[1] += 0.7 if 10 < k < 40 else 0.0
        heard[2, 0] = np.nan if 20 < k < 35 else heard[2, 0]
        batch = batch.hear(heard, DT)
        for robot in range(3):
            alone[robot] = alone[robot].hear(heard[robot], DT)
            assert batch.value[robot].tolist() == alone[robot].value.tolist()
            assert batch.age[robot] == alone[robot].age
            assert batch.why[robot] == alone[robot].why


@pytest.mark.parametrize(
    ("heard", "why"),
    [
        (POSE + 0.01, BELIEVED),
        (turned(0.5), BELIEVED),
        (turned(0.1 + 2 * np.pi), BELIEVED),
        (turned(1.2), JUMPED),
        (POSE + np.array([0.3, 0, 0, 0, 0, 0, 0]), JUMPED),
        (POSE * 1000, IMPOSSIBLE),
        (POSE * np.nan, LOST),
        (np.zeros(7), IMPOSSIBLE),
    ],
)
def test_poses(heard, why):
    if why == BELIEVED:
        heard = np.concatenate((heard[:3], heard[3:] / np.linalg.norm(heard[3:])))
    reading = PoseReading.of(TRUST, POSE).hear(heard, DT)
    assert reading.why == why
    if why == BELIEVED:
        return
    assert reading.value.tolist() == POSE.tolist()


def test_an_object_that_was_moved_is_found_where_it_stays():
    reading, there = PoseReading.of(TRUST, POSE), POSE + np.array([0.5, 0, 0, 0, 0, 0, 0])
    for _ in range(10):
        reading = reading.hear(there, DT)
    assert reading.value.tolist() == there.tolist()


@pytest.mark.parametrize("name", vars(TRUST))
def test_settings_are_positive(name):
    with pytest.raises(DataError, match=f"{name} of Trust is a positive number"):
        Trust(**{name: 0.0})
