"""References that follow wanted postures within bounds on speed, acceleration and jerk.

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

from tpgmm_control.motion.limit_arrays import ROUNDING, limit_arrays
from tpgmm_control.motion.trajectory_generator import first_part, stopping_range
from tpgmm_torch.data.arrays import Array, as_array, as_tensor
from tpgmm_torch.exceptions import DataError, ShapeError
from tpgmm_torch.motion.motion_bounds import MotionBounds

Mask = NDArray[np.bool_]
#: A duration, of all robots or of each one [s].
Seconds = float | Array

#: Seconds after which a posture that is not reached is expected to move on as it does.
MEMORY = 0.05
#: The share of the speed limit up to which a wanted posture is expected to move on.
CRUISE = 0.9
#: Plans are for multiples of ``1 / GRID`` [rad or m]: they enlarge a difference of rounding ten
#: million times.
GRID = 2.0**20


@dataclass(frozen=True, eq=False)
class Follower:
    """References of a batch of robots that follow wanted postures within bounds; immutable.

    Made by :meth:`at`. Robots and joints do not depend on one another.

    Parameters
    ----------
    bounds : MotionBounds
        On position, speed, acceleration and jerk.
    reference : Tensor of shape (..., n_joints)
        The last reference; it has the gradient of a wanted posture that was taken exactly.
    moment : Moment
        How it has moved.
    aim : Tensor of shape (..., n_joints), optional
        The wanted posture that the last tick was made towards.
    """

    bounds: MotionBounds
    reference: Tensor
    moment: Moment
    aim: Tensor | None = None

    @classmethod
    def at(cls, bounds: MotionBounds, reference: Any, velocity: Any = None) -> Self:
        """A follower that begins where a robot stands.

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

    def undone(self, robots: Tensor, before: Self) -> Self:
        """The same follower, with some robots as they were.

        Parameters
        ----------
        robots : Tensor of bool, of shape (...)
            Which ones.
        before : Follower
            Of the same robots.
        """
        where = robots.unsqueeze(-1)
        reference = torch.where(where, before.reference, self.reference)
        moment = before.moment.choose(where.numpy(force=True), self.moment)
        return replace(self, reference=reference, moment=moment)

    @property
    def velocity(self) -> Tensor:
        """Velocity of the reference [rad/s or m/s], shape (..., n_joints)."""
        return torch.from_numpy(self.moment.motion[1]).to(self.reference)

    def fits(self, wanted: Tensor, dt: Seconds) -> Tensor:
        """Robots that can be at a wanted posture within bounds: bool of shape (...)."""
        fits = self._fits(self.moment.taken(as_array(wanted), _column(dt))).all(-1)
        return torch.from_numpy(np.asarray(fits)).to(wanted.device)

    def braked(self, beside: Self) -> Self:
        """The next references if all joints come to rest, in a tick as long as ``beside``."""
        dt = beside.moment.dt
        seconds = dt[..., 0] if isinstance(dt, np.ndarray) and dt.ndim else dt
        return self.advance(torch.full_like(self.reference, torch.nan), seconds)

    def redirected(self, before: Self, motion: Array, robots: Mask) -> Self:
        """The same tick, in which some robots move otherwise; they go on from there.

        Parameters
        ----------
        before : Follower
            At the end of the tick before.
        motion : ndarray of shape (3, ..., n_joints)
            Position, velocity and acceleration at the end, which have to be within reach, as
            those of :class:`~tpgmm_control.motion.braking.Braking` are.
        robots : ndarray of bool, of shape (...)
            Which ones.
        """
        where = robots[..., None]
        moment = before.moment.redirected(self.moment, motion).choose(where, self.moment)
        reached = torch.from_numpy(np.asarray(moment.motion[0])).to(self.reference)
        reference = torch.where(torch.from_numpy(where), reached, self.reference)
        return replace(self, reference=reference, moment=moment)

    def _fits(self, exact: Moment) -> Mask:
        """Joints of which that may be the next moment; no reference leaves the limits."""
        limits, position = limit_arrays(self.bounds), exact.motion[0]
        within = (position >= limits.lower) & (position <= limits.upper)
        return within & self.moment.allows(exact, self.bounds)

    def advance(self, wanted: Tensor, dt: Seconds) -> Self:
        """The next reference: the wanted posture where it can be followed, else towards it.

        Parameters
        ----------
        wanted : Tensor of shape (..., n_joints)
            At the end of this tick, brought into the limits of position; a joint of which it is
            not finite comes to rest.
        dt : float or ndarray of shape (...)
            Duration of the tick, for all robots or of each one [s].

        Raises
        ------
        DataError
            If ``dt`` is not positive.
        """
        if not (0 < dt < np.inf if isinstance(dt, float) else np.all((dt > 0) & (dt < np.inf))):
            raise DataError(f"a tick takes a positive number of seconds, got dt={dt}")
        moment, bounds, raw = self.moment, self.bounds, as_array(wanted)
        limits, known = limit_arrays(bounds), np.where(np.isfinite(raw), raw, moment.motion[0])
        target = np.minimum(np.maximum(known, limits.lower), limits.upper)
        exact = moment.taken(target, _column(dt))
        fits = moment.allows(exact, bounds)
        as_wanted = fits & (raw == target)
        if as_wanted.all():
            return type(self)(bounds, wanted, exact, wanted)
        following = exact if fits.all() else moment.generated(exact, ~fits, bounds)
        reached = torch.from_numpy(following.motion[0]).to(wanted)
        if wanted.requires_grad:
            reached = torch.where(
                torch.from_numpy(as_wanted).to(wanted.device), wanted, reached
            )
        return type(self)(bounds, reached, following, wanted)


