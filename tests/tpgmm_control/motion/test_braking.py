"""Where joints can be after a tick, and where they can stop from there."""

import numpy as np
import pytest
import torch

from tpgmm_control.motion.braking import Braking, rest
from tpgmm_control.motion.follower import Follower
from tpgmm_torch.motion.motion_bounds import MotionBounds

N = 12


def bounds():
    one = torch.ones(N, dtype=torch.float64)
    return MotionBounds(-one, one, 2 * one, 9 * one, 300 * one)


@pytest.mark.parametrize("dt", [0.04, 0.01, 0.002])
def test_any_choice_of_rest_keeps_all_bounds_for_ever(dt):
    rng = np.random.default_rng(0)
    limits, follower = bounds(), Follower.at(bounds(), torch.zeros(N))
    references = [np.zeros(N)] * 3
    for _ in range(300):
        after = follower.advance(torch.from_numpy(rng.uniform(-1, 1, N)), dt)
        braking = Braking.of(follower, after)
        low, _, high = braking.rests
        assert (np.diff(braking.rests, axis=0) >= 0).all()
        # ends as often as what lies between
        share = np.clip(rng.uniform(-0.5, 1.5, N), 0, 1)
        state = braking.state(low + share * (high - low))
        follower = after.redirected(follower, state, np.array(True))
        np.testing.assert_allclose(rest(follower), rest(follower, state))
        references.append(follower.reference.numpy())
    for order, most in ((1, limits.velocity), (2, limits.acceleration), (3, limits.jerk)):
        moved = np.abs(np.diff(references, order, axis=0)) / dt**order
        assert moved.max() <= float(most[0]) * (1 + 1e-6)
        assert moved.max() > 0.5 * float(most[0])  # it is tried hard
    assert np.abs(references).max() <= 1 + 1e-9


def test_a_place_of_rest_that_was_chosen_can_be_chosen_at_the_next_tick():
    rng, follower = np.random.default_rng(1), Follower.at(bounds(), torch.zeros(N))
    for _ in range(100):
        after = follower.advance(torch.from_numpy(rng.uniform(-1, 1, N)), 0.04)
        low, _, high = Braking.of(follower, after).rests
        chosen = low + rng.uniform(0, 1, N) * (high - low)
        state = Braking.of(follower, after).state(chosen)
        follower = after.redirected(follower, state, np.array(True))
        low, _, high = Braking.of(follower, after).rests
        assert (low - 1e-3 <= chosen).all() and (chosen <= high + 1e-3).all()


@pytest.mark.parametrize("dt", [0.04, 0.01])
def test_joints_that_are_asked_to_rest_where_they_would_come_to_rest_and_stay(dt):
    follower = Follower.at(bounds(), torch.zeros(N))
    for _ in range(9):
        follower = follower.advance(torch.linspace(-1, 1, N), dt)
    chosen = rest(follower)
    assert np.abs(chosen - follower.reference.numpy()).max() > 0.01  # they are on their way
    for _ in range(round(1 / dt)):
        after = follower.advance(torch.linspace(-1, 1, N), dt)
        state = Braking.of(follower, after).state(chosen)
        follower = after.redirected(follower, state, np.array(True))
    np.testing.assert_allclose(follower.moment.motion[0], chosen, atol=1e-6)
    np.testing.assert_allclose(follower.moment.motion[1:], 0, atol=1e-6)


def test_some_robots_are_redirected_and_the_others_are_as_they_were():
    start = torch.zeros(2, N, dtype=torch.float64)
    before = Follower.at(bounds(), start)
    after = before.advance(start + 0.5, 0.04)
    low = Braking.of(before, after).rests[0]
    other = after.redirected(
        before, Braking.of(before, after).state(low), np.array([True, False])
    )
    assert torch.equal(other.reference[1], after.reference[1])
    assert (other.reference[0] < 0).all() and (after.reference[0] > 0).all()
    # both go on from where they are, and neither leaps
    following = other.advance(start + 0.5, 0.04)
    moved = (following.reference - other.reference).abs()
    assert moved.max() <= 9 * 0.04**2 * 2
