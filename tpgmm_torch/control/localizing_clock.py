"""The localising clock: progress from the likelihood of what is observed.

A belief over the times of a skill says where in it a robot is that does not follow. It moves
along as time does, and is corrected by the likelihood of what is observed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch.control.clocks import (
    WaitingClock,
    WaitingProgress,
    array,
    deviations,
    tensor,
)
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.robots.kinematics import RobotState
from tpgmm_torch.skills.skill import Observation, Skill

__all__ = ["LocalizingClock", "local_mode", "move"]

Flags = NDArray[np.bool_]

#: Spacing of the grid of times, at least [s]: neighbours below look alike.
GRID_STEP = 0.04
#: Places of the skill that are less apart are one: the width of a mode [s].
NEARBY = 0.3
#: Standard deviation of the time of robots that follow [s].
FOLLOWING_STD = 0.1
#: Variance that the belief gains per second [s^2/s].
DIFFUSION = 0.016
#: Independent observations per second: those between them show the same.
OBSERVATION_RATE = 1.25
#: Mean distance of a displaced robot's place from the present time [s].
DISPLACEMENT = 2.0
#: A robot has to be at another place for that long before time moves there [s].
RELOCALISATION_DWELL = 0.05
#: Time stands for that long when a robot was pushed [s].
PUSH_DWELL = 0.3
#: A robot whose error shrinks to that share between two corrections returns by itself.
RETURNING = 0.9
#: Distance of a robot's place from the time at which the rate changes by half [s].
RATE_MARGIN = 0.2
#: A robot that moves by less is stationary [rad or m].
STATIONARY = 0.01
#: A robot is stopped if time goes on for longer after it has come to rest [s].
STOPPED_AFTER = 0.1


@dataclass(frozen=True)
class LocalizingClock(WaitingClock):
    """Time goes on from where the robot is.

    Robots that follow, as :class:`WaitingClock` has it, run evenly. Of one that does not, a
    belief over the times of the skill says where it is: it begins at the present time less
    the lag, moves on as time does, and is corrected by the likelihood of what is observed. As
    long as a place nearby explains the observation no other is considered, so that repeating
    motions do not jump a period. A place explains it if the reference there, in the present
    situation, is as near to the robot as :class:`WaitingClock` expects it to be.

    Time waits for a robot that is behind, hurries after one that is ahead, and moves to the
    place of a displaced one: :attr:`Progress.relocalized` says so. Of one that was pushed, time
    stands until its place was observed. Where no place explains the observation, time waits. A
    robot that was stopped is noticed late: when it moves again, time goes back to when it came
    to rest.

    Parameters
    ----------
    speed, tolerance, lag, floor, arrivals : float or tuple of float
        See :class:`WaitingClock`.
    initial : {"beginning", "anywhere"}, default="beginning"
        Where in the skill robots start. With ``"anywhere"`` that is the earliest of the places
        which explain the start posture best; the beginning if none does, or if it explains it
        too and is not far from there.

    Raises
    ------
    DataError
        If a number is not positive, or ``initial`` is another text.

    Examples
    --------
    >>> LocalizingClock(initial="anywhere").initial
    'anywhere'
    """

    initial: str = "beginning"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.initial not in ("beginning", "anywhere"):
            raise DataError(
                "initial of LocalizingClock is one of ['beginning', 'anywhere'], got "
                f"{self.initial!r}"
            )

    def start(
        self,
        skill: Skill,
        joints: Tensor,
        frames: Mapping[str, Frame],
        begin: float | None = None,
        end: float | None = None,
    ) -> LocalizingProgress:
        """Start at the beginning, or where the robots are; see :meth:`Clock.start`."""
        waiting = super().start(skill, joints, frames, begin, end)
        now, posture, zero = waiting.now, waiting.expected, waiting.error
        duration = waiting.end - waiting.begin
        count = min(4096, max(2, round(duration / GRID_STEP) + 1))  # for very long skills
        progress = LocalizingProgress(
            **{field.name: getattr(waiting, field.name) for field in fields(waiting)},
            grid=np.linspace(waiting.begin, waiting.end, count, dtype=np.float64),
            weights=np.zeros((*now.shape, count)),
            localized=zero > 0,
            lost=zero > 0,
            place=now,
            since_correction=zero,
            corrected_time=now,
            corrected_error=zero,
            followed_time=now,
            followed_joints=posture,
            rest_time=now,
            rest_joints=posture,
            rest_reference=posture,
            stopped=zero > 0,
            resumed_time=now - np.inf,
            elsewhere_for=zero,
            stands_for=zero,
            moved=zero > 0,
        )
        return progress.at_start(frames) if self.initial == "anywhere" else progress


@dataclass(frozen=True, eq=False)
class LocalizingProgress(WaitingProgress):
    """See :class:`LocalizingClock`.

    Parameters
    ----------
    clock, skill, begin, end, now, rate, expected, measured, error
        See :class:`WaitingProgress`.
    grid : array of shape (G,)
        Times over which the belief is, evenly spaced from the beginning to the end [s].
    weights : array of shape (..., G)
        The belief of robots that do not follow.
    localized : bool array of shape (...)
        Robots that do not follow, and whose belief was corrected since.
    lost : bool array of shape (...)
        Robots among them whose place is not known.
    place : array of shape (...)
        The time of a robot's place, if it is known [s].
    since_correction : array of shape (...)
        Time since the last correction [s].
    corrected_time, corrected_error : array of shape (...)
        Skill time and tracking error at the last correction [s].
    followed_time : array of shape (...)
        Skill time when a robot last followed [s].
    followed_joints : array of shape (..., n_joints)
        Its posture then.
    rest_time : array of shape (...)
        Skill time when a robot came to where it is stationary [s].
    rest_joints, rest_reference : array of shape (..., n_joints)
        Its posture and reference then.
    stopped : bool array of shape (...)
        Robots that are stationary although their references moved.
    resumed_time : array of shape (...)
        Skill time to which a stopped robot went back last, which it does once [s].
    elsewhere_for : array of shape (...)
        For how long a robot has been at another place [s].
    stands_for : array of shape (...)
        For how long time stands for a robot that was pushed [s].
    moved : bool array of shape (...)
        See :attr:`Progress.relocalized`.
    """

    grid: Array
    weights: Array
    localized: Flags
    lost: Flags
    place: Array
    since_correction: Array
    corrected_time: Array
    corrected_error: Array
    followed_time: Array
    followed_joints: Array
    rest_time: Array
    rest_joints: Array
    rest_reference: Array
    stopped: Flags
    resumed_time: Array
    elsewhere_for: Array
    stands_for: Array
    moved: Flags

    @property
    def relocalized(self) -> Tensor:
        """See :attr:`Progress.relocalized`."""
        moved = np.asarray(self.moved)  # of numpy's scalars, old versions make no tensors
        return torch.as_tensor(moved, device=self.skill.kinematics.lower.device)

    @property
    def belief(self) -> Tensor:
        """Probability of each time of the grid (..., G): where the robots are."""
        belief = np.where(self.localized[..., None], self.weights, self._nearby(self.now))
        return tensor(belief, self.skill.kinematics.lower)

    def advance(self, dt: float | Tensor, observation: Observation) -> Self:
        """From where the robots are; see :meth:`Progress.advance`."""
        if observation.pushed is not None:
            displaced = self._displaced(observation.pushed.numpy(force=True))
            return displaced.advance(dt, replace(observation, pushed=None))
        new, passed = self.waited(dt, observation), array(dt) if isinstance(dt, Tensor) else dt
        pushed = self.stands_for > 0
        new["now"] = now = np.where(pushed | self.stopped, self.now, new["now"])
        new["rate"] = np.where(pushed | self.stopped, 0.0, new["rate"])
        astray = (new["error"] > self.clock.tolerance) | pushed
        since = self.since_correction + passed
        due = since > (1 - 1e-6) * self._step
        measured, reference = new["measured"], array(observation.reference)
        left = self._left_rest(measured, observation.joints)
        new["since_correction"] = np.where(due, 0.0, since)
        new["rest_time"] = np.where(left, now, self.rest_time)
        new["rest_joints"] = np.where(left[..., None], measured, self.rest_joints)
        new["rest_reference"] = np.where(left[..., None], reference, self.rest_reference)
        new["stands_for"] = np.maximum(self.stands_for - passed, 0.0)
        new["moved"] = none = np.zeros_like(self.moved)
        if not (astray | self.localized).any():
            following = {"followed_time": now, "followed_joints": measured, "stopped": none}
            return replace(self, **new, **following, corrected_time=now)
        # a robot that does not move at all although its reference does is stopped, and is led
        # from there; once it moves again, time goes back to what it has missed
        late = now > self.rest_time + STOPPED_AFTER
        asked = np.abs(reference - self.rest_reference).max(-1)
        stopped = late & (asked > self.clock.tolerance * self.clock.floor)
        resumes = late & left & self.stopped & (astray | self.localized) & ~pushed
        resumes &= np.abs(self.rest_time - self.resumed_time) > NEARBY
        went = replace(
            self,
            **new,
            corrected_time=np.where(due | ~astray, now, self.corrected_time),
            corrected_error=np.where(due, new["error"], self.corrected_error),
            followed_time=np.where(astray, self.followed_time, now),
            followed_joints=np.where(astray[..., None], self.followed_joints, measured),
            stopped=(self.stopped | stopped) & astray & ~left,
            localized=self.localized & astray,
            elsewhere_for=np.where(astray, self.elsewhere_for, 0.0),
        )
        rows = due & astray & ~resumes
        if rows.any():
            went = self._corrected(went, rows, since[rows], observation)
        if not resumes.any():
            return went
        return replace(
            went._relocated(resumes, self.rest_time),
            resumed_time=np.where(resumes, self.rest_time, went.resumed_time),
            localized=went.localized & ~resumes,
        )

    def at_start(self, frames: Mapping[str, Frame]) -> Self:
        """At the places that explain the start postures best.

        Parameters
        ----------
        frames : mapping of str to Frame
        """
        rows = np.ones(self.now.shape, bool)
        measured, seen = self.measured[rows], self._seen(rows, frames)
        likelihood = seen.log_likelihood(self.grid)
        best = likelihood.max(1)
        begin = now = self.now[rows]
        at_begin, known = self._explains(begin, measured, seen), np.zeros(rows.sum(), bool)
        for _ in range(5):  # modes, the highest first
            place = self.grid[likelihood.argmax(1)]
            # of several, as in a repeating motion, the earliest: the others leave something
            # out; log-likelihoods that differ by less than 5 are alike
            fits = self._explains(place, measured, seen)
            fits &= ~known | ((place < now) & (likelihood.max(1) > best - 5.0))
            now, known = np.where(fits, place, now), known | fits
            near = np.abs(self.grid - place[:, None]) <= NEARBY
            likelihood = np.where(near, -np.inf, likelihood)
        # the first half second is left out only where the beginning explains nothing
        now = np.where(at_begin & (now - begin < 0.5), begin, now).reshape(self.now.shape)
        return replace(
            self, now=now, corrected_time=now, followed_time=now, place=now, rest_time=now
        )

    def late_rate(self, following: Array) -> Array:
        """Time waits for a robot that is behind, and hurries up to twice after one ahead."""
        ahead = self.place - self.now
        behind = np.clip(2 + ahead / RATE_MARGIN, 0, 1)
        rate = np.minimum(following, behind)
        rate = np.maximum(rate, np.clip(2 * ahead / RATE_MARGIN, 0, 2.0))
        return np.where(self.localized & ~self.lost, rate, following)

    @property
    def _step(self) -> float:
        return float(self.grid[1] - self.grid[0])

    def _left_rest(self, measured: Array, joints: Tensor | None) -> Flags:
        """Robots that are no longer where they came to rest."""
        away = np.abs(measured - self.rest_joints)
        if joints is not None:  # coordinates that are not measured do not leave
            away = np.where(np.isnan(array(joints)), 0.0, away)
        return np.asarray(away.max(-1) > STATIONARY)

    def _displaced(self, robots: Flags) -> Self:
        """Robots that may be anywhere, and for which time stands."""
        return replace(
            self,
            stands_for=np.where(robots, PUSH_DWELL, self.stands_for),
            weights=np.where(robots[..., None], self._anywhere(self.now), self.weights),
            localized=self.localized | robots,
            lost=self.lost | robots,
        )

    def _anywhere(self, now: Array) -> Array:
        """The belief about displaced robots, the nearer the likelier.

        Ahead counts twice: of places that look alike, those that leave something out are worse.
        """
        apart = self.grid - now[..., None]
        apart = np.maximum(2 * apart, -apart) / DISPLACEMENT
        return _normalized(np.exp(-apart) + 0.01)

    def _nearby(self, now: Array) -> Array:
        """The belief about robots that follow."""
        lag = self.clock.lag * self.clock.speed
        apart = self.grid - np.maximum(now - lag, self.begin)[..., None]
        apart = apart / FOLLOWING_STD
        return _normalized(np.where(np.abs(apart) < 3, np.exp(-0.5 * apart**2), 0.0))

    def _relocated(self, robots: Flags, time: Array) -> Self:
        """Some robots at another time, from where they stand on."""
        joints = robots[..., None]
        times = "now", "corrected_time", "followed_time", "place", "rest_time"
        postures = "followed_joints", "expected", "rest_joints", "rest_reference"
        fields: dict[str, Any] = {
            name: np.where(robots, time, getattr(self, name)) for name in times
        }
        fields |= {
            name: np.where(joints, self.measured, getattr(self, name)) for name in postures
        }
        return replace(
            self,
            **fields,
            rate=np.where(robots, 0.0, self.rate),
            elsewhere_for=np.where(robots, 0.0, self.elsewhere_for),
            moved=self.moved | robots,
        )

    def _corrected(
        self, went: Self, rows: Flags, since: Array, observation: Observation
    ) -> Self:
        """``went``, with the belief of some robots corrected; ``self`` is the last tick's."""
        clock, measured = self.clock, went.measured[rows]
        pushed = went.stands_for[rows] > 0
        seen = went._seen(rows, observation.frames, observation.attach)
        belief = self._predicted(went.now[rows], rows, since)
        [inside] = np.nonzero(belief.any(0))
        window = slice(inside[0], inside[-1] + 1)
        # while time stands for a pushed robot, that is worth one observation
        worth = since * np.where(pushed, 1 / PUSH_DWELL, OBSERVATION_RATE)
        evidence = worth[:, None] * seen.log_likelihood(self.grid, window)
        belief[:, window] = _posterior(belief[:, window], evidence)
        place = local_mode(belief, self.grid)
        explained = self._explains(place, measured, seen)
        place = np.clip(place + clock.lag * clock.speed, self.begin, self.end)
        # a robot that is held is nowhere that it has not been
        distance = np.abs(measured - went.followed_joints[rows]).max(-1)
        moved = pushed | (distance > 2 * clock.tolerance * clock.floor)
        place = np.where(moved, place, np.minimum(place, went.followed_time[rows]))
        elsewhere = explained & moved & self._is_elsewhere(went, rows, place)
        elsewhere_for = np.where(elsewhere, self.elsewhere_for[rows] + since, 0.0)
        moves = elsewhere & (self.elsewhere_for[rows] > 0)
        moves &= elsewhere_for > RELOCALISATION_DWELL
        went = replace(
            went,
            weights=_put(went.weights, rows, belief),
            localized=went.localized | rows,
            lost=_put(went.lost, rows, ~explained),
            place=_put(went.place, rows, place),
            elsewhere_for=_put(went.elsewhere_for, rows, elsewhere_for),
        )
        if not moves.any():
            return went
        return went._relocated(_put(np.zeros_like(rows), rows, moves), went.place)

    def _predicted(self, now: Array, rows: Flags, since: Array) -> Array:
        """The belief of some robots before the observation."""
        before, step = self.corrected_time[rows], self._step
        shift = np.maximum(now - before, 0.0) / step
        belief = move(self.weights[rows], shift, DIFFUSION * since / step**2)
        localized, lost = self.localized[rows], (self.localized & self.lost)[rows]
        belief = np.where(localized[:, None], belief, self._nearby(before))
        # where no place nearby explains the observation, the robot is elsewhere
        return np.where(lost[:, None], 0.9 * belief + 0.1 * self._anywhere(now), belief)

    def _is_elsewhere(self, went: Self, rows: Flags, place: Array) -> Flags:
        """Whether robots are at another place, and neither late nor on their way back."""
        pushed, error = went.stands_for[rows] > 0, went.error[rows]
        # a slow one is between where it was when it last followed and the present time
        slow = (place > went.followed_time[rows] - NEARBY) & (place < went.now[rows] + NEARBY)
        far = pushed | (error > 2 * self.clock.tolerance)
        # one that was held, and is let go, returns to the reference
        known = self.localized[rows] & (self.elsewhere_for[rows] == 0)
        returns = known & (error < RETURNING * self.corrected_error[rows])
        return np.asarray(~slow & far & (pushed | ~returns))

    def _seen(
        self,
        rows: Flags,
        frames: Mapping[str, Frame],
        attach: Callable[[RobotState], RobotState] | None = None,
    ) -> _Seen:
        """Some robots as they are observed."""
        kinematics, mask = self.skill.kinematics, torch.from_numpy(np.asarray(rows))
        with torch.inference_mode():
            if attach is None:
                state = kinematics.state(tensor(self.measured[rows], kinematics.lower))
            else:  # the objects that robots hold are attached to all robots
                state = attach(kinematics.state(tensor(self.measured, kinematics.lower)))
                state = state[mask]
            shared = {
                name: frame.expand(rows.shape)[mask] if frame.batch_shape else frame
                for name, frame in frames.items()
            }
            if len(state.joints) == 1:  # one robot is faster computed without a batch
                state = state[0]
                shared = {name: f[0] if f.batch_shape else f for name, f in shared.items()}
        names = frozenset((*shared, *state.links))
        skill = self.skill.observed(names)
        return _Seen(skill and skill.of_robots(mask), state, shared)

    def _explains(self, place: Array, measured: Array, seen: _Seen) -> Flags:
        """Whether robots are near the references at some times (B,)."""
        estimate = seen.reference(place)
        if estimate is None:
            return np.zeros(len(place), bool)
        usual = self.clock.floor + deviations(estimate)
        ratio = np.abs(array(estimate.joints) - measured) / usual
        return np.asarray(np.atleast_2d(ratio).max(-1) <= self.clock.tolerance)


