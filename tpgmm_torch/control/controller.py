"""A running skill: Algorithm 1's synthesis, one control tick at a time."""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol, Self, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch.checks.situations import START
from tpgmm_torch.checks.summary import TrainingSummary
from tpgmm_torch.control.clocks import Clock, EvenClock, Progress
from tpgmm_torch.control.command import Command, Status
from tpgmm_torch.control.hold_watch import HoldWatch
from tpgmm_torch.control.holding import Holding
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.exceptions import DataError, ShapeError, TPGMMError
from tpgmm_torch.impedance.stiffness import Impedance
from tpgmm_torch.motion.follower import Follower, Seconds
from tpgmm_torch.motion.minimum_jerk import fading_time, minimum_jerk
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.regression.conditioning import Conditioning
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.robots.kinematics import RobotState
from tpgmm_torch.sensing.inputs import Inputs
from tpgmm_torch.sensing.pose_filter import OneEuro
from tpgmm_torch.sensing.trust import Trust
from tpgmm_torch.skills.skill import Observation

__all__ = ["Controller", "SkillController"]

#: For so long a robot that was moved is remembered to have been [s].
PUSH_MEMORY = 0.5
#: Below that share of its speed, time stands, and a robot is led.
STANDS = 0.05
#: The share of the usual lead of robots that hold something.
CAREFUL = 1 / 3
#: What is wanted is a multiple of ``1 / GRID`` [rad or m]: the rounding of a batch, which is
#: another one for each size, ends there, before whoever follows enlarges it.
GRID = 2.0**32

#: What passes for a robot whose time did not increase, and which is held [s].
INSTANT = 1e-6

_Joints = TypeVar("_Joints", Tensor, Tensor | None)


class SkillController(Protocol):
    """What runs a skill, of one way or of several, on one robot or a batch of them."""

    command: Command | None

    @property
    def reference(self) -> Tensor:
        """See :class:`Controller`."""

    @property
    def time(self) -> Tensor:
        """See :class:`Controller`."""

    @property
    def finished(self) -> bool:
        """See :attr:`Controller.finished`."""

    def step(
        self,
        dt: float | Tensor,
        joints: Any = None,
        frames: Mapping[str, Any] | None = None,
        *,
        told: Mapping[str, str | None] | None = None,
        ages: Mapping[str, float] | None = None,
    ) -> Command:
        """See :meth:`Controller.step`."""

    def copy(self) -> Self:
        """See :meth:`Controller.copy`."""

    def ahead(self) -> Self:
        """See :meth:`Controller.ahead`."""

    def resumed(
        self, moment: Self, passed: float, joints: Any, frames: Mapping[str, Any] | None = None
    ) -> Self:
        """See :meth:`Controller.resumed`."""


