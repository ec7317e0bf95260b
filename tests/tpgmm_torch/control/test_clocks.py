"""Clocks: even, waiting; robots that lag, or are held."""

import math

import pytest
import torch
from torch import Tensor

from tests.support.servos import Run, held
from tests.support.skills import LAST, canonical, hands, new_handling, wave, waves
from tpgmm_torch.control.clock_text import format_clock
from tpgmm_torch.control.clocks import (
    Clock,
    EvenClock,
    WaitingClock,
)
from tpgmm_torch.control.localizing_clock import LocalizingClock
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.skills.skill import Observation

START = wave(torch.zeros(1, dtype=torch.float64))[0]
WAITING, LOCALIZING = WaitingClock(), LocalizingClock()


@pytest.fixture(scope="module")
def regression() -> Regression:
    """Three joints that move by up to 3 rad/s, for two seconds."""
    return canonical(reg_covar=1e-6).fit(waves(4, 60)).skill


def begun(regression: Regression, clock: Clock, *batch: int, **options) -> Run:
    return Run(regression, clock, 0.0, LAST, START.expand(*batch, 3), **options)


def seen(joints: Tensor | None, reference: Tensor = START) -> Observation:
    return Observation(joints, reference, None, {})


@pytest.mark.parametrize("clock", [EvenClock(), WAITING, LOCALIZING], ids=format_clock)
def test_numbers_of_single_precision_are_those_of_double(regression, clock):
    """And a driver that writes what it measures into the same memory disturbs nothing."""
    times = []
    for dtype in (torch.float64, torch.float32):
        joints = START.to(dtype).clone()
        progress = clock.start(regression, joints, {}, 0.0, LAST)
        for k in range(30):
            joints += 0.0187
            progress = progress.advance(0.01 * (k % 3), seen(joints, START.to(dtype)))
        times.append(float(progress.time))
        assert progress.time.dtype == torch.float64
    assert times[0] == pytest.approx(times[1], abs=1e-4)
    ahead = progress.advance(0.1, seen(joints))
    joints -= 5.0
    assert torch.equal(progress.advance(0.1, seen(joints + 5.0)).time, ahead.time)


# Even


@pytest.mark.parametrize("speed", [1.0, 0.5, 3.0])
def test_even_time_is_dt_times_the_speed_for_all_robots_alike(regression, speed):
    progress = EvenClock(speed).start(regression, START.expand(5, 3), {}, 0.2, 1.4)
    for k in range(1, 4):
        progress = progress.advance(0.1, seen(START.expand(5, 3) + 9.0))
        assert progress.time.shape == ()
        assert float(progress.time) == pytest.approx(0.2 + speed * 0.1 * k, rel=1e-12)
        assert not progress.relocalized


def test_a_robot_on_hold_has_a_time_of_its_own(regression):
    progress = EvenClock().start(regression, START.expand(2, 3), {}, 0.0, 0.25)
    step = torch.tensor([0.1, 0.0], dtype=torch.float64)
    for _ in range(2):
        progress = progress.advance(step, seen(None))
    assert progress.time.tolist() == pytest.approx([0.2, 0.0])
    progress = progress.advance(0.1, seen(None))
    assert progress.time.tolist() == pytest.approx([0.25, 0.1])
    assert progress.finished.tolist() == [True, False]


@pytest.mark.parametrize("clock", [EvenClock(), WAITING, LOCALIZING], ids=format_clock)
def test_the_end_is_reached_and_held(regression, clock):
    progress = clock.start(regression, START, {}, 0.0, 0.3)
    steps = 0
    while not progress.finished:  # 0.1 + 0.1 + 0.1 is more than 0.3
        progress, steps = progress.advance(0.1, seen(START)), steps + 1
    assert steps == 3
    assert float(progress.time) == 0.3
    assert float(progress.advance(0.1, seen(START)).time) == 0.3


@pytest.mark.parametrize("clock", [EvenClock(), WAITING, LOCALIZING], ids=format_clock)
@pytest.mark.parametrize(("begin", "end"), [(1.0, 1.0), (0.0, math.nan), (0.0, math.inf)])
def test_a_skill_without_a_span_is_refused(regression, clock, begin, end):
    with pytest.raises(DataError, match=r"ends after its beginning, got .* s to"):
        clock.start(regression, START, {}, begin, end)


# Waiting


@pytest.mark.parametrize("dt", [0.04, 0.01, 0.002])
@pytest.mark.parametrize("lag", [0.03, 0.1, 0.15])
def test_an_ordinary_lag_does_not_slow_it(regression, dt, lag):
    run = begun(regression, WAITING, dt=dt, lag=lag)
    assert run.finish() == pytest.approx(LAST, rel=0.02)


