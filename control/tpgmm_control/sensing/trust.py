"""Readings of joints and poses of objects: which are accepted, and why others are not.

A reading that is wrong raises nothing in the middle of a motion; it is not used. Readings are
numpy arrays: of few numbers numpy takes a quarter of the time that torch takes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tpgmm_control.sensing.states import check_positive, replace_fields

__all__ = ["Trust"]

#: Whether a reading was accepted, and why not.
ACCEPTED, LOST, IMPOSSIBLE, JUMPED, OTHER_UNIT, DEAD, FLIPPED = range(7)

#: Speed that no joint of a robot without limits of speed exceeds [rad/s].
UNKNOWN_SPEED = 10.0
#: Share of its limit of speed by which a joint may be seen to move faster.
SPEED_MARGIN = 1.5
#: Speeds that no object exceeds [m/s, rad/s].
OBJECT_SPEED, OBJECT_TURN_RATE = 3.0, 3.0

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Trust:
    """Rules of which readings a controller accepts, and for how long it goes on without.

    A reading that is not finite is lost; one beyond the limits is impossible; one too far from
    the last one has jumped. None of them is used. A jump is accepted once readings that live,
    which differ in the last bit, have stayed there for ``settling_time``; a jump to the last
    reading in degrees, of all joints to 0, or of an object's orientation alone, as trackers
    flip, never is. A robot without an accepted reading for longer than a timeout is held until
    there is one.

    Parameters
    ----------
    joint_timeout : float
        How long a robot goes on with the last reading of its joints [s].
    frame_timeout : float
        The same of the pose of an object, which is less likely to change [s].
    settling_time : float
        How long readings have to stay where they jumped to [s].
    limit_margin : float
        How far measured joints may be beyond their limits of position [rad or m].
    joint_jump : float
        From one reading to the next, on top of what 1.5 times the limit of speed allows [rad].
    largest_jump : float
        What offsets and pushes of a joint do not exceed [rad or m]: readings that have jumped
        further are accepted where the skill explains them, or when they are back.
    frame_jump : float
        The same as ``joint_jump`` of an object's position, on top of 3 m/s [m].
    turn_jump : float
        The same of its orientation, on top of 3 rad/s [rad].

    Raises
    ------
    DataError
        If a value is not positive.
    """

    joint_timeout: float = 0.2
    frame_timeout: float = 1.0
    settling_time: float = 0.02
    limit_margin: float = 0.5
    joint_jump: float = 0.1
    largest_jump: float = 0.5
    frame_jump: float = 0.06
    turn_jump: float = 0.6

    def __post_init__(self) -> None:
        check_positive(self)


@dataclass(frozen=True, eq=False)
class Reading:
    """The last accepted value of a signal, for each robot of a batch.

    Parameters
    ----------
    trust : Trust
        Which readings to accept.
    value : ndarray of shape (..., d)
    age : ndarray of shape (...)
        For how long none was accepted [s].
    fault : ndarray of shape (...)
        The fault of the last one, ``ACCEPTED`` where there was none.
    rival : ndarray of shape (..., d)
        Where the signal jumped to, NaN where it did not.
    rival_age : ndarray of shape (...)
        For how long it has stayed there [s].
    rival_lives : bool ndarray of shape (...)
        Whether it has changed there.
    lost_for : ndarray of shape (...)
        For how long there has been none since the last accepted one [s].
    same_for : ndarray of shape (...)
        For how long it has been the same to the last bit [s].
    jumped : bool ndarray of shape (...)
        Whether the last one was accepted although it had jumped.
    pending : bool ndarray of shape (...)
        Whether the last one would be, had it not jumped so far; not at every tick.
    """

    trust: Trust
    value: Floats
    age: Floats
    fault: NDArray[np.int8]
    rival: Floats
    rival_age: Floats
    rival_lives: Mask
    lost_for: Floats
    same_for: Floats
    jumped: Mask
    pending: Mask

    @classmethod
    def first(cls, trust: Trust, value: Floats, **limits: Any) -> Self:
        """An accepted value (..., d); ``limits`` are further fields of the class."""
        zero = np.zeros(value.shape[:-1])
        rival = np.full_like(value, np.nan)
        none = zero.astype(np.int8)
        return cls(
            trust, value, zero, none, rival, zero, zero > 0, zero, zero, zero > 0, zero > 0,
            **limits,
        )  # fmt: skip

    @property
    def accepted(self) -> Mask:
        """Robots of which the last one was accepted, shape (...)."""
        return self.fault == ACCEPTED

    def update(self, seen: Floats | None, dt: float | Floats) -> Self:
        """The next reading, ``dt`` seconds later.

        Parameters
        ----------
        seen : ndarray of shape (..., d) or None
            None if there was none.
        dt : float or ndarray of shape (...)
            For all robots or for each one [s].
        """
        if seen is None:
            seen = np.full_like(self.value, np.nan)
        same = (seen == self.value).all(-1)
        same_for = np.where(same, self.same_for + dt, 0.0)
        if self.accepted.all():  # an ordinary tick
            change = np.abs(seen - self.value)
            if (change <= self._small_change()).all() and not self._faults(seen).any():
                none = self.jumped & False
                return replace_fields(
                    self, value=seen, same_for=same_for, jumped=none, pending=none
                )
        with np.errstate(invalid="ignore"):
            fault = self._faults(seen)
            known = np.maximum(np.minimum(self.age, self.trust.settling_time), self.lost_for)
            elapsed = dt + known
            near = (fault == ACCEPTED) & self._near(seen, self.value, elapsed)
            far = (fault == ACCEPTED) & ~near
            stays = (fault == ACCEPTED) & self._near(seen, self.rival, dt)
            lives = stays & (self.rival_lives | self._lives(seen))
        rival_age = np.where(stays, self.rival_age + dt, 0.0)
        each = 2 * self.trust.settling_time
        settled = stays & (rival_age >= self.trust.settling_time)
        jumped = settled & lives & self._small(seen)
        accepted = near | jumped
        jumped |= near & (self.fault == JUMPED) & stays
        return replace_fields(
            self,
            value=np.where(accepted[..., None], seen, self.value),
            age=np.where(accepted, 0.0, self.age + dt),
            fault=np.where(far & ~accepted, JUMPED, fault).astype(np.int8),
            rival=np.where((far & ~accepted)[..., None], seen, np.nan),
            rival_age=rival_age,
            rival_lives=lives,
            lost_for=np.where(accepted, 0.0, self.lost_for + dt * (fault == LOST)),
            same_for=same_for,
            jumped=jumped,
            pending=settled & ~jumped & (rival_age // each > self.rival_age // each),
        )

    def accept(self, robots: Mask) -> Self:
        """The readings to which the signal of some robots has jumped."""
        return replace_fields(
            self,
            value=np.where(robots[..., None], self.rival, self.value),
            age=np.where(robots, 0.0, self.age),
            fault=np.where(robots, ACCEPTED, self.fault).astype(np.int8),
            jumped=self.jumped | robots,
        )

    def _lives(self, seen: Floats) -> Mask:
        """Readings after a jump that count for its being over."""
        return np.ones(seen.shape[:-1], dtype=bool)

    def _small(self, seen: Floats) -> Mask:
        """Jumps that are accepted once they stay."""
        return np.ones(seen.shape[:-1], dtype=bool)

    def _small_change(self) -> float:
        """A change of each coordinate that is accepted whatever the time step."""
        raise NotImplementedError

    def _faults(self, seen: Floats) -> NDArray[np.int8]:
        """Why readings cannot be right, whatever the time step."""
        raise NotImplementedError

    def _near(self, seen: Floats, other: Floats, elapsed: float | Floats) -> Mask:
        """Readings that are as near to others as the time allows."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class JointReading(Reading):
    """Measured joints, shape (..., n_joints) [rad or m]; see :class:`Reading`.

    Parameters
    ----------
    trust, value, age, fault, rival, rival_age
        As for :class:`Reading`.
    lower, upper, velocity : ndarray of shape (n_joints,)
        Limits of the robot; may be infinite.
    """

    lower: Floats
    upper: Floats
    velocity: Floats

    def _lives(self, seen: Floats) -> Mask:
        return np.asarray((seen != self.rival).any(-1))

    def _small(self, seen: Floats) -> Mask:
        return np.asarray(np.abs(seen - self.value).max(-1) <= self.trust.largest_jump)

    def _small_change(self) -> float:
        return self.trust.joint_jump

    def _faults(self, seen: Floats) -> NDArray[np.int8]:
        margin = self.trust.limit_margin
        inside = (seen >= self.lower - margin) & (seen <= self.upper + margin)
        dead = (seen == 0).all(-1) & (np.abs(self.value).max(-1) > margin / 10)
        dead &= seen.shape[-1] > 1
        fine = inside.all(-1) & ~dead
        if fine.all() and (np.abs(seen - self.value) <= self.trust.joint_jump).all():
            return np.zeros(fine.shape, np.int8)
        cases = [~np.isfinite(seen).all(-1), ~inside.all(-1), dead, self._other_unit(seen)]
        return np.select(cases, [LOST, IMPOSSIBLE, DEAD, OTHER_UNIT], ACCEPTED).astype(np.int8)

    @property
    def _speed(self) -> Floats:
        """Largest speed of each joint (n_joints,) [rad/s]."""
        return SPEED_MARGIN * np.minimum(self.velocity, UNKNOWN_SPEED)

    def _near(self, seen: Floats, other: Floats, elapsed: float | Floats) -> Mask:
        reach = self.trust.joint_jump + self._speed * np.asarray(elapsed)[..., None]
        return (np.abs(seen - other) <= reach).all(-1)

    def _other_unit(self, seen: Floats) -> Mask:
        """Whether it is the last value in degrees, or that was and it is in radians."""
        size = np.linalg.norm(self.value, axis=-1) + self.trust.joint_jump
        degrees = math.degrees(1.0)
        # it has moved on meanwhile
        room = 0.1 * size + np.minimum(
            np.linalg.norm(self._speed) * self.age, self.trust.largest_jump
        )
        off = np.linalg.norm(seen / degrees - self.value, axis=-1)
        back = np.linalg.norm(degrees * seen - self.value, axis=-1)
        far = (np.abs(seen - self.value) > self.trust.joint_jump).any(-1)
        return far & ((off < 0.1 * np.linalg.norm(self.value, axis=-1)) | (back < room))


