"""A running skill: Algorithm 1's synthesis, one control tick at a time."""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch.checks.situations import START
from tpgmm_torch.checks.summary import TrainingSummary
from tpgmm_torch.control.clock_text import parse_clock
from tpgmm_torch.control.clocks import Clock
from tpgmm_torch.control.command import Command, Status
from tpgmm_torch.control.displacement import Displacement
from tpgmm_torch.control.hold_watch import HoldWatch
from tpgmm_torch.control.holding import Holding
from tpgmm_torch.control.localizing_clock import LocalizingClock
from tpgmm_torch.control.situations import completed_frames, report_start
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError, ShapeError, TPGMMError
from tpgmm_torch.impedance.stiffness import Impedance
from tpgmm_torch.motion.follower import Follower, Seconds
from tpgmm_torch.motion.minimum_jerk import fading_time, minimum_jerk
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.robots.kinematics import RobotState
from tpgmm_torch.sensing.inputs import Inputs
from tpgmm_torch.sensing.pose_filter import OneEuro
from tpgmm_torch.sensing.trust import Trust
from tpgmm_torch.skills.skill import Observation, Skill

__all__ = ["Controller"]

#: Below that share of the clock's speed a robot waits, and is led.
WAITING_RATE = 0.05
#: Share of the usual lead of waiting robots that hold something.
HOLDING_LEAD = 1 / 3
#: Wanted postures are multiples of ``1 / GRID`` [rad or m]: the rounding of a batch, which is
#: another one for each size, ends there, before the follower enlarges it.
GRID = 2.0**32
#: Duration of a tick for robots whose time did not increase, and which are held [s].
INSTANT = 1e-6


@dataclass
class _Tick:
    """What is known of one tick: durations, measurements, progress.

    Parameters
    ----------
    seconds : float or array of shape (...)
        Duration of the tick, at most the longest step that is trusted.
    passed : float or Tensor of shape (...)
        The same, 0 for robots that are held.
    measured : Tensor of shape (..., n_joints), optional
        NaN where nothing was accepted.
    halted, late : Tensor of bool of shape (...), optional
        Robots without accepted inputs, and those whose time did not increase.
    ended : Tensor of bool of shape (...), optional
        Robots that have been at the end of the skill for a tick.
    waits : Tensor of bool of shape (...), optional
        Robots whose clock stands.
    following : Follower, optional
        At the wanted posture, where all robots can follow it.
    """

    seconds: Seconds
    passed: float | Tensor
    measured: Tensor | None
    halted: Tensor | None
    late: Tensor | None
    ended: Tensor | None = None
    waits: Tensor | None = None
    following: Follower | None = None


