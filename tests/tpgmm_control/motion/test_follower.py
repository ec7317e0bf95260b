"""References keep within bounds on position, speed, acceleration, jerk, whatever is wanted."""

import numpy as np
import pytest
import torch

from tpgmm_control.motion.follower import Follower
from tpgmm_torch.exceptions import DataError, ShapeError
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.robots.kinematics import JointSpace

DT = 0.01
ROBOT = JointSpace(["a", "b", "c"])
SIZE = {"lower": -1.0, "upper": [1.0, 2.0, 1.5], "velocity": [2.0, 4.0, 1.0]}


def bounds(**given):
    return MotionBounds.of(
        ROBOT,
        **{**SIZE, "acceleration": [10.0, 30.0, 5.0], "jerk": [200.0, 900.0, 50.0]} | given,
    )


def paths(seed, steps, robots=16):
    """Wanted postures (steps, robots, 3): ramps, swings, jumps, noise, beyond the limits."""
    rng = np.random.default_rng(seed)
    time = DT * np.arange(steps)[:, None, None]
    size = robots, 3
    ramp = rng.uniform(-3, 3, size) * time
    swing = rng.uniform(0, 1.5, size) * np.sin(rng.uniform(0.5, 20, size) * time)
    jumps = rng.uniform(-2, 2, (steps, *size)) * (rng.uniform(size=(steps, *size)) < 0.01)
    noise = rng.choice([0.0, 1e-4, 1e-2], size) * rng.standard_normal((steps, *size))
    kinds = rng.integers(0, 2, (4, *size))
    parts = ramp, swing, jumps.cumsum(0), noise
    return torch.from_numpy(sum(k * part for k, part in zip(kinds, parts, strict=True)))


def follow(follower, wanted, steps):
    """Followers after each tick."""
    found = []
    for posture, dt in zip(wanted, steps, strict=True):
        follower = follower.advance(posture, dt)
        found.append(follower)
    return found


def assert_within(limits, references, steps, jerk=True):
    """The laws, from references (T, ..., n) after the start posture, and durations (T,)."""
    steps = torch.tensor(steps, dtype=torch.float64)[:, None, None]
    slopes = references.diff(dim=0) / steps
    bends = slopes.diff(dim=0) / ((steps[1:] + steps[:-1]) / 2)
    rounding = 1 + 1e-6
    assert bool((slopes.abs() <= limits.velocity * rounding).all())
    assert bool((bends.abs() <= limits.acceleration * rounding).all())
    assert bool((references >= limits.lower - 1e-8).all())
    assert bool((references <= limits.upper + 1e-8).all())
    if jerk:  # of even ticks
        assert bool((bends.diff(dim=0).abs() <= limits.jerk * DT * rounding).all())


@pytest.mark.parametrize("seed", range(4))
def test_whatever_is_wanted_references_keep_within_bounds(seed):
    limits, steps = bounds(), 400
    wanted = paths(seed, steps)
    start = torch.zeros(16, 3, dtype=torch.float64)
    followers = follow(Follower.at(limits, start), wanted, [DT] * steps)
    references = torch.stack([start, *(one.reference for one in followers)])
    assert_within(limits, references, [DT] * steps)
    # both ways of going occurred, and the one led to the other
    exact = (references[1:] == wanted).double()
    assert 0.02 < exact.mean() < 0.98
    assert int(exact.diff(dim=0).abs().sum()) > 40


@pytest.mark.parametrize("options", [{"jerk": np.inf}, {"jerk": 1e6}, {"velocity": 0.05}])
def test_other_bounds_are_kept_as_well(options):
    limits = bounds()
    values = vars(limits) | {
        name: torch.full_like(limits.lower, value) for name, value in options.items()
    }
    limits = MotionBounds(**{name: values[name] for name in MotionBounds.__annotations__})
    start = torch.zeros(16, 3, dtype=torch.float64)
    followers = follow(Follower.at(limits, start), paths(7, 300), [DT] * 300)
    references = torch.stack([start, *(one.reference for one in followers)])
    assert_within(limits, references, [DT] * 300)


