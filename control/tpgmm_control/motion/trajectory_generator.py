"""Fastest motions within bounds, planned by an on-line trajectory generator.

Each column of an array is a motion of its own, of one joint of one robot. A state of N motions
is an array of shape (3, N): positions, velocities, accelerations. The planning is that of
`ruckig <https://docs.ruckig.com>`_ (Berscheid, Kröger: Jerk-limited real-time trajectory
generation with arbitrary target states, RSS 2021).
"""

from __future__ import annotations

import numpy as np
from ruckig import (
    ControlInterface,
    InputParameter,
    Ruckig,
    RuckigError,
    Synchronization,
    Trajectory,
)

from tpgmm_control.motion.limit_arrays import ENDLESS
from tpgmm_torch.data.arrays import Array


def first_part(start: Array, target: Array, drift: Array, dt: Array, limits: Array) -> Array:
    """The state of the fastest motions to targets after ``dt``.

    A target moves on with a constant velocity: the plan is made in a frame that moves with it,
    where the bounds of speed are shifted and the target rests.

    Parameters
    ----------
    start : ndarray of shape (3, N)
        Faster than its bounds, a motion is braked.
    target : ndarray of shape (N,)
        Where the targets are after ``dt``.
    drift : ndarray of shape (N,)
        Their velocities, within the bounds of speed.
    dt : ndarray of shape (N,)
        Durations [s].
    limits : ndarray of shape (3, N)
        Bounds of speed, acceleration and jerk; they may be infinite.

    Returns
    -------
    ndarray of shape (3, N)
    """
    speed, acceleration, jerk = limits
    reach = speed * dt
    position = np.minimum(np.maximum(target, start[0] - reach), start[0] + reach)
    found = np.array((position, (position - start[0]) / dt, np.zeros_like(target)))
    bound = np.isfinite(acceleration) | np.isfinite(jerk)  # others are at once as fast
    if bound.all():
        return _planned(start, target, drift, dt, limits)
    if bound.any():
        parts = start[:, bound], target[bound], drift[bound], dt[bound], limits[:, bound]
        found[:, bound] = _planned(*parts)
    return found


def stopping_range(start: Array, acceleration: Array, jerk: Array) -> tuple[Array, Array]:
    """The lowest and the highest position of motions that stop as soon as they can.

    Parameters
    ----------
    start : ndarray of shape (3, N)
    acceleration, jerk : ndarray of shape (N,)
        Bounds; they may be infinite.

    Returns
    -------
    low : ndarray of shape (N,)
    high : ndarray of shape (N,)
        Infinite if no plan is found.
    """
    position, plan = start[0], _stop(start, acceleration, jerk)
    if plan is None:
        unknown = np.full_like(position, np.inf)
        return -unknown, unknown
    extrema = np.array([(bound.min, bound.max) for bound in plan.position_extrema]).T
    moves = np.array(plan.independent_min_durations) > 0  # 0 for the others
    low, high = np.where(moves, extrema, position)
    return low, high


def braked_part(start: Array, dt: Array, acceleration: Array, jerk: Array) -> Array | None:
    """The state after ``dt`` of motions that stop as soon as they can; None without a plan.

    Parameters
    ----------
    start : ndarray of shape (3, N)
    dt : ndarray of shape (N,)
        Durations [s].
    acceleration, jerk : ndarray of shape (N,)
        Bounds; they may be infinite.

    Returns
    -------
    ndarray of shape (3, N), or None
    """
    plan = _stop(start, acceleration, jerk)
    return None if plan is None else _at(plan, dt)


def rest_positions(start: Array, acceleration: Array, jerk: Array) -> Array:
    """Where motions come to rest that stop as soon as they can.

    Parameters
    ----------
    start : ndarray of shape (3, N)
    acceleration, jerk : ndarray of shape (N,)
        Bounds; they may be infinite.

    Returns
    -------
    ndarray of shape (N,)
        Where they are, if no plan is found.
    """
    plan = _stop(start, acceleration, jerk)
    if plan is None:
        return start[0]
    return np.array(plan.at_time(plan.duration)[0])


def _stop(start: Array, acceleration: Array, jerk: Array) -> Trajectory | None:
    """The plan of motions to rest."""
    position, at_once = start[0], np.isinf(acceleration) & np.isinf(jerk)
    if at_once.any():
        start = np.where(at_once, [position, 0 * position, 0 * position], start)
    asked = _input(start)
    asked.max_acceleration = np.minimum(acceleration, ENDLESS).tolist()
    asked.max_jerk = jerk.tolist()
    asked.control_interface = ControlInterface.Velocity
    return _plan(asked)


def _planned(start: Array, target: Array, drift: Array, dt: Array, limits: Array) -> Array:
    """Motions with bounds on the acceleration or the jerk."""
    speed, acceleration, jerk = limits
    speed = np.minimum(speed, ENDLESS)
    asked = _input(np.array((start[0], start[1] - drift, start[2])))
    asked.max_acceleration = np.minimum(acceleration, ENDLESS).tolist()
    asked.max_jerk = jerk.tolist()
    asked.target_position = (target - drift * dt).tolist()
    asked.max_velocity = (speed - drift).tolist()
    asked.min_velocity = (-speed - drift).tolist()
    plan = _plan(asked)
    if plan is not None:
        return _at(plan, dt) + np.array((drift * dt, drift, np.zeros_like(drift)))
    if len(target) > 1:  # one motion that cannot be planned fails all
        singles = (
            _planned(start[:, [i]], target[[i]], drift[[i]], dt[[i]], limits[:, [i]])
            for i in range(len(target))
        )
        return np.concatenate(list(singles), axis=1)
    change = np.clip(-start[1] / dt, -acceleration, acceleration)  # it loses speed
    moved = start[0] + start[1] * dt + change * (dt * dt / 2)
    return np.stack((moved, start[1] + change * dt, np.zeros_like(change)))


def _at(plan: Trajectory, dt: Array) -> Array:
    """States (3, N) of planned motions after durations (N,)."""
    first = float(dt[0])
    if (dt == first).all():
        return np.array(plan.at_time(first))
    found = np.empty((3, len(dt)))
    for duration in np.unique(dt):
        then = dt == duration
        found[:, then] = np.array(plan.at_time(float(duration)))[:, then]
    return found


def _input(start: Array) -> InputParameter:
    asked = InputParameter(start.shape[1])
    asked.synchronization = Synchronization.No
    asked.current_position, asked.current_velocity, asked.current_acceleration = start.tolist()
    return asked


def _plan(asked: InputParameter) -> Trajectory | None:
    """The plan of all motions; None if one of them cannot be planned."""
    size = asked.degrees_of_freedom
    plan = Trajectory(size)
    try:
        Ruckig(size).calculate(asked, plan)
    except (RuckigError, ValueError):  # a ValueError where a motion takes hours
        return None
    return plan
