"""Clocks: how a running skill's time goes on, given what is seen of the robot.

A clock is a setting; starting it gives the progress of some robots, which is replaced, never
changed, at every tick. Progress is computed on the processor in float64: it is a few numbers
for each robot.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.regression.regression import Estimate, Regression

__all__ = [
    "Clock",
    "EvenClock",
    "Observation",
    "Progress",
    "WaitingClock",
    "format_clock",
    "parse_clock",
]

Array = NDArray[np.float64]
#: From standing still, the rate of progress takes that long to be whole again [s].
RESTART = 0.2


@dataclass(frozen=True, eq=False)
class Observation:
    """What a clock may look at before the next tick.

    Parameters
    ----------
    joints : Tensor of shape (..., n_joints), optional
        Where the robots stand [rad or m]; None if that was not measured. NaN stands for a
        coordinate without a sensor.
    reference : Tensor of shape (..., n_joints)
        What they were told at the last tick [rad or m].
    velocity : Tensor of shape (..., n_joints), optional
        Of the reference [rad/s or m/s].
    frames : mapping of str to Frame
        Present poses of the objects.
    estimate : Estimate, optional
        What the reference was made from.
    """

    joints: Tensor | None
    reference: Tensor
    velocity: Tensor | None
    frames: Mapping[str, Frame]
    estimate: Estimate | None = None


class Progress(ABC):
    """How far robots have come in a skill that began and will end.

    Attributes
    ----------
    begin, end : float
        When the skill begins and ends [s].
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
        """Whether the last tick moved the time elsewhere, in place of letting it run.

        A bool tensor of the shape of :attr:`time`; references may jump there.
        """
        return torch.zeros_like(self.time, dtype=torch.bool)

    @abstractmethod
    def advance(self, dt: float | Tensor, observation: Observation) -> Self:
        """The progress after some time, never beyond the skill's beginning and end.

        Parameters
        ----------
        dt : float or Tensor of the batch's shape
            Seconds since the last tick; zero for robots that are on hold.
        observation : Observation
        """


class Clock(ABC):
    """How time goes on in a running skill."""

    @abstractmethod
    def start(
        self,
        regression: Regression,
        begin: float,
        end: float,
        joints: Tensor,
        frames: Mapping[str, Frame],
    ) -> Progress:
        """Start a skill.

        Parameters
        ----------
        regression : Regression
            The skill.
        begin, end : float
            When it begins and ends [s].
        joints : Tensor of shape (..., n_joints)
            Where the robots stand.
        frames : mapping of str to Frame
            Present poses of the objects.

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
        regression: Regression,
        begin: float,
        end: float,
        joints: Tensor,
        frames: Mapping[str, Frame],
    ) -> EvenProgress:
        """Start at the beginning; see :meth:`Clock.start`."""
        _check_span(begin, end)
        like = regression.kinematics.lower
        return EvenProgress(self.speed, begin, end, like, np.asarray(begin, np.float64))


@dataclass(frozen=True, eq=False)
class EvenProgress(Progress):
    """See :class:`EvenClock`."""

    speed: float
    begin: float
    end: float
    like: Tensor
    now: Array

    @property
    def time(self) -> Tensor:
        """Of shape () as long as no robot was on hold; see :attr:`Progress.time`."""
        return _tensor(self.now, self.like)

    def advance(self, dt: float | Tensor, observation: Observation) -> EvenProgress:
        """``dt`` times the speed; see :meth:`Progress.advance`."""
        step = self.speed * (_array(dt) if isinstance(dt, Tensor) else dt)
        return replace(self, now=_until(self.end, self.now + step, step))


@dataclass(frozen=True)
class WaitingClock(Clock):
    """Time waits for robots that do not follow.

    The rate of progress falls with the tracking error in units of what is to be expected: of
    joint j, with ``x`` where a servo with that ``lag`` would be,

        u_j = |reference_j - measured_j| / (|reference_j - x_j| + std_j + floor),

    where std is the standard deviation of the fused Gaussian. Up to ``tolerance`` the largest
    u leaves time alone, at twice the tolerance it stands still. A robot that comes back
    restarts smoothly. Where nothing is measured, time goes on evenly.

    Parameters
    ----------
    speed : float, default=1.0
        Seconds of the skill per second, for robots that follow.
    tolerance : float, default=2.0
        How many times the error that is to be expected is nothing to wait for.
    lag : float, default=0.1
        Time constant of the robot's servos [s].
    floor : float, default=0.02
        Error that means nothing: noise, friction, gravity [rad or m].

    Raises
    ------
    DataError
        If one of them is not positive.

    Examples
    --------
    >>> WaitingClock(tolerance=3)
    WaitingClock(speed=1.0, tolerance=3.0, lag=0.1, floor=0.02)
    """

    speed: float = 1.0
    tolerance: float = 2.0
    lag: float = 0.1
    floor: float = 0.02

    def __post_init__(self) -> None:
        _check_positive(self, "speed", "tolerance", "lag", "floor")

    def start(
        self,
        regression: Regression,
        begin: float,
        end: float,
        joints: Tensor,
        frames: Mapping[str, Frame],
    ) -> WaitingProgress:
        """Start at the beginning; see :meth:`Clock.start`."""
        _check_span(begin, end)
        batch = joints.shape[:-1]
        return WaitingProgress(
            self, regression, begin, end, np.full(batch, begin), np.ones(batch), _array(joints)
        )


@dataclass(frozen=True, eq=False)
class WaitingProgress(Progress):
    """See :class:`WaitingClock`.

    Parameters
    ----------
    clock : WaitingClock
    regression : Regression
    begin, end : float
    now : array of shape (...)
        The time of each robot [s].
    rate : array of shape (...)
        Of the last tick, as a share of the clock's speed.
    expected : array of shape (..., n_joints)
        Where servos with the clock's lag would be now.
    """

    clock: WaitingClock
    regression: Regression
    begin: float
    end: float
    now: Array
    rate: Array
    expected: Array

    @property
    def time(self) -> Tensor:
        """Of the batch's shape; see :attr:`Progress.time`."""
        return _tensor(self.now, self.regression.kinematics.lower)

    def advance(self, dt: float | Tensor, observation: Observation) -> Self:
        """Less than ``dt`` where a robot does not follow; see :meth:`Progress.advance`."""
        clock, passed = self.clock, _array(dt) if isinstance(dt, Tensor) else dt
        reference = _array(observation.reference)
        expected = self._servo(reference, passed)
        rate = np.ones_like(self.now)
        if observation.joints is not None:
            measured = self._like_reference(observation.joints, reference)
            share = self.following(measured, reference, expected, observation.estimate)
            rate = np.minimum(share, self.rate + passed / RESTART)
        step = clock.speed * passed * rate
        now = _until(self.end, self.now + step, step)
        return replace(self, now=now, rate=rate, expected=expected)

    def following(
        self, measured: Array, reference: Array, expected: Array, estimate: Estimate | None
    ) -> Array:
        """How well robots follow: 1 within the tolerance, 0 from twice of it on.

        Parameters
        ----------
        measured, reference, expected : array of shape (..., n_joints)
        estimate : Estimate, optional

        Returns
        -------
        array of shape (...)
        """
        usual = np.abs(reference - expected) + self.clock.floor
        if estimate is not None:
            variance = _array(estimate.covariance.diagonal(dim1=-2, dim2=-1))
            usual += np.sqrt(variance)
        # a coordinate that is not measured says nothing, and nor does a robot without any
        ratio = np.fmax.reduce(np.abs(reference - measured) / usual, -1, initial=0.0)
        excess = np.clip(ratio / self.clock.tolerance - 1, 0, 1)
        return 1 - excess**2 * (3 - 2 * excess)

    def _servo(self, reference: Array, passed: float | Array) -> Array:
        """Where servos of first order are, a tick after they were told the reference."""
        left = np.exp(-np.asarray(passed) / self.clock.lag)[..., None]
        return reference + left * (self.expected - reference)

    def _like_reference(self, joints: Tensor, reference: Array) -> Array:
        """Measured joints, quaternions among them on the side of the reference's."""
        measured = _array(joints)
        starts = self.regression.kinematics.quaternion_starts
        if starts:
            blocks = quaternions.quaternion_blocks(starts, measured.shape[-1]).numpy()
            inner = np.nan_to_num(measured * reference) @ blocks.T
            measured = measured * (1 + (np.copysign(1.0, inner) - 1) @ blocks)
        return measured


