"""What a running skill believes of its inputs: nothing raises in the middle of a motion.

Readings are numpy arrays here: they come from a processor's memory, and of few numbers numpy
asks a quarter of the time that torch asks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tpgmm_torch.exceptions import DataError

__all__ = ["JointReading", "PoseReading", "Reading", "Trust"]

#: Whether a reading was believed, and why not.
BELIEVED, LOST, IMPOSSIBLE, JUMPED, OTHER_UNIT = range(5)

#: Radians in degrees: the unit that a reading is most likely to change to.
DEGREES = 180 / math.pi

#: What no joint of a robot without limits of speed exceeds [rad/s].
UNKNOWN_SPEED = 10.0

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Trust:
    """When a controller believes what it is told, and for how long it goes on without.

    A reading that is not finite is lost; one beyond the limits is impossible; one too far from
    the last one has jumped. None of them is used. A jump is believed once the readings have
    stayed there for ``settling``; a jump to what the last reading is in degrees never is. A
    robot that has had no reading to believe for its ``patience`` is held until there is one.

    Parameters
    ----------
    patience : float
        How long a robot goes on with the last reading of its joints [s].
    frame_patience : float
        The same of the pose of an object, which is less likely to change [s].
    settling : float
        How long readings have to stay where they jumped to [s].
    beyond : float
        How far measured joints may be beyond their limits of position [rad or m].
    joint_jump : float
        From one reading to the next, on top of what 1.5 times the limit of speed allows [rad].
    frame_jump : float
        The same of an object's position, on top of 3 m/s [m].
    turn_jump : float
        The same of its orientation, on top of 10 rad/s [rad].
    largest_gap : float
        Of a robot that stands further than this from its reference, in one joint, the reference
        comes to where it stands, and goes on from there [rad or m]: what drove it away would be
        fought with all force otherwise.
    largest_push : float
        Of a robot that was moved further than this from its reference, faster than the
        reference moves itself, the same [rad or m].
    lag : float
        How late a servo may be: on top of that, what the reference moves in this time [s].
    lead : float
        How far the reference of a robot that is waited for is ahead of it [rad or m]; a third
        of that if it holds something, which it would lose with a jerk when it is let go.
    longest_step : float
        A loop that stood for longer goes on as if it had stood for that long [s].

    Raises
    ------
    DataError
        If a value is not positive.
    """

    patience: float = 0.2
    frame_patience: float = 1.0
    settling: float = 0.1
    beyond: float = 0.5
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
    """The last value of a signal that was believed, for each robot of a batch.

    Parameters
    ----------
    trust : Trust
        When to believe.
    value : ndarray of shape (..., d)
    age : ndarray of shape (...)
        For how long nothing was believed [s].
    why : ndarray of shape (...)
        What was wrong with the last one, ``BELIEVED`` where nothing was.
    rival : ndarray of shape (..., d)
        Where the signal jumped to, NaN where it did not.
    rival_age : ndarray of shape (...)
        For how long it has stayed there [s].
    calm : bool
        Whether all robots believed the last one.
    """

    trust: Trust
    value: Floats
    age: Floats
    why: NDArray[np.int8]
    rival: Floats
    rival_age: Floats
    calm: bool

    def hear(self, heard: Floats | None, dt: float | Floats) -> Self:
        """The next reading, ``dt`` seconds later; None if there was none.

        ``heard`` has the shape of ``value``; ``dt`` may be one of each robot, shape (...).
        """
        if heard is None:
            heard = np.full_like(self.value, np.nan)
        elif self.calm:
            change = np.abs(heard - self.value)
            if (change <= self._unsuspicious()).all() and self._possible(heard).all():
                return self._with(value=heard) if change.any() else self
        finite = np.isfinite(heard).all(-1)
        with np.errstate(invalid="ignore"):
            possible = finite & self._possible(heard)
            # what was not believed for long is found by where it stays
            elapsed = dt + np.minimum(self.age, self.trust.settling)
            near = possible & self._near(heard, self.value, elapsed)
            scaled = possible & ~near & self._other_unit(heard)
            candidate = possible & ~near & ~scaled
            stays = candidate & self._near(heard, self.rival, dt)
            rival_age = np.where(stays, self.rival_age + dt, 0.0)
        settled = stays & (rival_age >= self.trust.settling)
        believed = near | settled
        why = np.select(
            [believed, ~finite, ~possible, scaled],
            [BELIEVED, LOST, IMPOSSIBLE, OTHER_UNIT],
            JUMPED,
        )
        return self._with(
            value=np.where(believed[..., None], heard, self.value),
            age=np.where(believed, 0.0, self.age + dt),
            why=why.astype(np.int8),
            rival=np.where((candidate & ~believed)[..., None], heard, np.nan),
            rival_age=rival_age,
            calm=bool(believed.all()),
        )

    def _with(self, **changes: Any) -> Self:
        """``dataclasses.replace`` without its checks, which take longer than the reading."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__, **changes)
        return other

    @property
    def believed(self) -> Mask:
        """Where the last one was believed."""
        return self.why == BELIEVED

    def _unsuspicious(self) -> Floats | float:
        """A difference in each coordinate that needs no closer look, whatever the time step."""
        raise NotImplementedError

    def _possible(self, heard: Floats) -> Mask:
        raise NotImplementedError

    def _near(self, heard: Floats, other: Floats, elapsed: float | Floats) -> Mask:
        raise NotImplementedError

    def _other_unit(self, heard: Floats) -> Mask:
        return np.zeros(heard.shape[:-1], dtype=bool)


