"""Clocks: progress of a running skill, from the clock alone or from what is measured.

A clock is a setting; starting it gives the progress of some robots, which is replaced, never
changed, at every tick. Progress is computed on the processor in float64: it is a few numbers
for each robot.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.skills.skill import Observation, Skill

__all__ = ["Clock", "EvenClock", "Progress", "WaitingClock"]

#: Time in which the rate of progress of a robot that stood rises to 1 [s].
RESTART = 0.2


class Progress(ABC):
    """Progress of robots in a skill.

    Attributes
    ----------
    begin, end : float
        Start and end of the skill [s].
    """

    begin: float
    end: float

    @property
    @abstractmethod
    def time(self) -> Tensor:
        """Skill time [s]: of shape () if all robots are alike, else that of the batch."""

    @property
    def finished(self) -> Tensor:
        """Whether the end is reached: a bool tensor of the shape of :attr:`time`."""
        return self.time >= self.end

    @property
    def relocalized(self) -> Tensor:
        """Whether the last tick set the time to another place of the skill.

        A bool tensor of the shape of :attr:`time`; references may jump there.
        """
        return torch.zeros_like(self.time, dtype=torch.bool)

    @abstractmethod
    def advance(self, dt: float | Tensor, observation: Observation) -> Self:
        """Progress after some time, within the skill's beginning and end.

        Parameters
        ----------
        dt : float or Tensor of the batch's shape
            Seconds since the last tick; zero for robots that are on hold.
        observation : Observation
        """


class Clock(ABC):
    """How the time of a running skill goes on."""

    @abstractmethod
    def start(
        self,
        skill: Skill,
        joints: Tensor,
        frames: Mapping[str, Frame],
        begin: float | None = None,
        end: float | None = None,
    ) -> Progress:
        """Start a skill.

        Parameters
        ----------
        skill : Skill
        joints : Tensor of shape (..., n_joints)
            Start postures.
        frames : mapping of str to Frame
            Present poses of the objects.
        begin, end : float, optional
            The part of the skill to run [s]; all of it by default.

        Raises
        ------
        DataError
            If the end is not after the beginning.
        """


@dataclass(frozen=True)
class EvenClock(Clock):
    """Time goes on evenly, whatever the robots do; all robots of a batch are alike.

    Parameters
    ----------
    speed : float, default=1.0
        Seconds of the skill per second.

    Raises
    ------
    DataError
        If the speed is not positive.

    Examples
    --------
    >>> EvenClock(speed=0.5)
    EvenClock(speed=0.5)
    """

    speed: float = 1.0

    def __post_init__(self) -> None:
        _check_positive(self, "speed")

    def start(
        self,
        skill: Skill,
        joints: Tensor,
        frames: Mapping[str, Frame],
        begin: float | None = None,
        end: float | None = None,
    ) -> EvenProgress:
        """Start at the beginning; see :meth:`Clock.start`."""
        begin, end = _span(skill, begin, end)
        now = np.asarray(begin, np.float64)
        return EvenProgress(self.speed, begin, end, skill.kinematics.lower, now)


@dataclass(frozen=True, eq=False)
class EvenProgress(Progress):
    """See :class:`EvenClock`."""

    speed: float
    begin: float
    end: float
    like: Tensor
    now: Array

    @cached_property
    def time(self) -> Tensor:  # type: ignore[override]
        """Of shape () as long as no robot was on hold; see :attr:`Progress.time`."""
        return tensor(self.now, self.like)

    def advance(self, dt: float | Tensor, observation: Observation) -> EvenProgress:
        """``dt`` times the speed; see :meth:`Progress.advance`."""
        step = self.speed * (array(dt) if isinstance(dt, Tensor) else dt)
        return replace(self, now=until(self.end, self.now + step, step))


@dataclass(frozen=True)
class WaitingClock(Clock):
    """Time waits for robots that do not follow.

    The rate of progress falls with the tracking error in units of what is to be expected: of
    joint j, with ``x`` where a servo with that ``lag`` would be,

        ``u_j = |reference_j - measured_j| / (|reference_j - x_j| + std_j + floor)``,

    where std is the standard deviation of the fused Gaussian. Up to ``tolerance`` the largest
    u leaves time alone, at twice the tolerance it stands still. A robot that comes back
    restarts smoothly. Where nothing is measured, time goes on evenly.

    Parameters
    ----------
    speed : float, default=1.0
        Seconds of the skill per second, for robots that follow.
    tolerance : float, default=2.0
        Error up to which time does not wait, in units of the expected error.
    lag : float, default=0.1
        Time constant of the robot's servos [s].
    floor : float, default=0.02
        Error of noise, friction, gravity [rad or m].
    arrivals : tuple of float, default=()
        Times in the skill that are not passed before each joint has come to its reference, but
        for ``floor`` [s]: for a gripper to close when the hand is there, not when it is time.

    Raises
    ------
    DataError
        If a number is not positive, or an arrival no number.

    Examples
    --------
    >>> WaitingClock(tolerance=3)
    WaitingClock(speed=1.0, tolerance=3.0, lag=0.1, floor=0.02, arrivals=())
    """

    speed: float = 1.0
    tolerance: float = 2.0
    lag: float = 0.1
    floor: float = 0.02
    arrivals: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        _check_positive(self, "speed", "tolerance", "lag", "floor")
        try:
            arrivals = tuple(sorted(map(float, self.arrivals)))
        except (TypeError, ValueError):
            arrivals = (math.nan,)
        if not all(map(math.isfinite, arrivals)):
            raise DataError(
                f"arrivals of {type(self).__name__} are times in seconds, got {self.arrivals!r}"
            )
        object.__setattr__(self, "arrivals", arrivals)

    def start(
        self,
        skill: Skill,
        joints: Tensor,
        frames: Mapping[str, Frame],
        begin: float | None = None,
        end: float | None = None,
    ) -> WaitingProgress:
        """Start at the beginning; see :meth:`Clock.start`."""
        begin, end = _span(skill, begin, end)
        one, error = np.ones(joints.shape[:-1]), np.zeros(joints.shape[:-1])
        posture = array(joints)
        return WaitingProgress(
            self, skill, begin, end, begin * one, one, posture, posture, error
        )


@dataclass(frozen=True, eq=False)
class WaitingProgress(Progress):
    """See :class:`WaitingClock`.

    Parameters
    ----------
    clock : WaitingClock
    skill : Skill
    begin, end : float
    now : array of shape (...)
        The time of each robot [s].
    rate : array of shape (...)
        Of the last tick, as a share of the clock's speed.
    expected : array of shape (..., n_joints)
        Where servos with the clock's lag would be now.
    measured : array of shape (..., n_joints)
        Measured joints; the reference where nothing was measured.
    error : array of shape (...)
        The largest tracking error over that of such servos; 0 where nothing was measured.
    """

    clock: WaitingClock
    skill: Skill
    begin: float
    end: float
    now: Array
    rate: Array
    expected: Array
    measured: Array
    error: Array

    @cached_property
    def time(self) -> Tensor:  # type: ignore[override]
        """Of the batch's shape; see :attr:`Progress.time`."""
        return tensor(self.now, self.skill.kinematics.lower)

    def advance(self, dt: float | Tensor, observation: Observation) -> Self:
        """Less than ``dt`` where a robot does not follow; see :meth:`Progress.advance`."""
        return replace(self, **self.waited(dt, observation))

    def waited(self, dt: float | Tensor, observation: Observation) -> dict[str, Any]:
        """The fields of this class after a tick."""
        clock, passed = self.clock, array(dt) if isinstance(dt, Tensor) else dt
        reference = array(observation.reference)
        # servos of first order, a tick after they got the reference
        left = np.exp(-np.asarray(passed) / clock.lag)[..., None]
        expected = reference + left * (self.expected - reference)
        rate, error = np.ones_like(self.now), np.zeros_like(self.now)
        measured = reference
        if observation.joints is not None:
            measured = self._like(reference, observation.joints)
            deviation = np.abs(measured - reference)
            usual = np.abs(reference - expected) + clock.floor
            error = (deviation / usual).max(-1)
            if (late := error > clock.tolerance).any():
                if observation.estimate is not None:
                    usual = usual + deviations(observation.estimate)
                excess = np.clip((deviation / usual).max(-1) / clock.tolerance - 1, 0, 1)
                rate = np.where(late, self.late_rate(1 - excess**2 * (3 - 2 * excess)), rate)
            rate = np.minimum(rate, self.rate + passed / RESTART)
        step = clock.speed * passed * rate
        now = until(self.end, self.now + step, step)
        if clock.arrivals and observation.joints is not None:
            late = np.abs(measured - reference).max(-1) > clock.floor
            stops = np.array([*clock.arrivals, math.inf])
            now = np.where(late, np.minimum(now, stops[stops.searchsorted(self.now)]), now)
        return {
            "now": now,
            "rate": rate,
            "expected": expected,
            "measured": measured,
            "error": error,
        }

    def late_rate(self, following: Array) -> Array:
        """Rate of late robots: ``following`` is 1 within the tolerance, 0 from twice on."""
        return following

    def _like(self, reference: Array, joints: Tensor) -> Array:
        """Measured joints, with the reference where they are NaN, in its hemispheres."""
        measured = array(joints)
        if (unknown := np.isnan(measured)).any():
            measured = np.where(unknown, reference, measured)
        starts = self.skill.kinematics.quaternion_starts
        if starts:
            both = torch.from_numpy(measured), torch.from_numpy(reference)
            measured = quaternions.match_hemisphere(*both, starts).numpy()
        return measured


