"""Clocks: how a running skill's time goes on, given what is seen of the robot.

A clock is a setting; starting it gives the progress of some robots, which is replaced, never
changed, at every tick. Progress is computed on the processor in float64: it is a few numbers
for each robot.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.control.localization import MODE, SPREAD, Localizer, Look, local_mode, move
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.robots.kinematics import RobotState
from tpgmm_torch.skills.skill import Observation

__all__ = [
    "Clock",
    "EvenClock",
    "LocalizingClock",
    "Progress",
    "WaitingClock",
    "format_clock",
    "parse_clock",
]

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
#: From standing still, the rate of progress takes that long to be whole again [s].
RESTART = 0.2
#: What robots may be believed at the start of a skill.
INITIAL = ("beginning", "anywhere")
#: Places whose log-likelihoods differ by less explain a posture alike.
ALIKE = 5.0
#: So many places may explain the start posture.
CANDIDATES = 5
#: A skill that might begin there may as well begin at its beginning [s].
SOON = 0.5
#: Standard deviation of the time of robots that follow [s].
WIDTH = 0.1
#: Observations per second that are worth one by themselves: those between see the same.
EVIDENCE = 1.25
#: Logarithm of a probability that is none, beside the most likely one's.
NOTHING = -30.0
#: Robots that are brought elsewhere: mean distance on the skill [s].
ELSEWHERE = 2.0
#: Places that are less apart are no others [s].
JUMP = 0.3
#: For how long a robot is known to be elsewhere before time moves there [s].
PATIENCE = 0.05
#: For how long time stands when a robot was pushed: where to is found, and it is let go [s].
UNDECIDED = 0.3
#: A robot returns whose error falls below that share of itself between two corrections.
RETURNING = 0.9
#: So far behind the time a robot may be, beyond its lag [s]; twice, and time stands still.
GRACE = 0.2
#: A robot that moves by less has not moved [rad or m].
STILL = 0.01
#: A robot is missed late if time goes on for longer after it has come to rest [s].
PAUSE = 0.1
#: Below that share of its speed, time stands, and a robot is led.
STANDS = 0.05
#: The most that time hurries, in units of its speed.
HURRY = 2.0


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

    @cached_property
    def time(self) -> Tensor:  # type: ignore[override]
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

        ``u_j = |reference_j - measured_j| / (|reference_j - x_j| + std_j + floor)``,

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
        regression: Regression,
        begin: float,
        end: float,
        joints: Tensor,
        frames: Mapping[str, Frame],
    ) -> WaitingProgress:
        """Start at the beginning; see :meth:`Clock.start`."""
        _check_span(begin, end)
        one, error = np.ones(joints.shape[:-1]), np.zeros(joints.shape[:-1])
        stand = _array(joints)
        return WaitingProgress(
            self, regression, begin, end, begin * one, one, stand, stand, error
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
    measured : array of shape (..., n_joints)
        Where the robots are; where that is not known, what they were told.
    error : array of shape (...)
        The largest tracking error over what the servo lets one expect; 0 where none is known.
    """

    clock: WaitingClock
    regression: Regression
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
        return _tensor(self.now, self.regression.kinematics.lower)

    def advance(self, dt: float | Tensor, observation: Observation) -> Self:
        """Less than ``dt`` where a robot does not follow; see :meth:`Progress.advance`."""
        return replace(self, **self._went(dt, observation))

    def _went(self, dt: float | Tensor, observation: Observation) -> dict[str, Any]:
        """What is new after some time."""
        clock, passed = self.clock, _array(dt) if isinstance(dt, Tensor) else dt
        reference = _array(observation.reference)
        # servos of first order, a tick after they were told the reference
        left = np.exp(-np.asarray(passed) / clock.lag)[..., None]
        expected = reference + left * (self.expected - reference)
        rate, error = np.ones_like(self.now), np.zeros_like(self.now)
        measured = reference
        if observation.joints is not None:
            measured = self._measured(observation.joints, reference)
            deviation = np.abs(measured - reference)
            usual = np.abs(reference - expected) + clock.floor
            error = (deviation / usual).max(-1)
            if (late := error > clock.tolerance).any():
                if observation.estimate is not None:
                    usual = usual + _deviations(observation.estimate)
                excess = np.clip((deviation / usual).max(-1) / clock.tolerance - 1, 0, 1)
                rate = np.where(late, self._rate(1 - excess**2 * (3 - 2 * excess)), rate)
            rate = np.minimum(rate, self.rate + passed / RESTART)
        step = clock.speed * passed * rate
        now = _until(self.end, self.now + step, step)
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

    def _rate(self, following: Array) -> Array:
        """Rate of robots that follow by a share: 1 within the tolerance, 0 from twice on."""
        return following

    def _measured(self, joints: Tensor, reference: Array) -> Array:
        """Joints like the reference: where they are unknown, the same; quaternions' signs."""
        measured = _array(joints)
        if (unknown := np.isnan(measured)).any():
            measured = np.where(unknown, reference, measured)
        starts = self.regression.kinematics.quaternion_starts
        if starts:
            both = torch.from_numpy(measured), torch.from_numpy(reference)
            measured = quaternions.match_hemisphere(*both, starts).numpy()
        return measured


