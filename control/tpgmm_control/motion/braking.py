"""Where joints can be after a tick, and where each of these motions can come to rest.

Bounds of position, speed, acceleration and jerk are convex: if two motions that begin alike
keep them at all times, so does every mixture of both. Take the fastest motions towards both
limits for one tick, to the states s_0 and s_2, and the motion that brakes as hard as may be, to
s_1; brake from each as hard as may be, to rest at r_0 <= r_1 <= r_2. Then

    s = (1 - x) s_i + x s_i+1,   r = (1 - x) r_i + x r_i+1,   0 <= x <= 1                 (B1)

is a state after the tick, and a place where the joint can stop from there, within all bounds.
So the place of rest, joint by joint between r_0 and r_2, decides the next reference, and what
keeps places of rest clear of something can be kept: at the next tick the same place can be
chosen again, r_1. A joint comes to rest there, which without s_1 it would not: mixtures of the
fastest motions alone pass it from tick to tick, by a few thousandths of a radian.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from tpgmm_control.motion.follower import Follower
from tpgmm_control.motion.limit_arrays import limit_arrays
from tpgmm_control.motion.trajectory_generator import braked_part, first_part, rest_positions
from tpgmm_torch.data.arrays import Array

#: Further away than this within a tick no joint is asked to go [rad or m].
FAR = 10.0


@dataclass(frozen=True, eq=False)
class Braking:
    """States after a tick within the bounds, by the place of rest (B1).

    Parameters
    ----------
    states : ndarray of shape (3, 3, ..., n_joints)
        Position, velocity and acceleration after the fastest motion down, the one that brakes,
        and the fastest one up.
    rests : ndarray of shape (3, ..., n_joints)
        Where they come to rest.
    """

    states: Array
    rests: Array

    @classmethod
    def of(cls, before: Follower, after: Follower) -> Self:
        """Of a follower ``before`` a tick; one ``after`` it knows how long the tick takes."""
        limits, start = limit_arrays(before.bounds), before.moment.motion
        shape = start.shape[1:]
        dt = np.broadcast_to(after.moment.dt, shape).ravel()
        rates = np.stack(
            [
                np.broadcast_to(x, shape).ravel()
                for x in (limits.velocity, limits.acceleration, limits.jerk)
            ]
        )
        flat, still = start.reshape(3, -1), np.zeros(dt.size)
        ends = [
            np.clip(limits.lower, start[0] - FAR, start[0]),
            np.clip(limits.upper, start[0], start[0] + FAR),
        ]
        down, up = (first_part(flat, end.ravel(), still, dt, rates) for end in ends)
        braked = braked_part(flat, dt, *rates[1:])
        braked = 0.5 * (down + up) if braked is None else braked
        states = np.stack((down, braked, up)).reshape(3, *start.shape)
        return cls(states, np.sort(np.stack([rest(before, state) for state in states]), axis=0))

    def state(self, rest: Array) -> Array:
        """The state (3, ..., n_joints) from which a joint can stop at ``rest``."""
        onwards = rest > self.rests[1]
        low, high = np.where(onwards, self.rests[1:], self.rests[:2])
        first, second = np.where(onwards, self.states[1:], self.states[:2])
        wide = high - low
        share = np.where(wide > 0, (rest - low) / np.where(wide > 0, wide, 1.0), ~onwards)
        share = np.clip(share, 0.0, 1.0)
        mixed: Array = first + share * (second - first)
        return mixed


def rest(follower: Follower, motion: Array | None = None) -> Array:
    """Where joints stop that brake as hard as may be, (..., n_joints).

    Parameters
    ----------
    follower : Follower
    motion : ndarray of shape (3, ..., n_joints), optional
        Position, velocity and acceleration; by default the follower's.
    """
    motion = follower.moment.motion if motion is None else motion
    limits, shape = limit_arrays(follower.bounds), motion.shape[1:]
    rates = (np.broadcast_to(x, shape).ravel() for x in (limits.acceleration, limits.jerk))
    return rest_positions(motion.reshape(3, -1), *rates).reshape(shape)