def _first(value: Floats) -> dict[str, Any]:
    shape = value.shape[:-1]
    return {
        "value": value,
        "age": np.zeros(shape),
        "why": np.zeros(shape, dtype=np.int8),
        "rival": np.full_like(value, np.nan),
        "rival_age": np.zeros(shape),
        "calm": True,
    }


@dataclass(frozen=True, eq=False)
class JointReading(Reading):
    """Measured joints, shape (..., n_joints) [rad or m]; see :class:`Reading`.

    Parameters
    ----------
    trust, value, age, why, rival, rival_age, calm
        As for :class:`Reading`.
    lower, upper, velocity : ndarray of shape (n_joints,)
        Limits of the robot; may be infinite.
    """

    lower: Floats
    upper: Floats
    velocity: Floats

    @classmethod
    def of(cls, trust: Trust, value: Floats, limits: tuple[Floats, Floats, Floats]) -> Self:
        """The first one, which is believed."""
        lower, upper, velocity = limits
        return cls(
            trust,
            **_first(value),
            lower=lower - trust.beyond,
            upper=upper + trust.beyond,
            velocity=1.5 * np.minimum(velocity, UNKNOWN_SPEED),
        )

    def _unsuspicious(self) -> float:
        return self.trust.joint_jump

    def _possible(self, heard: Floats) -> Mask:
        return np.all((heard >= self.lower) & (heard <= self.upper), axis=-1)

    def _near(self, heard: Floats, other: Floats, elapsed: float | Floats) -> Mask:
        reach = self.trust.joint_jump + self.velocity * np.asarray(elapsed)[..., None]
        return (np.abs(heard - other) <= reach).all(-1)

    def _other_unit(self, heard: Floats) -> Mask:
        """Whether it is the last value in degrees, or was and is in radians."""
        size = np.linalg.norm(self.value, axis=-1) + self.trust.joint_jump
        return (
            np.linalg.norm(heard - DEGREES * self.value, axis=-1) < 0.1 * DEGREES * size
        ) | (np.linalg.norm(DEGREES * heard - self.value, axis=-1) < 0.1 * size)


@dataclass(frozen=True, eq=False)
class PoseReading(Reading):
    """An object's pose, shape (..., 7): position [m] and unit quaternion (w, x, y, z).

    Parameters
    ----------
    trust, value, age, why, rival, rival_age, calm
        As for :class:`Reading`.
    """

    @classmethod
    def of(cls, trust: Trust, value: Floats) -> Self:
        """The first one, which is believed."""
        return cls(trust, **_first(value))

    def _unsuspicious(self) -> float:
        return 0.5 * min(self.trust.frame_jump, self.trust.turn_jump / 2)

    def _possible(self, heard: Floats) -> Mask:
        turn = heard[..., 3:]
        return np.abs(np.einsum("...i,...i", turn, turn) - 1) < 2e-2

    def _near(self, heard: Floats, other: Floats, elapsed: float | Floats) -> Mask:
        elapsed = np.asarray(elapsed)
        moved = np.linalg.norm(heard[..., :3] - other[..., :3], axis=-1)
        cosine = np.abs((heard[..., 3:] * other[..., 3:]).sum(-1)).clip(0, 1)
        return (moved <= self.trust.frame_jump + 3 * elapsed) & (
            2 * np.arccos(cosine) <= self.trust.turn_jump + 10 * elapsed
        )
