"""Plans of many motions at once, and what is done where one of them fails."""

import numpy as np
import pytest
from ruckig import RuckigError

from tpgmm_control.motion import trajectory_generator
from tpgmm_control.motion.trajectory_generator import first_part, stopping_range

BOUNDS = np.array([[1.0, 2.0], [10.0, 20.0], [100.0, 400.0]])
TICK = np.full(2, 0.01)
REST = np.zeros((3, 2))


def after(start, target, drift, duration):
    """The motion, planned again at every tick."""
    for k in range(round(duration / 0.01)):
        now = target + drift * (k + 1) * 0.01
        start = first_part(start, now, drift, TICK, BOUNDS)
    return start


def test_a_target_is_reached_in_the_time_that_bounds_ask():
    # 1 m at 1 m/s, ramps of 0.2 s: 1.2 s
    target, still = np.array([1.0, -2.0]), np.zeros(2)
    almost = after(REST, target, still, 1.19)
    assert 0 < 1.0 - almost[0, 0] < 1e-4
    done = after(REST, target, still, 1.3)
    np.testing.assert_allclose(done, [target, still, still], atol=1e-9)


def test_a_target_that_moves_is_met_and_gone_along_with():
    target, drift = np.array([0.1, -0.3]), np.array([0.5, 0.4])
    met = after(REST, target, drift, 2.0)
    np.testing.assert_allclose(met[0], target + 2 * drift, atol=1e-9)
    np.testing.assert_allclose(met[1], drift, atol=1e-9)


def test_a_motion_is_stopped_in_the_time_and_room_that_bounds_ask():
    start = np.array([[0.0, 0.0], [1.0, -1.0], [0.0, 20.0]])
    low, high = stopping_range(start, *BOUNDS[1:])
    # from 1 m/s by a triangle of jerk, 2 sqrt(v / J) long, v / 2 fast on average
    np.testing.assert_allclose((low[0], high[0]), (0, 1.0 * np.sqrt(1.0 / 100)), atol=1e-12)
    # the other one is being braked already
    assert -0.1 < low[1] < -0.02 and high[1] == 0


def test_without_bounds_a_motion_stands_or_goes_at_once():
    endless = np.full(2, np.inf)
    start = np.array([[0.5, 0.0], [9.0, 0.0], [0.0, 0.0]])
    low, high = stopping_range(start, endless, endless)
    assert low.tolist() == high.tolist() == [0.5, 0.0]
    target = np.array([3.0, 1.0])
    bounds = np.array([[np.inf, 2.0], endless, endless])
    went = first_part(start, target, np.zeros(2), TICK, bounds)
    np.testing.assert_allclose(went[0], [3.0, 0.02])


def test_one_motion_that_cannot_be_planned_spoils_no_other(monkeypatch):
    class Failing(trajectory_generator.Ruckig):
        def calculate(self, asked, plan):
            if -1.0 in asked.target_position:
                raise RuckigError("this one")
            return super().calculate(asked, plan)

    start = np.array([[0.0, 0.0], [0.05, 0.5], [0.0, 0.0]])
    target, still = np.array([1.0, -1.0]), np.zeros(2)
    alone = first_part(start, target, still, TICK, BOUNDS)
    monkeypatch.setattr(trajectory_generator, "Ruckig", Failing)
    some = first_part(start, target, still, TICK, BOUNDS)
    assert some[:, 0].tolist() == alone[:, 0].tolist()
    # it loses speed, as fast as it may
    assert some[1, 1] == pytest.approx(0.5 - 20 * 0.01)
    assert some[0, 1] == pytest.approx(0.5 * 0.01 - 20 * 0.01**2 / 2)
