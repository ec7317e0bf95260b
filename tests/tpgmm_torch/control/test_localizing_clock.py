"""The localising clock: robots that lag, are held, are pushed, are displaced."""

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.support.carrying import HELD, carrying_model, scenes
from tests.support.motions import ease
from tests.support.servos import Run, between, held
from tests.support.worlds import upper_body
from tpgmm_torch import Demonstration, LocalizingClock, TaskParameterizedGMM
from tpgmm_torch.control.holding import Holding
from tpgmm_torch.control.localizing_clock import local_mode, move
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.skills.skill import Observation

LOCALIZING = LocalizingClock()


def seen(joints: Tensor | None, reference: Tensor) -> Observation:
    return Observation(joints, reference, None, {})


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
    return TaskParameterizedGMM(34).fit(demonstrations).skill


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
    belief, instants = run.progress.belief, torch.from_numpy(run.progress.grid)
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
    regression, time = model.skill, model.time_
    holding = Holding.start(upper_body(), regression.carried_names, [HELD], scene.frames)
    joints = scene.start
    progress = LOCALIZING.start(regression, joints, scene.frames, 0.0, float(time[-1]))
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


# Beliefs


def test_a_belief_moves_and_widens():
    instants = np.arange(41.0)
    belief = np.zeros((3, 41))
    belief[:, 10] = 1.0
    shift, spread = np.array([0.0, 1.3, 2.0]), np.array([0.4, 0.2, 0.0])
    moved = move(belief, shift, spread)
    mean = moved @ instants
    variance = moved @ instants**2 - mean**2
    np.testing.assert_allclose(moved.sum(1), 1.0)
    np.testing.assert_allclose(mean, 10 + shift)
    # between two instants, both are believed
    np.testing.assert_allclose(variance, spread + np.array([0.0, 0.3 * 0.7, 0.0]), atol=1e-12)
    assert (belief[:, 10] == 1).all()


def test_what_leaves_at_the_ends_stays_there():
    belief = np.zeros((2, 9))
    belief[0, 0] = belief[1, 7] = 1.0
    for _ in range(20):
        belief = move(belief, np.array([0.0, 3.0]), np.array([0.0, 0.4]))
    np.testing.assert_allclose(belief.sum(1), 1.0)
    assert belief[0, 0] == 1
    assert belief[1, -1] > 0.7


def test_the_mode_is_the_highest_place_not_the_mean_of_two():
    instants = np.linspace(0, 10, 251)
    belief = np.exp(-0.5 * ((instants - 2.01) / 0.1) ** 2)
    belief += 0.5 * np.exp(-0.5 * ((instants - 8) / 0.1) ** 2)
    assert local_mode(belief[None], instants) == pytest.approx(2.01, abs=0.01)