def _array(tensor: Tensor) -> Array:
    return tensor.numpy(force=True)


def _tensor(array: Array, like: Tensor) -> Tensor:
    return torch.as_tensor(array, dtype=like.dtype, device=like.device)


def _until(end: float, time: Array, step: float | Array) -> Array:
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


def _check_span(begin: float, end: float) -> None:
    if not -math.inf < begin < end < math.inf:
        raise DataError(f"a skill ends after its beginning, got {begin!r} s to {end!r} s")


CLOCKS: Mapping[str, type[EvenClock] | type[WaitingClock]] = {
    "even": EvenClock,
    "waiting": WaitingClock,
}


def parse_clock(text: str) -> Clock:
    """The clock that a text stands for.

    Parameters
    ----------
    text : str
        A kind, ``even`` or ``waiting``; with options behind a colon, separated by commas.

    Raises
    ------
    DataError
        If there is no such clock or option, or its value is no number; the message lists what
        exists.

    Examples
    --------
    >>> parse_clock("even")
    EvenClock(speed=1.0)
    >>> parse_clock("waiting:tolerance=3,lag=0.05").lag
    0.05
    """
    kind, colon, options = text.partition(":")
    clock = CLOCKS.get(kind.strip())
    if clock is None:
        raise DataError(
            f"clock {text!r}: there is no {kind.strip()!r}; there are {list(CLOCKS)}, each "
            "with options behind a colon, as in 'waiting:tolerance=3,lag=0.05'"
        )
    known = {field.name: field for field in fields(clock)}
    settings: dict[str, Any] = {}
    for option in options.split(",") if colon else ():
        name, _, value = (part.strip() for part in option.partition("="))
        if name not in known or name in settings:
            problem = "is given twice" if name in settings else "is no option"
            raise DataError(
                f"clock {text!r}: {name!r} {problem}; {kind.strip()!r} has {list(known)}, each "
                "written as NAME=VALUE"
            )
        try:
            settings[name] = float(value)
        except ValueError:
            raise DataError(f"clock {text!r}: {name} is a number, got {value!r}") from None
    return clock(**settings)


def format_clock(clock: Clock) -> str:
    """The inverse of :func:`parse_clock`; defaults are left out.

    Parameters
    ----------
    clock : Clock
        A user's own is given by its ``repr``.

    Examples
    --------
    >>> format_clock(WaitingClock(tolerance=3))
    'waiting:tolerance=3'
    """
    for kind, known in CLOCKS.items():
        if type(clock) is known:
            changed = [
                f"{field.name}={str(value).removesuffix('.0')}"
                for field in fields(known)
                if (value := getattr(clock, field.name)) != field.default
            ]
            return ":".join([kind, ",".join(changed)] if changed else [kind])
    return repr(clock)