@dataclass(frozen=True)
class LocalizingClock(WaitingClock):
    """Time goes on from where the robot is.

    Robots that follow, as :class:`WaitingClock` has it, run evenly. Of one that does not, a
    belief over the instants of the skill says where it is: it begins at the present time less
    the lag, moves on as time does, and is corrected by the likelihood of what is observed. As
    long as a place nearby explains the observation, no other is believed, so that repeating
    motions do not jump a period. A place explains it if the reference there, in the present
    situation, is as near to the robot as :class:`WaitingClock` expects it to be.

    Time waits for a robot that is behind, hurries after one that is ahead, and moves to where
    a robot is that was brought to another place: :attr:`Progress.relocalized` says so. Of one
    that was pushed, no place is believed before it was looked at; until then time stands. Where
    no place explains what is observed, time waits. A robot that was stopped is missed late:
    when it moves again, time goes back to when it came to rest.

    Parameters
    ----------
    speed, tolerance, lag, floor, arrivals : float or tuple of float
        See :class:`WaitingClock`.
    initial : {"beginning", "anywhere"}, default="beginning"
        Where in the skill robots are believed to be at its start. With ``"anywhere"`` that is
        the earliest of the places which explain the start posture best; the beginning if none
        does, or if it explains it too and is not far from there.

    Raises
    ------
    DataError
        If a number is not positive, or the initial belief is none of these.

    Examples
    --------
    >>> LocalizingClock(initial="anywhere").initial
    'anywhere'
    """

    initial: str = "beginning"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.initial not in INITIAL:
            raise DataError(
                f"initial of LocalizingClock is one of {list(INITIAL)}, got {self.initial!r}"
            )

    def start(
        self,
        regression: Regression,
        begin: float,
        end: float,
        joints: Tensor,
        frames: Mapping[str, Frame],
    ) -> LocalizingProgress:
        """Start at the beginning, or where the robots are; see :meth:`Clock.start`."""
        waiting = super().start(regression, begin, end, joints, frames)
        localizer, no = Localizer(regression, begin, end), np.zeros(joints.shape[:-1], bool)
        progress = LocalizingProgress(
            **{field.name: getattr(waiting, field.name) for field in fields(waiting)},
            localizer=localizer,
            since=waiting.error,
            before=waiting.now,
            reached=waiting.now,
            stood=waiting.expected,
            strayed=waiting.error,
            weights=np.zeros((*no.shape, len(localizer.instants))),
            localized=no,
            lost=no,
            place=waiting.now,
            sure=waiting.error,
            moved=no,
            rest=waiting.expected,
            rested=waiting.now,
            told=waiting.expected,
            stalled=no,
            returned=waiting.now - math.inf,
            undecided=waiting.error,
        )
        return progress.located(frames) if self.initial == "anywhere" else progress


