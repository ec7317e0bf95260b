"""Clocks: even, waiting, localising; robots that lag, are held, are lost; their text forms."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.support.carrying import HELD, carrying_model, scenes
from tests.support.motions import ease
from tests.support.servos import Run, between, held
from tests.support.skills import LAST, canonical, hands, new_handling, wave, waves
from tests.support.worlds import upper_body
from tpgmm_torch import Demonstration, TaskParameterizedGMM
from tpgmm_torch.control.clocks import (
    Clock,
    EvenClock,
    LocalizingClock,
    WaitingClock,
    format_clock,
    parse_clock,
)
from tpgmm_torch.control.holding import Holding
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.skills.skill import Observation

START = wave(torch.zeros(1, dtype=torch.float64))[0]
WAITING, LOCALIZING = WaitingClock(), LocalizingClock()


@pytest.fixture(scope="module")
def regression() -> Regression:
    """Three joints that move by up to 3 rad/s, for two seconds."""
    return canonical(reg_covar=1e-6).fit(waves(4, 60)).regression()


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
        progress = clock.start(regression, 0.0, LAST, joints, {})
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
    progress = EvenClock(speed).start(regression, 0.2, 1.4, START.expand(5, 3), {})
    for k in range(1, 4):
        progress = progress.advance(0.1, seen(START.expand(5, 3) + 9.0))
        assert progress.time.shape == ()
        assert float(progress.time) == pytest.approx(0.2 + speed * 0.1 * k, rel=1e-12)
        assert not progress.relocalized


def test_a_robot_on_hold_has_a_time_of_its_own(regression):
    progress = EvenClock().start(regression, 0.0, 0.25, START.expand(2, 3), {})
    step = torch.tensor([0.1, 0.0], dtype=torch.float64)
    for _ in range(2):
        progress = progress.advance(step, seen(None))
    assert progress.time.tolist() == pytest.approx([0.2, 0.0])
    progress = progress.advance(0.1, seen(None))
    assert progress.time.tolist() == pytest.approx([0.25, 0.1])
    assert progress.finished.tolist() == [True, False]


@pytest.mark.parametrize("clock", [EvenClock(), WAITING, LOCALIZING], ids=format_clock)
def test_the_end_is_reached_and_held(regression, clock):
    progress = clock.start(regression, 0.0, 0.3, START, {})
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
        clock.start(regression, begin, end, START, {})


@pytest.mark.parametrize("clock", [EvenClock(), WAITING, LOCALIZING], ids=format_clock)
def test_looking_ahead_changes_nothing(regression, clock):
    run = begun(regression, clock)
    run.run(0.4)
    before, ahead = run.progress.time.clone(), run.progress
    for _ in range(5):
        ahead = ahead.advance(0.04, seen(START + 9.0))
    assert torch.equal(run.progress.time, before)


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


def test_every_robot_has_its_own_time_whatever_its_batch(regression):
    """Robot b of 64 is held from 0.02 b s on for a second; each alone does the same."""
    since = 0.02 * torch.arange(64, dtype=torch.float64)

    together = begun(regression, WAITING, 64)
    together.run(1.9, between(since, since + 1))
    assert together.progress.time.std() > 0.1
    for robot in (0, 17, 63):
        alone = begun(regression, WAITING)
        alone.run(1.9, between(since[robot], since[robot] + 1))
        assert alone.progress.time.shape == ()
        times = torch.stack(together.times)[:, robot]
        torch.testing.assert_close(torch.stack(alone.times), times, rtol=0, atol=1e-9)


@pytest.mark.parametrize("joints", [None, torch.full((3,), torch.nan, dtype=torch.float64)])
def test_where_nothing_is_measured_it_runs_evenly(regression, joints):
    progress = WAITING.start(regression, 0.0, 1.0, START, {})
    for _ in range(4):
        progress = progress.advance(0.1, seen(joints))
    assert float(progress.time) == pytest.approx(0.4)


def test_a_coordinate_that_is_not_measured_says_nothing_others_do(regression):
    progress = WAITING.start(regression, 0.0, 1.0, START, {})
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
        progress = WAITING.start(regression, 0.0, 2.0, told.joints, {})
        assert float(progress.advance(0.1, observation).time) == pytest.approx(0.1 * rate)


def test_a_quaternion_and_its_negative_are_one_rotation():
    situation, _ = new_handling()
    model = hands()
    progress = WAITING.start(model.regression(), 0.0, 1.0, situation.joints, situation.frames)
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


# Localising: a skill that reaches (to 5 s), holds (to 6), brings (to 10), shakes (to 16), rests


END = 17.0


@pytest.fixture(scope="module")
def shaking() -> Regression:
    """Five joints; no posture comes twice, but for the shaking and the pauses."""
    time = np.arange(0, END + 1e-9, 0.1)
    reach, bring = np.array([0.8, -0.5, 0, 0, 0.6]), np.array([0, 0.6, 0.7, -0.8, 0])
    path = np.outer(ease(time, 0, 5), reach) + np.outer(ease(time, 6, 10), bring)
    envelope = ease(time, 10, 10.6) * (1 - ease(time, 15.4, 16))
    path[:, 2:4] += (0.4 * envelope * np.sin(np.pi * (time - 10)))[:, None]
    shifts = np.random.default_rng(0).uniform(-0.03, 0.03, (5, 5))
    demonstrations = [Demonstration(time, path + shift) for shift in shifts]
    return TaskParameterizedGMM(34).fit(demonstrations).regression()


def localizing(regression: Regression, *batch: int, **options) -> Run:
    clock = options.pop("clock", LOCALIZING)
    start = regression.estimate(torch.zeros((), dtype=torch.float64), torch.zeros(5), {}).joints
    options = {"joints": start.expand(*batch, 5), **options}
    return Run(regression, clock, 0.0, END, **options)


def posture(regression: Regression, time: float | Tensor) -> Tensor:
    """Where a robot is that follows."""
    time = torch.as_tensor(time, dtype=torch.float64)
    return regression.estimate(
        time, torch.zeros(*time.shape, 5, dtype=torch.float64), {}
    ).joints


@pytest.mark.parametrize("noise", [0.0, 0.005])
@pytest.mark.parametrize("lag", [0.05, 0.1])
def test_a_robot_that_follows_is_neither_slowed_nor_moved(shaking, lag, noise):
    run = localizing(shaking, 8, lag=lag, noise=noise)
    assert run.finish() == pytest.approx(END, rel=0.02)
    assert torch.stack(run.times).diff(dim=0).min() >= 0
    assert not torch.stack(run.relocalized).any()


def test_robots_are_held_for_ten_seconds(shaking):
    """At 24 instants, from the first second to the end of the shaking."""
    since = torch.linspace(1.0, 15.5, 24, dtype=torch.float64)
    run = localizing(shaking, 24, dt=0.05)
    run.run(END + 15, between(since, since + 10))
    times = torch.stack(run.times)
    # time only goes back, and once, to where a robot was stopped, or a pause began
    again = torch.stack(run.relocalized)
    gone = times.diff(dim=0)
    assert again.sum(0).max() <= 1
    assert gone[~again].min() >= 0
    assert again.sum() >= 20 and gone[again].max() < -0.05
    where = [int(column.nonzero()[0]) if column.any() else None for column in again.T]
    after = [times[tick + 1, k] - since[k] for k, tick in enumerate(where) if tick is not None]
    assert max(after) < 0.15 and sorted(after)[len(after) // 2] > -0.15
    tick = torch.stack((since + 5, since + 9.9)) / run.dt
    later, last = times.gather(0, tick.long())
    assert torch.equal(later, last)
    assert bool(run.progress.finished.all())
    # time stops where the reference is further away than servos that lag let one expect: the
    # slower the skill is, the later
    away = (posture(shaking, last) - posture(shaking, since)).abs().amax(-1)
    assert away.max() < 0.6  # the shaking has 1.3 rad/s


@pytest.mark.parametrize("seconds", [0.5, 1.0, 5.0])
def test_what_a_stopped_robot_missed_is_done(shaking, seconds):
    """In the midst of reaching, bringing and shaking: nothing is left out, nor done twice."""
    since = torch.tensor([2.2, 2.6, 7.7, 8.3, 11.1, 12.0, 13.1, 14.0], dtype=torch.float64)
    run = localizing(shaking, len(since), dt=0.02)
    run.run(float(since.max()) + seconds + 1.0, between(since, since + seconds))
    times = torch.stack(run.times)
    released = ((since + seconds) / run.dt).long()
    for k, tick in enumerate(released.tolist()):
        onwards = times[tick : tick + 25, k]  # half a second
        assert float(onwards.min()) == pytest.approx(float(since[k]), abs=0.06)
        missed = posture(shaking, onwards.min()) - posture(shaking, since[k])
        assert missed.abs().max() < 0.05


def test_time_stands_until_it_is_known_where_a_robot_was_pushed_to(shaking):
    """No further than a slow servo lags: of one that only is late, time goes on."""
    start, place = 2.6, 2.0
    target = posture(shaking, place)
    assert 0.05 < (target - posture(shaking, start)).abs().max() < 0.2
    for pushed in (torch.tensor(True), None):
        run = localizing(shaking, dt=0.02)
        run.run(start)
        began = float(run.progress.time)
        seen = Observation(target, run.reference, None, {}, run.estimate, None, pushed)
        run.progress, run.joints = run.progress.advance(run.dt, seen), target
        assert (float(run.progress.time) == began) == (pushed is not None)
        run.run(0.26, held(target))
        if pushed is not None:
            assert sum(map(int, run.relocalized)) == 1
            assert float(run.progress.time) == pytest.approx(place, abs=0.1)


@pytest.mark.parametrize("dt", [0.04, 0.01, 0.002])
@pytest.mark.parametrize("shift", [-2.0, 2.0])
def test_a_robot_that_is_pushed_goes_on_from_where_it_is(shaking, shift, dt):
    run = localizing(shaking, dt=dt)
    start = 3.8 if shift < 0 else 1.8
    target = posture(shaking, start + shift)
    run.run(start)
    run.run(0.3, held(target))
    assert sum(map(int, run.relocalized)) == 1
    moved = run.relocalized.index(torch.tensor(True)) * dt
    assert moved < start + 0.25
    run.run(1.0)
    # it set out when it was let go, or as soon as its place was known
    assert start + shift + 0.9 < float(run.progress.time) < start + shift + 1.4
    assert run.finish() == pytest.approx(END - shift, abs=0.4)
    assert sum(map(int, run.relocalized)) == 1


def test_robots_are_carried_to_any_other_place(shaking):
    """While reaching, to where they will bring; and back."""
    start = torch.tensor([1.5, 8.5, 2.0, 8.0], dtype=torch.float64)
    place = torch.tensor([8.5, 1.5, 8.0, 2.0], dtype=torch.float64)
    run = localizing(shaking, 4)
    target = posture(shaking, place)
    run.run(10.0, between(start, start + 0.5, target))
    expected = place + 10.0 - start - 0.5
    assert (run.progress.time - expected).abs().max() < 0.5
    # when they were let go, some had been held at the new place for a while
    again, gone = torch.stack(run.relocalized), torch.stack(run.times).diff(dim=0)
    assert (again & (gone.abs() > 1)).sum(0).tolist() == [1, 1, 1, 1]
    assert again.sum() <= 8 and gone[again & (gone.abs() <= 1)].max() < 0


def test_to_a_pause_they_may_come_anywhere_in_it(shaking):
    run = localizing(shaking)
    run.run(8.0)
    run.run(0.5, held(posture(shaking, 5.5)))
    assert 4.3 < float(run.progress.time) < 7.0
    assert sum(map(int, run.relocalized)) == 1


def test_shaking_does_not_jump_a_period(shaking):
    """Neither robots that are noisy nor such as are held, late, or stopped again and again."""
    since = torch.linspace(10.6, 13.4, 12, dtype=torch.float64)
    run = localizing(shaking, 12, noise=0.005)
    run.run(16.0, between(since, since + 1.5))
    # they only go back to where they were held
    gone = torch.stack(run.times).diff(dim=0)[torch.stack(run.relocalized)]
    assert gone.max() < 0 and gone.min() > -0.8
    # what the time gained while robots were held is less than half a period of 2 s
    gained = run.progress.time - (16.0 - 1.5)
    assert gained.max() < 0.8
    assert gained.min() > -0.5


def test_where_no_place_explains_it_time_waits(shaking):
    run = localizing(shaking)
    run.run(8.0)
    aside = posture(shaking, 8.0) + torch.tensor([0, 0.8, 0, 0, -0.8], dtype=torch.float64)
    run.run(5.0, held(aside))
    assert float(run.progress.time) < 8.3
    assert not torch.stack(run.relocalized).any()
    assert run.finish() == pytest.approx(END + 5.0, abs=0.5)


def test_one_reading_from_elsewhere_is_not_believed(shaking):
    run = localizing(shaking)
    run.run(8.0)
    reading = seen(posture(shaking, 3.0), run.reference)
    progress = run.progress.advance(0.04, reading)
    assert not progress.relocalized
    assert float(progress.time - run.progress.time) == pytest.approx(0.0, abs=0.04)


@pytest.mark.parametrize("speed", [0.5, 1.5])
def test_time_goes_with_a_robot_that_is_led(shaking, speed):
    """Somebody leads the robot through the skill, slower or faster than it was shown."""
    run = localizing(shaking, lag=1e-3)
    start = 6.5
    run.run(start)
    seconds = 2.5 / speed
    run.run(seconds, lambda passed, joints: posture(shaking, start + speed * (passed - start)))
    assert float(run.progress.time) == pytest.approx(start + 2.5, abs=0.6)


@pytest.mark.parametrize("batch", [(), (3,)])
def test_the_start_may_be_anywhere(shaking, batch):
    clock = LocalizingClock(initial="anywhere")
    soon = localizing(shaking, clock=clock, joints=posture(shaking, 1.0).expand(*batch, 5))
    assert soon.progress.time.max() < 1.3  # from the beginning, which explains it too
    for time in (2.0, 3.5, 7.5, 8.5):
        joints = posture(shaking, time).expand(*batch, 5)
        run = localizing(shaking, clock=clock, joints=joints)
        assert run.progress.time.shape == batch
        assert (run.progress.time - time).abs().max() < 0.3
        run.run(1.0)
        assert (run.progress.time - time - 1.0).abs().max() < 0.3


def test_a_start_that_no_place_explains_is_the_beginning(shaking):
    clock = LocalizingClock(initial="anywhere")
    joints = posture(shaking, 8.0) + torch.tensor([0, 0.8, 0, 0, -0.8], dtype=torch.float64)
    assert float(localizing(shaking, clock=clock, joints=joints).progress.time) == 0.0


def test_the_belief_is_where_the_robot_is(shaking):
    run = localizing(shaking, 2)
    run.run(8.0)
    target = posture(shaking, torch.tensor([2.0, 8.0], dtype=torch.float64))
    never = torch.tensor(99.0)
    run.run(0.2, between(torch.stack((torch.tensor(8.0), never)), never, target))
    belief, instants = run.progress.belief, torch.from_numpy(run.progress.localizer.instants)
    assert torch.allclose(belief.sum(-1), torch.ones(2, dtype=torch.float64))
    assert (belief @ instants).tolist() == pytest.approx([2.0, 8.1], abs=0.2)


def test_localised_robots_do_not_depend_on_their_batch(shaking):
    """64 robots, half of them held, half pushed back, from different moments on."""
    since = torch.linspace(2.5, 4.2, 64, dtype=torch.float64)
    targets = posture(shaking, since - torch.where(torch.arange(64) % 2 == 0, 0.0, 2.0))
    together = localizing(shaking, 64)
    together.run(5.5, between(since, since + 0.4, targets))
    assert torch.stack(together.relocalized).sum() > 25
    times = torch.stack(together.times)
    for robot in (0, 1, 31, 32, 63):
        alone = localizing(shaking)
        alone.run(5.5, between(since[robot], since[robot] + 0.4, targets[robot]))
        torch.testing.assert_close(torch.stack(alone.times), times[:, robot], rtol=0, atol=1e-9)


def test_a_robot_that_carries_something_is_localised_with_it():
    """On its way to the tray it is pushed back by a second; the bottle stays in the hand."""
    scene, model = scenes(1, seed=7)[0], carrying_model()
    regression, time = model.regression(), model.time_
    holding = Holding.start(upper_body(), regression.operators, [HELD], scene.frames)
    joints = scene.start
    progress = LOCALIZING.start(regression, 0.0, float(time[-1]), joints, scene.frames)
    passed, pushed, estimate, moves = [joints], 0, None, 0
    while progress.time < 5.0:
        reference = passed[-1] if estimate is None else estimate.joints
        holding = holding.advance(progress.time, reference)
        state = holding.state(upper_body().state(reference))
        estimate = regression.estimate(progress.time, state, holding.frames)
        joints = estimate.joints + 0.5 * (joints - estimate.joints)
        if progress.time > 4.0 or 0 < pushed < 8:
            joints, pushed = (passed[75], pushed + 1) if pushed < 8 else (joints, pushed)
        passed.append(joints)
        told = (joints, estimate.joints, None, holding.frames, estimate, holding.state)
        progress = progress.advance(0.04, Observation(*told))
        if progress.relocalized:
            moves += 1
            assert float(progress.time) == pytest.approx(3.1, abs=0.2)
    assert moves == 1
    assert len(passed) == pytest.approx((5.0 + 1.0) / 0.04, abs=15)


def test_robots_in_more_dimensions_and_on_hold(shaking):
    run = localizing(shaking, 2, 3)
    run.run(4.0)
    step = torch.full((2, 3), 0.04, dtype=torch.float64)
    step[1] = 0.0
    before, progress = run.progress.time, run.progress
    away = posture(shaking, torch.full((2, 3), 2.0))
    for _ in range(4):
        progress = progress.advance(step, seen(away, run.reference))
    assert progress.relocalized.shape == (2, 3)
    assert (progress.time[0] - before[0]).max() < -1.5
    assert torch.equal(progress.time[1], before[1])


# Texts


@pytest.mark.parametrize(
    ("text", "clock"),
    [
        ("even", EvenClock()),
        ("even:speed=0.5", EvenClock(0.5)),
        ("waiting", WaitingClock()),
        ("waiting:tolerance=3,lag=0.05", WaitingClock(tolerance=3, lag=0.05)),
        ("waiting:arrivals=4.5/7", WaitingClock(arrivals=(7, 4.5))),
        ("localizing", LocalizingClock()),
        (
            "localizing:floor=0.01,initial=anywhere",
            LocalizingClock(floor=0.01, initial="anywhere"),
        ),
    ],
)
def test_texts_and_clocks_are_each_others_inverse(text, clock):
    assert parse_clock(text) == parse_clock(clock) == clock
    assert format_clock(clock) == text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sundial", r"no 'sundial'; there are \['even', 'waiting'.*waiting:tolerance=3"),
        ("", r"no ''; there are"),
        ("even:tolerance=3", r"'tolerance' is no option; 'even' has \['speed'\].*NAME=VALUE"),
        ("waiting:", r"'' is no option; 'waiting' has \['speed', 'tolerance'"),
        ("waiting:lag=1,lag=2", r"'lag' is given twice"),
        ("waiting:arrivals=4,5", r"'5' is no option"),
        ("waiting:arrivals=4/x", r"arrivals takes numbers joined by '/', got '4/x'"),
        (
            "waiting:arrivals=nan",
            r"arrivals of WaitingClock are times in seconds, got \(nan,\)",
        ),
        ("waiting:lag=soon", r"lag takes a number, got 'soon'"),
        ("waiting:lag=-1", r"lag of WaitingClock must be positive, got -1.0"),
        ("localizing:initial=here", r"one of \['beginning', 'anywhere'\], got 'here'"),
        ("even:speed=nan", r"speed of EvenClock must be positive, got nan"),
        (3, r"one of \['even', 'waiting', 'localizing'\], as text or as an object, got 3"),
        (EvenClock, "as text or as an object, got <class"),
    ],
)
def test_texts_that_are_no_clock_are_refused(text, message):
    with pytest.raises(DataError, match=message):
        parse_clock(text)


def test_a_clock_of_somebodys_own_is_its_repr():
    class Sundial(Clock):
        def start(self, regression, begin, end, joints, frames):
            raise NotImplementedError

        def __repr__(self):
            return "Sundial()"

    assert format_clock(Sundial()) == "Sundial()"


@pytest.mark.parametrize("speed", ["1", None, True])
def test_a_setting_that_is_no_number_is_refused(speed):
    with pytest.raises(DataError, match="speed of EvenClock is a number, got"):
        EvenClock(speed)