class Controller:
    """A batch of robots that run a skill, each at its own pace, from its beginning to its end.

    At each step a clock says how far each robot is, from what is measured; the skill gives the
    estimate there; a follower goes there within the bounds of motion. Inputs that cannot be
    right are rejected, and a robot without accepted inputs is held until there are some. After
    the end the last reference is held. Robots of a batch do not influence each other.

    Parameters
    ----------
    skill : Skill
        A fitted model's ``skill``, or one that holds others.
    joints : array-like of shape (..., n_joints)
        The start postures.
    frames : mapping of str to Frame, optional
        Poses of the objects until a step is given others, of shapes that broadcast with the
        batch.
    clock : Clock or str
        How the time of the skill goes on; text is for :func:`parse_clock`. Without measured
        joints, every clock runs evenly.
    trust : Trust, optional
        Which measurements are accepted; None accepts everything, and raises on what is wrong.
    smoothing : OneEuro, optional
        Filter of poses that come at each step; only with ``trust``.
    bounds : MotionBounds, mapping of str to bounds, "robot" or None
        Of position, speed, acceleration and jerk: "robot" takes those of the robot and of the
        demonstrations, a mapping tightens these (:meth:`MotionBounds.of`), and None takes each
        estimate for a reference.
    blend : float
        How long the difference between posture and estimate fades, by a minimum-jerk step, at
        the start and whenever a robot goes on from somewhere else [s].
    feedback : {"reference", "measured"}
        What q_{t-1} is: the last reference, or the measured posture.
    impedance : Impedance, optional
        Stiffness and damping of the commands.
    begin, end : float, optional
        Run a part of the skill [s].
    at_rest : bool
        Whether robots stand when the skill begins; else they move as the skill does.

    Attributes
    ----------
    holding : Holding
        What the robots hold, and where objects were last free.
    reference : Tensor of shape (..., n_joints)
        The last reference; the start posture before the first step.
    time : Tensor of shape () or (...)
        Progress at the last step [s]; the beginning before the first one.
    command : Command or None
        What the last step returned.
    measured : Tensor of shape (..., n_joints) or None
        Measured joints at the last step, NaN where they were rejected; None if there were none.

    Raises
    ------
    ShapeError, DataError, UnknownNameError
        If the postures do not fit the robot, frames are missing, or bounds contradict each
        other.
    """

    def __init__(
        self,
        skill: Skill,
        joints: Any,
        frames: Mapping[str, Frame] | None = None,
        *,
        clock: Clock | str = LocalizingClock(),  # noqa: B008  (frozen)
        trust: Trust | None = Trust(),  # noqa: B008  (frozen)
        smoothing: OneEuro | None = OneEuro(),  # noqa: B008  (frozen)
        bounds: MotionBounds | Mapping[str, Any] | str | None = "robot",
        blend: float = 1.0,
        feedback: str = "reference",
        impedance: Impedance | None = None,
        begin: float | None = None,
        end: float | None = None,
        at_rest: bool = True,
    ) -> None:
        if feedback not in ("reference", "measured"):
            raise DataError(f"feedback is 'reference' or 'measured', got {feedback!r}")
        kinematics = skill.kinematics
        self.reference = kinematics.joint_tensor(joints)
        frames = completed_frames(skill, joints, frames or {})
        if trust is not None:
            report_start(skill, joints, frames)
        self._frames = self._first_frames = self._converted(kinematics, frames)
        self._skill = skill = skill.start(self.reference, self._frames)
        self._end = skill.end if end is None else end
        self.command: Command | None = None
        self.measured: Tensor | None = None
        self._measured_feedback, self._blend = feedback == "measured", blend
        self._impedance = impedance or Impedance(kinematics)
        self._gripping = kinematics.gripping()
        self._bounds = _motion_bounds(skill, bounds)
        self._progress = parse_clock(clock).start(
            skill, self.reference, self._frames, begin, end
        )
        self._start_sensing(trust, smoothing)
        self._start_motion(at_rest)

    def _start_sensing(self, trust: Trust | None, smoothing: OneEuro | None) -> None:
        kinematics, progress = self._skill.kinematics, self._progress
        self.holding = Holding.start(
            kinematics, self._skill.carried_names, self._skill.holds, self._frames
        )
        self._watch = HoldWatch(kinematics)
        self._first_holds: dict[str, float] = {}  # start of the first hold of each object
        for hold in self.holding.holds:
            earlier = self._first_holds.get(hold.frame, math.inf)
            self._first_holds[hold.frame] = min(hold.begin, earlier)
        self._given_holds: frozenset[str] = frozenset()  # objects whose holds were given
        self._trust, self._inputs = trust, None
        if trust is not None:
            self._inputs = Inputs(kinematics, self.reference, self._frames, trust, smoothing)
        # robots that begin in the middle of the skill stand where no demonstration starts
        midway = progress.time > progress.begin + START * (progress.end - progress.begin)
        self._start = torch.where(midway.unsqueeze(-1), torch.nan, self.reference)
        none = torch.zeros(self.reference.shape[:-1], dtype=torch.bool).to(midway.device)
        self._waiting, self._displaced = none, none
        self._displacement = Displacement()

    def _start_motion(self, at_rest: bool) -> None:
        self._follower: Follower | None = None
        self._position_bounds = None
        if (bounds := self._bounds) is not None:
            self._follower = Follower.at(bounds, self.reference) if at_rest else None
            # rounded postures stay within these
            low, high = (bounds.lower * GRID).ceil(), (bounds.upper * GRID).floor()
            self._position_bounds = low / GRID, high / GRID
        self._search = self._skill.posture_search()
        self._velocity = torch.zeros_like(self.reference)
        self._wanted = self._target = self.reference  # of estimates, and for clocks
        self._fading = self._blend > 0
        self._gap, self._fade_time = self._velocity, torch.full_like(self._start[..., 0], -1.0)
        self._fade_duration = torch.full_like(self._fade_time, self._blend)

    @property
    def time(self) -> Tensor:
        """Progress at the last step [s], the same for all robots or of each one."""
        return self._progress.time

    @property
    def finished(self) -> bool:
        """Whether all robots are at the end: further steps hold the last reference."""
        return self.command is not None and bool((self.time >= self._end).all())

    def step(
        self,
        dt: float | Tensor,
        joints: Any = None,
        frames: Mapping[str, Any] | None = None,
        *,
        holds: Mapping[str, str | None] | None = None,
        ages: Mapping[str, float] | None = None,
    ) -> Command:
        """Find the next reference.

        Parameters
        ----------
        dt : float or Tensor of shape (...)
            Seconds since the last step, for all robots or of each one. The first step is at
            the beginning, whatever it is. A robot whose time did not increase is held for this
            step.
        joints : array-like of shape (..., n_joints), optional
            Measured joints [rad].
        frames : mapping of str to Frame, optional
            Poses of the objects from now on. With ``trust`` also arrays (..., 7) of positions
            and quaternions (w, x, y, z), which need not be finite, or None for a lost one.
        holds : mapping of str to str or None, optional
            Which link holds an object from now on, None if it is free from now on: in place
            of the holds that the skill began with.
        ages : mapping of str to float, optional
            How old ``"joints"`` and the frames are [s].

        Returns
        -------
        Command

        Raises
        ------
        ShapeError
            If there are more or fewer robots than at the start. Nothing has moved then.
        """
        seconds, late = _durations(dt)
        first = self.command is None
        if not first and not isinstance(seconds, np.ndarray) and not 0 < seconds < math.inf:
            return self._refused(f"time did not increase: dt = {seconds} s")
        tick = self._sensed(seconds, None if first else late, joints, frames, ages)
        if not first:
            self._locate(tick)
            if tick.ended is not None and bool(tick.ended.all()):
                assert self.command is not None
                return self._sent(tick, self.command.estimate, self._wanted)
        self._update_holds(tick, None if frames is None else dict(self._frames), holds)
        estimate, wanted = self._estimated(tick)
        return self._sent(tick, estimate, wanted, self._lead(tick, estimate, wanted))

    def copy(self) -> Self:
        """The same moment, to look ahead from."""
        return copy.copy(self)  # its tensors are replaced, never changed

    def ahead(self) -> Self:
        """The same moment, to look ahead from: robots will follow, and objects will stay."""
        other = self.copy()
        other._inputs = None
        return other

    def resumed(
        self, moment: Self, passed: float, joints: Any, frames: Mapping[str, Any] | None = None
    ) -> Self:
        """A moment that was looked ahead to, with measurements from then on.

        Parameters
        ----------
        moment : Controller
            Out of steps of :meth:`ahead`.
        passed : float
            Seconds between this moment and that one.
        joints, frames
            As for :meth:`step`, at that moment.
        """
        other = moment.copy()
        other._inputs = self._inputs
        if self._inputs is not None and passed > 0:
            other._inputs = self._inputs.update(passed, joints, frames)
            other._frames = other._inputs.frames
        return other

    # Sensing

    def _sensed(
        self,
        seconds: Seconds,
        late: Tensor | None,
        joints: Any,
        frames: Mapping[str, Any] | None,
        ages: Mapping[str, float] | None,
    ) -> _Tick:
        """Accepted measurements, and how long this tick is for each robot."""
        measured, halted = self._accepted(seconds, joints, frames, ages)
        if measured is not None and self._gripping is not None:
            # the objects that they hold keep gripping joints from their references
            measured = torch.where(self._gripping, torch.nan, measured)
        self.measured = measured
        if self.command is not None and self._trust is not None:
            seconds = np.minimum(seconds, self._trust.longest_step)
        passed = _each(seconds, torch.float64)
        still = [robots for robots in (halted, late) if robots is not None]
        if still:
            going = torch.as_tensor(passed, dtype=torch.float64)
            passed = torch.where(torch.stack(still).any(0), 0.0, going)
        return _Tick(seconds, passed, measured, halted, late)

    def _accepted(
        self,
        seconds: Seconds,
        joints: Any,
        frames: Mapping[str, Any] | None,
        ages: Mapping[str, float] | None,
    ) -> tuple[Tensor | None, Tensor | None]:
        """Measured joints, and robots without accepted inputs; frames are kept."""
        if self._inputs is None:
            if frames is not None:
                self._frames = self._converted(self._skill.kinematics, frames)
            return self._validated(joints), None
        known = seconds if self.command else np.maximum(seconds, 1e-3)
        self._inputs = self._inputs.update(known, joints, frames, ages)
        self._frames, untrusted = self._inputs.frames, self._inputs.untrusted()
        halted = None if untrusted is None else torch.as_tensor(untrusted)
        return self._inputs.measured, halted

    def _validated(self, joints: Any) -> Tensor | None:
        if joints is None:
            return None
        measured = self._skill.kinematics.joint_tensor(joints)
        if measured.shape != self.reference.shape:
            raise ShapeError(
                f"the skill began with joints of shape {tuple(self.reference.shape)}, now "
                f"there are {tuple(measured.shape)}: start another controller for other robots"
            )
        return measured

    @staticmethod
    def _converted(kinematics: Any, frames: Mapping[str, Frame]) -> dict[str, Frame]:
        return {name: frame.to(kinematics.lower) for name, frame in frames.items()}

    # Progress

    def _locate(self, tick: _Tick) -> None:
        """Progress of each robot; displaced robots restart from where they are."""
        assert self.command is not None
        measured, before, displaced = tick.measured, self._progress, None
        if measured is not None and self._trust is not None and self._inputs is not None:
            displaced, self._displacement = self._displacement.detect(
                measured, self.reference, self._velocity, tick.seconds, self._trust
            )
        holding = self.holding
        observation = Observation(
            measured, self._target, None, holding.frames, self.command.estimate,
            holding.state if holding.carries else None, displaced,
        )  # fmt: skip
        self._progress = before.advance(tick.passed, observation)
        time = self._progress.time
        if bool((time >= self._end).any()):
            tick.ended = (time >= self._end) & (before.time >= self._end)
        if measured is None:
            return
        self._restart_displaced(measured, displaced)
        waits = time - before.time < WAITING_RATE * tick.passed
        tick.waits = waits.expand(self._waiting.shape)
        if tick.ended is not None:
            tick.waits = tick.waits & ~tick.ended

    def _restart_displaced(self, measured: Tensor, displaced: Tensor | None) -> None:
        """Robots that were displaced, and those whose place was found."""
        if displaced is not None:
            self._restart_from(measured, displaced)
            self._displaced = self._displaced | displaced
        if bool((moved := self._progress.relocalized).any()):
            self._restart_from(measured, moved)
            self._displaced = self._displaced & ~moved

    def _restart_from(self, measured: Tensor, robots: Tensor) -> None:
        """References of some robots are where these stand, at rest."""
        joints = robots.unsqueeze(-1) & ~measured.isnan()
        self.reference = torch.where(joints, measured, self.reference)
        self._velocity = torch.where(joints, 0.0, self._velocity)
        if self._follower is not None:
            self._follower = self._follower.put(joints, self.reference)
        if self._search is not None:
            self._search = self._search.ended(robots)
        self._displacement = self._displacement.forget(joints)
        self._restart_fading(robots)

    # Holds

    def _update_holds(
        self,
        tick: _Tick,
        frames: Mapping[str, Frame] | None,
        holds: Mapping[str, str | None] | None,
    ) -> None:
        """What the robots hold: by the skill's times, by what was given, and as it is seen."""
        time, stands = self._progress.time, self._postures(tick, measured=True)
        seconds = _each(tick.seconds, stands)
        self._given_holds = self._given_holds.union(holds or ())
        shares: Mapping[str, Tensor] = {}
        if self._inputs is not None:
            shares = self._inputs.shares
            if self._inputs.poses and not holds:
                now = time.expand(stands.shape[:-1])
                given = self._first_holds.keys() & self._given_holds
                self._watch, self.holding, frames = self._watch.update(
                    self._inputs.poses.keys() - given, self._frames, stands, self.holding,
                    seconds, {n: now < at for n, at in self._first_holds.items()},
                )  # fmt: skip
        self.holding = self.holding.advance(
            time, stands, frames, holds, dt=seconds, shares=shares
        )

    def _postures(self, tick: _Tick, measured: bool) -> Tensor:
        """References, or measured joints where there are some."""
        if not measured or tick.measured is None:
            return self.reference
        return torch.where(tick.measured.isnan(), self.reference, tick.measured)

    # Estimate

    def _estimated(self, tick: _Tick) -> tuple[Estimate, Tensor]:
        """The skill's estimate, and the posture that is wanted."""
        time, last = self._progress.time, self.command
        at = self._postures(tick, self._measured_feedback)
        estimate = self._estimate(time, at)
        self._skill = self._skill.advance(estimate)
        seconds = 0.0 if last is None else tick.seconds
        shift = self._faded(estimate.joints, seconds)
        wanted = self._rounded(estimate.joints, shift)
        if last is not None and self._cannot_follow(tick, wanted):
            wanted = self._rounded(self._nearest(tick, at, estimate, wanted), shift)
        if last is not None and tick.ended is not None and bool(tick.ended.any()):
            # for them it is as if all had come to the end
            wanted = torch.where(tick.ended.unsqueeze(-1), self._wanted, wanted)
            estimate = _choose(tick.ended, last.estimate, estimate)
        return estimate, wanted

    def _estimate(self, time: Tensor, at: Tensor) -> Estimate:
        """The skill's estimate; not finite for robots for which it has none."""
        state: Tensor | RobotState = at
        if self.holding.carries:
            state = self._state(at)
        given = self.holding.frames, self._position_bounds
        try:
            return self._skill.estimate(time, state, *given)
        except TPGMMError:
            if self._trust is None or self.command is None:
                raise  # nothing moves yet, or inputs are the caller's own
        # one robot's failure is not its batch's
        known, batch = self.command.estimate, at.shape[:-1]
        joints = torch.full_like(at, torch.nan)
        covariance = known.covariance.expand(*at.shape, -1).clone()
        activation = known.activation.expand(*batch, -1).clone()
        frames, bounds = given
        for index in np.ndindex(*batch):
            here = {n: f.expand(batch)[index] for n, f in frames.items()}
            now = time[index] if time.ndim else time
            try:
                estimate = self._skill.estimate(now, state[index], here, bounds)
            except TPGMMError:
                continue
            joints[index], covariance[index] = estimate.joints, estimate.covariance
            activation[index] = estimate.activation
        return Estimate(joints, covariance, activation)

    def _state(self, joints: Tensor) -> RobotState:
        """With the objects that the robots hold."""
        return self.holding.state(self._skill.kinematics.state(joints))

    def _cannot_follow(self, tick: _Tick, wanted: Tensor) -> bool:
        """Whether a robot cannot be at its estimate, or is searched for already."""
        if self._follower is None or self._skill.posture_search() is None:
            return False
        if self._search is None or self._search.active is None:
            tick.following = self._follower.take(wanted, tick.seconds)
        return tick.following is None

    def _nearest(self, tick: _Tick, at: Tensor, estimate: Estimate, wanted: Tensor) -> Tensor:
        """The nearest posture where an estimate, one linearised step, leads too far."""
        assert self._follower is not None and self._position_bounds is not None
        search = self._search or self._skill.posture_search()
        assert search is not None
        asked = ~self._follower.fits(wanted, tick.seconds) & wanted.isfinite().all(-1)
        try:
            joints, self._search = search.advance(
                self._progress.time, at, self.holding.frames, estimate, self._position_bounds,
                asked, self._state if self.holding.carries else None,
            )  # fmt: skip
        except TPGMMError:
            if self._trust is None:
                raise
            return estimate.joints
        return joints

    def _rounded(self, joints: Tensor, shift: Tensor | None) -> Tensor:
        """Wanted postures; where there are bounds, on a grid."""
        if shift is not None:
            joints = joints + shift
        joints = self._skill.kinematics.retract(joints)
        if self._bounds is None:
            return joints
        rounded = (joints.detach() * GRID).round() / GRID
        return joints + (rounded - joints).detach() if joints.requires_grad else rounded

    # Fading from where robots start

    def _restart_fading(self, robots: Tensor) -> None:
        self._fade_time = torch.where(robots, -1.0, self._fade_time)  # the gap is not known yet
        self._fading = self._blend > 0

    def _faded(self, estimate: Tensor, dt: Seconds) -> Tensor | None:
        """The rest of the difference between where robots went on and the estimate."""
        if not self._fading:
            return None
        fresh = self._fade_time < 0
        if bool(fresh.any()):
            gap = (self.reference - estimate).nan_to_num(0.0)
            self._gap = torch.where(fresh.unsqueeze(-1), gap, self._gap)
            if self.command is not None:
                duration = fading_time(self._gap, self._blend)
                self._fade_duration = torch.where(fresh, duration, self._fade_duration)
        self._fade_time = torch.where(fresh, 0.0, self._fade_time + _each(dt, estimate))
        left = 1 - minimum_jerk(self._fade_time / self._fade_duration)
        self._fading = bool((left > 0).any())
        return left.unsqueeze(-1) * self._gap

    # Following

    def _lead(self, tick: _Tick, estimate: Estimate, wanted: Tensor) -> Tensor | None:
        """Postures to which waiting robots are led; None if none waits."""
        if tick.waits is None or tick.measured is None or self._trust is None:
            return None
        measured, waits, lead = tick.measured, tick.waits, self._trust.lead
        if bool(self._displaced.any()):
            gap = (estimate.joints - measured).abs().nan_to_num(0.0).amax(-1)
            self._displaced = self._displaced & ~(gap <= 2 * lead)
        if bool((follow := self._waiting & ~waits).any()):
            self._restart_fading(follow)  # from where they were led to
        self._waiting = waits
        if not bool(waits.any()):
            return None
        # whatever holds them is not fought, and joints go on together, as a held object needs
        way = wanted - measured
        size = way.abs().nan_to_num(0.0).amax(-1, keepdim=True)
        most = way.new_full(waits.shape, lead)
        most = torch.where(self.holding.busy(waits), HOLDING_LEAD * most, most).unsqueeze(-1)
        step = way * (most / torch.maximum(size, most))
        return torch.where(waits.unsqueeze(-1) & ~measured.isnan(), measured + step, wanted)

    def _sent(
        self, tick: _Tick, estimate: Estimate, wanted: Tensor, goal: Tensor | None = None
    ) -> Command:
        """The command that brings robots to the wanted postures, or to where they are led."""
        before, self._wanted = self._wanted, wanted
        to = wanted if goal is None else goal
        lost = None
        if self._bounds is None:
            self._set_reference(tick, to)
        elif self.command is not None:  # the first reference is where robots stand
            lost = self._follow(tick, to, before)
        # the clock compares with the estimate where a robot is led, or was displaced
        self._target = self.reference
        if goal is not None:
            self._target = torch.where(self._waiting.unsqueeze(-1), wanted, self._target)
        if self._trust is not None and bool(self._displaced.any()):
            known = self._displaced.unsqueeze(-1) & estimate.joints.isfinite()
            self._target = torch.where(known, estimate.joints, self._target)
        codes, reasons = self._statuses(tick, lost)
        self.command = Command(
            self.reference,
            self._velocity,
            self.time,
            estimate,
            codes,
            reasons,
            self._impedance,
            self._situation_novelty(),
        )
        return self.command

    def _set_reference(self, tick: _Tick, to: Tensor) -> None:
        """Without bounds, the wanted posture is the reference."""
        last = self.reference
        for still in (tick.halted, tick.late):
            if still is not None:
                to = torch.where(still.unsqueeze(-1), last, to)
        if self.command is not None:
            self._velocity = (to - last) / _column(tick.seconds, last)
        self.reference = to

    def _follow(self, tick: _Tick, to: Tensor, before: Tensor) -> Tensor | None:
        """Within bounds; robots without a finite posture, which come to rest."""
        assert self._bounds is not None
        if tick.halted is not None:  # what is not finite brings a robot to rest
            to = torch.where(tick.halted.unsqueeze(-1), torch.nan, to)
        if self._follower is None:  # a gap to where the skill begins is no speed
            fastest = self._bounds.velocity
            moving = (to - before) / _column(tick.seconds, self.reference)
            moving = moving.clamp(-fastest, fastest)
            self._follower = Follower.at(self._bounds, self.reference, moving)
        last, lost = self._follower, None
        follower = tick.following
        if follower is None or follower.reference is not to:
            follower = last.advance(to, tick.seconds)
            lost = ~to.isfinite().all(-1)
        if tick.late is not None:
            follower = follower.undone(tick.late, last)
        self._follower = follower
        self.reference, self._velocity = follower.reference, follower.velocity
        return lost

    # Status

    def _statuses(
        self, tick: _Tick, lost: Tensor | None
    ) -> tuple[Tensor, dict[tuple[int, ...], str]]:
        """Status of each robot, and why one is held."""
        codes = torch.zeros_like(self._waiting, dtype=torch.int8)
        reasons: dict[tuple[int, ...], str] = {}
        if tick.ended is not None:
            codes = torch.where(tick.ended, Status.FINISHED.code, codes)
        held = ((lost, "the model has no finite answer here"), (tick.late, NOT_INCREASED))
        for robots, reason in held:
            if robots is not None and bool(robots.any()):
                codes = torch.where(robots, Status.HOLDING.code, codes)
                indices = map(tuple, np.argwhere(robots.numpy(force=True)).tolist())
                reasons |= dict.fromkeys(indices, reason)
        if tick.halted is not None and self._inputs is not None:
            codes = torch.where(tick.halted, Status.HOLDING.code, codes)
            reasons |= self._inputs.reasons(tick.halted.numpy(force=True))
        return codes.to(torch.int8), reasons

    def _refused(self, reason: str) -> Command:
        """The last command, while nothing moves."""
        assert self.command is not None
        codes = torch.full_like(self.command.codes, Status.HOLDING.code)
        robots = np.ndindex(*codes.shape)
        self.command = replace(self.command, codes=codes, reasons=dict.fromkeys(robots, reason))
        return self.command

    def _situation_novelty(self) -> Callable[[], Tensor] | None:
        """Novelty of where robots began and objects are, or were last free."""
        summary = self._skill.summary
        if summary is None:
            return None
        places = self.holding.frames, self._first_frames
        return functools.partial(_novelty, summary, self._start, *places)


