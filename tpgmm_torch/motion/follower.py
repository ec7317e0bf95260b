"""How to get to what is wanted: references within bounds on speed, acceleration and jerk.

What is wanted now and how to get there are two questions. A tick asks them in this order::

    box = bounds.lower, bounds.upper
    estimate = skill.estimate(time, follower.reference, frames, box)
    following = None if search.active is not None else follower.take(estimate.joints, dt)
    if following is None:  # a limit, a jump, or something out of reach
        asked = ~follower.fits(estimate.joints, dt)
        wanted, search = search.advance(
            regression, time, follower.reference, frames, estimate, box, asked
        )
        following = follower.advance(wanted, dt)

where ``search`` is a :class:`~tpgmm_torch.regression.posture.PostureSearch` and ``box`` the
limits of position. ``take`` is all that an ordinary tick needs: the wanted posture becomes the
reference as it is.

Let ``w_k = (q_k - q_{k-1}) / dt`` be the mean velocity of a tick and
``a_k = (w_k - w_{k-1}) / dt`` the second difference of the references. The parabola through the
last three references has at their end

    velocity w_k + a_k dt / 2,  acceleration a_k,                                           (F1)

and a motion that goes on from there with acceleration and jerk within bounds keeps the second
and third differences of all references within them too, because those are means of the
acceleration and of the jerk. So a tick may be exact or generated, joint by joint, in any order.
A wanted posture is taken exactly where ``|a_k| <= A``, ``|a_k - a_{k-1}| <= J dt``, and where
the motion (F1) can be stopped within the bounds of speed and position. Elsewhere an on-line
trajectory generator plans the fastest motion to the wanted posture, seen as one that moves on
with the velocity it has had for a while, and its first ``dt`` is taken.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch.data.arrays import Array, as_array, as_tensor
from tpgmm_torch.exceptions import DataError, ShapeError
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.motion.trajectory_generator import (
    Motion,
    Seconds,
    first_part,
    stopping_range,
)

__all__ = ["Follower"]

Mask = NDArray[np.bool_]

#: What rounding may add to a bound, as a share of it.
ROUNDING = 1e-9
#: Seconds after which a posture that is not reached is expected to move on as it does.
MEMORY = 0.05
#: Of the speed limit, how much a wanted posture is believed to move on with.
CRUISE = 0.9
#: What is planned for is a multiple of ``1 / GRID`` [rad or m]: a plan enlarges a difference of
#: rounding ten million times.
GRID = 2.0**20


@dataclass(frozen=True, eq=False)
class Follower:
    """References of a batch of robots that follow wanted postures within bounds; immutable.

    Make one by :meth:`at`. Robots and joints do not depend on one another.

    Parameters
    ----------
    bounds : MotionBounds
        On position, speed, acceleration and jerk.
    reference : Tensor of shape (..., n_joints)
        The last reference; it has the gradient of a wanted posture that was taken exactly.
    moment : Moment
        How it has moved.
    """

    bounds: MotionBounds
    reference: Tensor
    moment: Moment

    @classmethod
    def at(cls, bounds: MotionBounds, reference: Any, velocity: Any = None) -> Self:
        """A follower that begins somewhere: where a robot is found.

        Parameters
        ----------
        bounds : MotionBounds
        reference : array-like of shape (..., n_joints)
            May lie outside the limits of position: following brings it back.
        velocity : array-like of shape (..., n_joints), optional
            At rest by default; beyond the speed limit it is braked.

        Raises
        ------
        ShapeError, DataError
            If they do not fit the bounds, or are not finite.
        """
        start = _checked(bounds, reference, "reference")
        speed = torch.zeros_like(start)
        if velocity is not None:
            speed = _checked(bounds, velocity, "velocity").expand_as(start)
        return cls(bounds, start, Moment.moving(as_array(start), as_array(speed)))

    def reset(self, reference: Any, velocity: Any = None) -> Self:
        """The same follower somewhere else; see :meth:`at`."""
        return type(self).at(self.bounds, reference, velocity)

    def put(self, joints: Tensor, reference: Tensor) -> Self:
        """The same follower, with some joints at rest somewhere else.

        Parameters
        ----------
        joints : Tensor of bool, of shape (..., n_joints)
            Which ones.
        reference : Tensor of shape (..., n_joints)
            Where they are then.
        """
        moment = self.moment.put(joints.numpy(force=True), as_array(reference))
        return replace(
            self, reference=torch.where(joints, reference, self.reference), moment=moment
        )

    @property
    def velocity(self) -> Tensor:
        """Of the reference [rad/s or m/s], shape (..., n_joints)."""
        return torch.from_numpy(self.moment.motion.velocity).to(self.reference)

    @property
    def acceleration(self) -> Tensor:
        """Of the reference [rad/s^2 or m/s^2], shape (..., n_joints)."""
        return torch.from_numpy(self.moment.motion.acceleration).to(self.reference)

    def take(self, wanted: Tensor, dt: Seconds) -> Self | None:
        """The wanted posture as the reference, where that is within bounds for all robots.

        Parameters
        ----------
        wanted : Tensor of shape (..., n_joints)
            At the end of this tick.
        dt : float or ndarray of shape (...)
            Duration of the tick, for all robots or of each one [s].

        Returns
        -------
        Follower or None
            None if a joint of a robot cannot follow.
        """
        moment, raw = self.moment, as_array(wanted)
        exact = moment.taken(raw, _column(dt))
        # bytes are sooner looked at than an array of bool
        certain = (
            moment.behind is None and b"\0" not in moment.measured(exact, self.bounds).tobytes()
        )
        if not certain and not self._serves(raw, exact).all():
            return None
        return type(self)(self.bounds, wanted, exact)

    def fits(self, wanted: Tensor, dt: Seconds) -> Tensor:
        """Which robots :meth:`take` would serve: bool of shape (...)."""
        raw = as_array(wanted)
        fits = self._serves(raw, self.moment.taken(raw, _column(dt))).all(-1)
        return torch.from_numpy(np.asarray(fits)).to(wanted.device)

    def _serves(self, wanted: Array, exact: Moment) -> Mask:
        """Which joints may be taken there: outside their limits they go back to them."""
        limits = self.bounds.arrays
        within = (wanted >= limits.lower) & (wanted <= limits.upper)
        return within & self.moment.allows(exact, self.bounds)

    def advance(self, wanted: Tensor, dt: Seconds) -> Self:
        """The next reference: what is wanted where it can be followed, else towards it.

        Parameters
        ----------
        wanted : Tensor of shape (..., n_joints)
            At the end of this tick. What lies beyond the limits of position is wanted at them;
            a joint of which it is not finite comes to rest.
        dt : float or ndarray of shape (...)
            Duration of the tick, for all robots or of each one [s].

        Raises
        ------
        DataError
            If ``dt`` is not positive.
        """
        if not np.all((dt > 0) & (dt < np.inf)):
            raise DataError(f"a tick takes a positive number of seconds, got dt={dt}")
        moment, bounds, raw = self.moment, self.bounds, as_array(wanted)
        known = np.where(np.isfinite(raw), raw, moment.motion.position)
        target = np.clip(known, bounds.arrays.lower, bounds.arrays.upper)
        exact = moment.taken(target, _column(dt))
        fits = moment.allows(exact, bounds)
        following = exact if fits.all() else moment.generated(exact, ~fits, bounds)
        as_wanted = torch.from_numpy(fits & (raw == target)).to(wanted.device)
        reached = torch.from_numpy(following.motion.position).to(wanted)
        return replace(
            self, reference=torch.where(as_wanted, wanted, reached), moment=following
        )

    def undone(self, robots: Tensor, before: Self) -> Self:
        """The same follower, with some robots as they were.

        Parameters
        ----------
        robots : Tensor of bool, of shape (...)
            Which ones.
        before : Follower
            Of the same robots.
        """
        joints = robots.unsqueeze(-1)
        reference = torch.where(joints, before.reference, self.reference)
        moment = before.moment.choose(joints.numpy(force=True), self.moment)
        return replace(self, reference=reference, moment=moment)


class Moment(NamedTuple):
    """The end of a tick; arrays of shape (..., n_joints).

    Parameters
    ----------
    motion : Motion
        At this instant, of the motion that goes through the references.
    slope, bend : ndarray
        First and second difference of the references over time.
    wanted, drift : ndarray
        The posture that was wanted, and the velocity that it moves with.
    behind : ndarray of bool, or None
        Joints that are on their way to it; None if there are none.
    dt : float or ndarray of shape (..., 1)
        Duration of the tick [s]; 0 at the start.
    """

    motion: Motion
    slope: Array
    bend: Array
    wanted: Array
    drift: Array
    behind: Mask | None
    dt: Seconds

    @classmethod
    def moving(cls, position: Array, velocity: Array) -> Self:
        """With a constant velocity."""
        zero = np.zeros_like(position)
        motion = Motion(position, velocity, zero)
        return cls(motion, velocity, zero, position, velocity, None, 0.0)

    def put(self, joints: Mask, position: Array) -> Self:
        """Some joints at rest somewhere else."""
        rest = type(self).moving(position, np.zeros_like(position))
        return rest.choose(joints, self)._replace(dt=self.dt)

    def choose(self, where: Mask, other: Self) -> Self:
        """For some joints, or robots (..., 1), this moment, and another for the rest."""

        def either(one: Array, rest: Array) -> Array:
            return np.where(where, one, rest)

        behind = None
        if self.behind is not None or other.behind is not None:
            none = np.zeros(self.slope.shape, dtype=bool)
            one, rest = (none if x.behind is None else x.behind for x in (self, other))
            behind = np.asarray(np.where(where, one, rest), dtype=bool)
        slope, bend, wanted, drift = map(either, self[1:5], other[1:5])
        return type(self)(
            Motion(*map(either, self.motion, other.motion)),
            slope,
            bend,
            wanted,
            drift,
            behind if behind is not None and behind.any() else None,
            np.where(where, self.dt, other.dt) if where.shape[-1] == 1 else other.dt,
        )

    def ago(self, dt: Seconds) -> Seconds:
        """How long the tick before took; as long as this one, if there was none [s]."""
        if isinstance(self.dt, np.ndarray):
            return np.where(self.dt > 0, self.dt, dt)
        return self.dt or dt

    def taken(self, position: Array, dt: Seconds) -> Self:
        """The next moment if that is the next reference."""
        slope = (position - self.motion.position) / dt
        bend = (slope - self.slope) * (2 / (dt + self.ago(dt)))
        velocity = slope + bend * (dt / 2)  # (F1)
        drift = slope if self.behind is None else (position - self.wanted) / dt
        motion = Motion(position, velocity, bend)
        return type(self)(motion, slope, bend, position, drift, None, dt)

    def measured(self, following: Self, bounds: MotionBounds) -> Mask:
        """Which of five bounds a step keeps for certain: bool of shape (..., 5, n_joints)."""
        limits, motion, bend = bounds.arrays, following.motion, following.bend
        size = np.abs(bend)
        rows = np.empty((*bend.shape[:-1], 5, bend.shape[-1]))
        rows[..., 0, :] = size
        between = (following.dt + 2 * self.ago(following.dt)) / 3
        rows[..., 1, :] = np.abs(bend - self.bend) / between
        # the speed may grow until the acceleration is gone
        rows[..., 2, :] = peak = np.abs(motion.velocity) + size * size * limits.half_over_jerk
        room = peak * limits.stopping_time + limits.stopping_distance
        rows[..., 3, :] = motion.position + room
        rows[..., 4, :] = room - motion.position
        kept: Mask = rows <= limits.rows
        return kept

    def allows(self, following: Self, bounds: MotionBounds) -> Mask:
        """Which joints may make that step: differences within bounds, and it can be stopped."""
        limits, kept = bounds.arrays, self.measured(following, bounds)
        fits: Mask = kept[..., 0, :] & kept[..., 1, :]
        if self.behind is not None:
            # who catches up goes on only if it keeps up with what is wanted next
            joining = (following.drift - following.slope) / following.dt
            jerk = limits.jerk * following.dt
            keeps = np.abs(joining) <= np.minimum(limits.acceleration, jerk)
            keeps &= np.abs(joining - following.bend) <= jerk
            fits &= keeps | ~self.behind
        asked = fits & ~kept[..., 2:, :].all(-2)
        if asked.any():
            fits[asked] = self._stops(following.motion.select(asked), asked, bounds)
        return fits

    def generated(self, exact: Self, asked: Mask, bounds: MotionBounds) -> Self:
        """That step, with the joints that are asked on the fastest way to it."""
        limits, dt = bounds.arrays, exact.dt
        start = self.motion.select(asked)
        speed, acceleration, jerk, low, high = (
            np.broadcast_to(x, asked.shape)[asked]
            for x in (
                limits.velocity, limits.acceleration, limits.jerk, limits.lower, limits.upper,
            )
        )  # fmt: skip
        target, before = (
            np.clip(np.rint(x[asked] * GRID) / GRID, low, high)
            for x in (exact.wanted, self.wanted)
        )
        each = dt if isinstance(dt, float) else np.broadcast_to(dt, asked.shape)[asked]
        drift, moved = self.drift[asked], (target - before) / each
        # that it moves on is believed little by little, and that it does not at once: what has
        # jumped is not expected further on
        slower = np.where(drift * moved < 0, 0.0, moved)
        rising = drift + np.minimum(1.0, each / MEMORY) * (moved - drift)
        drift = np.where(np.abs(slower) < np.abs(rising), slower, rising)
        drift = np.clip(drift, -CRUISE * speed, CRUISE * speed)
        part = first_part(start, target, drift, each, speed, acceleration, jerk)
        unsafe = ~self._stops(part, asked, bounds)
        if unsafe.any():  # towards a limit: as if the target stood still, which ends in time
            still = np.zeros(unsafe.sum())
            share = each if isinstance(each, float) else each[unsafe]
            safe = first_part(
                start.select(unsafe), target[unsafe], still, share,
                speed[unsafe], acceleration[unsafe], jerk[unsafe],
            )  # fmt: skip
            part.put(unsafe, safe)
        motion = Motion(*(field.copy() for field in exact.motion))
        motion.put(asked, part)
        slope = (motion.position - self.motion.position) / dt
        bend = (slope - self.slope) * (2 / (dt + self.ago(dt)))
        drifts = exact.drift.copy()
        drifts[asked] = drift
        return type(self)(motion, slope, bend, exact.wanted, drifts, asked, dt)

    def _stops(self, motion: Motion, asked: Mask, bounds: MotionBounds) -> Mask:
        """Which of the joints that are asked can be stopped within speed and position.

        ``motion`` is theirs, one tick after this moment.
        """
        limits, here = bounds.arrays, self.motion.position
        # what stands outside its limits may stay as far out as it is, and come back
        low, high = np.minimum(limits.lower, here), np.maximum(limits.upper, here)
        speed, acceleration, jerk, low, high, half = (
            np.broadcast_to(x, asked.shape)[asked]
            for x in (
                limits.velocity, limits.acceleration, limits.jerk, low, high,
                limits.half_over_jerk,
            )
        )  # fmt: skip
        lowest, highest = stopping_range(motion, acceleration, jerk)
        peak = motion.velocity + motion.acceleration * np.abs(motion.acceleration) * half
        slow = np.maximum(np.abs(peak), np.abs(motion.velocity)) <= speed * (1 + ROUNDING)
        return slow & (lowest >= low - ROUNDING) & (highest <= high + ROUNDING)


def _column(dt: Seconds) -> Seconds:
    """For joints: of shape (..., 1), if each robot has a duration of its own."""
    return dt[..., None] if isinstance(dt, np.ndarray) else float(dt)


def _checked(bounds: MotionBounds, values: Any, name: str) -> Tensor:
    tensor = as_tensor(values, name).to(bounds.lower)
    if tensor.ndim == 0 or tensor.shape[-1:] != bounds.lower.shape:
        raise ShapeError(
            f"{name} has shape (..., {len(bounds.lower)}) for bounds on {len(bounds.lower)} "
            f"joints, got {tuple(tensor.shape)}"
        )
    return tensor
