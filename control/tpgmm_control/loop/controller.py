"""A running skill: Algorithm 1's synthesis, one control tick at a time.

A tick is a list of stages. Each is a file with an immutable state of its own and a function
from that state and from what the stages before gave to the next state:

sense
    accepted readings, and who is held without (:mod:`~tpgmm_control.sensing.inputs`)
locate
    each robot's time in the skill, and whether it follows (:mod:`~tpgmm_control.loop.locate`,
    :mod:`~tpgmm_control.sensing.servo`, :mod:`~tpgmm_control.loop.places`)
gate
    robots that wait until a skill of a sequence may begin, or go back
    (:mod:`~tpgmm_control.loop.gates`)
hold
    objects that move with a hand (:mod:`~tpgmm_control.loop.hold`)
touch
    links that move by the error of their forces (:mod:`~tpgmm_control.contact.admittance`)
estimate
    the Gaussian of the joints (:mod:`~tpgmm_control.loop.estimate`)
reach
    the posture that is wanted (:mod:`~tpgmm_control.loop.reach`)
follow
    the next reference, within bounds (:mod:`~tpgmm_control.motion.follow`)
avoid
    references that keep clear of obstacles (:mod:`~tpgmm_control.obstacles.avoid`)
command
    what is sent, and the status in words (:mod:`~tpgmm_control.loop.command`)

Three rules hold whatever the stages are made of.

1. References are continuous: *follow* alone writes them, within the bounds of position, speed,
acceleration and
   jerk in the time that has passed.
2. What the controller does itself is no evidence: only the gap that lag and offset of the
servos do not explain
   is (:mod:`~tpgmm_control.sensing.servo`).
3. The status tells the truth: running, waiting (for which joint, how far off), displaced,
holding (why), finished.
"""

from __future__ import annotations

import copy
import functools
import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from tpgmm_control.contact.admittance import Admittance, Offsets
from tpgmm_control.impedance.stiffness import Impedance
from tpgmm_control.loop import command as commands
from tpgmm_control.loop.clock import Clock, Patience
from tpgmm_control.loop.command import Command, Status
from tpgmm_control.loop.estimate import choose, estimate
from tpgmm_control.loop.expected_gaps import ExpectedGaps
from tpgmm_control.loop.gates import Gates, Moment
from tpgmm_control.loop.hold import Holds
from tpgmm_control.loop.locate import CATCH_UP, LONGEST_TICK, Mode, Progress, Seen
from tpgmm_control.loop.places import Places
from tpgmm_control.loop.reach import Fade, nearest
from tpgmm_control.motion.follow import Following
from tpgmm_control.motion.follower import Follower, Seconds
from tpgmm_control.obstacles.avoid import Avoidance
from tpgmm_control.obstacles.scene import Scene
from tpgmm_control.sensing.gripping import gripping_joints
from tpgmm_control.sensing.inputs import Inputs
from tpgmm_control.sensing.pose_filter import OneEuro
from tpgmm_control.sensing.servo import Flags
from tpgmm_control.sensing.trust import Trust
from tpgmm_control.sensing.wrenches import Wrenches
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError, PlausibilityWarning, ShapeError
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.robots.kinematics import RobotState
from tpgmm_torch.skills.holding import Holding
from tpgmm_torch.skills.situations import START, complete_frames, report_start
from tpgmm_torch.skills.skill import Skill

__all__ = ["Controller"]

#: Wanted postures are multiples of ``1 / GRID`` [rad or m]: the rounding of a batch, which is
#: another one for each size, ends there, before the follower enlarges it.
GRID = 2.0**32
#: Duration of a tick for robots whose time did not increase, and which are held [s].
INSTANT = 1e-6


@dataclass
class _Tick:
    """Knowledge of one tick.

    Parameters
    ----------
    seconds : float or array of shape (...)
        Duration of the tick, at most the longest that is trusted [s].
    drive : float or array of shape (...)
        The same, at most little longer than usual: a loop that stood has to be caught up with
        gently, since drives go to each reference at once.
    late : bool array of shape (B,), optional
        Robots whose time did not increase.
    first : bool
    time : Tensor of shape () or (...)
        Progress, from when each robot is located on [s].
    joints : Tensor of shape (..., n_joints), optional
        Accepted readings, NaN elsewhere.
    halted : bool array of shape (B,), optional
        Robots without accepted inputs.
    obstructed : array of shape (B,), optional
        How much obstacles hold robots up; from 1 on time stands.
    ended : Tensor of bool of shape (...), optional
        Robots that have been at the end of the skill for a tick.
    """

    seconds: Seconds
    late: Flags | None
    first: bool
    drive: Seconds = 0.0
    paused: Flags | None = None
    time: Tensor = field(init=False)
    joints: Tensor | None = None
    halted: Flags | None = None
    obstructed: Array | None = None
    ended: Tensor | None = None


