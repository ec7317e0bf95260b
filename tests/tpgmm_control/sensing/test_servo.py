"""Lags, offsets and gaps that neither explains, of joints with known servos."""

from collections.abc import Callable

import numpy as np
import pytest

from tpgmm_control.sensing.servo import Servo

DT = 0.02
ALL, NONE = np.array([True]), np.array([False])


def swing(time: float) -> np.ndarray:
    """A reference that moves and rests, at most 0.8 rad/s."""
    return np.array([0.4 * np.sin(2 * np.clip(time, 0.0, 7.0)) ** 2])


def followed(
    lag: float,
    seconds: float = 6.0,
    dt: float = DT,
    reading: Callable[[float, np.ndarray, np.random.Generator], np.ndarray] | None = None,
    learns: bool = True,
) -> tuple[Servo, list[Servo]]:
    """A joint with a servo of second order, and its model at each tick."""
    servo, rng = Servo.start(swing(0.0)), np.random.default_rng(0)
    first = second = swing(0.0)
    seen = []
    for tick in range(round(seconds / dt)):
        reference, time = swing(tick * dt), (tick + 1) * dt
        left, behind = np.exp(-2 * dt / lag), first - reference
        second = reference + left * (second - reference + 2 * dt / lag * behind)
        first = reference + left * behind
        y = second if reading is None else reading(time, second, rng)
        servo.advance(reference, y, dt, jumped=False, learns=learns)
        seen.append(servo.copy())
    return servo, seen


def test_the_bank_does_not_depend_on_the_length_of_ticks():
    posture, reference = np.zeros(2), np.array([0.3, -0.2])
    whole, parts = Servo.start(posture), Servo.start(posture)
    whole.advance(reference, reference, 0.06, jumped=False, learns=False)
    for dt in (0.01, 0.03, 0.02):
        parts.advance(reference, reference, dt, jumped=False, learns=False)
    np.testing.assert_allclose(parts.bank.first, whole.bank.first, atol=1e-12)
    np.testing.assert_allclose(parts.bank.second, whole.bank.second, atol=1e-12)


@pytest.mark.parametrize("dt", [0.002, 0.02, 0.04])
@pytest.mark.parametrize("lag", [0.02, 0.08, 0.2, 0.4])
def test_a_lag_is_learned_and_is_no_gap(lag, dt):
    servo, seen = followed(lag, dt=dt)
    assert servo.lag[0] == pytest.approx(lag, rel=0.6)
    assert max(float(one.judgement.excess.max()) for one in seen) < 1
    assert np.abs(servo.gaps.mean).max() < 0.03


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.03])
@pytest.mark.parametrize("offset", [0.05, -0.08])
def test_an_offset_is_learned_from_motion(offset, noise):
    servo, seen = followed(
        0.08, reading=lambda time, x, rng: x + offset + noise * rng.standard_normal(x.shape)
    )
    assert servo.offset.mean[0] == pytest.approx(offset, abs=0.02)
    assert max(float(one.judgement.excess.max()) for one in seen[100:]) < 1
    assert servo.std[0] == pytest.approx(noise, rel=0.5, abs=1e-3)


def test_a_joint_that_stops_is_neither_late_nor_off():
    seen = []

    def stopped(time, x, rng):
        seen.append(x if time < 3.2 else seen[-1])
        return seen[-1]

    before, _ = followed(0.08, 3.2)
    servo, _ = followed(0.08, 4.0, reading=stopped)
    assert servo.lag[0] == pytest.approx(before.lag[0], abs=0.03)
    assert np.abs(servo.offset.mean - before.offset.mean).max() < 0.02
    assert servo.judgement.excess.max() > 2


def test_what_nobody_learns_stays():
    servo, _ = followed(0.08, reading=lambda time, x, rng: x + 0.05, learns=False)
    assert not servo.offset.mean.any()
    assert not np.ptp(servo.bank.score)


def test_single_outliers_are_no_gaps():
    _, seen = followed(0.08, reading=lambda time, x, rng: x + 0.5 * (abs(time - 3.0) < DT / 2))
    assert max(float(np.abs(one.gaps.mean).max()) for one in seen) < 0.03


def test_a_gap_becomes_an_offset_at_once():
    servo, _ = followed(0.08, 0.1, reading=lambda time, x, rng: x + 0.3, learns=False)
    taken, untouched = servo.copy(), servo.copy()
    taken.take_offsets(ALL)
    untouched.take_offsets(NONE)
    assert taken.offset.mean[0] == pytest.approx(servo.gaps.mean[0])
    assert not taken.gaps.mean.any()
    assert untouched.offset.mean.tolist() == servo.offset.mean.tolist()


def test_joints_without_readings_have_no_gaps():
    servo, _ = followed(0.3, reading=lambda time, x, rng: np.full_like(x, np.nan))
    assert not servo.gaps.mean.any()
    assert servo.judgement.usual.min() > 0