def test_ticks_of_uneven_duration_keep_within_bounds():
    limits, rng = bounds(), np.random.default_rng(3)
    steps = (DT * rng.uniform(0.5, 1.5, 400) * rng.choice([1, 1, 1, 3], 400)).tolist()
    start = torch.zeros(16, 3, dtype=torch.float64)
    followers = follow(Follower.at(limits, start), paths(5, 400), steps)
    references = torch.stack([start, *(one.reference for one in followers)])
    assert_within(limits, references, steps, jerk=False)


def test_a_posture_within_bounds_is_taken_as_it_is():
    limits = bounds()
    follower = Follower.at(limits, [0.0, 0.0, 0.0])
    for k in range(1, 50):
        wanted = torch.full((3,), 0.3 * (1 - np.cos(1.5 * k * DT)), dtype=torch.float64)
        wanted.requires_grad_()
        follower = follower.advance(wanted, DT)
        assert follower.reference is wanted
        assert bool(Follower.at(limits, wanted.detach()).fits(wanted, DT))
    slope = 0.3 * 1.5 * np.sin(1.5 * 49 * DT)
    np.testing.assert_allclose(follower.velocity.numpy(), slope, rtol=1e-3)


def test_who_can_follow_is_told_robot_by_robot():
    follower = Follower.at(bounds(), torch.zeros(2, 3, dtype=torch.float64))
    wanted = torch.tensor([[1e-5, 0.0, 0.0], [0.5, 0.0, 0.0]], dtype=torch.float64)
    assert follower.fits(wanted, DT).tolist() == [True, False]
    assert follower.advance(wanted, DT).reference is not wanted
    moved = follower.advance(wanted.requires_grad_(), DT).reference
    assert torch.equal(moved[0], wanted[0]) and 0 < moved[1, 0] < 0.01
    # what was taken has its gradient, what was generated none
    moved.sum().backward()
    assert wanted.grad.tolist() == [[1, 1, 1], [0, 1, 1]]


def test_a_jump_is_reached_as_fast_as_bounds_allow_and_then_followed():
    limits = bounds()
    follower = Follower.at(limits, [0.0, 0.0, 0.0])
    found = []
    for k in range(1, 150):
        wanted = 0.5 + 0.2 * k * DT * torch.ones(3, dtype=torch.float64)
        follower = follower.advance(wanted, DT)
        found.append(bool((follower.reference == wanted).all()))
    first = found.index(True)
    assert all(found[first:])
    # the slowest joint: 0.5 rad at 1 rad/s, 5 rad/s^2, 50 rad/s^3, while it moves on at 0.2
    assert 0.6 < first * DT < 1.1


@pytest.mark.parametrize(
    ("speed", "acceleration", "jerk"), [(2.0, 10.0, 200.0), (np.inf, 250.0, 1e4)]
)
@pytest.mark.parametrize("ticks", [1, 2, 3])
def test_a_posture_that_stops_is_not_overshot(speed, acceleration, jerk, ticks):
    one = torch.ones(1, dtype=torch.float64)
    limits = MotionBounds(-9 * one, 9 * one, speed * one, acceleration * one, jerk * one)
    away = 0.5 if np.isinf(speed) else 0.95 * speed * DT * ticks
    # it stands, moves on for some ticks, and stands
    path = np.interp(np.arange(200), [9, 9 + ticks], [0.0, away])
    wanted = torch.from_numpy(path[:, None])
    followers = follow(Follower.at(limits, [0.0]), wanted, [DT] * len(wanted))
    references = torch.stack([one.reference for one in followers])
    assert bool((references <= away + 1e-9).all())
    assert torch.equal(references[-1], wanted[-1])