class Controller:
    """A batch of robots that run a skill, each at its own pace, from its beginning to its end.

    At each step a clock says how far each robot is, from what is observed; the model says which
    posture is wanted there; a follower goes there within the bounds of motion. What cannot be
    believed is not used, and a robot that has nothing to believe stands until there is
    something. After the end the last reference is held. Robots of a batch do not know of each
    other.

    Parameters
    ----------
    regression : Regression
        What is asked for the joints at each step.
    joints : array-like of shape (..., n_joints)
        The start postures.
    frames : mapping of str to Frame, optional
        Poses of the objects until others are told, of shapes that broadcast with the batch.
    begin, end : float
        When the skill begins and ends [s].
    clock : Clock, optional
        How the skill goes on; evenly by default.
    blend : float
        How long the difference between posture and model fades, at the start and whenever a
        robot goes on from somewhere else [s]. The difference goes by a minimum-jerk step.
    bounds : MotionBounds, optional
        Of position, speed, acceleration and jerk; None takes each estimate for a reference.
    trust : Trust, optional
        When to believe what is told; None believes everything, and raises on what is wrong.
    smoothing : OneEuro, optional
        What takes the noise from poses that come at each step; only with ``trust``.
    holds : sequence of Hold
        From when to when which link holds which object.
    at_rest : bool
        Whether robots stand when the skill begins; else they move as the model does.
    feedback : {"reference", "measured"}
        What q_{t-1} is: the last reference, or the measured posture.
    impedance : Impedance, optional
        What stiffness and damping are made with.
    novelty : TrainingSummary, optional
        What tells how new the situation is.
    via : Conditioning, optional
        Via-points through which the robots pass.

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
        Where the robots stood at the last step, NaN where that was not believed; None if
        nothing was measured.

    Raises
    ------
    ShapeError, DataError
        If the postures do not fit the robot.
    """

    def __init__(
        self,
        regression: Regression,
        joints: Any,
        frames: Mapping[str, Frame] | None = None,
        *,
        begin: float,
        end: float,
        clock: Clock = EvenClock(),  # noqa: B008  (frozen)
        blend: float = 0.0,
        bounds: MotionBounds | None = None,
        trust: Trust | None = None,
        smoothing: OneEuro | None = None,
        holds: Sequence[Hold] = (),
        at_rest: bool = True,
        feedback: str = "reference",
        impedance: Impedance | None = None,
        novelty: TrainingSummary | None = None,
        via: Conditioning | None = None,
    ) -> None:
        if feedback not in ("reference", "measured"):
            raise DataError(f"feedback is 'reference' or 'measured', got {feedback!r}")
        kinematics = regression.kinematics
        self.reference = kinematics.joint_tensor(joints)
        self.command: Command | None = None
        self.measured: Tensor | None = None
        self._regression, self._end, self._blend = regression, end, blend
        self._measured_feedback, self._impedance = feedback == "measured", impedance
        self._gripping = kinematics.gripping()
        self._frames = self._converted(frames or {})
        self.holding = Holding.start(kinematics, regression.operators, holds, self._frames)
        self._trust, self._watch = trust, HoldWatch(kinematics)
        self._begins: dict[str, float] = {}  # when the skill first holds what it holds
        for hold in self.holding.holds:
            self._begins[hold.frame] = min(hold.begin, self._begins.get(hold.frame, math.inf))
        self._said: frozenset[str] = frozenset()  # of whose holds somebody told
        self._inputs: Inputs | None = None
        if trust is not None:
            self._inputs = Inputs(kinematics, self.reference, self._frames, trust, smoothing)
        self._progress = clock.start(regression, self.reference, self._frames, begin, end)
        self._novelty, self._at_first = novelty, self._frames
        # who begins in the middle of the skill stands where nobody starts
        midway = self._progress.time > begin + START * (end - begin)
        self._start = torch.where(midway.unsqueeze(-1), torch.nan, self.reference)
        self._follower: Follower | None = None
        self._bounds, self._position_bounds = bounds, None
        if bounds is not None:
            self._follower = Follower.at(bounds, self.reference) if at_rest else None
            # what is rounded keeps within them
            low, high = (bounds.lower * GRID).ceil(), (bounds.upper * GRID).floor()
            self._position_bounds = low / GRID, high / GRID
        self._search, self._via = regression.posture_search(), via
        self._late: Tensor | None = None  # robots whose time did not increase in this tick
        self._taken: Follower | None = None  # of this tick, where all can be followed
        self._velocity = torch.zeros_like(self.reference)
        self._wanted = self._asked = self.reference
        self._gap_before: NDArray[np.float64] | None = None  # reference and robot, last tick
        self._pushed: NDArray[np.float64] | float = 0.0
        shape = self.reference.shape[:-1]
        self._codes = torch.zeros(shape, dtype=torch.int8, device=self.reference.device)
        none = torch.zeros(shape, dtype=torch.bool, device=self.reference.device)
        self._led, self._brought = none, none
        self._gap, self._since = self._velocity, torch.full_like(self._velocity[..., 0], -1.0)
        self._lasting = torch.full_like(self._since, blend)
        self._fading = blend > 0

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
        told: Mapping[str, str | None] | None = None,
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
            Where the robots stand [rad].
        frames : mapping of str to Frame, optional
            Poses of the objects from now on. With ``trust`` also arrays (..., 7) of positions
            and quaternions (w, x, y, z), which need not be finite, or None for a lost one.
        told : mapping of str to str or None, optional
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
        last, self._late = self.command, None
        seconds: Seconds
        if isinstance(dt, Tensor):
            seconds, late = _durations(dt)
            self._late = None if last is None else late
        else:
            seconds = dt
        nothing = not isinstance(seconds, np.ndarray) and not 0 < seconds < math.inf
        if last is not None and nothing:
            return self._refuse(last, f"time did not increase: dt = {seconds} s")
        measured, halted = self._hear(seconds, joints, frames, ages)
        self.measured = measured
        before = self._progress
        if last is not None and self._trust is not None:
            seconds = np.minimum(seconds, self._trust.longest_step)
        passed = _of_each(seconds, torch.float64)
        for robots in (halted, self._late):
            if robots is not None:
                going = torch.as_tensor(passed, dtype=torch.float64)
                passed = torch.where(robots, 0.0, going)
        if last is not None:
            holding = self.holding
            away = None if measured is None else self._driven_away(measured, seconds)
            observed = Observation(
                self._unbent(measured), self._unbent(self._asked), None,
                holding.frames, last.estimate,
                holding.state if holding.carries else None, away,
            )  # fmt: skip
            self._progress = before.advance(passed, observed)
            if measured is not None:
                if away is not None:
                    self._stand(away, measured)
                    self._brought = self._brought | away
                if bool((moved := self._progress.relocalized).any()):
                    self._stand(moved, measured)
                    self._brought = self._brought & ~moved
        time, ended = self._progress.time, None
        if last is not None and bool((time >= self._end).any()):
            ended = (time >= self._end) & (before.time >= self._end)
            if bool(ended.all()):  # nothing more is asked: the follower comes to rest
                return self._send(last.estimate, self._wanted, seconds, halted, ended)
        at = self.reference
        if self._measured_feedback and measured is not None:
            at = torch.where(measured.isnan(), at, measured)
        seen = None if frames is None else dict(self._frames)
        stands = at if measured is None else torch.where(measured.isnan(), at, measured)
        self._said = self._said.union(told or ())
        if self._inputs is not None and self._inputs.poses and not told:
            begins, now = self._begins, time.expand(stands.shape[:-1])
            said = begins.keys() & self._said
            self._watch, self.holding, seen = self._watch.look(
                self._inputs.poses.keys() - said, self._frames, stands, self.holding,
                _of_each(seconds, stands), {n: now < at for n, at in begins.items()},
            )  # fmt: skip
        shares = {} if self._inputs is None else self._inputs.shares
        self.holding = self.holding.advance(
            time, stands, seen, told, dt=_of_each(seconds, stands), shares=shares
        )
        at = self._unbent(at)
        estimate = self._estimated(time, at)
        if self._via is not None:
            estimate, self._via = self._conditioned(time, estimate)
        shift = self._fade(estimate.joints, 0.0 if last is None else seconds)
        wanted = self._shifted(estimate.joints, shift)
        # robots that via-points lead are late for another reason than what is searched for
        bent = self._via is not None and self._via.shift is not None
        following = self._follower is not None and last is not None and not bent
        if following and not self._follows(wanted, seconds):
            wanted = self._shifted(self._searched(time, at, estimate, wanted, seconds), shift)
        if last is not None and ended is not None and bool(ended.any()):
            # for them it is as if all had come to the end
            wanted = torch.where(ended.unsqueeze(-1), self._wanted, wanted)
            estimate = _choose(ended, last.estimate, estimate)
        goal = None
        if measured is not None and self._trust is not None and last is not None:
            waits = (time - before.time < STANDS * passed).expand(self._led.shape)
            waits = waits if ended is None else waits & ~ended
            goal = self._leading(estimate.joints, wanted, measured, waits)
        return self._send(estimate, wanted, seconds, halted, ended, goal)

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
        """What was looked ahead to has come, and what is told counts again.

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

    def switched(self, other: Self, progress: Progress) -> Self:
        """The same robots from here on with another skill, into which they are faded.

        Parameters
        ----------
        other : Controller
            Of that skill, for the same robots and objects.
        progress : Progress
            Where they are in it.
        """
        skill = self.copy()
        skill._regression, skill._end, skill._progress = other._regression, other._end, progress
        skill._novelty, skill._via, skill._search = (
            other._novelty,
            other._via,
            other._search.begun(),
        )
        if not self.holding.held:
            skill.holding = other.holding
        skill._restart_fading(torch.ones_like(self._led))
        return skill

    def _hear(
        self,
        dt: Seconds,
        joints: Any,
        frames: Mapping[str, Any] | None,
        ages: Mapping[str, float] | None,
    ) -> tuple[Tensor | None, Tensor | None]:
        """Measured joints, and robots that are halted; frames are kept.

        Of joints that grip it is as if they were not measured: what they hold keeps them from
        their references.
        """
        measured, halted = self._told(dt, joints, frames, ages)
        if measured is not None and self._gripping is not None:
            measured = torch.where(self._gripping, torch.nan, measured)
        return measured, halted

    def _told(
        self,
        dt: Seconds,
        joints: Any,
        frames: Mapping[str, Any] | None,
        ages: Mapping[str, float] | None,
    ) -> tuple[Tensor | None, Tensor | None]:
        if self._inputs is None:
            if frames is not None:
                self._frames = self._converted(frames)
            return self._checked(joints), None
        dt = dt if self.command else np.maximum(dt, 1e-3)
        self._inputs = inputs = self._inputs.update(dt, joints, frames, ages)
        self._frames = inputs.frames
        untrusted = inputs.untrusted()
        halted = None if untrusted is None else torch.as_tensor(untrusted)
        return inputs.measured, halted

    def _shifted(self, joints: Tensor, shift: Tensor | None) -> Tensor:
        if shift is not None:
            joints = joints + shift
        joints = self._regression.kinematics.retract(joints)
        if self._bounds is None:
            return joints
        rounded = (joints.detach() * GRID).round() / GRID
        return joints + (rounded - joints).detach() if joints.requires_grad else rounded

    def _follows(self, wanted: Tensor, dt: Seconds) -> bool:
        """Whether all robots can be where they are wanted, as in an ordinary tick."""
        if self._search.active is not None or self._follower is None:
            return False
        self._taken = self._follower.take(wanted, dt)
        return self._taken is not None

    def _searched(
        self, time: Tensor, at: Tensor, estimate: Estimate, wanted: Tensor, dt: Seconds
    ) -> Tensor:
        """What is wanted where one step of the linearised product leads too far."""
        assert self._follower is not None and self._position_bounds is not None
        asked = ~self._follower.fits(wanted, dt) & wanted.isfinite().all(-1)
        holding = self.holding
        try:
            joints, self._search = self._search.advance(
                time, at, holding.frames, estimate, self._position_bounds,
                asked, self._carrying if holding.carries else None,
            )  # fmt: skip
        except TPGMMError:
            if self._trust is None:
                raise
            return estimate.joints
        return joints

    def _carrying(self, joints: Tensor) -> RobotState:
        return self.holding.state(self._regression.kinematics.state(joints))

    @property
    def _bend(self) -> Tensor | float:
        """By how much via-points moved the last estimate."""
        shift = None if self._via is None else self._via.shift
        return 0.0 if shift is None else shift

    def _unbent(self, joints: _Joints) -> _Joints:
        """Joints as they would be without via-points, for what knows of none."""
        return joints if joints is None or self._via is None else joints - self._bend

    def _conditioned(self, time: Tensor, free: Estimate) -> tuple[Estimate, Conditioning]:
        """The estimate, given the via-points; as it is where they cannot be told."""
        assert self._via is not None
        holding = self.holding
        attach = holding.state if holding.carries else None
        try:
            return self._via.advance(time, free, holding.frames, self._position_bounds, attach)
        except TPGMMError:
            if self._trust is None or self.command is None:
                raise
            return free, self._via

    def _estimated(self, time: Tensor, at: Tensor) -> Estimate:
        """What the model asks for; not finite for robots of which it cannot tell."""
        state: Tensor | RobotState = at
        if self.holding.carries:
            state = self.holding.state(self._regression.kinematics.state(at))
        frames, bounds = self.holding.frames, self._position_bounds
        try:
            return self._regression.estimate(time, state, frames, bounds)
        except TPGMMError:
            if self._trust is None or self.command is None:
                raise  # nothing moves yet, or who predicts wants to know
        # one robot's trouble is not its batch's
        unknown = self.command.estimate
        batch = at.shape[:-1]
        joints = torch.full_like(at, torch.nan)
        covariance = unknown.covariance.expand(*at.shape, -1).clone()
        activation = unknown.activation.expand(*batch, -1).clone()
        for index in np.ndindex(*batch) if batch else ():
            one = state[index]
            here = {n: f.expand(batch)[index] for n, f in frames.items()}
            now = time[index] if time.ndim else time
            try:
                estimate = self._regression.estimate(now, one, here, bounds)
            except TPGMMError:
                continue
            joints[index], covariance[index] = estimate.joints, estimate.covariance
            activation[index] = estimate.activation
        return Estimate(joints, covariance, activation)

    def _driven_away(self, measured: Tensor, dt: Seconds) -> Tensor | None:
        """Robots that somebody else has moved from their references; None if there is none.

        A robot that is slow, or stopped, is left behind as fast as its reference moves; one
        that is moved goes faster.
        """
        if self._inputs is None:
            return None
        trust = self._inputs.trust  # in numpy, which takes a third of the time of torch
        stands, reference = measured.numpy(force=True), self.reference.numpy(force=True)
        gap, speed = np.abs(stands - reference), np.abs(self._velocity.numpy(force=True))
        before, unknown = self._gap_before, np.isnan(gap)
        if before is None:
            self._gap_before = np.where(unknown, 0.0, gap)
            return None
        if unknown.any():
            gap = np.where(unknown, before, gap)
        each = dt[..., None] if isinstance(dt, np.ndarray) else dt
        kept = self._pushed * np.maximum(0.0, 1 - each / PUSH_MEMORY)
        pushed = np.maximum(kept + gap - before - speed * each, 0.0)
        far = (gap > trust.largest_gap + trust.lag * speed) | (pushed > trust.largest_push)
        self._gap_before, self._pushed = gap, pushed
        if not far.any():
            return None
        return torch.as_tensor(far.any(-1), device=self.reference.device)

    def _stand(self, robots: Tensor, measured: Tensor) -> None:
        """References of robots that were brought elsewhere begin anew where they stand."""
        joints = robots.unsqueeze(-1) & ~measured.isnan()
        self.reference = torch.where(joints, measured, self.reference)
        self._velocity = torch.where(joints, 0.0, self._velocity)
        if self._follower is not None:
            self._follower = self._follower.put(joints, self.reference)
        self._search = self._search.ended(robots)
        if self._gap_before is not None:
            rows = joints.numpy(force=True)
            self._gap_before = np.where(rows, 0.0, self._gap_before)
            self._pushed = np.where(rows, 0.0, self._pushed)
        self._restart_fading(robots)

    def _leading(
        self, asked: Tensor, wanted: Tensor, measured: Tensor, waits: Tensor
    ) -> Tensor | None:
        """Where robots are led that do not follow; None if all do."""
        assert self._trust is not None
        if bool(self._brought.any()):
            back = (asked - measured).abs().nan_to_num(0.0).amax(-1) <= 2 * self._trust.lead
            self._brought = self._brought & ~back
        if bool((follow := self._led & ~waits).any()):
            self._restart_fading(follow)  # from where they were led to
        self._led = waits
        if not bool(waits.any()):
            return None
        # what holds them is not fought, and joints go on together, as a held object needs it
        way = wanted - measured
        size = way.abs().nan_to_num(0.0).amax(-1, keepdim=True)
        most = way.new_full(waits.shape, self._trust.lead)
        most = torch.where(self.holding.busy(waits), CAREFUL * most, most).unsqueeze(-1)
        lead = way * (most / torch.maximum(size, most))
        return torch.where(waits.unsqueeze(-1) & ~measured.isnan(), measured + lead, wanted)

    def _checked(self, joints: Any) -> Tensor | None:
        if joints is None:
            return None
        measured = self._regression.kinematics.joint_tensor(joints)
        if measured.shape != self.reference.shape:
            raise ShapeError(
                f"the skill began with joints of shape {tuple(self.reference.shape)}, now "
                f"there are {tuple(measured.shape)}: begin it anew for other robots"
            )
        return measured

    def _refuse(self, last: Command, reason: str) -> Command:
        """The last command again: nothing moves, and why."""
        codes = torch.full_like(self._codes, Status.HOLDING.code)
        robots = np.ndindex(*self._codes.shape)
        self.command = replace(last, codes=codes, reasons=dict.fromkeys(robots, reason))
        return self.command

    def _converted(self, frames: Mapping[str, Frame]) -> dict[str, Frame]:
        like = self._regression.kinematics.lower
        return {name: frame.to(like) for name, frame in frames.items()}

    def _restart_fading(self, robots: Tensor) -> None:
        self._since = torch.where(robots, -1.0, self._since)  # their gap is not known yet
        self._fading = self._blend > 0

    def _fade(self, estimate: Tensor, dt: Seconds) -> Tensor | None:
        """What is left of the difference between where robots went on and the estimate."""
        if not self._fading:
            return None
        fresh = self._since < 0
        if bool(fresh.any()):
            gap = self.reference - estimate
            self._gap = torch.where(fresh.unsqueeze(-1), gap.nan_to_num(0.0), self._gap)
            if self.command is not None:
                lasting = fading_time(self._gap, self._blend)
                self._lasting = torch.where(fresh, lasting, self._lasting)
        self._since = torch.where(fresh, 0.0, self._since + _of_each(dt, estimate))
        left = 1 - minimum_jerk(self._since / self._lasting)
        self._fading = bool((left > 0).any())
        return left.unsqueeze(-1) * self._gap

    def _send(
        self,
        estimate: Estimate,
        wanted: Tensor,
        dt: Seconds,
        halted: Tensor | None,
        ended: Tensor | None,
        goal: Tensor | None = None,
    ) -> Command:
        """The command that brings robots to where they are wanted, or are led."""
        last, wanted_before, lost = self.reference, self._wanted, None
        self._wanted = wanted
        wanted = wanted if goal is None else goal
        each = _of_each(dt, last)
        each = each.unsqueeze(-1) if isinstance(each, Tensor) else each
        if self._bounds is None:
            for still in (halted, self._late):
                if still is not None:
                    wanted = torch.where(still.unsqueeze(-1), last, wanted)
            if self.command is not None:
                self._velocity = (wanted - last) / each
            self.reference = wanted
        elif self.command is not None:  # the first reference is where robots stand
            if halted is not None:  # what is not finite brings a robot to rest
                wanted = torch.where(halted.unsqueeze(-1), torch.nan, wanted)
            if self._follower is None:  # a gap to where the skill begins is no speed
                fastest = self._bounds.velocity
                moving = ((wanted - wanted_before) / each).clamp(-fastest, fastest)
                self._follower = Follower.at(self._bounds, last, moving)
            before, (follower, self._taken) = self._follower, (self._taken, None)
            if follower is None or follower.reference is not wanted:
                follower = self._follower.advance(wanted, dt)
                lost = ~wanted.isfinite().all(-1)  # and is brought to rest
            if self._late is not None:
                follower = follower.undone(self._late, before)
            self._follower = follower
            self.reference, self._velocity = follower.reference, follower.velocity
        # who is led or was brought elsewhere is not where it should be, however near its
        # reference is
        self._asked = self.reference
        if goal is not None:
            self._asked = torch.where(self._led.unsqueeze(-1), self._wanted, self._asked)
        if self._trust is not None and bool(self._brought.any()):
            known = self._brought.unsqueeze(-1) & estimate.joints.isfinite()
            self._asked = torch.where(known, estimate.joints, self._asked)
        codes = self._codes
        reasons: Mapping[tuple[int, ...], str] = {}
        if ended is not None and bool(ended.any()):
            codes = torch.where(ended, Status.FINISHED.code, codes)
        if lost is not None and bool(lost.any()):
            codes = torch.where(lost, Status.HOLDING.code, codes)
            robots = map(tuple, np.argwhere(lost.numpy(force=True)).tolist())
            reasons = dict.fromkeys(robots, "the model has no finite answer here")
        if self._late is not None:
            codes = torch.where(self._late, Status.HOLDING.code, codes)
            late = map(tuple, np.argwhere(self._late.numpy(force=True)).tolist())
            reasons = {**reasons, **dict.fromkeys(late, "time did not increase")}
        if halted is not None and self._inputs is not None:
            codes = torch.where(halted, Status.HOLDING.code, codes)
            reasons = {**reasons, **self._inputs.reasons(halted.numpy(force=True))}
        self.command = Command(
            self.reference,
            self._velocity,
            self.time,
            estimate,
            codes.to(torch.int8),
            reasons,
            self._impedance,
            self._situation_novelty(),
        )
        return self.command

    def _situation_novelty(self) -> Callable[[], Tensor] | None:
        """What tells how new it is where robots began and objects are, or were last free."""
        if self._novelty is None:
            return None
        return functools.partial(
            _ratio, self._novelty, self._start, self.holding.frames, self._at_first
        )


def _of_each(seconds: Seconds, like: Tensor | torch.dtype) -> float | Tensor:
    """A tensor, if each robot has a duration of its own."""
    return torch.as_tensor(seconds).to(like) if isinstance(seconds, np.ndarray) else seconds


def _durations(dt: Tensor) -> tuple[Seconds, Tensor | None]:
    """Of the tick, of each robot or of all, and the robots whose time did not increase."""
    increased = (dt > 0) & dt.isfinite()
    seconds = torch.where(increased, dt, INSTANT).double().numpy(force=True)
    if not bool(increased.any()):
        return 0.0, None
    if bool(increased.all()):
        first = float(seconds.flat[0])
        return (first if (seconds == first).all() else seconds), None
    return seconds, ~increased


def _ratio(
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