class Controller:
    """A batch of robots that run a skill, each at its own pace, from its beginning to its end.

    At each step the clock says how far each robot is, from what is measured; the skill gives
    the estimate there; the reference goes there within the bounds of motion. Inputs that cannot
    be right are rejected, and a robot without accepted inputs is held until there are some.
    After the end the last reference is held. Robots of a batch do not influence each other.

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
        How the time of the skill goes on; text is for :meth:`Clock.parse`. Without measured
        joints, every clock runs evenly.
    trust : Trust, optional
        Which measurements are accepted; None accepts everything, raises on what is wrong, and
        follows every ``dt`` to the letter.
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
    admittance : Admittance, optional
        How references move by the error of forces, where the skill has operators
        :class:`~tpgmm_torch.operators.Wrench` and steps are given wrenches; None to follow
        positions alone.
    begin, end : float, optional
        Run a part of the skill [s].
    at_rest : bool
        Whether robots stand when the skill begins; else they move as the skill does.
    obstacles : Scene, optional
        What references keep clear of (:class:`~tpgmm_control.obstacles.scene.Scene`). Time
        waits for robots that are kept too far off, and before something is taken or put; not
        with the clock ``"even"``. The command's reason says what is in the way.

    Attributes
    ----------
    command : Command or None
        What the last step returned.

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
        clock: Clock | str = Clock(),  # noqa: B008  (frozen)
        trust: Trust | None = Trust(),  # noqa: B008  (frozen)
        smoothing: OneEuro | None = OneEuro(),  # noqa: B008  (frozen)
        bounds: MotionBounds | Mapping[str, Any] | str | None = "robot",
        blend: float = 1.0,
        feedback: str = "reference",
        impedance: Impedance | None = None,
        admittance: Admittance | None = Admittance(),  # noqa: B008  (frozen)
        begin: float | None = None,
        end: float | None = None,
        at_rest: bool = True,
        obstacles: Scene | None = None,
    ) -> None:
        if feedback not in ("reference", "measured"):
            raise DataError(f"feedback is 'reference' or 'measured', got {feedback!r}")
        kinematics = skill.kinematics
        start = kinematics.joint_tensor(joints)
        frames = complete_frames(skill, joints, frames or {})
        if trust is not None:
            report_start(skill, joints, frames)
        self._frames = self._first_frames = _converted(kinematics, frames)
        self._skill = skill = skill.start(start, self._frames)
        self._trusts, self._feedback = trust is not None, feedback
        self._impedance, self._gripping = (
            impedance or Impedance(kinematics),
            gripping_joints(kinematics),
        )
        self._inputs = None
        if trust is not None:
            grips = None if self._gripping is None else self._gripping.numpy(force=True)
            self._inputs = Inputs(kinematics, start, self._frames, trust, smoothing, grips)
        self._holds = Holds.start(skill, self._frames)
        begin, end = _span(skill, begin, end)
        self._wrenches = _expected_contacts(skill, start, begin)
        forces = self._wrenches.thresholds
        self._offsets = Offsets(admittance) if admittance is not None and forces else None
        self._needs_wrench = self._offsets is not None
        self._begin_at(Clock.parse(clock), start, begin, end)
        self._fade, self._search = Fade.start(start, blend), skill.posture_search()
        # what is not for a robot, as a rollout, is where the joints should be
        self._gaps = ExpectedGaps.start(skill, start, blend) if self._trusts else None
        bounds = _motion_bounds(skill, bounds)
        self._following = Following.start(bounds, start, at_rest)
        self._avoidance, batch = None, len(self._progress)
        if obstacles is not None:
            self._avoidance = Avoidance.start(obstacles, kinematics, bounds, batch)
            self._holds = self._holds.of_solids(obstacles.geometry.objects)
        self._limits = _limits(bounds)
        self.command: Command | None = None

    def _begin_at(self, clock: Clock, start: Tensor, begin: float, end: float) -> None:
        self._places, rows = Places(self._skill, begin, end), _rows(as_array(start))
        self._patience = None
        if clock.wait_limit < math.inf:
            self._patience = Patience(clock.wait_limit, np.zeros(len(rows)))
        time = np.full(len(rows), begin, np.float64)
        self._gates = Gates.start(self._skill.gates, time.tolist(), end, self._trusts)
        if clock.kind == "localizing" and clock.initial == "anywhere":
            before = replace(self._places, end=min(end, self._gates.find_span(0)[1]))
            for row in range(len(rows)):
                time[row] = before.find_start(row, self.holding, start)
        self._clock, self._end = clock, end
        starts = zip(time.tolist(), rows, strict=True)
        self._progress = [Progress.start(clock, now, end, row) for now, row in starts]
        self._limit_times()
        # robots that begin in the middle of the skill stand where no demonstration starts
        midway = torch.from_numpy(time > begin + START * (end - begin))
        midway = midway.view(start.shape[:-1]).to(start.device)
        self._start = torch.where(midway.unsqueeze(-1), torch.nan, start)

    @property
    def reference(self) -> Tensor:
        """The last reference (..., n_joints); the start posture before the first step."""
        return self._sent.reference

    @property
    def _sent(self) -> Following | Follower:
        """Sent references: the ordinary ones, or those that keep clear of obstacles."""
        sent = None if self._avoidance is None else self._avoidance.sent
        return self._following if sent is None else sent

    @property
    def _wanted_posture(self) -> Tensor:
        """Where the joints should be: the last reference, less what servos need beyond."""
        return self.reference if self._gaps is None else self.reference - self._gaps.gap

    @property
    def holding(self) -> Holding:
        """Objects that the robots hold, and where objects were last free."""
        return self._holds.holding

    @property
    def contacts(self) -> dict[str, Tensor]:
        """Which robots are in contact (...), by links whose wrench was given."""
        device = self.reference.device
        readings = self._wrenches.readings.items()
        return {link: torch.from_numpy(one.contact).to(device) for link, one in readings}

    @property
    def time(self) -> Tensor:
        """Progress at the last step [s], the same () for all robots or of each one (...)."""
        times = self._times
        if self._clock.kind == "even" and (times == times[0]).all():
            return torch.as_tensor(times[0]).to(self.reference)
        return self._tensor(times)

    @property
    def _times(self) -> Array:
        """Progress of the robots (B,) [s]."""
        return np.array([robot.time for robot in self._progress])

    @property
    def _running(self) -> Flags:
        """Robots (B,) that follow the skill."""
        return np.array([robot.mode is Mode.RUNNING for robot in self._progress])

    @property
    def finished(self) -> bool:
        """Whether all robots' references are at the end: further steps hold the last ones."""
        ended = self.command is not None and bool((self._times >= self._end).all())
        return ended and bool(self._fade.done.all())

    def step(
        self,
        dt: float | Tensor,
        joints: Any = None,
        frames: Mapping[str, Any] | None = None,
        *,
        holds: Mapping[str, str | None] | None = None,
        ages: Mapping[str, float] | None = None,
        wrenches: Mapping[str, Any] | None = None,
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
            How old ``"joints"`` and the frames are [s]; infinite for what else holds robots,
            a reason in words.
        wrenches : mapping of str to array-like of shape (..., 6), optional
            Measured forces [N] and moments [N m] that links exert, at their origins, in the
            base frame, without the weight of the tool. One that was given once is expected
            at each step; while it is missing, or not finite, its link moves no further.

        Returns
        -------
        Command

        Raises
        ------
        ShapeError
            If there are more or fewer robots than at the start. Nothing has moved then.
        UnknownNameError
            If wrenches are those of links that the robot does not have.

        Warns
        -----
        PlausibilityWarning
            With ``trust``, if ``dt`` is more than a second, or the first step has no wrench of
            a skill that expects forces.
        """
        tick = self._timed(dt)
        if tick is None:
            assert self.command is not None
            self.command = commands.refused(self.command, f"{NOT_INCREASED}: dt = {dt!r}")
            return self.command
        self._sense(tick, joints, frames, self._touched(tick, wrenches, ages))
        self._locate(tick)
        self._gate(tick)
        tick.time = self.time
        if tick.ended is None or not bool(tick.ended.all()):
            self._hold(tick, frames, holds)
            self._touch(tick)
        self._move(tick)
        command = self._send(tick)
        if self._patience is not None:
            self._wait(tick, command)
        return command

    def copy(self) -> Self:
        """The same moment, to look ahead from."""
        other = copy.copy(self)  # other states are replaced, never changed
        other._progress = [robot.copy() for robot in self._progress]
        return other

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

    # Stages

    def _timed(self, dt: Any) -> _Tick | None:
        """How long this tick is for each robot; None if no time has passed."""
        seconds, late = _durations(dt)
        first = self.command is None
        if first:
            seconds = np.maximum(np.nan_to_num(seconds, posinf=1e-3), 1e-3)
            return _Tick(seconds, None, True, seconds)
        if isinstance(seconds, float) and seconds == 0:
            return None
        if not self._trusts:
            return _Tick(seconds, late, False, seconds)
        paused = None
        each: Any = seconds if isinstance(seconds, float) else seconds.reshape(-1)
        if np.any(each > PAUSE):
            warnings.warn(LONG_TICK, PlausibilityWarning, stacklevel=3)
            paused = np.broadcast_to(each > PAUSE, len(self._progress))
        seconds, each = (np.minimum(x, LONGEST_TICK) for x in (seconds, each))
        usual = np.array([robot.timing.usual_dt for robot in self._progress])
        most = CATCH_UP * np.where(usual > 0, usual, each)
        drive: Seconds = seconds
        if (each > most).any():
            drive = np.minimum(seconds, most.reshape(self.reference.shape[:-1]))
        return _Tick(seconds, late, False, drive, paused)

    def _sense(self, tick: _Tick, joints: Any, frames: Any, ages: Any) -> None:
        """Accepted readings, and robots that are held without them."""
        if self._inputs is None:
            if frames is not None:
                self._frames = _converted(self._skill.kinematics, frames)
            measured = self._checked(joints)
        else:
            self._inputs = self._inputs.update(tick.seconds, joints, frames, ages)
            self._accept_places()
            self._frames, measured = self._inputs.frames, self._inputs.measured
            untrusted = self._inputs.untrusted(self._holds.known(self.reference))
            halted: Flags = untrusted.reshape(-1)
            if tick.paused is not None:
                halted = halted | tick.paused
            if self._patience is not None:
                halted = halted | self._patience.stands
            tick.halted = halted if halted.any() else None
        if measured is not None and self._gripping is not None:
            # the objects that they hold keep gripping joints from their references
            measured = torch.where(self._gripping, torch.nan, measured)
        tick.joints = measured

    def _touched(self, tick: _Tick, wrenches: Any, ages: Any) -> Any:
        """Measured wrenches; ages of inputs, with those that are missing too long."""
        if tick.first and self._trusts and self._needs_wrench and not wrenches:
            warnings.warn(NO_WRENCH, PlausibilityWarning, stacklevel=3)
        self._wrenches = self._wrenches.update(tick.seconds, wrenches)
        if self._inputs is None:
            return ages
        return {**(ages or {}), **self._wrenches.late(self._inputs.trust.joint_timeout)}

    def _accept_places(self) -> None:
        """Readings that have jumped far, to the reference or to where the skill leads."""
        assert self._inputs is not None
        reading = self._inputs.joints
        if reading is None or not reading.pending.any():
            return
        gripping = None if self._gripping is None else as_array(self._gripping)
        explained: Flags = np.zeros(len(self._progress), bool)
        for row in np.flatnonzero(reading.pending).tolist():
            robot, servo = self._progress[row], self._progress[row].servo
            posture = _rows(reading.rival)[row] - servo.offset.mean
            if gripping is not None:  # of which readings tell nothing
                posture = np.where(gripping, servo.expected, posture)
            away = np.abs(posture - servo.expected) - servo.judgement.usual
            explained[row] = away.max() <= reading.trust.joint_jump or (
                self._clock.kind == "localizing"
                and self._find(row, robot.time, posture) is not None
            )
        accepted = reading.accept(explained.reshape(reading.pending.shape))
        self._inputs = replace(self._inputs, joints=accepted)

    def _locate(self, tick: _Tick) -> None:
        """Progress of each robot."""
        if tick.first:
            return
        before, passed, still = self._times, self._measure_tick(tick), self._stands(tick)
        tick.obstructed = self._obstruction(passed)
        obstructed = np.zeros(len(before)) if tick.obstructed is None else tick.obstructed
        if not self._trusts and tick.joints is None:
            steps = np.where(still, 0.0, passed).tolist()
            for robot, step, much in zip(
                self._progress, steps, obstructed.tolist(), strict=True
            ):
                robot.advance_unseen(step, much)
        else:
            self._advance_progress(tick, passed, still, obstructed)
        over = (self._times >= self._end) & (before >= self._end)
        if over.any():
            over &= self._fade.done.numpy(force=True).reshape(-1)
        tick.ended = self._tensor(over) if over.any() else None

    def _advance_progress(
        self, tick: _Tick, passed: Array, still: Flags, obstructed: Array
    ) -> None:
        """Let robots (B,) make progress by what is measured."""
        reference, running = _rows(as_array(self._wanted_posture)), self._running
        joints = reference * np.nan if tick.joints is None else _rows(as_array(tick.joints))
        jumped: Flags = np.zeros(len(passed), bool)
        if self._inputs is not None:
            jumped = self._inputs.jumped.reshape(-1)
            still = still | self._inputs.jumping.reshape(-1)
        columns = (each.tolist() for each in (passed, jumped, still, obstructed))
        for row, (dt, jumps, halted, much) in enumerate(zip(*columns, strict=True)):
            robot = self._progress[row]
            floor = None if self._gaps is None else self._gaps.floor[row]
            seen = Seen(dt, joints[row], jumps, halted, much, floor)
            find = functools.partial(self._find, row, robot.time)
            robot.advance(reference[row], seen, find)
        self._resume(~running & self._running)

    def _measure_tick(self, tick: _Tick) -> Array:
        """Compute the duration of the tick for each robot (B,) [s]."""
        return np.zeros(len(self._progress)) + np.ravel(tick.seconds)

    def _obstruction(self, passed: Array) -> Array | None:
        """How much obstacles hold robots up (B,)."""
        if self._avoidance is None or not self._avoidance.led.any():
            return None
        stops = {*self._clock.arrivals, self._end}
        stops.update(time for hold in self._skill.holds for time in (hold.begin, hold.end))
        soon = self._times + CATCH_UP * self._clock.speed * passed
        return self._avoidance.obstruction(self._times, soon, sorted(stops))

    def _resume(self, robots: Flags) -> None:
        """Robots go on from where they are: those given, and those at another time."""
        robots = robots | np.array([robot.relocalized for robot in self._progress])
        if robots.any():
            self._fade = self._fade.again(self._tensor(robots))
            if self._gaps is not None:
                self._gaps = self._gaps.restart(self._tensor(robots))
            if self._search is not None:
                self._search = self._search.drop_robots(self._tensor(robots))

    def _wait(self, tick: _Tick, command: Command) -> None:
        """Count for how long robots are waited for."""
        assert self._patience is not None
        waits = command.of(Status.WAITING) | command.of(Status.DISPLACED)
        passed = self._measure_tick(tick)
        indices = list(np.ndindex(*self.reference.shape[:-1]))
        why = {row: command.reason(index) for row, index in enumerate(indices)}
        why = {row: text.partition("; stops for good")[0] for row, text in why.items()}
        flags = waits.numpy(force=True).reshape(-1)
        self._patience = self._patience.advance(flags, passed, why)

    def _find(self, row: int, now: float, posture: Array) -> float | None:
        """Find a time of the skill that explains a robot's posture."""
        if self._gates.robots[row].failed:
            return None
        within = self._gates.find_span(row)
        like = self.reference.detach()
        return self._places.find(row, posture, now, self.holding, like, within)

    def _gate(self, tick: _Tick) -> None:
        """Robots that wait for the end of one skill to be what the next one needs."""
        if tick.first or self._gates.over:
            return
        postures, passed = self._postures(tick, measured=True), self._measure_tick(tick)
        ready = self._running & ~self._stands(tick)
        moment = None
        if self._inputs is not None and any(stop is not None for stop in self._gates.stops):
            moment = self._moment(tick, postures)
        self._gates = self._gates.advance(self._times, passed, ready, moment)
        self._limit_times()
        self._pass_gates(postures)

    def _pass_gates(self, postures: Tensor) -> None:
        """Go on from other times at postures (..., n_joints)."""
        passages = self._gates.robots
        for robot, passage in zip(self._progress, passages, strict=True):
            if passage.goto is not None:
                robot.go_on_from(passage.goto)
        fades = self._tensor(np.array([passage.fade for passage in passages]))
        returned = np.array([passage.goes_back for passage in passages])
        begin, back = fades > 0, self._tensor(returned)
        if begin.any():  # a skill begins with objects where they are now
            self._holds = self._holds.restarted(begin, postures)
            self._fade = self._fade.again(begin, fades)
        if back.any():
            self._holds = self._holds.released(back, postures, self._frames)
            self._resume(returned)

    def _limit_times(self) -> None:
        """Let robots go no further than their gates."""
        for robot, stop in zip(self._progress, self._gates.stops, strict=True):
            robot.stop = stop

    def _stands(self, tick: _Tick) -> Flags:
        """Robots (B,) without accepted inputs, or whose time did not increase."""
        none: Flags = np.zeros(len(self._progress), bool)
        return np.logical_or.reduce(
            [none, *(x for x in (tick.halted, tick.late) if x is not None)]
        )

    def _moment(self, tick: _Tick, postures: Tensor) -> Moment:
        """State that the conditions of gates are judged by."""
        reference, velocity = self._wanted_posture.detach(), self._following.velocity.detach()
        readings = torch.nan * reference if tick.joints is None else tick.joints
        arrays = (_rows(as_array(each)) for each in (reference, velocity, readings))
        robots = zip(self._progress, *arrays, strict=True)
        arrived = self._tensor(np.array([robot.check_arrival(*at) for robot, *at in robots]))
        assert self._inputs is not None
        every, poses, lost = torch.ones_like(arrived), self._inputs.poses, self._inputs.lost
        unseen = {n: lost.get(n, every & (n not in poses)) for n in self._frames}
        return Moment(
            self.time, self._skill.kinematics.state(postures), self._frames, unseen,
            self.holding, self.contacts, arrived,
        )  # fmt: skip

    def _hold(self, tick: _Tick, frames: Any, holds: Any) -> None:
        """Update of the objects that the robots hold."""
        seen = None if frames is None else dict(self._frames)
        stands, seconds = self._postures(tick, measured=True), _each(tick.seconds)
        self._holds = self._holds.advance(tick.time, stands, seen, holds, seconds, self._inputs)

    def _touch(self, tick: _Tick) -> None:
        """How far links are moved by the errors of their forces."""
        if self._offsets is None or not self._wrenches.readings:
            return
        expected, kinematics = self._skill.expected_forces(tick.time), self._skill.kinematics
        operators, state = (*(one.operator for one in expected), *self._offsets.values), None
        if any(operator.frame in kinematics.links for operator in operators):
            state = kinematics.state(self._postures(tick, measured=True))
        passed = torch.as_tensor(_each(tick.drive)).to(self.reference)
        passed = torch.where(self._tensor(self._stands(tick)), 0.0, passed)
        self._offsets = self._offsets.advance(
            expected, self._wrenches, state, self.holding.frames, passed
        )

    def _estimate(self, tick: _Tick) -> Estimate:
        """Estimate by the skill."""
        at: Any = self._postures(tick, self._feedback == "measured")
        at = self._state(at) if self._is_changed else at
        last = self.command.estimate if self.command is not None and self._trusts else None
        found = estimate(self._skill, tick.time, at, self.holding, self._limits, last)
        self._skill = self._skill.advance(found)
        return found

    def _reach(self, tick: _Tick, found: Estimate) -> tuple[Estimate, Tensor, Follower | None]:
        """The posture that is wanted, and the follower of the next tick, if it is known."""
        seconds = 0.0 if tick.first else _each(tick.drive)
        posture = self._postures(tick, measured=False)
        shift, self._fade = self._fade.advance(posture, found.joints, seconds, tick.first)
        if self._gaps is not None:
            self._gaps = self._gaps.advance(self._skill, self._times, seconds, tick.first)
            shift = self._gaps.gap if shift is None else shift + self._gaps.gap
        wanted, fitting = self._rounded(found.joints, shift), None
        if not tick.first:
            wanted, fitting = self._nearest(tick, found, wanted, shift)
        if tick.ended is not None:  # for them it is as if all had come to the end
            assert self.command is not None
            last = self._following.wanted
            wanted = torch.where(tick.ended.unsqueeze(-1), last, wanted)
            found = choose(tick.ended, self.command.estimate, found)
        return found, wanted, fitting

    def _nearest(
        self, tick: _Tick, found: Estimate, wanted: Tensor, shift: Tensor | None
    ) -> tuple[Tensor, Follower | None]:
        """The same where an estimate cannot be followed."""
        search, follower = self._skill.posture_search(), self._following.follower
        if follower is None or search is None or self._limits is None:
            return wanted, None
        search = self._search or search
        if search.active is None:
            following = follower.advance(wanted, tick.drive)
            if following.reference is wanted or not _touch_limits(found, self._limits).any():
                return wanted, following
        binds = _touch_limits(found, self._limits)
        joints, self._search = nearest(
            search, follower, wanted, tick.drive, tick.time,
            self._postures(tick, self._feedback == "measured"), self.holding.frames,
            found, self._limits, self._state if self._is_changed else None,
            not self._trusts, binds,
        )  # fmt: skip
        return self._rounded(joints, shift), None

    def _move(self, tick: _Tick) -> None:
        """From the estimate to the next references."""
        if tick.ended is None or not bool(tick.ended.all()):
            self._follow(tick, *self._reach(tick, self._estimate(tick)))
        else:
            assert self.command is not None
            self._follow(tick, self.command.estimate, self._following.wanted, None)

    def _follow(
        self, tick: _Tick, found: Estimate, wanted: Tensor, fitting: Follower | None
    ) -> None:
        """The next references, within the bounds."""
        self._found, goal, running = found, wanted, self._running
        if not running.all() and tick.joints is not None:
            goal = self._lead(wanted, running, tick.joints)
        halted, late = (
            None if robots is None else self._tensor(robots)
            for robots in (None if tick.first else tick.halted, tick.late)
        )
        before = self._following.follower
        self._following = self._following.advance(
            wanted, goal, tick.drive, halted, late, tick.first, fitting
        )
        if before is not None and not tick.first:
            self._avoid(tick, before)

    def _lead(self, wanted: Tensor, running: Flags, measured: Tensor) -> Tensor:
        """Find where references go (..., n_joints): of robots that do not run, elsewhere."""
        busy, beyond = self._holds.busy(wanted), 0.0 if self._gaps is None else self._gaps.gap
        led = np.array(_rows(as_array(wanted - beyond)), np.float64)
        for row in np.flatnonzero(~running).tolist():
            led[row] = self._progress[row].lead(led[row].copy(), bool(busy[row]))
        alone = self._tensor(running).unsqueeze(-1) | measured.isnan()
        return torch.where(alone, wanted, self._tensor(led).to(wanted) + beyond)

    def _avoid(self, tick: _Tick, before: Follower) -> None:
        """The references that are sent, clear of obstacles."""
        after = self._following.follower
        if self._avoidance is not None and after is not None:
            none: Flags = np.zeros(len(self._progress), bool)
            state = self._state(self.reference) if self.holding.carries else None
            self._avoidance = self._avoidance.advance(
                before, after, state, self.holding.frames,
                none if tick.halted is None else tick.halted,
                none if tick.late is None else tick.late,
            )  # fmt: skip

    def _send(self, tick: _Tick) -> Command:
        """The command, with the status of each robot."""
        following, robots = self._following, self._progress
        lost = None if following.lost is None else following.lost.numpy(force=True).reshape(-1)
        ended = None if tick.ended is None else tick.ended.numpy(force=True).reshape(-1)
        blocked: Mapping[int, tuple[bool, str]] = self._behind()
        if tick.obstructed is not None and self._avoidance is not None:
            blocked = {**blocked, **self._avoidance.reasons(tick.obstructed)}
        codes, reasons = commands.statuses(
            self.reference.shape[:-1], self._skill.kinematics.joint_names, robots,
            following.wanted, ended,
            ((lost, NO_ANSWER), (tick.late, NOT_INCREASED), (tick.paused, PAUSED)),
            tick.halted, self._inputs, self._gates, blocked, self._patience,
        )  # fmt: skip
        self.command = Command(
            self._sent.reference,
            self._sent.velocity,
            tick.time,
            self._found,
            self._tensor(codes),
            reasons,
            self._impedance,
            self._novelty(),
            self._tensor(np.array([robot.relocalized for robot in robots])),
            self._tensor(np.array([robot.servo.offset.mean for robot in robots])),
        )
        return self.command

    def _behind(self) -> dict[int, tuple[bool, str]]:
        """Say which references are behind what the skill wants, as fast as they may."""
        following = self._following
        if following.follower is None or not np.any(following.follower.moment.behind):
            return {}
        gap = _rows(as_array(following.wanted.detach() - following.reference.detach()))
        late = np.abs(gap) / as_array(following.follower.bounds.velocity)
        names, found = self._skill.kinematics.joint_names, {}
        for row in np.flatnonzero(late.max(-1) > LATE).tolist():
            joint = int(late[row].argmax())
            said = f"joint {names[joint]!r} is {gap[row, joint]:+.2f} from what the skill wants"
            found[row] = (False, f"{said}, as fast as its bounds allow")
        return found

    # Conversions

    def _tensor(self, rows: Any) -> Tensor:
        """Rows of robots (B, ...) in the batch's shape."""
        like, array = self._start, np.ascontiguousarray(rows)
        tensor = torch.from_numpy(array.reshape((*like.shape[:-1], *rows.shape[1:])))
        return tensor.to(like) if tensor.is_floating_point() else tensor.to(like.device)

    def _checked(self, joints: Any) -> Tensor | None:
        """Joints that are trusted, of as many robots as at the start."""
        if joints is None:
            return None
        measured = self._skill.kinematics.joint_tensor(joints)
        if measured.shape != self.reference.shape:
            raise ShapeError(
                f"the skill began with joints of shape {tuple(self.reference.shape)}, now "
                f"there are {tuple(measured.shape)}: start another controller for other robots"
            )
        return measured

    def _postures(self, tick: _Tick, measured: bool) -> Tensor:
        """References, or measured joints where there are some."""
        if not measured or tick.joints is None:
            if self._gaps is None and self._avoidance is None:
                return self._following.reference
            return self._following.reference - (self.reference - self._wanted_posture)
        return torch.where(tick.joints.isnan(), self._wanted_posture, tick.joints)

    @property
    def _is_changed(self) -> bool:
        """Whether there is more to a state than the kinematics say."""
        return self.holding.carries or (self._offsets is not None and self._offsets.active)

    def _state(self, joints: Tensor) -> RobotState:
        """With the objects that the robots hold, and the offsets of links in contact."""
        state = self._skill.kinematics.state(joints)
        if self._offsets is not None:
            state = self._offsets.displaced(state, self.holding.frames)
        return self.holding.state(state)

    def _rounded(self, joints: Tensor, shift: Tensor | None) -> Tensor:
        """Wanted postures; where there are bounds, on a grid."""
        if shift is not None:
            joints = joints + shift
        joints = self._skill.kinematics.retract(joints)
        if self._following.bounds is None:
            return joints
        if self._gaps is not None and self._limits is not None:
            joints = joints.clamp(*self._limits)
        rounded = (joints.detach() * GRID).round() / GRID
        return joints + (rounded - joints).detach() if joints.requires_grad else rounded

    def _novelty(self) -> Any:
        """Computes the novelty of where robots began and objects are, or were last free."""
        summary = self._skill.summary
        if summary is None:
            return None
        first, now = self._first_frames, self.holding.frames
        return functools.partial(_novelty, summary, self._start, first, now)


#: A reference that is later than this behind what is wanted, at full speed, is said to be [s].
LATE = 0.2
#: A loop that stood for longer holds robots for a tick [s].
PAUSE = 1.0
#: Why a robot is held.
PAUSED = "dt is more than a second: it is in seconds, and the loop must not stand for so long"
NOT_INCREASED, NO_ANSWER = "time did not increase", "the model has no finite answer here"
LONG_TICK = (
    "dt is more than a second: it is in seconds, not in milliseconds; after a pause of the "
    "loop, the robot is held for a tick"
)
NO_WRENCH = (
    "the skill expects forces, and the first step has no wrench: what is measured corrects "
    "nothing. Give step(..., wrenches={link: ...}), or do without, Controller(..., "
    "admittance=None), TorqueGains(integral=0)"
)


def _novelty(
    summary: Any, start: Tensor, first: Mapping[str, Frame], now: Mapping[str, Frame]
) -> Tensor:
    """Novelty of each robot (...) of a batch of start postures."""
    known = {n: f for n, f in first.items() if n in summary.frames and summary.frames[n].moves}
    novelty = torch.as_tensor(summary.novelty(start, {**now, **known})).to(start)
    return novelty.expand(start.shape[:-1])


def _touch_limits(found: Estimate, limits: tuple[Tensor, Tensor]) -> Tensor:
    """Robots (...) of which a joint is estimated at a limit of position."""
    return ((found.joints <= limits[0]) | (found.joints >= limits[1])).any(-1)


def _each(seconds: Seconds) -> float | Tensor:
    """Durations of robots as a tensor."""
    return torch.from_numpy(seconds) if isinstance(seconds, np.ndarray) else seconds


def _rows(array: Array) -> Array:
    """Robots of a batch in one dimension."""
    return array.reshape(-1, array.shape[-1])


def _converted(kinematics: Any, frames: Mapping[str, Frame]) -> dict[str, Frame]:
    return {name: frame.to(kinematics.lower) for name, frame in frames.items()}


def _expected_contacts(skill: Skill, start: Tensor, begin: float) -> Wrenches:
    """The wrenches of robots, with the thresholds of the skill's own contacts."""
    forces = [one.operator for one in skill.expected_forces(start.new_tensor(begin))]
    contacts = {operator.link: operator.contact for operator in forces}
    return Wrenches(skill.kinematics.links, tuple(start.shape[:-1]), contacts)


def _span(skill: Skill, begin: float | None, end: float | None) -> tuple[float, float]:
    begin = skill.begin if begin is None else begin
    end = skill.end if end is None else end
    if not -math.inf < begin < end < math.inf:
        raise DataError(f"a skill ends after its beginning, got {begin!r} s to {end!r} s")
    return begin, end


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


def _limits(bounds: MotionBounds | None) -> tuple[Tensor, Tensor] | None:
    """Between which rounded postures stay."""
    if bounds is None:
        return None
    return (bounds.lower * GRID).ceil() / GRID, (bounds.upper * GRID).floor() / GRID


def _durations(dt: Any) -> tuple[Seconds, Flags | None]:
    """Duration of a tick, of each robot or of all, and robots whose time did not increase."""
    if isinstance(dt, float) and 0 < dt < math.inf:
        return dt, None
    try:
        given = dt.numpy(force=True) if isinstance(dt, Tensor) else dt
        seconds = np.asarray(given, np.float64)
    except (TypeError, ValueError):
        return 0.0, None
    increased = (seconds > 0) & np.isfinite(seconds)
    if not increased.any():
        return 0.0, None
    if increased.all():
        first = float(seconds.flat[0])
        return (first if (seconds == first).all() else seconds), None
    return np.where(increased, seconds, INSTANT), ~increased.reshape(-1)