class Moment(NamedTuple):
    """The end of a tick; arrays of shape (..., n_joints).

    Parameters
    ----------
    motion : ndarray of shape (3, ..., n_joints)
        Position, velocity and acceleration of the motion that goes through the references.
    slope, bend : ndarray
        First and second difference of the references over time.
    wanted, drift : ndarray
        The posture that was wanted, and the velocity that it moves with.
    behind : ndarray of bool
        Joints that have not reached it.
    dt, dt_before : float or ndarray of shape (..., 1)
        Duration of the tick and of the one before [s]; 0 at the start.
    """

    motion: Array
    slope: Array
    bend: Array
    wanted: Array
    drift: Array
    behind: Mask
    dt: Seconds
    dt_before: Seconds

    @classmethod
    def moving(cls, position: Array, velocity: Array) -> Self:
        """With a constant velocity."""
        zero = np.zeros_like(position)
        motion = np.stack((position, velocity, zero))
        return cls(motion, velocity, zero, position, velocity, zero.astype(bool), 0.0, 0.0)

    def choose(self, where: Mask, other: Self) -> Self:
        """For some joints, or robots (..., 1), this moment, and another for the rest."""
        return type(self)(*(np.where(where, *pair) for pair in zip(self, other, strict=True)))

    def taken(self, position: Array, dt: Seconds) -> Self:
        """The next moment if that is the next reference."""
        before = self._last_dt(dt)
        slope, bend = self._differences(position, dt, before)
        motion = np.array((position, slope + bend * (dt / 2), bend))  # (F1)
        drift = slope
        if self.behind.any():
            drift = (position - self.wanted) / dt
        none = np.zeros_like(self.behind)
        return type(self)(motion, slope, bend, position, drift, none, dt, before)

    def redirected(self, ordinary: Self, motion: Array) -> Self:
        """The next moment as it is in another motion (3, ..., n_joints)."""
        slope, bend = self._differences(motion[0], ordinary.dt, ordinary.dt_before)
        behind = motion[0] != ordinary.wanted
        return ordinary._replace(motion=motion, slope=slope, bend=bend, behind=behind)

    def _differences(self, position: Array, dt: Seconds, last: Seconds) -> tuple[Array, Array]:
        slope = (position - self.motion[0]) / dt
        return slope, (slope - self.slope) * (2 / (dt + last))

    def _last_dt(self, dt: Seconds) -> Seconds:
        """Duration of the tick before; of this one if it was the first [s]."""
        if isinstance(self.dt, float):
            return self.dt if self.dt > 0 else dt
        return np.where(np.asarray(self.dt) > 0, self.dt, dt)

    def allows(self, following: Self, bounds: MotionBounds) -> Mask:
        """Joints that may make that step: differences within bounds, and it can be stopped."""
        limits = limit_arrays(bounds)
        position, velocity, acceleration = following.motion
        size = np.abs(acceleration)
        last = following.dt_before
        earlier = self.dt_before
        if not isinstance(earlier, float) or earlier <= 0:
            earlier = np.where(np.asarray(earlier) > 0, earlier, last)
        between = (following.dt + last + earlier) / 3
        fits: Mask = size <= limits.acceleration
        fits &= np.abs(acceleration - self.bend) / between <= limits.jerk
        if self.behind.any():
            # a joint that catches up goes on only if it keeps up with the next wanted posture
            joining = (following.drift - following.slope) / following.dt
            jerk = limits.jerk * following.dt
            keeps = np.abs(joining) <= np.minimum(limits.acceleration, jerk)
            keeps &= np.abs(joining - acceleration) <= jerk
            fits &= keeps | ~self.behind
        # certain without a plan; the speed may grow until the acceleration is gone
        peak = np.abs(velocity) + size * size * limits.half_over_jerk
        room = peak * limits.stopping_time + limits.stopping_distance
        stops = (peak <= limits.velocity) & (position + room <= limits.upper)
        asked = fits & ~(stops & (room - position <= -limits.lower))
        if asked.any():
            fits[asked] = self._stops(following.motion[:, asked], asked, bounds)
        return fits

    def generated(self, exact: Self, asked: Mask, bounds: MotionBounds) -> Self:
        """That step, with the joints that are asked on the fastest way to it."""
        limits, joint = limit_arrays(bounds), np.nonzero(asked)[-1]
        rates = np.array((limits.velocity, limits.acceleration, limits.jerk))[:, joint]
        target, before = (
            np.minimum(
                np.maximum(np.rint(x[asked] * GRID) / GRID, limits.lower[joint]),
                limits.upper[joint],
            )
            for x in (exact.wanted, self.wanted)
        )
        dt = (np.zeros(asked.shape) + exact.dt)[asked]
        drift, moved = self.drift[asked], (target - before) / dt
        # a motion is expected to go on only after a while, and to stop at once: a posture that
        # has jumped is not expected further on
        slower = np.where(drift * moved < 0, 0.0, moved)
        rising = drift + np.minimum(1.0, dt / MEMORY) * (moved - drift)
        drift = np.where(np.abs(slower) < np.abs(rising), slower, rising)
        fastest = CRUISE * rates[0]
        drift = np.minimum(np.maximum(drift, -fastest), fastest)
        start = self.motion[:, asked]
        part = first_part(start, target, drift, dt, rates)
        unsafe = ~self._stops(part, asked, bounds)
        if unsafe.any():  # towards a limit: as if the target stood still, which ends in time
            rest = np.zeros(unsafe.sum())
            part[:, unsafe] = first_part(
                start[:, unsafe], target[unsafe], rest, dt[unsafe], rates[:, unsafe]
            )
        motion, drifts = exact.motion.copy(), exact.drift.copy()
        motion[:, asked], drifts[asked] = part, drift
        differences = self._differences(motion[0], exact.dt, exact.dt_before)
        return exact._replace(
            motion=motion, slope=differences[0], bend=differences[1], drift=drifts, behind=asked
        )

    def _stops(self, motion: Array, asked: Mask, bounds: MotionBounds) -> Mask:
        """Whether motions (3, N), one tick later, can be stopped within speed and position.

        They are of the N joints that are asked.
        """
        limits, here, joint = limit_arrays(bounds), self.motion[0][asked], np.nonzero(asked)[-1]
        # a joint outside its limits may stay as far out as it is, and come back
        low = np.minimum(limits.lower[joint], here) - ROUNDING
        high = np.maximum(limits.upper[joint], here) + ROUNDING
        lowest, highest = stopping_range(motion, limits.acceleration[joint], limits.jerk[joint])
        _, velocity, acceleration = motion
        peak = velocity + acceleration * np.abs(acceleration) * limits.half_over_jerk[joint]
        fastest = np.maximum(np.abs(peak), np.abs(velocity))
        slow = fastest <= limits.velocity[joint] * (1 + ROUNDING)
        return slow & (lowest >= low) & (highest <= high)


def _column(dt: Seconds) -> Seconds:
    """Durations of robots for their joints, of shape (..., 1)."""
    return dt[..., None] if isinstance(dt, np.ndarray) else float(dt)


def _checked(bounds: MotionBounds, values: Any, name: str) -> Tensor:
    tensor = as_tensor(values, name).to(bounds.lower)
    if tensor.ndim == 0 or tensor.shape[-1:] != bounds.lower.shape:
        raise ShapeError(
            f"{name} has shape (..., {len(bounds.lower)}) for bounds on {len(bounds.lower)} "
            f"joints, got {tuple(tensor.shape)}"
        )
    return tensor
