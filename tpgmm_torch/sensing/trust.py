"""Readings of joints and poses of objects: which are accepted, and why others are not.

A reading that is wrong raises nothing in the middle of a motion; it is not used. Readings are
numpy arrays: of few numbers numpy takes a quarter of the time that torch takes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tpgmm_torch.exceptions import DataError

__all__ = ["JointReading", "PoseReading", "Reading", "Trust"]

#: Whether a reading was accepted, and why not.
ACCEPTED, LOST, IMPOSSIBLE, JUMPED, OTHER_UNIT = range(5)

#: Speed that no joint of a robot without limits of speed exceeds [rad/s].
UNKNOWN_SPEED = 10.0
#: Share of its limit of speed by which a joint may be seen to move faster.
SPEED_MARGIN = 1.5
#: Speeds that no object exceeds [m/s, rad/s].
OBJECT_SPEED, OBJECT_TURN_RATE = 3.0, 10.0

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Trust:
    """Rules of which readings a controller accepts, and for how long it goes on without.

    A reading that is not finite is lost; one beyond the limits is impossible; one too far from
    the last one has jumped. None of them is used. A jump is accepted once the readings have
    stayed there for ``settling_time``; a jump to the last reading in degrees never is. A robot
    without an accepted reading for longer than a timeout is held until there is one.

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
    frame_jump : float
        The same of an object's position, on top of 3 m/s [m].
    turn_jump : float
        The same of its orientation, on top of 10 rad/s [rad].
    largest_gap : float
        Of a robot that stands further than this from its reference, in one joint, the reference
        comes to where it stands, and goes on from there [rad or m]: against whatever moved it
        away it would push with all force otherwise.
    largest_push : float
        Of a robot that was moved further than this from its reference, faster than the
        reference moves itself, the same [rad or m].
    lag : float
        How late a servo may be: on top of that, the way of the reference in this time [s].
    lead : float
        How far the reference of a robot that is waited for is ahead of it [rad or m]; a third
        of that if it holds an object, which it would lose with a jerk when it is let go.
    longest_step : float
        A loop that stood for longer goes on as if it had stood for that long [s].

    Raises
    ------
    DataError
        If a value is not positive.
    """

    joint_timeout: float = 0.2
    frame_timeout: float = 1.0
    settling_time: float = 0.1
    limit_margin: float = 0.5
    joint_jump: float = 0.1
    frame_jump: float = 0.06
    turn_jump: float = 0.6
    largest_gap: float = 0.3
    largest_push: float = 0.06
    lag: float = 0.15
    lead: float = 0.015
    longest_step: float = 0.5

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise DataError(f"{name} of Trust is a positive number, got {value!r}")


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
    """

    trust: Trust
    value: Floats
    age: Floats
    fault: NDArray[np.int8]
    rival: Floats
    rival_age: Floats

    @classmethod
    def first(cls, trust: Trust, value: Floats, **limits: Any) -> Self:
        """An accepted value (..., d); ``limits`` are further fields of the class."""
        zero = np.zeros(value.shape[:-1])
        rival = np.full_like(value, np.nan)
        return cls(trust, value, zero, zero.astype(np.int8), rival, zero, **limits)

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
        elif self.accepted.all():  # an ordinary tick
            change = np.abs(seen - self.value)
            if (change <= self._small_change()).all() and self._possible(seen).all():
                return replace(self, value=seen) if change.any() else self
        finite = np.isfinite(seen).all(-1)
        with np.errstate(invalid="ignore"):
            possible = finite & self._possible(seen)
            elapsed = dt + np.minimum(self.age, self.trust.settling_time)
            near = possible & self._near(seen, self.value, elapsed)
            scaled = possible & ~near & self._other_unit(seen)
            jumped = possible & ~near & ~scaled
            stays = jumped & self._near(seen, self.rival, dt)
        rival_age = np.where(stays, self.rival_age + dt, 0.0)
        accepted = near | (stays & (rival_age >= self.trust.settling_time))
        cases = [accepted, ~finite, ~possible, scaled]
        fault = np.select(cases, [ACCEPTED, LOST, IMPOSSIBLE, OTHER_UNIT], JUMPED)
        return replace(
            self,
            value=np.where(accepted[..., None], seen, self.value),
            age=np.where(accepted, 0.0, self.age + dt),
            fault=fault.astype(np.int8),
            rival=np.where((jumped & ~accepted)[..., None], seen, np.nan),
            rival_age=rival_age,
        )

    def _small_change(self) -> float:
        """A change of each coordinate that is accepted whatever the time step."""
        raise NotImplementedError

    def _possible(self, seen: Floats) -> Mask:
        raise NotImplementedError

    def _near(self, seen: Floats, other: Floats, elapsed: float | Floats) -> Mask:
        raise NotImplementedError

    def _other_unit(self, seen: Floats) -> Mask:
        return np.zeros(seen.shape[:-1], dtype=bool)


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

    def _small_change(self) -> float:
        return self.trust.joint_jump

    def _possible(self, seen: Floats) -> Mask:
        margin = self.trust.limit_margin
        inside = (seen >= self.lower - margin) & (seen <= self.upper + margin)
        return np.all(inside, axis=-1)

    def _near(self, seen: Floats, other: Floats, elapsed: float | Floats) -> Mask:
        speed = SPEED_MARGIN * np.minimum(self.velocity, UNKNOWN_SPEED)
        reach = self.trust.joint_jump + speed * np.asarray(elapsed)[..., None]
        return (np.abs(seen - other) <= reach).all(-1)

    def _other_unit(self, seen: Floats) -> Mask:
        """Whether it is the last value in degrees, or that was and it is in radians."""
        size = np.linalg.norm(self.value, axis=-1) + self.trust.joint_jump
        degrees = math.degrees(1.0)
        off = np.linalg.norm(seen - degrees * self.value, axis=-1)
        back = np.linalg.norm(degrees * seen - self.value, axis=-1)
        return (off < 0.1 * degrees * size) | (back < 0.1 * size)


@dataclass(frozen=True, eq=False)
class PoseReading(Reading):
    """An object's pose, shape (..., 7): position [m] and unit quaternion (w, x, y, z)."""

    def _small_change(self) -> float:
        return 0.5 * min(self.trust.frame_jump, self.trust.turn_jump / 2)

    def _possible(self, seen: Floats) -> Mask:
        turn = seen[..., 3:]
        return np.abs(np.einsum("...i,...i", turn, turn) - 1) < 2e-2

    def _near(self, seen: Floats, other: Floats, elapsed: float | Floats) -> Mask:
        elapsed = np.asarray(elapsed)
        moved = np.linalg.norm(seen[..., :3] - other[..., :3], axis=-1)
        cosine = np.abs((seen[..., 3:] * other[..., 3:]).sum(-1)).clip(0, 1)
        return (moved <= self.trust.frame_jump + OBJECT_SPEED * elapsed) & (
            2 * np.arccos(cosine) <= self.trust.turn_jump + OBJECT_TURN_RATE * elapsed
        )
