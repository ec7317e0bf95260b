"""Fastest motions within bounds, planned at once: what an on-line trajectory generator does.

Each number of an array is a motion of its own, of one joint of one robot. The planning is that
of `ruckig <https://docs.ruckig.com>`_ (Berscheid, Kröger: Jerk-limited real-time trajectory
generation with arbitrary target states, RSS 2021).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from ruckig import (
    ControlInterface,
    InputParameter,
    Ruckig,
    RuckigError,
    Synchronization,
    Trajectory,
)

from tpgmm_torch.data.arrays import Array

__all__ = ["Motion", "Seconds", "first_part", "stopping_range"]

#: A duration, of all motions or of each one [s].
Seconds = float | Array

#: Faster than anything: bounds that are not there.
ENDLESS = 1e9


class Motion(NamedTuple):
    """Motions at an instant.

    Parameters
    ----------
    position, velocity, acceleration : ndarray
        Arrays of one shape.
    """

    position: Array
    velocity: Array
    acceleration: Array

    def select(self, index: Any) -> Motion:
        """Some of them."""
        return Motion(*(field[index] for field in self))

    def put(self, index: Any, others: Motion) -> None:
        """Write ``others`` in the place of some of them."""
        for field, values in zip(self, others, strict=True):
            field[index] = values


def first_part(
    start: Motion,
    target: Array,
    drift: Array,
    dt: Seconds,
    velocity: Array,
    acceleration: Array,
    jerk: Array,
) -> Motion:
    """Where the fastest motion to a target is after ``dt``, with its velocity and acceleration.

    The target moves on with a constant velocity: the plan is made in a frame that moves with
    it, where the bounds of speed are shifted and the target rests.

    Parameters
    ----------
    start : Motion
        Of N motions. What is faster than its bounds is braked.
    target : ndarray of shape (N,)
        Where the targets are after ``dt``.
    drift : ndarray of shape (N,)
        Their velocities, within the bounds of speed.
    dt : float or ndarray of shape (N,)
        Duration [s].
    velocity, acceleration, jerk : ndarray of shape (N,)
        Bounds; they may be infinite.
    """
    free = np.isinf(acceleration) & np.isinf(jerk)
    found = Motion(*(np.empty_like(target) for _ in range(3)))
    for part, fastest in ((free, _jumped), (~free, _planned)):
        if part.any():
            bounds = velocity[part], acceleration[part], jerk[part]
            share = dt[part] if isinstance(dt, np.ndarray) else dt
            motion = fastest(start.select(part), target[part], drift[part], share, *bounds)
            found.put(part, motion)
    return found


def stopping_range(start: Motion, acceleration: Array, jerk: Array) -> tuple[Array, Array]:
    """The lowest and the highest position until motions have been stopped, as soon as can be.

    Parameters
    ----------
    start : Motion
        Of N motions.
    acceleration, jerk : ndarray of shape (N,)
        Bounds; they may be infinite.
    """
    # without bounds they stand at once
    at_once = np.isinf(acceleration) & np.isinf(jerk)
    still = Motion(
        start.position,
        *(np.where(at_once, 0.0, x) for x in (start.velocity, start.acceleration)),
    )
    asked = _input(still, acceleration, jerk)
    asked.control_interface = ControlInterface.Velocity
    plan = _plan(asked)
    if plan is None:  # unknown: nothing may be built on it
        unknown = np.full_like(start.position, np.inf)
        return -unknown, unknown
    extrema = np.array([(bound.min, bound.max) for bound in plan.position_extrema]).T
    moves = np.array(plan.independent_min_durations) > 0  # it says 0 of those that do not
    low, high = np.where(moves, extrema, start.position)
    return low, high


def _jumped(
    start: Motion, target: Array, drift: Array, dt: Seconds, velocity: Array, *_: Array
) -> Motion:
    """Motions that only speed binds."""
    reach = velocity * dt
    position = np.clip(target, start.position - reach, start.position + reach)
    return Motion(position, (position - start.position) / dt, np.zeros_like(target))


def _planned(
    start: Motion,
    target: Array,
    drift: Array,
    dt: Seconds,
    velocity: Array,
    acceleration: Array,
    jerk: Array,
) -> Motion:
    """Motions with bounds on the acceleration or the jerk."""
    relative = Motion(start.position, start.velocity - drift, start.acceleration)
    fastest = np.minimum(velocity, ENDLESS)
    asked = _input(relative, acceleration, jerk)
    asked.target_position = (target - drift * dt).tolist()
    asked.max_velocity = (fastest - drift).tolist()
    asked.min_velocity = (-fastest - drift).tolist()
    plan = _plan(asked)
    if plan is not None:
        position, speed, rate = _at(plan, dt)
        return Motion(position + drift * dt, speed + drift, rate)
    if len(target) == 1:
        return _braked(start, dt, acceleration)
    parts = [
        _planned(
            start.select([i]),
            target[[i]],
            drift[[i]],
            dt[[i]] if isinstance(dt, np.ndarray) else dt,
            velocity[[i]],
            acceleration[[i]],
            jerk[[i]],
        )
        for i in range(len(target))
    ]
    return Motion(*map(np.concatenate, zip(*parts, strict=True)))


def _at(plan: Trajectory, dt: Seconds) -> Motion:
    """Each motion of a plan after its own duration."""
    if not isinstance(dt, np.ndarray):
        return Motion(*map(np.array, plan.at_time(dt)))
    found = Motion(*(np.empty_like(dt) for _ in range(3)))
    for duration in np.unique(dt):
        then = dt == duration
        found.put(then, Motion(*map(np.array, plan.at_time(duration))).select(then))
    return found


def _input(start: Motion, acceleration: Array, jerk: Array) -> InputParameter:
    asked = InputParameter(len(start.position))
    asked.synchronization = Synchronization.No
    asked.current_position = start.position.tolist()
    asked.current_velocity = start.velocity.tolist()
    asked.current_acceleration = start.acceleration.tolist()
    asked.max_acceleration = np.minimum(acceleration, ENDLESS).tolist()
    asked.max_jerk = jerk.tolist()
    return asked


def _plan(asked: InputParameter) -> Trajectory | None:
    """None if one of the motions cannot be planned, which fails all of them."""
    size = asked.degrees_of_freedom
    plan = Trajectory(size)
    try:
        Ruckig(size).calculate(asked, plan)
    except (RuckigError, ValueError):  # it has no name for a motion that takes hours
        return None
    return plan


def _braked(start: Motion, dt: Seconds, acceleration: Array) -> Motion:
    """A motion that loses speed: what is left where nothing can be planned."""
    change = np.clip(-start.velocity / dt, -acceleration, acceleration)
    return Motion(
        start.position + start.velocity * dt + change * (dt * dt / 2),
        start.velocity + change * dt,
        np.zeros_like(change),
    )