def array(values: Tensor) -> Array:
    """A copy in float64: whoever measures may use the same memory again."""
    return np.array(values.numpy(force=True), dtype=np.float64)


def tensor(values: Array, like: Tensor) -> Tensor:
    """On the device and in the dtype of another tensor."""
    return torch.as_tensor(values, dtype=like.dtype, device=like.device)


def deviations(estimate: Estimate) -> Array:
    """Standard deviations (..., n_joints) of the references."""
    return np.sqrt(array(estimate.covariance.diagonal(dim1=-2, dim2=-1)))


def until(end: float, time: Array, step: float | Array) -> Array:
    """``time``, at most the end; rounding does not cost a last step."""
    return np.where(time > end - 1e-6 * step, end, time)


def _check_positive(clock: Clock, *names: str) -> None:
    for name in names:
        value = getattr(clock, name)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise DataError(f"{name} of {type(clock).__name__} is a number, got {value!r}")
        if not 0 < value < math.inf:
            raise DataError(f"{name} of {type(clock).__name__} must be positive, got {value!r}")
        object.__setattr__(clock, name, float(value))


def _span(skill: Skill, begin: float | None, end: float | None) -> tuple[float, float]:
    begin = skill.begin if begin is None else begin
    end = skill.end if end is None else end
    if not -math.inf < begin < end < math.inf:
        raise DataError(f"a skill ends after its beginning, got {begin!r} s to {end!r} s")
    return begin, end