@dataclass(frozen=True, eq=False)
class LocalizingProgress(WaitingProgress):
    """See :class:`LocalizingClock`.

    Parameters
    ----------
    clock, regression, begin, end, now, rate, expected, measured, error
        See :class:`WaitingProgress`.
    localizer : Localizer
    since : array of shape (...)
        Since when the belief has not been corrected [s].
    before : array of shape (...)
        The time at the last correction [s].
    reached : array of shape (...)
        The time when a robot last followed [s].
    stood : array of shape (..., n_joints)
        Where it stood then.
    strayed : array of shape (...)
        The error at the last correction.
    weights : array of shape (..., G)
        The belief of robots that do not follow.
    localized : bool array of shape (...)
        Those whose belief was corrected since.
    lost : bool array of shape (...)
        Robots among them whose place is not known.
    place : array of shape (...)
        The time that suits where a robot is, if it is known [s].
    sure : array of shape (...)
        For how long that has been another place than the present one [s].
    moved : bool array of shape (...)
        See :attr:`Progress.relocalized`.
    rest : array of shape (..., n_joints)
        The posture that a robot has not left since.
    rested : array of shape (...)
        The time when it came there [s].
    told : array of shape (..., n_joints)
        Their reference then.
    stalled : bool array of shape (...)
        Robots that have not moved since, although their references have.
    returned : array of shape (...)
        Where time has gone back to last, which it does once [s].
    undecided : array of shape (...)
        For how long time stands for a robot that was pushed [s].
    """

    localizer: Localizer
    since: Array
    before: Array
    reached: Array
    stood: Array
    strayed: Array
    weights: Array
    localized: Flags
    lost: Flags
    place: Array
    sure: Array
    moved: Flags
    rest: Array
    rested: Array
    told: Array
    stalled: Flags
    returned: Array
    undecided: Array

    @property
    def relocalized(self) -> Tensor:
        """See :attr:`Progress.relocalized`."""
        moved = np.asarray(self.moved)  # of numpy's scalars, old versions make no tensors
        return torch.as_tensor(moved, device=self.regression.kinematics.lower.device)

    @property
    def belief(self) -> Tensor:
        """Probability of each of the localizer's instants (..., G): where the robots are."""
        near = self._near(self.now)
        belief = np.where(self.localized[..., None], self.weights, near)
        return _tensor(belief, self.regression.kinematics.lower)

    def advance(self, dt: float | Tensor, observation: Observation) -> Self:
        """From where the robots are; see :meth:`Progress.advance`."""
        if observation.pushed is not None:
            lost = self._lost(observation.pushed.numpy(force=True))
            return lost.advance(dt, replace(observation, pushed=None))
        new, passed = self._went(dt, observation), _array(dt) if isinstance(dt, Tensor) else dt
        pushed, reference = self.undecided > 0, _array(observation.reference)
        for key, stands in (("now", self.now), ("rate", 0.0)):
            new[key] = np.where(pushed | self.stalled, stands, new[key])
        now, measured = new["now"], new["measured"]
        astray = (new["error"] > self.clock.tolerance) | pushed
        since = self.since + passed
        due = since > (1 - 1e-6) * self.localizer.step
        new["since"] = np.where(due, 0.0, since)
        away = np.abs(measured - self.rest)
        if observation.joints is not None:  # what is not known does not leave
            away = np.where(np.isnan(_array(observation.joints)), 0.0, away)
        left = away.max(-1) > STILL
        no = np.zeros_like(self.moved)
        stood: dict[str, Any] = {
            "rest": np.where(left[..., None], measured, self.rest),
            "rested": np.where(left, now, self.rested),
            "told": np.where(left[..., None], reference, self.told),
            "undecided": np.maximum(self.undecided - passed, 0.0),
        }
        if not (astray | self.localized).any():
            return replace(
                self,
                **new,
                **stood,
                before=now,
                reached=now,
                stood=measured,
                stalled=no,
                moved=no,
            )
        # one that does not move at all although it should is stopped, and is led from there;
        # let go, it does again what it has not done
        late = now > self.rested + PAUSE
        told = np.abs(reference - self.told).max(-1)
        stopped = late & (told > self.clock.tolerance * self.clock.floor)
        back = late & left & self.stalled & (astray | self.localized) & ~pushed
        back &= np.abs(self.rested - self.returned) > JUMP
        went = replace(
            self,
            **new,
            **stood,
            stalled=(self.stalled | stopped) & astray & ~left,
            before=np.where(due | ~astray, now, self.before),
            reached=np.where(astray, self.reached, now),
            stood=np.where(astray[..., None], self.stood, measured),
            strayed=np.where(due, new["error"], self.strayed),
            localized=self.localized & astray,
            sure=np.where(astray, self.sure, 0.0),
            moved=no,
        )
        rows = due & astray & ~back
        if rows.any():
            went = self._corrected(went, rows, since, observation)
        if not back.any():
            return went
        return replace(
            went._relocated(back, self.rested),
            returned=np.where(back, self.rested, went.returned),
            localized=went.localized & ~back,
        )

    def _lost(self, robots: Flags) -> Self:
        """Robots that may be anywhere, the nearer the sooner."""
        return replace(
            self,
            undecided=np.where(robots, UNDECIDED, self.undecided),
            weights=np.where(robots[..., None], self._anywhere(self.now), self.weights),
            localized=self.localized | robots,
            lost=self.lost | robots,
        )

    def _anywhere(self, now: Array) -> Array:
        """The belief about robots that are not where they should be.

        Ahead counts twice: of places that look alike, those that leave something out are worse.
        """
        apart = self.localizer.instants - now[..., None]
        apart = np.maximum(2 * apart, -apart) / ELSEWHERE
        return _normalized(np.exp(-apart) + 0.01)

    def _relocated(self, robots: Flags, time: Array) -> Self:
        """The time of some robots moved elsewhere, from where they stand on."""
        joints = robots[..., None]
        return replace(
            self,
            now=np.where(robots, time, self.now),
            before=np.where(robots, time, self.before),
            reached=np.where(robots, time, self.reached),
            place=np.where(robots, time, self.place),
            stood=np.where(joints, self.measured, self.stood),
            expected=np.where(joints, self.measured, self.expected),
            rest=np.where(joints, self.measured, self.rest),
            told=np.where(joints, self.measured, self.told),
            rested=np.where(robots, time, self.rested),
            rate=np.where(robots, 0.0, self.rate),
            sure=np.where(robots, 0.0, self.sure),
            moved=self.moved | robots,
        )

    def _rate(self, following: Array) -> Array:
        """Behind the time, it waits for the robot; ahead of it, it hurries after the robot."""
        ahead = self.place - self.now
        behind = np.clip(2 + ahead / GRACE, 0, 1)
        rate = np.maximum(np.minimum(following, behind), np.clip(2 * ahead / GRACE, 0, HURRY))
        return np.where(self.localized & ~self.lost, rate, following)

    def _near(self, now: Array) -> Array:
        """The belief about robots that follow."""
        lag = self.clock.lag * self.clock.speed
        apart = (self.localizer.instants - np.maximum(now - lag, self.begin)[..., None]) / WIDTH
        return _normalized(np.where(np.abs(apart) < 3, np.exp(-0.5 * apart**2), 0.0))

    def _corrected(
        self, went: Self, rows: Flags, since: Array, observation: Observation
    ) -> Self:
        """After a look at robots that do not follow; ``self`` is how it was before."""
        clock, localizer, measured = self.clock, self.localizer, went.measured[rows]
        now, before, passed = went.now[rows], self.before[rows], since[rows]
        shift = np.maximum(now - before, 0.0) / localizer.step
        belief = move(self.weights[rows], shift, SPREAD * passed / localizer.step**2)
        localized, lost = self.localized[rows], (self.localized & self.lost)[rows]
        pushed = went.undecided[rows] > 0
        belief = np.where(localized[:, None], belief, self._near(before))
        # where no place nearby explains what is seen it is elsewhere
        belief = np.where(lost[:, None], 0.9 * belief + 0.1 * self._anywhere(now), belief)
        look = went._look(rows, observation.frames, observation.attach)
        [inside] = np.nonzero(belief.any(0))
        window = slice(inside[0], inside[-1] + 1)
        # while time stands for one that was pushed, what is seen is worth one observation
        worth = passed * np.where(pushed, 1 / UNDECIDED, EVIDENCE)
        evidence = worth[:, None] * look.log_likelihood(window)
        belief[:, window] = _posterior(belief[:, window], evidence)
        place = local_mode(belief, localizer.instants)
        explained = self._explains(place, measured, look)
        place = np.clip(place + clock.lag * clock.speed, self.begin, self.end)
        # one that is held stands where it stood, and is nowhere that it has not been
        distance = np.abs(measured - went.stood[rows]).max(-1)
        moved = pushed | (distance > 2 * clock.tolerance * clock.floor)
        place = np.where(moved, place, np.minimum(place, went.reached[rows]))
        # a slow one is between where it was when it last followed and the present time
        slow = (place > went.reached[rows] - JUMP) & (place < now + JUMP)
        elsewhere = explained & moved & ~slow
        error = went.error[rows]
        elsewhere &= pushed | (error > 2 * clock.tolerance)
        # one that was held, and is let go, returns to the reference: it goes nowhere else
        known = localized & (self.sure[rows] == 0)
        elsewhere &= pushed | ~(known & (error < RETURNING * self.strayed[rows]))
        sure = np.where(elsewhere, self.sure[rows] + passed, 0.0)
        moves = elsewhere & (self.sure[rows] > 0) & (sure > PATIENCE)
        went = replace(
            went,
            weights=_put(went.weights, rows, belief),
            localized=went.localized | rows,
            lost=_put(went.lost, rows, ~explained),
            place=_put(went.place, rows, place),
            sure=_put(went.sure, rows, sure),
        )
        if not moves.any():
            return went
        return went._relocated(_put(np.zeros_like(rows), rows, moves), went.place)

    def _look(
        self,
        rows: Flags,
        frames: Mapping[str, Frame],
        attach: Callable[[RobotState], RobotState] | None = None,
    ) -> Look:
        """What is seen of some robots."""
        kinematics, mask = self.regression.kinematics, torch.from_numpy(np.asarray(rows))
        with torch.inference_mode():
            if attach is None:
                state = kinematics.state(_tensor(self.measured[rows], kinematics.lower))
            else:  # of all robots: what they carry is
                state = attach(kinematics.state(_tensor(self.measured, kinematics.lower)))
                state = state[mask]
            shared = {
                name: frame.expand(rows.shape)[mask] if frame.batch_shape else frame
                for name, frame in frames.items()
            }
        return self.localizer.look(state, shared)

    def _explains(self, place: Array, measured: Array, look: Look) -> Flags:
        """Whether the references at some times (B,) are where the robots are."""
        estimate = look.reference(place)
        if estimate is None:
            return np.zeros(len(place), bool)
        usual = self.clock.floor + _deviations(estimate)
        ratio = np.abs(_array(estimate.joints) - measured) / usual
        return np.asarray(np.atleast_2d(ratio).max(-1) <= self.clock.tolerance)

    def located(self, frames: Mapping[str, Frame]) -> Self:
        """At the places that explain best where the robots are."""
        rows, instants = np.ones(self.now.shape, bool), self.localizer.instants
        measured = self.measured[rows]
        look = self._look(rows, frames)
        likelihood = look.log_likelihood()
        best = likelihood.max(1)
        begin = now = self.now[rows]
        at_begin, known = self._explains(begin, measured, look), np.zeros(rows.sum(), bool)
        for _ in range(CANDIDATES):
            place = instants[likelihood.argmax(1)]
            # of several, as in a repeating motion, the earliest: the others leave something out
            fits = self._explains(place, measured, look)
            fits &= ~known | ((place < now) & (likelihood.max(1) > best - ALIKE))
            now, known = np.where(fits, place, now), known | fits
            near = np.abs(instants - place[:, None]) <= MODE
            likelihood = np.where(near, -np.inf, likelihood)
        # little is left out only with a reason
        now = np.where(at_begin & (now - begin < SOON), begin, now).reshape(self.now.shape)
        return replace(self, now=now, before=now, reached=now, place=now, rested=now)