@dataclass(frozen=True, eq=False)
class PoseReading(Reading):
    """An object's pose, shape (..., 7): position [m] and unit quaternion (w, x, y, z)."""

    def update(self, seen: Floats | None, dt: float | Floats) -> Self:
        """The next reading; an object that flips is where it is seen, turned as before."""
        new = super().update(seen, dt)
        flipped = new.fault == JUMPED
        if seen is None or not flipped.any():
            return new
        flipped &= ~self._small(seen)
        kept = np.concatenate((seen[..., :3], new.value[..., 3:]), -1)
        return replace_fields(
            new,
            value=np.where(flipped[..., None], kept, new.value),
            fault=np.where(flipped, FLIPPED, new.fault).astype(np.int8),
        )

    def _small(self, seen: Floats) -> Mask:
        moved = np.linalg.norm(seen[..., :3] - self.value[..., :3], axis=-1)
        return np.asarray(moved > self.trust.frame_jump)

    def _small_change(self) -> float:
        return 0.5 * min(self.trust.frame_jump, self.trust.turn_jump / 2)

    def _faults(self, seen: Floats) -> NDArray[np.int8]:
        turn = seen[..., 3:]
        unit = np.abs((turn * turn).sum(-1) - 1) < 2e-2
        if unit.all() and np.isfinite(seen).all():
            return np.zeros(unit.shape, np.int8)
        impossible = np.where(unit, ACCEPTED, IMPOSSIBLE)
        return np.where(np.isfinite(seen).all(-1), impossible, LOST).astype(np.int8)

    def _near(self, seen: Floats, other: Floats, elapsed: float | Floats) -> Mask:
        elapsed = np.asarray(elapsed)
        moved = np.linalg.norm(seen[..., :3] - other[..., :3], axis=-1)
        cosine = np.abs((seen[..., 3:] * other[..., 3:]).sum(-1)).clip(0, 1)
        return (moved <= self.trust.frame_jump + OBJECT_SPEED * elapsed) & (
            2 * np.arccos(cosine) <= self.trust.turn_jump + OBJECT_TURN_RATE * elapsed
        )