def test_noise_does_not_slow_it(regression):
    run = begun(regression, WAITING, 20, dt=0.01, noise=0.005)
    assert run.finish() == pytest.approx(LAST, rel=0.02)


@pytest.mark.parametrize("dt", [0.04, 0.01, 0.002])
def test_it_stands_still_while_the_robot_is_held_and_then_goes_on(regression, dt):
    run = begun(regression, WAITING, dt=dt)
    run.run(0.8)
    at = run.joints
    run.run(2.0, held(at))
    stopped = run.progress.time
    run.run(8.0, held(at))
    assert torch.equal(run.progress.time, stopped)
    assert float(stopped) < 1.2  # four times 0.1 rad away, at about 1 rad/s
    assert run.finish() == pytest.approx(LAST + 10.0 - (float(stopped) - 0.8), abs=0.3)
    assert torch.stack(run.times).diff().min() >= 0


def test_it_restarts_smoothly(regression):
    """As soon as the robot is back the rate rises, a share of the tick at a time."""
    run = begun(regression, WAITING, dt=0.001)
    run.run(0.8)
    run.run(2.0, held(run.joints))
    run.run(0.6)
    rates = torch.stack(run.times).diff() / 0.001
    assert rates.max() <= 1 + 1e-9
    assert rates.diff().max() < 0.001 / 0.2 + 1e-9
    assert rates[-1] == pytest.approx(1.0)


@pytest.mark.parametrize("joints", [None, torch.full((3,), torch.nan, dtype=torch.float64)])
def test_where_nothing_is_measured_it_runs_evenly(regression, joints):
    progress = WAITING.start(regression, START, {}, 0.0, 1.0)
    for _ in range(4):
        progress = progress.advance(0.1, seen(joints))
    assert float(progress.time) == pytest.approx(0.4)


def test_a_coordinate_that_is_not_measured_says_nothing_others_do(regression):
    progress = WAITING.start(regression, START, {}, 0.0, 1.0)
    away = START + torch.tensor([9.0, 0.0, torch.nan], dtype=torch.float64)
    for _ in range(4):
        progress = progress.advance(0.1, seen(away))
    assert float(progress.time) == 0.0


def test_what_the_model_leaves_open_is_no_error(regression):
    """Half a radian away: nothing where the fused Gaussian is that wide."""
    estimate = regression.estimate(torch.tensor(1.0, dtype=torch.float64), START, {})
    wide = torch.eye(3, dtype=torch.float64) * 0.5**2
    for covariance, rate in ((estimate.covariance, 0.0), (wide, 1.0)):
        told = type(estimate)(estimate.joints, covariance, estimate.activation)
        observation = Observation(told.joints + 0.5, told.joints, None, {}, told)
        progress = WAITING.start(regression, told.joints, {}, 0.0, 2.0)
        assert float(progress.advance(0.1, observation).time) == pytest.approx(0.1 * rate)


def test_a_quaternion_and_its_negative_are_one_rotation():
    situation, _ = new_handling()
    model = hands()
    progress = WAITING.start(model.skill, situation.joints, situation.frames, 0.0, 1.0)
    flipped = situation.joints.clone()
    flipped[3:7] *= -1
    progress = progress.advance(0.1, seen(flipped, situation.joints))
    assert float(progress.time) == pytest.approx(0.1)


@pytest.mark.parametrize("dt", [0.04, 0.01])
def test_what_waits_for_arrival_happens_when_the_robot_is_there(regression, dt):
    """At 1 s the robot is held short of its place for a while: time does not pass 1 s."""
    run = begun(regression, WaitingClock(floor=0.05, arrivals=(1.5, 1.0)), dt=dt)
    run.run(0.92)
    short = run.joints + 0.06 * torch.sign(run.joints - run.reference)
    run.run(1.0, held(short))
    assert float(run.progress.time) == 1.0
    run.run(0.32)
    assert float(run.progress.time) > 1.0
    run.finish()
    for stop in (1.0, 1.5):
        after = next(k for k, time in enumerate(run.times) if time > stop)
        # it was there when time went on: what is measured is the last reference's
        reached = run.measured[after] - run.references[after - 1]
        assert reached.abs().max() <= 0.05


def test_without_measurements_nothing_is_waited_for(regression):
    run = begun(regression, WaitingClock(arrivals=(1.0,)))
    run.run(1.2, seen=False)
    assert float(run.progress.time) == pytest.approx(1.2)