def _array(tensor: Tensor) -> Array:
    """A copy: whoever measures may use the same memory again."""
    return np.array(tensor.numpy(force=True), dtype=np.float64)


def _deviations(estimate: Estimate) -> Array:
    """Standard deviations (..., n_joints) of the references."""
    return np.sqrt(_array(estimate.covariance.diagonal(dim1=-2, dim2=-1)))


def _normalized(belief: Array) -> Array:
    return belief / belief.sum(-1, keepdims=True)


def _posterior(belief: Array, evidence: Array) -> Array:
    """The belief times the exponential of the evidence, without what is next to nothing."""
    with np.errstate(divide="ignore"):
        log_belief = np.log(belief) + evidence
    log_belief -= log_belief.max(-1, keepdims=True)
    return _normalized(np.where(log_belief > NOTHING, np.exp(log_belief), 0.0))


def _put(array: NDArray[Any], rows: Flags, values: NDArray[Any]) -> NDArray[Any]:
    array = np.array(array)
    array[rows] = values
    return array


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
    "localizing": LocalizingClock,
}


def parse_clock(text: str | Clock) -> Clock:
    """The clock that a text stands for.

    Parameters
    ----------
    text : str or Clock
        A kind, ``even``, ``waiting`` or ``localizing``; with options
        behind a colon, separated by commas. A clock stands for itself.

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
    if isinstance(text, Clock):
        return text
    if not isinstance(text, str):
        raise DataError(
            f"a clock is one of {list(CLOCKS)}, as text or as an object, got {text!r}"
        )
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
        default = known[name].default
        try:
            if isinstance(default, tuple):
                settings[name] = tuple(map(float, value.split("/")))
            else:
                settings[name] = value if isinstance(default, str) else float(value)
        except ValueError:
            form = "numbers joined by '/'" if isinstance(default, tuple) else "a number"
            raise DataError(f"clock {text!r}: {name} takes {form}, got {value!r}") from None
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
                f"{field.name}={_text(value)}"
                for field in fields(known)
                if (value := getattr(clock, field.name)) != field.default
            ]
            return ":".join([kind, ",".join(changed)] if changed else [kind])
    return repr(clock)


def _text(value: Any) -> str:
    return (
        "/".join(map(_text, value))
        if isinstance(value, tuple)
        else str(value).removesuffix(".0")
    )
