"""Stage *locate*: how far each robot is in its skill, and whether it follows.

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

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tpgmm_control.loop.clock import Clock
from tpgmm_control.sensing.servo import FLOOR, STANDSTILL, Flags, Servo
from tpgmm_control.sensing.states import replace_fields
from tpgmm_torch.data.arrays import Array

#: A time of the skill for a robot (row) at a posture, if one explains it.
Find = Callable[[int, Array], float | None]

RUNNING, PROBING, HELD = range(3)
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
    """Measurements of B robots at a tick.

    Parameters
    ----------
    dt : array of shape (B,)
        Duration of the tick [s].
    joints : array of shape (B, n_joints)
        Accepted readings, NaN elsewhere [rad or m].
    jumped : bool array of shape (B,)
        Robots whose readings have jumped to somewhere else, and stay there.
    halted : bool array of shape (B,)
        Robots for which time stands: nothing can be trusted, or time did not increase.
    obstructed : array of shape (B,), optional
        How much obstacles hold robots up: time goes on the slower, and from 1 on stands.
    floor : array of shape (B, n_joints), optional
        Half the gap that means nothing where the skill is [rad or m].
    """

    dt: Array
    joints: Array
    jumped: Flags
    halted: Flags
    obstructed: Array | None = None
    floor: Array | None = None


@dataclass(frozen=True, eq=False)
class Progress:
    """Progress of B robots; immutable, made by :meth:`start`.

    Parameters
    ----------
    clock : Clock
    end : float
        Of the skill [s].
    servo : Servo
    time, rate : array of shape (B,)
        In the skill [s]; seconds of it per second, over the clock's speed.
    owed, usual_dt : array of shape (B,)
        Time that is still to be caught up, mean duration of the ticks [s].
    mode : int array of shape (B,)
    since, off_for : array of shape (B,)
        For how long a robot is in its mode, and has gaps that are not usual [s].
    target : array of shape (B, n_joints)
        Where the references of robots go that do not run.
    stuck : bool array of shape (B, n_joints)
        Joints that did not follow when a robot was no longer running.
    opened : array of shape (B, n_joints)
        Size of the gaps then.
    model, reading : array of shape (B, n_joints)
        Expected positions and readings from when on motion is compared.
    compared : bool array of shape (B,)
        Whether these are known: what opened the gap has to be over.
    explained : bool array of shape (B,)
        Robots of which a gap was found to be an offset at this tick.
    followed : array of shape (2, B, n_joints)
        Readings and expected positions when a robot last followed.
    rest : array of shape (B, n_joints)
        Its reading when it came to rest.
    rest_bank : array of shape (K, B, n_joints)
        Its servos then.
    rest_time, resumed : array of shape (B,)
        Time in the skill then, and to which a robot went back last [s].
    displaced, placed, relocalized : bool array of shape (B,)
        Robots that somebody else has moved; whose place was found; whose time was set at this
        tick.
    wanted : array of shape (B, n_joints)
        What the skill wanted last of robots that do not run.
    stop : array of shape (B,)
        Time beyond which robots do not go [s].
    """

    clock: Clock
    end: float
    servo: Servo
    time: Array
    rate: Array
    owed: Array
    usual_dt: Array
    mode: NDArray[np.int_]
    since: Array
    off_for: Array
    target: Array
    stuck: Flags
    opened: Array
    model: Array
    reading: Array
    compared: Flags
    explained: Flags
    followed: Array
    rest: Array
    rest_bank: Array
    rest_time: Array
    resumed: Array
    displaced: Flags
    placed: Flags
    relocalized: Flags
    wanted: Array
    stop: Array

    @classmethod
    def start(cls, clock: Clock, time: Array, end: float, posture: Array) -> Self:
        """At times (B,) of the skill, at rest in a posture (B, n_joints)."""
        zero = np.zeros_like(time)
        none, both, servo = zero > 0, np.stack((posture, posture)), Servo.at_rest(posture)
        return cls(
            clock, end, servo, time, zero + 1, zero, zero,
            zero.astype(int), zero, zero, posture, posture < -np.inf, 0 * posture,
            posture, posture, none, none, both, posture, servo.second, time,
            zero - np.inf, none, none, none, posture, zero + np.inf,
        )  # fmt: skip

    @property
    def waits(self) -> Flags:
        """Robots that are waited for."""
        late = self.off_for >= self._patience
        return (late | (self.mode != RUNNING)) & (self.time < self.end)

    @property
    def lasting(self) -> Flags:
        """Robots that have been off for more than a moment."""
        return self.off_for > self._patience

    @property
    def _patience(self) -> Array:
        """Return for how long a gap that is not usual means nothing (B,) [s]."""
        return np.maximum(DWELL, 2 * self.usual_dt)

    def advance(self, reference: Array, seen: Seen, find: Find) -> Self:
        """Progress after a tick.

        Parameters
        ----------
        reference : array of shape (B, n_joints)
            What was sent a tick ago.
        seen : Seen
        find : callable
            ``find(row, posture)``: the time of the skill that explains a robot's posture, or
            None.
        """
        dt = seen.dt[:, None]
        running = (self.mode == RUNNING) & ~seen.halted
        servo = self.servo
        if seen.floor is not None:
            servo = replace_fields(servo, floor=seen.floor)
        servo = servo.update(reference, seen.joints, dt, seen.jumped[:, None], running[:, None])
        new = replace_fields(self, servo=servo, relocalized=np.zeros_like(self.placed))
        new = new._timed(seen)
        if self.clock.kind == "even" or not (
            (self.mode != RUNNING).any() or self.compared.any() or (new.off_for > 0).any()
        ):
            return new
        new = new._compared(seen)._noticed(reference, seen, find)
        return new._probed(reference, seen, find)._released(seen)

    def even(self, dt: float | Array, obstructed: Array | None = None) -> Self:
        """Progress where nothing is measured."""
        if obstructed is not None and self.clock.kind != "even":
            dt = dt * np.clip(2 - 2 * obstructed, 0.0, 1.0)
        return replace_fields(self, time=self._until_end(self.clock.speed * dt))

    def arrived(self, reference: Array, velocity: Array, readings: Array) -> Flags:
        """Robots whose joints are where the reference is, at rest: (B,).

        Parameters
        ----------
        reference, velocity : array of shape (B, n_joints)
            What was sent a tick ago [rad or m, rad/s or m/s].
        readings : array of shape (B, n_joints)
            NaN where nothing is measured: there the reference counts.
        """
        servo, known = self.servo, np.isfinite(readings)
        rests = np.abs(servo.reading - servo.near_reading) <= FLOOR / 10 + 2 * np.sqrt(
            servo.noise
        )
        there = np.abs(servo.corrected - reference) <= servo.floor
        there = (there & rests) | ~known
        return (there & (np.abs(velocity) <= FLOOR)).all(-1) & (self.mode == RUNNING)

    def gated(self, stop: Array, time: Array) -> Self:
        """Progress up to other times, of robots that may go on from another time.

        Parameters
        ----------
        stop : array of shape (B,)
            Time beyond which robots do not go [s].
        time : array of shape (B,)
            From where they go on; NaN from where they are.
        """
        now, rest = (np.where(np.isfinite(time), time, x) for x in (self.time, self.rest_time))
        return replace_fields(self, stop=stop, time=now, rest_time=rest)

    def led(self, wanted: Array, careful: Flags) -> tuple[Self, Array]:
        """Where references go: of robots that run, the wanted postures (B, n_joints).

        Parameters
        ----------
        wanted : array of shape (B, n_joints)
        careful : bool array of shape (B,)
            Robots that hold an object.
        """
        lead = np.where(careful, CAREFUL, 1.0)[:, None] * self._lead
        lead = np.maximum(lead, TELLING * self._motion_of_held)
        lead = np.where((self.mode == HELD)[:, None] & self.stuck, lead, 0.0)
        led = self.target + np.clip(np.nan_to_num(wanted - self.target), -lead, lead)
        goal = np.where((self.mode == RUNNING)[:, None], wanted, led)
        return replace_fields(self, wanted=wanted), goal

    @property
    def _lead(self) -> Array:
        """Of the references of robots that are held (B, 1)."""
        lead = self.servo.floor * (0.75 + self.since / PROBE_TIME)[:, None]
        return np.minimum(lead, MOST_LEAD)

    @property
    def _motion_of_held(self) -> Array:
        """From which on joints (B, n_joints) that were held have moved, beside their noise."""
        averaged = np.minimum(1.0, self.usual_dt / (2 * STANDSTILL))[:, None]
        return self.servo.floor / 2 + 3 * np.sqrt(2 * self.servo.noise * averaged)

    # Running

    def _timed(self, seen: Seen) -> Self:
        """Time goes on for robots that follow."""
        known = np.isfinite(seen.joints)
        excess = np.where(known, self.servo.excess, 0.0).max(-1)
        stands = seen.halted | (self.mode != RUNNING)
        waits = self.clock.kind != "even"
        lead = np.where(known, self.servo.lead, 0.0).max(-1)
        if seen.obstructed is not None:
            lead = np.maximum(lead, seen.obstructed)
        rate = np.minimum(np.maximum(2 - waits * 2 * np.maximum(excess, lead), 0.0), 1.0)
        if waits:
            rate = np.minimum(rate, self.rate + seen.dt / RESTART)
        rate = np.where(stands, seen.halted * self.rate, rate)
        usual = np.where(self.usual_dt > 0, self.usual_dt, seen.dt)
        usual = np.where(
            seen.halted, self.usual_dt, usual + 0.1 * (np.minimum(seen.dt, 2 * usual) - usual)
        )
        owed = np.where(stands, 0.0, self.owed + seen.dt)
        step = np.minimum(owed, CATCH_UP * np.where(usual > 0, usual, seen.dt))
        owed = np.where(rate < 1, 0.0, owed - step)
        step = np.where(stands, 0.0, self.clock.speed * rate * step)
        time = self._arrived(self._until_end(step), known)
        servo = self.servo
        moved = np.where(known, np.abs(servo.reading - self.rest), 0.0)
        left = (moved > MOTION / 2 + 3 * np.sqrt(servo.noise)).any(-1) & (self.mode == RUNNING)
        asked = servo.asked(self.rest_bank) - 6 * np.sqrt(servo.noise) - 2 * servo.floor
        stalled = waits & ~stands & ~left & (np.where(known, asked, -1.0) > 0).any(-1)
        off = ~stands & (excess > OFF) | stalled
        now = np.array((servo.reading, servo.expected))
        new = replace_fields(
            self,
            time=time,
            rate=rate,
            owed=owed,
            usual_dt=usual,
            since=self.since + seen.dt,
            off_for=np.where(off, self.off_for + seen.dt, 0.0),
            followed=np.where((excess < 0.5)[:, None] & ~stands[:, None], now, self.followed),
            rest=np.where(left[:, None], servo.reading, self.rest),
            rest_bank=np.where(left[:, None], servo.second, self.rest_bank),
            rest_time=np.where(left, time, self.rest_time),
        )
        slow = known & (np.maximum(servo.excess, servo.lead) > 0.5)
        return new._count_slow(self.off_for, slow, seen.dt, off | stands)

    def _count_slow(self, before: Array, slow: Flags, dt: Array, others: Flags) -> Self:
        """Count gaps for which time slows: once they outlast any lag, robots are waited for."""
        lag = np.where(slow, self.servo.lag, 0.0).max(-1)
        share = np.minimum(dt / (RESTART + DWELL + 4 * lag), 1.0)
        counted = np.minimum(before + share * self._patience, self._patience)
        rows = slow.any(-1) & ~others
        return replace_fields(self, off_for=np.where(rows, counted, self.off_for))

    def _until_end(self, step: float | Array) -> Array:
        """Time after a step; rounding does not cost a last one."""
        time = self.time + step
        time = np.where(time > self.end - 1e-6 * np.asarray(step), self.end, time)
        return np.minimum(time, self.stop)

    def _arrived(self, time: Array, known: Flags) -> Array:
        """Times, at most the next arrival of robots that have not arrived."""
        if not self.clock.arrivals:
            return time
        gap = np.where(known, self.servo.corrected - self.servo.first[0], 0.0)
        stops = np.array([*self.clock.arrivals, np.inf])
        return np.where(
            (np.abs(gap) > self.servo.floor).any(-1),
            np.minimum(time, stops[stops.searchsorted(self.time)]),
            time,
        )

    def _off(self, seen: Seen) -> Flags:
        """Joints that do not follow; of robots that are probed, whose gaps have not closed."""
        off = self.servo.excess > OFF
        probed = (self.mode == PROBING)[:, None] & self.stuck
        off |= probed & (
            np.abs(self.servo.gap) > np.maximum(0.5 * self.opened, self.servo.floor / 2)
        )
        return np.isfinite(seen.joints) & off

    # From mode to mode

    def _compared(self, seen: Seen) -> Self:
        """Robots whose joints run along with their references: their gaps are offsets."""
        servo, off = self.servo, self._off(seen)
        asked = ((self.mode == PROBING) | (self.off_for > 0)) & ~seen.halted
        lag = np.where(off, servo.lag, 0.0).max(-1)
        long = np.where(self.mode == PROBING, self.since, self.off_for)
        begins = asked & ~self.compared & (long > 1.5 * lag)
        model = np.where(begins[:, None], servo.expected, self.model)
        reading = np.where(begins[:, None], servo.reading, self.reading)
        ran, moved = servo.reading - reading, servo.expected - model
        tells = np.abs(moved) > MOTION + 3 * np.sqrt(servo.noise)
        along = off & tells & (np.abs(ran - moved) < 0.5 * np.abs(moved))
        along &= (asked & self.compared)[:, None]
        held = self.mode == HELD
        return replace_fields(
            self,
            servo=servo.with_offsets(along) if along.any() else servo,
            model=model,
            reading=reading,
            compared=(self.compared | begins) & (asked | held),
            explained=along.any(-1),
            displaced=self.displaced & ~along.any(-1),
        )

    def _noticed(self, reference: Array, seen: Seen, find: Find) -> Self:
        """Robots that do not follow, and are probed."""
        off = self._off(seen)
        late = self.lasting | (seen.jumped & (off.sum(-1) > 0))
        settled = self.since > RESTART + 4 * np.where(off, self.servo.lag, 0.0).max(-1)
        rows = late & settled & (self.mode == RUNNING) & (self.time < self.end) & ~seen.halted
        if not rows.any():
            return self
        servo, known = self.servo, np.isfinite(seen.joints)
        asked = known & (servo.asked(self.rest_bank) > FLOOR)  # it stands
        off = np.where(off.any(-1, keepdims=True), off, asked)
        # what a joint that is slow or held does lies between rest and what its reference did
        done, asked = servo.reading - self.followed[0], servo.expected - self.followed[1]
        strange = done - np.clip(done, np.minimum(asked, 0), np.maximum(asked, 0))
        moved = (off & (np.abs(strange) > 3 * MOTION)).any(-1)
        several = moved & (off.sum(-1) > 1)
        off |= moved[:, None] & known  # who was displaced is met in all joints
        target = np.where(off, servo.corrected, reference)
        new = self._switched(rows, PROBING, target)
        new = replace_fields(
            new,
            stuck=np.where(rows[:, None], off, self.stuck),
            opened=np.where(rows[:, None], np.abs(servo.gap), self.opened),
            displaced=np.where(rows, moved, self.displaced),
            placed=self.placed & ~rows,
            compared=self.compared & ~rows,
        )
        return new._placed(rows & several, known, find)

    def _probed(self, reference: Array, seen: Seen, find: Find) -> Self:
        """Robots whose probe tells something."""
        servo, probing = self.servo, (self.mode == PROBING) & ~seen.halted
        if not probing.any():
            return self
        off, known = self._off(seen), np.isfinite(seen.joints)
        lag = np.where(off, servo.lag, 0.0).max(-1)
        stuck = known & self.stuck
        near = np.where(stuck, np.abs(reference - self.target), 0.0).max(-1) < FLOOR / 10
        way = np.where(stuck, np.abs(servo.corrected - self.target), 0.0)
        moved = (way > MOTION + 3 * np.sqrt(servo.noise)).any(-1)
        closed = probing & ~off.any(-1)
        came = closed & (moved | self.explained)
        arrived = probing & ~came & near & (closed | (self.since > DWELL + 4 * lag))
        came |= closed & (self.since > PROBE_TIME)
        new = self._switched(came | (arrived & self.placed), RUNNING, self.target)
        held = arrived & ~self.placed
        if not held.any():
            return new
        target = np.where(known, servo.corrected, reference)
        new = replace_fields(
            new._switched(held, HELD, target),
            reading=np.where(held[:, None], servo.resting, new.reading),
        )
        new = new._placed(held & self.displaced, known, find)
        return new._switched(held & new.placed, RUNNING, target)

    def _released(self, seen: Seen) -> Self:
        """Robots that were held, and move again: what they missed is done then."""
        stuck = np.isfinite(seen.joints) & self.stuck
        now = np.array((self.servo.near_reading, self.servo.reading))
        way = np.where(stuck, np.abs(now - self.reading).min(0), 0.0)
        moved = (way > self._motion_of_held).any(-1)
        # as far as it is led it may stick: from where nothing more is wanted, time goes on
        there = (~stuck | (np.abs(self.wanted - self.target) < self._lead)).all(-1)
        rows = (self.mode == HELD) & (moved | there) & ~seen.halted
        if not rows.any():
            return self
        back = rows & (self.time - self.rest_time > MISSED)
        back &= (np.abs(self.rest_time - self.resumed) > NEARBY) & ~self.displaced
        back &= self.clock.kind == "localizing"
        new = self._switched(rows, RUNNING, self.target)
        return replace_fields(
            new,
            time=np.where(back, self.rest_time, self.time),
            resumed=np.where(back, self.rest_time, self.resumed),
            relocalized=new.relocalized | back,
        )

    def _placed(self, rows: Flags, known: Flags, find: Find) -> Self:
        """Robots that are at another place of the skill, and go on there."""
        if self.clock.kind != "localizing":
            return self
        posture = np.where(known, self.servo.corrected, self.target)
        found = {int(row): find(int(row), posture[row]) for row in np.flatnonzero(rows)}
        time, placed, moved = self.time.copy(), self.placed.copy(), self.relocalized.copy()
        for row, place in found.items():
            if place is not None and abs(place - time[row]) > NEARBY:
                time[row], placed[row], moved[row] = place, True, True
        return replace_fields(
            self,
            time=time,
            placed=placed,
            relocalized=moved,
            rest_time=np.where(moved, time, self.rest_time),
        )

    def _switched(self, rows: Flags, mode: int, target: Array) -> Self:
        """Some robots in another mode."""
        if not rows.any():
            return self
        zero: Any = {
            name: np.where(rows, 0.0, getattr(self, name))
            for name in ("since", "off_for", "rate", "owed")
        }
        servo, rest, bank = self.servo, self.rest, self.rest_bank
        if mode == RUNNING:
            servo = servo.moving_on(np.broadcast_to(rows[:, None], self.target.shape))
            if (self.displaced & rows).any():
                servo = servo.put((self.displaced & rows)[:, None])
            rest = np.where(rows[:, None], servo.reading, rest)
            bank = np.where(rows[:, None], servo.second, bank)
        return replace_fields(
            self,
            servo=servo,
            rest=rest,
            rest_bank=bank,
            mode=np.where(rows, mode, self.mode),
            target=np.where(rows[:, None], target, self.target),
            displaced=self.displaced & ~(rows & (mode == RUNNING)),
            **zero,
        )
