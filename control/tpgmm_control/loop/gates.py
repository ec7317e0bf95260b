"""Stage *gate*: robots that wait at a time of their skill, go on, go back, or give up."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import repeat
from typing import Any, Self

import torch
from torch import Tensor

from tpgmm_control.loop.hold import LOST, LOST_TIME, LOST_TURN
from tpgmm_control.sensing.servo import Flags
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.robots.kinematics import RobotState
from tpgmm_torch.skills.gate import CONTACT, Condition, Gate
from tpgmm_torch.skills.holding import MOVED, Holding, choose

__all__ = ["Moment"]

#: Share of its way with a hand by which an object that is held may be off, as of holds that
#: are found in how objects move.
SHARE = 0.4


@dataclass(frozen=True, eq=False)
class Moment:
    """State that conditions are judged by, at one tick.

    Parameters
    ----------
    time : Tensor of shape () or (...)
        In the skill [s].
    state : RobotState
        Of the joints as they are measured, or as they should be where nothing is.
    frames : mapping of str to Frame
        Where objects are seen, or were seen last.
    unseen : mapping of str to Tensor of bool of shape (...)
        Which robots do not see an object of ``frames`` now; those that were given at the
        start alone are seen by none.
    holding : Holding
        What the robots hold.
    contacts : mapping of str to Tensor of bool of shape (...)
        Links whose contact is measured.
    arrived : Tensor of bool of shape (...)
        Robots whose joints are where the reference is, at rest.
    """

    time: Tensor
    state: RobotState
    frames: Mapping[str, Frame]
    unseen: Mapping[str, Tensor]
    holding: Holding
    contacts: Mapping[str, Tensor]
    arrived: Tensor

    @property
    def no_robot(self) -> Tensor:
        """False (...)."""
        return self.arrived & False


@dataclass(frozen=True, eq=False)
class Grip:
    """A link and an object from when the link took it, of each robot.

    Parameters
    ----------
    link, thing : Frame
        Their poses then.
    holds : Tensor of bool of shape (...)
        Whether it is to hold it now.
    carries : Tensor of bool of shape (...)
        Whether the object was last seen where the link carries it.
    """

    link: Frame
    thing: Frame
    holds: Tensor
    carries: Tensor

    def update(self, hold: Hold, moment: Moment) -> Self:
        """Let a tick pass."""
        link, thing = moment.state.pose(hold.link), moment.frames[hold.frame]
        holds = moment.no_robot
        if (held := moment.holding.held.get(hold.frame)) is not None:
            index = moment.holding.kinematics.links.index(hold.link)
            holds = holds | (held.carrier.to(holds.device) == index)
        new = holds & ~self.holds
        grip = replace(
            self, link=choose(new, link, self.link), thing=choose(new, thing, self.thing)
        )
        there = grip.find_carried(hold, moment)
        off, way = (one.change(there, LOST, LOST_TURN) for one in (thing, grip.thing))
        along = (way >= MOVED / LOST) & (off < (SHARE * way).clamp(max=1.0))
        known = torch.where(moment.unseen[hold.frame], self.carries & ~new, along)
        return replace(grip, holds=holds, carries=holds & known)

    def keep(self, robots: Tensor) -> Self:
        """Keep it for some robots (...) alone."""
        return replace(self, holds=self.holds & robots, carries=self.carries & robots)

    def find_carried(self, hold: Hold, moment: Moment) -> Frame:
        """Find where the object would be if the link had it from then on."""
        return moment.state.pose(hold.link).compose(self.thing.seen_from(self.link))


@dataclass(frozen=True)
class Passage:
    """Where one robot is among the gates of a skill; immutable.

    Parameters
    ----------
    tries : tuple of int
        How often each gate took too long.
    index : int
        Number of gates that are behind the robot.
    waited, met_for : float
        For how long it has stood at a gate, and its conditions were met [s].
    failed : bool
        Whether it has given up.
    goto : float, optional
        Where its time is set to at this tick [s].
    fade : float
        How long it takes to the beginning of a separate skill; 0 if none begins [s].
    reason : str
        What it waits for, or why it gave up.
    """

    tries: tuple[int, ...]
    index: int = 0
    waited: float = 0.0
    met_for: float = 0.0
    failed: bool = False
    goto: float | None = None
    fade: float = 0.0
    reason: str = ""

    @property
    def goes_back(self) -> bool:
        """True if the robot goes back at this tick."""
        return self.goto is not None and self.fade == 0

    def open(self, gate: Gate, time: float) -> Self:
        """Pass the next gate, and go on from a time [s]."""
        goto = time if gate.fade > 0 else self.goto
        return replace(self, index=self.index + 1, fade=self.fade + gate.fade, goto=goto)

    def decide(self, gates: tuple[Gate, ...], unmet: str, dt: float) -> Self:
        """Wait at a gate, go on, go back, or give up.

        Parameters
        ----------
        gates : tuple of Gate
            Of the skill.
        unmet : str
            Why the robot may not go on; empty if it may.
        dt : float
            Duration of the tick [s].
        """
        gate = gates[self.index]
        if unmet:
            new = replace(self, met_for=0.0, reason=unmet)
            return new if self.waited < gate.timeout else new._try_again(gates)
        met_for = self.met_for + dt
        if met_for >= LOST_TIME:
            return replace(self, waited=0.0, met_for=0.0, reason="").open(gate, gate.onward)
        text = f"met for {met_for:.1f} s of {LOST_TIME:g} s"
        return replace(self, met_for=met_for, reason=text)

    def _try_again(self, gates: tuple[Gate, ...]) -> Self:
        """Go back, or give up, at a gate that took too long."""
        gate, tries = gates[self.index], list(self.tries)
        tries[self.index] += 1
        count = tries[self.index]
        new = replace(self, tries=tuple(tries))
        if count > gate.retries:
            after = f" not met after {count} tries" if count > 1 else " not met"
            return replace(new, failed=True, reason=self.reason.replace(" not met", after, 1))
        index = bisect_right([each.time for each in gates], gate.back)
        return replace(new, index=index, waited=0.0, goto=gate.back, reason="")


@dataclass(frozen=True, eq=False)
class Gates:
    """Where robots are among the gates of a skill; immutable.

    Parameters
    ----------
    gates : tuple of Gate
    closed : tuple of float or None
        Time beyond which robots do not go, by the number of gates behind them [s]; None where
        no gate is closed.
    robots : tuple of Passage
    grips : mapping of Hold to Grip
        Of the objects that conditions ask for.
    """

    gates: tuple[Gate, ...]
    closed: tuple[float | None, ...]
    robots: tuple[Passage, ...]
    grips: Mapping[Hold, Grip] = field(default_factory=dict)

    @classmethod
    def start(
        cls, gates: tuple[Gate, ...], times: Sequence[float], end: float, enforced: bool
    ) -> Self:
        """Begin at times of a skill; without enforcement all conditions count as met."""
        first = min(times)
        later = (gate for gate in gates if first < gate.time <= end)
        known = tuple(replace(gate, back=max(gate.back, first)) for gate in later)
        last = math.nextafter(end, -math.inf)  # at the end itself a robot is done
        closed: list[float | None] = [None]
        for gate in reversed(known):
            stop = closed[0]
            if enforced and gate.until:
                stop = min(gate.time, last)
            closed.insert(0, stop)
        return cls(known, tuple(closed), tuple(Passage((0,) * len(known)) for _ in times))

    @property
    def over(self) -> bool:
        """True if all gates are behind all robots."""
        return all(robot.index == len(self.gates) for robot in self.robots)

    @property
    def stops(self) -> list[float | None]:
        """Times beyond which robots do not go [s]."""
        return [self.closed[robot.index] for robot in self.robots]

    def find_span(self, row: int) -> tuple[float, float]:
        """Find between which times of the skill a robot may go on [s]."""
        index = self.robots[row].index
        stop = self.closed[index]
        begin = self.gates[index - 1].time + self.gates[index - 1].fade if index else -math.inf
        return begin, math.inf if stop is None else stop

    def advance(self, times: Array, passed: Array, ready: Flags, moment: Moment | None) -> Self:
        """Let a tick pass.

        Parameters
        ----------
        times : array of shape (B,)
            In the skill [s].
        passed : array of shape (B,)
            Duration of the tick [s].
        ready : bool array of shape (B,)
            Robots that follow their references, of which inputs are accepted.
        moment : Moment, optional
            What is known; without it, as when somebody looks ahead, gates stay as they are.
        """
        columns = zip(self.robots, times.tolist(), passed.tolist(), ready.tolist(), strict=True)
        moved, waiting = list[Passage](), dict[int, float]()
        for row, (before, time, dt, follows) in enumerate(columns):
            robot = self._pass_open(replace(before, goto=None, fade=0.0), time)
            stop = self.closed[robot.index]
            if stop is None or time < stop:
                robot = replace(robot, waited=0.0)
            elif follows and not robot.failed:
                robot, waiting[row] = replace(robot, waited=robot.waited + dt), dt
            moved.append(robot)
        new = replace(self, robots=tuple(moved))
        if moment is None:
            return new._look_ahead(waiting)
        return new._judge(times, waiting, moment)

    def _pass_open(self, robot: Passage, time: float) -> Passage:
        """Let a robot pass gates without conditions."""
        for gate in self.gates[robot.index :]:
            stop = self.closed[robot.index]
            if time <= gate.time or (stop is not None and stop <= gate.time):
                break
            robot = robot.open(gate, max(time, gate.onward))
        return robot

    def _look_ahead(self, waiting: Mapping[int, float]) -> Self:
        """Count for how long conditions are met that nobody judges."""
        robots = list(self.robots)
        for row, dt in waiting.items():
            if robots[row].met_for > 0:
                robots[row] = replace(robots[row], met_for=robots[row].met_for + dt)
        return replace(self, robots=tuple(robots))

    def _judge(self, times: Array, waiting: Mapping[int, float], moment: Moment) -> Self:
        """Decide whether robots that wait at their gates go on, go back, or give up."""
        new, robots = replace(self, grips=self._update_grips(moment)), list[Passage]()
        why = new._explain_unmet(list(waiting), moment)
        for row, (robot, time) in enumerate(zip(self.robots, times.tolist(), strict=True)):
            stop = self.closed[robot.index]
            stands = stop is not None and time >= stop
            if row in waiting:
                robot = robot.decide(self.gates, why[row], waiting[row])
            elif not stands:
                reason = robot.reason if robot.failed else ""
                robot = replace(robot, met_for=0.0, reason=reason)
            robots.append(robot)
        stays = [not robot.goes_back for robot in robots]
        grips = new.grips
        if not all(stays):
            kept = torch.tensor(stays).view(moment.arrived.shape)
            grips = {hold: grip.keep(kept) for hold, grip in grips.items()}
        return replace(new, robots=tuple(robots), grips=grips)

    def _update_grips(self, moment: Moment) -> Mapping[Hold, Grip]:
        """Follow the links and objects that conditions ask for."""
        grips, no_robot = dict(self.grips), moment.no_robot
        for hold in (hold for gate in self.gates for _, hold in gate.holds):
            if hold.frame in moment.frames:
                if hold not in grips:
                    link, thing = moment.state.pose(hold.link), moment.frames[hold.frame]
                    grips[hold] = Grip(link, thing, no_robot, no_robot)
                grips[hold] = grips[hold].update(hold, moment)
        return grips

    def _explain_unmet(self, rows: Iterable[int], moment: Moment) -> dict[int, str]:
        """Tell why robots at their gates may not go on; empty where they may."""
        why, unmet = dict[int, str](), dict[int, list[list[str]]]()
        for row in rows:
            number = self.robots[row].index
            if number not in unmet:
                unmet[number] = list(self._find_unmet(self.gates[number], moment))
            why[row] = next(filter(None, (texts[row] for texts in unmet[number])), "")
        return why

    def _find_unmet(self, gate: Gate, moment: Moment) -> Iterator[list[str]]:
        """Tell of each condition why robots do not meet it; empty where they do."""
        for one in gate.until:
            if one in ("held", "free"):
                holds = (hold for name, hold in gate.holds if name == one)
                found = [self._check_hold(hold, moment, one == "free") for hold in holds]
            else:
                found = [_check_condition(one, moment)]
            name = one if isinstance(one, str) else getattr(one, "__name__", "a function")
            for met, whys in found:
                rows = zip(_rows(met), whys, strict=False)
                yield ["" if ok else f"{name!r} not met: {why}" for ok, why in rows]

    def _check_hold(
        self, hold: Hold, moment: Moment, free: bool
    ) -> tuple[Tensor, Iterable[str]]:
        """Find robots (...) that hold an object, or let it go, and why others do not."""
        name, grip = hold.frame, self.grips.get(hold)
        if grip is None:
            return moment.no_robot, repeat(f"{name} is nowhere")
        there, seen, unseen = (
            grip.find_carried(hold, moment),
            moment.frames[name],
            moment.unseen,
        )
        lost = there.change(seen, LOST, LOST_TURN) >= 1
        apart = 1e3 * (there.position - seen.position).norm(dim=-1)
        away = (f"{one:.0f} mm from where {hold.link} would carry it" for one in _rows(apart))
        whys = (
            f"{name} is {'not seen' if hidden else far}"
            for far, hidden in zip(away, _rows(unseen[name]), strict=True)
        )
        return ~grip.holds & ~unseen[name] & lost if free else grip.carries, whys


def _check_condition(condition: Condition, moment: Moment) -> tuple[Tensor, Iterable[str]]:
    """Find robots (...) that meet a condition but those of objects, and why others do not."""
    if condition == "arrived":
        return moment.arrived, repeat("joints move, or are not at their reference")
    if isinstance(condition, str):
        link = condition.removeprefix(CONTACT)
        known = link in moment.contacts
        why = f"{link} touches nothing" if known else "no contact is measured there"
        return moment.contacts.get(link, moment.no_robot), repeat(why)
    try:
        found = torch.as_tensor(condition(moment))
        if found.dtype == torch.bool:
            return found.expand(moment.arrived.shape), repeat("it is false")
        why = f"it gives no bool but {found.dtype}"
    except Exception as error:  # of a user's function, which must not stop the loop
        why = f"it raised {error!r}"
    return moment.no_robot, repeat(why)


def _rows(values: Tensor) -> Any:
    """Values (...) of robots in one dimension."""
    return values.numpy(force=True).reshape(-1)
