"""Stage *locate*: how far a robot is in its skill, and whether it follows.

A robot is in one of three modes, decided by the gaps that its
:class:`~tpgmm_control.sensing.servo.Servo` does not explain:

running
    Time goes on, the slower the larger the largest gap is in units of what is usual. What a
    long tick has cost is caught up gently.
probing
    Time stands, and the reference goes, within its bounds, back to where the robot was when the
    gap was noticed: a posture that does not change, so it cannot run away. What happens
    meanwhile tells apart what looks alike. If the joint runs along with its reference, the gap
    is an *offset*, which is taken in. If the gap closes because the joint moves, it *came
    back*. If it closes because the reference has come to it, somebody or something *holds* it.
held
    The reference leads the robot by a little, the more the longer it lasts. Once the robot
    moves, time goes on, from when it came to rest; and where no more than that is wanted.

Where several joints are off, and the skill explains the posture at another time, the robot was
displaced, and time goes there; a single joint that is off is rather an offset.
"""

from __future__ import annotations

import copy
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from typing import Self

import numpy as np

from tpgmm_control.loop.clock import Clock
from tpgmm_control.sensing.servo import FLOOR, STANDSTILL, Flags, Servo
from tpgmm_torch.data.arrays import Array

#: A time of the skill that explains a posture (n_joints,), if there is one.
Find = Callable[[Array], float | None]


class Mode(Enum):
    """Whether a robot follows its skill."""

    RUNNING = "running"  #: time goes on
    PROBING = "probing"  #: a gap was noticed, and the reference goes back
    HELD = "held"  #: the robot stands, and the reference leads it by a little


#: A loop that stood for longer goes on as if it had stood for that long [s].
LONGEST_TICK = 0.5
#: Time goes on so much faster to catch up with what a long tick has cost.
CATCH_UP = 1.5
#: Time in which the rate of progress of a robot that stood rises to 1 [s].
RESTART = 0.2
#: Gaps, in units of what is usual, from which on a joint does not follow, and for how long [s].
OFF, DWELL = 0.85, 0.04
#: Motion that tells something: whether a joint runs along with its reference, that it does not
#: rest (half of it), and that somebody else moves it (three times) [rad or m].
MOTION = FLOOR
#: Time after which a probe that tells nothing ends, and in which the lead of a held robot's
#: reference grows by MOTION [s].
PROBE_TIME = 2.0
#: The largest lead of what is held [rad or m].
MOST_LEAD = 0.15
#: Lead, in units of the motion that ends it: what is held must be able to tell that it is free.
TELLING = 1.25
#: Share of the lead of robots that hold an object, which they would lose with a jerk.
CAREFUL = 1 / 3
#: Time that a stopped robot has missed, from when on it is done again [s].
MISSED = 0.1
#: Times of the skill that are less apart are one place [s].
NEARBY = 0.3


@dataclass(frozen=True, eq=False)
class Seen:
    """Measurements of a robot at a tick.

    Parameters
    ----------
    dt : float
        Duration of the tick [s].
    joints : array of shape (n_joints,)
        Accepted readings, NaN elsewhere [rad or m].
    jumped : bool
        Whether readings have jumped to somewhere else, and stay there.
    halted : bool
        Whether time stands: nothing can be trusted, or time did not increase.
    obstructed : float
        How much obstacles hold the robot up: time goes on the slower, and from 1 on stands.
    floor : array of shape (n_joints,), optional
        Half the gap that means nothing where the skill is [rad or m].
    """

    dt: float
    joints: Array
    jumped: bool = False
    halted: bool = False
    obstructed: float = 0.0
    floor: Array | None = None

    @property
    def is_known(self) -> Flags:
        """Joints with readings (n_joints,)."""
        return np.isfinite(self.joints)