@pytest.mark.parametrize("velocity", [None, [1.0, -1.0, 0.5], [5.0, -9.0, 3.0]])
def test_a_start_outside_comes_back_and_stays(velocity):
    limits = bounds()
    start = torch.tensor([1.5, -1.2, 1.4], dtype=torch.float64)
    follower = Follower.at(limits, start, velocity)
    wanted = torch.tensor([2.0, -3.0, 1.5], dtype=torch.float64)
    followers = follow(follower, [wanted] * 400, [DT] * 400)
    references = torch.stack([start, *(one.reference for one in followers)])
    bends = references.diff(n=2, dim=0) / DT**2
    assert bool((bends.abs() <= limits.acceleration * (1 + 1e-6)).all())
    np.testing.assert_allclose(references[-1].numpy(), [1.0, -1.0, 1.5], atol=1e-9)
    if velocity is None:  # it goes no further out
        assert bool((references[:, 0] <= 1.5).all() and (references[:, 1] >= -1.2).all())
    slopes = references.diff(dim=0).abs() / DT
    assert bool((slopes[100:] <= limits.velocity * (1 + 1e-6)).all())


def test_what_is_no_number_brings_a_joint_to_rest():
    follower = Follower.at(bounds(), [0.0, 0.0, 0.0], [1.0, 1.0, 0.5])
    wanted = torch.tensor([torch.nan, torch.inf, 0.2], dtype=torch.float64)
    for _ in range(300):
        follower = follower.advance(wanted, DT)
        assert bool(follower.reference.isfinite().all())
    assert float(follower.velocity.abs().max()) < 1e-9
    assert float(follower.reference[2]) == 0.2


def test_without_bounds_what_is_wanted_is_taken():
    limits = MotionBounds.of(ROBOT)
    follower = Follower.at(limits, [0.0, 0.0, 0.0])
    wanted = torch.tensor([100.0, -7.0, 0.1], dtype=torch.float64)
    assert follower.advance(wanted, DT).reference is wanted
    # and what is bound by position or speed alone goes as far as that allows
    limits = MotionBounds(
        limits.lower, limits.upper.new_tensor([1.0, 9.0, 9.0]),
        limits.velocity.new_tensor([torch.inf, 2.0, torch.inf]),
        limits.acceleration, limits.jerk,
    )  # fmt: skip
    followers = follow(Follower.at(limits, [0.0, 0.0, 0.0]), [wanted] * 5, [DT] * 5)
    np.testing.assert_allclose(followers[0].reference.numpy(), [1.0, -0.02, 0.1])
    np.testing.assert_allclose(followers[-1].reference.numpy(), [1.0, -0.10, 0.1])


@pytest.mark.parametrize("jitter", [0.0, 0.5])
def test_a_robot_does_not_depend_on_its_batch(jitter):
    limits, steps, rng = bounds(), 200, np.random.default_rng(2)
    wanted, start = paths(11, steps), torch.zeros(16, 3, dtype=torch.float64)
    ticks = DT * (1 + jitter * rng.uniform(-1, 3, (steps, 16)))
    together = follow(Follower.at(limits, start), wanted, list(ticks))
    for robot in (0, 5, 15):
        own = ticks[:, robot].tolist()
        alone = follow(Follower.at(limits, start[robot]), wanted[:, robot], own)
        for one, all_of_them in zip(alone, together, strict=True):
            np.testing.assert_allclose(
                one.reference.numpy(), all_of_them.reference[robot].numpy(), atol=1e-12
            )


def test_what_does_not_fit_is_refused():
    with pytest.raises(ShapeError, match=r"reference has shape \(..., 3\)"):
        Follower.at(bounds(), [0.0, 0.0])
    with pytest.raises(DataError, match="velocity holds 1 value"):
        Follower.at(bounds(), [0.0, 0.0, 0.0], [0.0, torch.nan, 0.0])
    follower = Follower.at(bounds(), [0.0, 0.0, 0.0])
    for dt in (0.0, -0.01, float("nan")):
        with pytest.raises(DataError, match="positive number of seconds"):
            follower.advance(follower.reference, dt)