#: Why a robot is held whose time stood still.
NOT_INCREASED = "time did not increase"


def _motion_bounds(
    skill: Skill, bounds: MotionBounds | Mapping[str, Any] | str | None
) -> MotionBounds | None:
    """Bounds as a controller takes them."""
    if isinstance(bounds, Mapping) and bounds:
        return MotionBounds.of(skill.kinematics, skill.peaks, **bounds)
    if isinstance(bounds, MotionBounds) or bounds is None:
        return bounds
    if isinstance(bounds, str) and bounds != "robot":
        raise DataError(f"bounds are MotionBounds, a mapping, 'robot' or None, got {bounds!r}")
    return skill.motion_bounds


def _each(seconds: Seconds, like: Tensor | torch.dtype) -> float | Tensor:
    """A tensor, if each robot has a duration of its own."""
    return torch.as_tensor(seconds).to(like) if isinstance(seconds, np.ndarray) else seconds


def _column(seconds: Seconds, like: Tensor) -> float | Tensor:
    """Durations for the joints of each robot."""
    each = _each(seconds, like)
    return each.unsqueeze(-1) if isinstance(each, Tensor) else each


def _durations(dt: float | Tensor) -> tuple[Seconds, Tensor | None]:
    """Duration of a tick, of each robot or of all, and robots whose time did not increase."""
    if not isinstance(dt, Tensor):
        return dt, None
    increased = (dt > 0) & dt.isfinite()
    seconds = torch.where(increased, dt, INSTANT).double().numpy(force=True)
    if not bool(increased.any()):
        return 0.0, None
    if bool(increased.all()):
        first = float(seconds.flat[0])
        return (first if (seconds == first).all() else seconds), None
    return seconds, ~increased


def _novelty(
    summary: TrainingSummary,
    start: Tensor,
    frames: Mapping[str, Frame],
    at_first: Mapping[str, Frame],
) -> Tensor:
    """Novelty of each robot (...) of a batch of start postures."""
    moving = {
        name: at_first[name]
        for name in at_first
        if name in summary.frames and summary.frames[name].moves
    }
    frames = {**frames, **moving}
    return torch.as_tensor(summary.novelty(start, frames)).to(start).expand(start.shape[:-1])


def _choose(where: Tensor, one: Estimate, other: Estimate) -> Estimate:
    """One estimate for some robots (...), the other for the rest."""
    mask = where.unsqueeze(-1)
    return Estimate(
        torch.where(mask, one.joints, other.joints),
        torch.where(mask.unsqueeze(-1), one.covariance, other.covariance),
        torch.where(mask, one.activation, other.activation),
    )