@dataclass(eq=False)
class Timing:
    """Durations that progress depends on.

    Parameters
    ----------
    rate : float
        Seconds of the skill per second, over the clock's speed.
    owed : float
        Time that is still to be caught up [s].
    usual_dt : float
        Mean duration of the ticks; 0 before the first [s].
    in_mode, off : float
        For how long the robot is in its mode, and has had gaps that are not usual [s].
    """

    rate: float = 1.0
    owed: float = 0.0
    usual_dt: float = 0.0
    in_mode: float = 0.0
    off: float = 0.0

    def advance(self, dt: float, halted: bool, stands: bool, rate: float) -> float:
        """Let a tick pass at a rate; return by how much time goes on, at full rate [s]."""
        usual = self.usual_dt if self.usual_dt > 0 else dt
        if not halted:
            self.usual_dt = usual = usual + 0.1 * (min(dt, 2 * usual) - usual)
        self.in_mode += dt
        if stands:
            self.rate, self.owed = self.rate if halted else 0.0, 0.0
            return 0.0
        step = min(self.owed + dt, CATCH_UP * usual)
        self.rate, self.owed = rate, 0.0 if rate < 1 else self.owed + dt - step
        return step

    def restart(self) -> None:
        """Begin another mode."""
        self.rate = self.owed = self.in_mode = self.off = 0.0


@dataclass(frozen=True, eq=False)
class Comparison:
    """State of a robot that its later motion is compared with.

    Parameters
    ----------
    expected, reading : array of shape (n_joints,)
        Positions as they were expected, and as they were measured [rad or m].
    """

    expected: Array
    reading: Array


@dataclass(eq=False)
class Probe:
    """Knowledge of a robot that does not run.

    Parameters
    ----------
    target : array of shape (n_joints,)
        Where its reference goes [rad or m].
    wanted : array of shape (n_joints,)
        What the skill wanted last.
    stuck : bool array of shape (n_joints,)
        Joints that did not follow.
    opened : array of shape (n_joints,)
        Size of the gaps then.
    held : array of shape (n_joints,)
        Where it was found to be held.
    displaced, placed : bool
        Whether somebody else has moved it, and whether its place was found.
    """

    target: Array
    wanted: Array
    stuck: Flags
    opened: Array
    held: Array
    displaced: bool = False
    placed: bool = False


@dataclass(frozen=True, eq=False)
class Rest:
    """The rest of a robot before it stopped.

    Parameters
    ----------
    reading : array of shape (n_joints,)
        Where it came to rest [rad or m].
    bank : array of shape (K, n_joints)
        Positions of its servos then.
    time : float
        In the skill [s].
    resumed : float, optional
        Time to which it went back last; None if it never did.
    """

    reading: Array
    bank: Array
    time: float
    resumed: float | None = None


