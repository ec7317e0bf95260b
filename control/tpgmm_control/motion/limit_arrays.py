"""Bounds on a motion as arrays, with constants of stopping: what every tick asks of them."""

from __future__ import annotations

from dataclasses import fields
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.motion.motion_bounds import MotionBounds

#: Share of a bound that rounding may add to it.
ROUNDING = 1e-9
#: In place of an infinite bound where numbers have to be finite.
ENDLESS = 1e9


class LimitArrays(NamedTuple):
    """Bounds as arrays of shape (n_joints,), and what every tick asks of them.

    Parameters
    ----------
    lower, upper, velocity, acceleration, jerk : ndarray
        The bounds, with room for rounding in the acceleration and the jerk.
    half_over_jerk : ndarray
        ``1 / 2J``: an acceleration a that is given up as fast as can be adds ``a^2 / 2J`` to
        the speed.
    stopping_time, stopping_distance : ndarray
        A motion that reaches the speed v at most is stopped within
        ``v * stopping_time + stopping_distance``.
    """

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    jerk: Array
    half_over_jerk: Array
    stopping_time: Array
    stopping_distance: Array


@lru_cache
def limit_arrays(bounds: MotionBounds) -> LimitArrays:
    """Convert ``bounds`` to arrays, and compute the constants of stopping."""
    values = (getattr(bounds, field.name) for field in fields(bounds))
    lower, upper, velocity, acceleration, jerk = map(as_array, values)
    with np.errstate(invalid="ignore", over="ignore"):
        ramp = np.where(np.isinf(jerk), 0.0, acceleration / jerk)
        brake = np.where(np.isinf(acceleration), 0.0, velocity / (2 * acceleration))
        distance = acceleration * ramp * ramp / 3
        stopping = 1.5 * ramp + brake
    # nothing is in the way of a joint without limits of position; infinite times a speed of 0
    # would be no number
    bounded = np.isfinite(lower) | np.isfinite(upper)
    stopping, distance = (
        np.where(bounded, np.nan_to_num(x, nan=ENDLESS, posinf=ENDLESS), 0.0)
        for x in (stopping, distance)
    )
    room = 1 + ROUNDING
    return LimitArrays(
        lower, upper, velocity, acceleration * room, jerk * room, 0.5 / jerk, stopping, distance
    )
