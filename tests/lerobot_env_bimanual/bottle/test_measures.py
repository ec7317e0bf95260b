"""When hands close, and how a rhythm is found in a motion."""

import math

import numpy as np
import pytest

from lerobot_env_bimanual.bottle import measures

RATE = 50
NOMINAL = 2 / 3


def closes(gaps, rate=RATE):
    """The number of the step at which hands with these gaps close; None if they never do."""
    closing = measures.Closing()
    for step, gap in enumerate(gaps):
        if closing.update(step / rate, gap):
            return step
    return None


def approach(seconds, rest=0.0, start=0.06, wait=1.0, rate=RATE):
    """Gaps of a minimum-jerk approach that stops at ``rest`` and waits."""
    u = np.linspace(0, 1, round(seconds * rate))
    travel = u**3 * (10 - 15 * u + 6 * u**2)
    return np.concatenate((start + (rest - start) * travel, np.full(round(wait * rate), rest)))


@pytest.mark.parametrize("rate", [10, 25, 50, 100])
@pytest.mark.parametrize("seconds", [0.5, 1.2, 2.0, 8.0])
def test_hands_close_once_they_have_arrived(seconds, rate):
    gaps = approach(seconds, rate=rate)
    step = closes(gaps, rate)
    assert gaps[step] < 0.0015
    assert step / rate <= seconds + 0.31  # the demonstrations wait for at least 0.36 s


def test_hands_close_as_late_as_the_later_one():
    both = np.maximum(approach(1.0, wait=4), np.pad(approach(1.0), (150, 0), mode="edge"))
    assert both[closes(both)] < 0.001


def test_hands_that_stop_short_close_only_within_reach():
    assert closes(approach(1.0, rest=0.014)) is not None
    assert closes(approach(1.0, rest=0.016)) is None


def test_hands_that_pass_by_do_not_close():
    time = np.arange(100) / RATE
    for speed, closest in ((0.15, -0.01), (0.08, 0.0), (0.05, 0.01)):
        assert closes(closest + speed * abs(time - 1)) is None


def test_hands_that_tremble_close():
    tremor = 0.001 * np.sin(np.arange(150))
    step = closes(approach(1.0, wait=2.0) + tremor)
    assert step is not None and step < 100


def test_hands_that_leave_have_to_arrive_again():
    gaps = np.concatenate((np.full(9, 0.001), np.full(30, 0.02), np.full(30, 0.005)))
    assert closes(gaps) == 49
    assert closes(np.full(30, -0.002)) == 10  # pressed in


def wave(seconds, frequency=NOMINAL, amplitude=0.25, rate=RATE):
    time = np.arange(round(seconds * rate)) / rate
    return amplitude * np.sin(2 * np.pi * frequency * time + 0.3)


@pytest.mark.parametrize("rate", [25, 50, 100])
@pytest.mark.parametrize("frequency", [0.5, NOMINAL, 0.9, 1.2])
def test_a_rhythm_is_found_between_other_motions(frequency, rate):
    shaken = wave(5, frequency, rate=rate)
    bring = 0.6 * np.concatenate((np.linspace(0, 1, 3 * rate) ** 2, np.ones(rate)))
    rest = np.full(2 * rate, 0.6)
    left = np.concatenate((bring, 0.6 + shaken, rest))
    right = np.concatenate((-bring, 0.8 * shaken - 0.6, rest))  # which jumps
    found = measures.find_shaking(np.stack((left, right), axis=1), rate, NOMINAL)
    assert found.frequency == pytest.approx(frequency, rel=0.01)
    np.testing.assert_allclose(found.amplitudes, (0.25, 0.2), rtol=0.02)
    assert 3.8 <= found.start / rate <= 6.2


def test_drift_and_noise_hardly_matter():
    rng = np.random.default_rng(0)
    both = np.stack((wave(8), -wave(8)), axis=1) + np.linspace(0, 0.4, 400)[:, None]
    found = measures.find_shaking(both + rng.normal(0, 0.02, both.shape), RATE, NOMINAL)
    assert found.frequency == pytest.approx(NOMINAL, rel=0.01)
    np.testing.assert_allclose(found.amplitudes, 0.25, rtol=0.03)


def test_no_rhythm_has_no_amplitude():
    assert measures.find_shaking(np.zeros((400, 2)), RATE, NOMINAL).amplitudes.max() == 0
    line = np.linspace(0, 1, 400)[:, None].repeat(2, axis=1)
    assert measures.find_shaking(line, RATE, NOMINAL).amplitudes.max() < 1e-9
    assert np.isfinite(measures.find_shaking(line, RATE, NOMINAL).frequency)


@pytest.mark.parametrize("steps", [0, 1, 149])
def test_less_than_two_periods_are_too_short(steps):
    found = measures.find_shaking(np.ones((steps, 2)), RATE, NOMINAL)
    assert found.frequency == 0 and not found.amplitudes.any()
    assert found.start == 0


def test_success_needs_every_figure():
    good = {name: f.high if f.low == 0 else f.low for name, f in measures.FIGURES.items()}
    assert measures.successful({**good, "frequency_hz": 0.0})
    for name, f in measures.FIGURES.items():
        beyond = math.nextafter(f.high, math.inf) if f.low == 0 else math.nextafter(f.low, 0)
        assert not measures.successful({**good, name: beyond})
        assert not measures.successful({**good, name: math.nan})