@dataclass(eq=False, kw_only=True)
class Progress:
    """Progress of one robot; made by :meth:`start`, changed by each tick.

    Parameters
    ----------
    clock : Clock
    end : float
        Of the skill [s].
    stop : float, optional
        Time beyond which the robot does not go [s].
    servo : Servo
    time : float
        In the skill [s].
    relocalized : bool
        Whether time was set to another one at this tick.
    mode : Mode
    timing : Timing
    probe : Probe
    rest : Rest
    comparison : Comparison, optional
        None before what opened a gap is over.
    followed : Comparison
        Expected positions and readings when the robot last followed.
    """

    clock: Clock
    end: float
    stop: float | None = None
    servo: Servo
    time: float
    relocalized: bool = False
    mode: Mode = Mode.RUNNING
    timing: Timing
    probe: Probe
    rest: Rest
    comparison: Comparison | None = None
    followed: Comparison

    @classmethod
    def start(cls, clock: Clock, time: float, end: float, posture: Array) -> Self:
        """Begin at a time of the skill, at rest in a posture (n_joints,)."""
        servo, none = Servo.start(posture), np.zeros(posture.shape, bool)
        return cls(
            clock=clock,
            end=end,
            servo=servo,
            time=time,
            timing=Timing(),
            probe=Probe(posture, posture, none, 0 * posture, posture),
            rest=Rest(posture, servo.bank.second, time),
            followed=Comparison(posture, posture),
        )

    def copy(self) -> Self:
        """Copy the progress as it is now."""
        new = copy.copy(self)
        new.servo, new.timing = self.servo.copy(), copy.copy(self.timing)
        new.probe = copy.copy(self.probe)
        return new

    @property
    def waits(self) -> bool:
        """True while the robot is waited for."""
        late = self.timing.off >= self._patience
        return (late or self.mode is not Mode.RUNNING) and self.time < self.end

    @property
    def lasting(self) -> bool:
        """True while the robot has been off for more than a moment."""
        return self.timing.off > self._patience

    @property
    def _patience(self) -> float:
        """Return for how long a gap that is not usual means nothing [s]."""
        return max(DWELL, 2 * self.timing.usual_dt)

    def advance(self, reference: Array, seen: Seen, find: Find) -> None:
        """Take in what was measured at a tick.

        Parameters
        ----------
        reference : array of shape (n_joints,)
            What was sent a tick ago.
        seen : Seen
        find : callable
            ``find(posture)``: the time of the skill that explains a posture, or None.
        """
        if seen.floor is not None:
            self.servo.floor = seen.floor
        learns = self.mode is Mode.RUNNING and not seen.halted
        self.servo.advance(reference, seen.joints, seen.dt, seen.jumped, learns)
        self.relocalized = False
        self._advance_time(seen)
        if self.clock.kind == "even":
            return
        explained = self._compare_motion(seen)
        if seen.halted:
            return
        if self.mode is Mode.RUNNING:
            self._notice_stop(reference, seen, find)
        if self.mode is Mode.PROBING:
            self._end_probe(reference, seen, find, explained)
        if self.mode is Mode.HELD:
            self._release(seen)

    def advance_unseen(self, dt: float, obstructed: float = 0.0) -> None:
        """Let a tick pass [s] at which nothing is measured."""
        if self.clock.kind != "even":
            dt *= min(max(2 - 2 * obstructed, 0.0), 1.0)
        self.time = self._limit_time(self.clock.speed * dt)

    def check_arrival(self, reference: Array, velocity: Array, readings: Array) -> bool:
        """Tell whether all joints are where the reference is, at rest.

        Parameters
        ----------
        reference, velocity : array of shape (n_joints,)
            What was sent a tick ago [rad or m, rad/s or m/s].
        readings : array of shape (n_joints,)
            NaN where nothing is measured: there the reference counts.
        """
        servo, known = self.servo, np.isfinite(readings)
        moved = np.abs(servo.readings.median - servo.readings.near)
        there = moved <= FLOOR / 10 + 2 * servo.std
        there &= np.abs(servo.position - reference) <= servo.floor
        still = np.abs(velocity) <= FLOOR
        return self.mode is Mode.RUNNING and bool(((there | ~known) & still).all())

    def go_on_from(self, time: float) -> None:
        """Go on from another time of the skill [s]."""
        self.time, self.rest = time, replace(self.rest, time=time)

    def lead(self, wanted: Array, careful: bool) -> Array:
        """Find where the reference goes: while the robot runs, to what is wanted.

        Parameters
        ----------
        wanted : array of shape (n_joints,)
        careful : bool
            Whether the robot holds an object.
        """
        probe = self.probe
        probe.wanted = wanted
        if self.mode is Mode.RUNNING:
            return wanted
        if self.mode is Mode.PROBING:
            return probe.target
        lead = (CAREFUL if careful else 1.0) * self._compute_lead()
        lead = np.maximum(lead, TELLING * self._motion_of_held)
        lead = np.where(probe.stuck, lead, 0.0)
        return probe.target + np.clip(np.nan_to_num(wanted - probe.target), -lead, lead)

    def _compute_lead(self) -> Array:
        """Compute by how much the reference of a robot that is held leads (n_joints,)."""
        share = 0.75 + self.timing.in_mode / PROBE_TIME
        return np.minimum(self.servo.floor * share, MOST_LEAD)

    @property
    def _motion_of_held(self) -> Array:
        """From which on joints (n_joints,) that were held have moved, beside their noise."""
        averaged = min(1.0, self.timing.usual_dt / (2 * STANDSTILL))
        noise = self.servo.readings.noise
        return self.servo.floor / 2 + 3 * np.sqrt(2 * noise * averaged)

    # Time

    def _advance_time(self, seen: Seen) -> None:
        """Let time go on if the robot follows."""
        known, judgement, timing = seen.is_known, self.servo.judgement, self.timing
        excess = float(judgement.excess[known].max(initial=0.0))
        lead = max(float(judgement.lead[known].max(initial=0.0)), seen.obstructed)
        stands = seen.halted or self.mode is not Mode.RUNNING
        rate = self._compute_rate(max(excess, lead), seen.dt)
        step = timing.advance(seen.dt, seen.halted, stands, rate)
        step = 0.0 if stands else self.clock.speed * rate * step
        self.time = self._stop_at_arrival(self._limit_time(step), known)
        left = self.mode is Mode.RUNNING and self._leave_rest(known)
        if stands:
            timing.off = 0.0
            return
        if excess > OFF or (not left and self._stalls(known)):
            timing.off += seen.dt
        else:
            slow = known & (np.maximum(judgement.excess, judgement.lead) > 0.5)
            timing.off = self._count_slow(slow, seen.dt)
        if excess < 0.5:
            self.followed = Comparison(self.servo.expected, self.servo.readings.median)

    def _count_slow(self, slow: Flags, dt: float) -> float:
        """Count gaps for which time slows: those that outlast any lag are waited for."""
        if not slow.any():
            return 0.0
        share = min(dt / (RESTART + DWELL + 4 * float(self.servo.lag[slow].max())), 1.0)
        return min(self.timing.off + share * self._patience, self._patience)

    def _compute_rate(self, gap: float, dt: float) -> float:
        """Compute the rate of time by the largest gap, in units of what is usual."""
        if self.clock.kind == "even":
            return 1.0
        return min(max(2 - 2 * gap, 0.0), 1.0, self.timing.rate + dt / RESTART)

    def _limit_time(self, step: float) -> float:
        """Compute the time after a step [s]; rounding does not cost a last one."""
        time = self.time + step
        time = self.end if time > self.end - 1e-6 * step else time
        return time if self.stop is None else min(time, self.stop)

    def _stop_at_arrival(self, time: float, known: Flags) -> float:
        """Limit time to the next arrival while some joint has not arrived."""
        arrivals = self.clock.arrivals
        following = bisect_left(arrivals, self.time)
        if following == len(arrivals) or time <= arrivals[following]:
            return time
        gap = np.abs(self.servo.position - self.servo.bank.first[0])
        late = bool((gap > self.servo.floor)[known].any())
        return arrivals[following] if late else time

    def _leave_rest(self, known: Flags) -> bool:
        """Notice that the robot has left where it was at rest."""
        servo = self.servo
        moved = np.abs(servo.readings.median - self.rest.reading) > MOTION / 2 + 3 * servo.std
        left = bool(moved[known].any())
        if left:
            self._rest_here(self.time)
        return left

    def _rest_here(self, time: float) -> None:
        """Let the rest of the robot be where it is now, at a time of the skill [s]."""
        servo, resumed = self.servo, self.rest.resumed
        self.rest = Rest(servo.readings.median, servo.bank.second, time, resumed)

    def _stalls(self, known: Flags) -> bool:
        """Tell whether joints were to move, however late they are, and none has."""
        if self.clock.kind == "even":
            return False
        asked = self.servo.measure_asked(self.rest.bank) - 6 * self.servo.std
        return bool((asked - 2 * self.servo.floor > 0)[known].any())

    def _find_off(self, seen: Seen) -> Flags:
        """Find joints that do not follow; while probing, those whose gaps have not closed."""
        off, probe = self.servo.judgement.excess > OFF, self.probe
        if self.mode is Mode.PROBING:
            closed = np.maximum(0.5 * probe.opened, self.servo.floor / 2)
            off = off | (probe.stuck & (np.abs(self.servo.gaps.mean) > closed))
        return seen.is_known & off

    # From mode to mode

    def _compare_motion(self, seen: Seen) -> bool:
        """Take gaps of joints that run along with references for offsets; tell if any does."""
        timing, servo, probing = self.timing, self.servo, self.mode is Mode.PROBING
        if seen.halted or not (probing or timing.off > 0):
            if self.mode is not Mode.HELD:
                self.comparison = None
            return False
        off = self._find_off(seen)
        if self.comparison is None:
            long = timing.in_mode if probing else timing.off
            if long > 1.5 * _longest_lag(servo, off):
                self.comparison = Comparison(servo.expected, servo.readings.median)
            return False
        ran = servo.readings.median - self.comparison.reading
        moved = servo.expected - self.comparison.expected
        tells = np.abs(moved) > MOTION + 3 * servo.std
        along = off & tells & (np.abs(ran - moved) < 0.5 * np.abs(moved))
        if not along.any():
            return False
        servo.take_offsets(along)
        self.probe.displaced = False
        return True

    def _notice_stop(self, reference: Array, seen: Seen, find: Find) -> None:
        """Probe a robot that does not follow."""
        off, servo = self._find_off(seen), self.servo
        late = self.lasting or (seen.jumped and bool(off.any()))
        settled = self.timing.in_mode > RESTART + 4 * _longest_lag(servo, off)
        if not (late and settled and self.time < self.end):
            return
        known = seen.is_known
        if not off.any():  # it stands
            off = known & (servo.measure_asked(self.rest.bank) > FLOOR)
        # what a joint that is slow or held does lies between rest and what its reference did
        done = servo.readings.median - self.followed.reading
        asked = servo.expected - self.followed.expected
        strange = done - np.clip(done, np.minimum(asked, 0), np.maximum(asked, 0))
        moved = bool((off & (np.abs(strange) > 3 * MOTION)).any())
        several = moved and off.sum() > 1
        if moved:  # who was displaced is met in all joints
            off = off | known
        self._switch(Mode.PROBING, np.where(off, servo.position, reference))
        probe = self.probe
        probe.stuck, probe.opened = off, np.abs(servo.gaps.mean)
        probe.displaced, probe.placed, self.comparison = moved, False, None
        if several:
            self._find_place(known, find)

    def _end_probe(self, reference: Array, seen: Seen, find: Find, explained: bool) -> None:
        """End a probe that tells something."""
        servo, probe, known = self.servo, self.probe, seen.is_known
        posture, resting, displaced = servo.position, servo.readings.resting, probe.displaced
        came, arrived = self._judge_probe(reference, seen, explained)
        if came or (arrived and probe.placed):
            self._switch(Mode.RUNNING, probe.target)
        if not arrived or probe.placed:
            return
        self._switch(Mode.HELD, np.where(known, posture, reference))
        probe.held = resting
        if self.comparison is not None:
            self.comparison = replace(self.comparison, reading=resting)
        if displaced and self._find_place(known, find):
            self._switch(Mode.RUNNING, probe.target)

    def _judge_probe(self, reference: Array, seen: Seen, explained: bool) -> tuple[bool, bool]:
        """Tell whether the robot came back, and whether its reference came to it instead."""
        servo, probe, since = self.servo, self.probe, self.timing.in_mode
        off, stuck = self._find_off(seen), seen.is_known & probe.stuck
        near = bool((np.abs(reference - probe.target)[stuck] < FLOOR / 10).all())
        if off.any():
            return False, near and since > DWELL + 4 * _longest_lag(servo, off)
        moved = np.abs(servo.position - probe.target) > MOTION + 3 * servo.std
        came = explained or bool(moved[stuck].any())
        return came or since > PROBE_TIME, near and not came

    def _release(self, seen: Seen) -> None:
        """Let a robot go on that was held, and moves again: what it missed is done then."""
        readings, probe, rest = self.servo.readings, self.probe, self.rest
        now = np.array((readings.near, readings.median))
        way = np.abs(now - probe.held).min(0)
        stuck = seen.is_known & probe.stuck
        moved = bool((way > self._motion_of_held)[stuck].any())
        # as far as it is led it may stick: from where nothing more is wanted, time goes on
        there = np.abs(probe.wanted - probe.target) < self._compute_lead()
        if not (moved or there[stuck].all()):
            return
        back = self.clock.kind == "localizing" and not probe.displaced
        back = back and self.time - rest.time > MISSED
        back = back and (rest.resumed is None or abs(rest.time - rest.resumed) > NEARBY)
        self._switch(Mode.RUNNING, probe.target)
        if back:
            self.time, self.relocalized = rest.time, True
            self.rest = replace(self.rest, resumed=rest.time)

    def _find_place(self, known: Flags, find: Find) -> bool:
        """Find another place of the skill where a robot is, to go on there."""
        if self.clock.kind != "localizing":
            return False
        place = find(np.where(known, self.servo.position, self.probe.target))
        if place is None or abs(place - self.time) <= NEARBY:
            return False
        self.go_on_from(place)
        self.probe.placed = self.relocalized = True
        return True

    def _switch(self, mode: Mode, target: Array) -> None:
        """Begin another mode."""
        if mode is Mode.RUNNING:
            self.servo.forget_motion(np.ones(target.shape, bool))
            if self.probe.displaced:
                self.servo.restart_here()
            self._rest_here(self.rest.time)
            self.probe.displaced = False
        self.mode, self.probe.target = mode, target
        self.timing.restart()


def _longest_lag(servo: Servo, joints: Flags) -> float:
    """Find the longest lag of some joints (n_joints,) [s]; 0 if there are none."""
    return float(servo.lag[joints].max(initial=0.0))