@dataclass(frozen=True, eq=False)
class _Seen:
    """Observed robots, and the skill as far as it is observed."""

    skill: Skill | None
    state: RobotState
    frames: Mapping[str, Frame]

    def log_likelihood(self, grid: Array, window: slice = slice(None)) -> Array:
        """Of the times of a window, (B, G)."""
        if self.skill is None:
            return np.zeros((1, len(grid[window])))
        times = torch.from_numpy(grid)
        return array(self.skill.log_likelihood(times, self.state, self.frames, window))

    def reference(self, time: Array) -> Estimate | None:
        """The skill's estimate for the robots at times (B,) [s]; None if nothing is seen."""
        if self.skill is None:
            return None
        with torch.inference_mode():
            joints = self.state.joints
            times = torch.as_tensor(time).to(joints).view(joints.shape[:-1])
            return self.skill.estimate(times, self.state, self.frames)


def _normalized(belief: Array) -> Array:
    return belief / belief.sum(-1, keepdims=True)


def _posterior(belief: Array, evidence: Array) -> Array:
    """The belief times the exponential of the evidence, without what is below e^-30."""
    with np.errstate(divide="ignore"):
        log_belief = np.log(belief) + evidence
    log_belief -= log_belief.max(-1, keepdims=True)
    return _normalized(np.where(log_belief > -30.0, np.exp(log_belief), 0.0))


def _put(values: NDArray[Any], rows: Flags, new: NDArray[Any]) -> NDArray[Any]:
    values = np.array(values)
    values[rows] = new
    return values


def move(belief: Array, shift: Array, spread: Array) -> Array:
    """A belief moved and widened; at the ends of the grid it piles up.

    Parameters
    ----------
    belief : array of shape (B, G)
    shift : array of shape (B,)
        How many instants it moves on, in fractions, not below zero.
    spread : array of shape (B,)
        The variance that it gains [instants^2]; more than 0.5 is 0.5.
    """
    size = belief.shape[1]
    aside = np.minimum(spread, 0.5) / 2
    reach = int(np.ceil(shift.max(initial=0.0))) + 1
    moved = np.zeros((len(belief), size + reach + 1))
    for offset in range(-1, reach + 1):
        apart = offset - shift
        kernel = np.zeros_like(shift)
        for side, share in ((-1, aside), (0, 1 - 2 * aside), (1, aside)):
            kernel += share * np.maximum(0, 1 - np.abs(apart - side))
        moved[:, offset + 1 : offset + 1 + size] += kernel[:, None] * belief
    moved[:, 1] += moved[:, 0]
    moved[:, size] += moved[:, size + 1 :].sum(1)
    return moved[:, 1 : size + 1]


def local_mode(belief: Array, instants: Array) -> Array:
    """Mean of the highest mode [s], (B,): that of two places would be neither.

    Parameters
    ----------
    belief : array of shape (B, G)
    instants : array of shape (G,)
    """
    highest = instants[belief.argmax(1)]
    inside = np.where(np.abs(instants - highest[:, None]) <= NEARBY, belief, 0.0)
    return np.asarray((inside @ instants) / inside.sum(1))
