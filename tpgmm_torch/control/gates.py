"""Stage *gate*: robots that wait at a time of their skill, go on, go back, or give up."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch.control.hold import LOST, LOST_TIME, LOST_TURN
from tpgmm_torch.control.holding import MOVED, Holding, choose
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.robots.kinematics import RobotState
from tpgmm_torch.sensing.servo import Flags
from tpgmm_torch.skills.gate import CONTACT, Condition, Gate

__all__ = ["Gates", "Grip", "Moment"]

#: Share of its way with a hand by which an object that is held may be off, as of holds that
#: are found in how objects move.
SHARE = 0.4


@dataclass(frozen=True, eq=False)
class Moment:
    """What conditions are asked of, at one tick.

    Parameters
    ----------
    time : Tensor of shape () or (...)
        In the skill [s].
    state : RobotState
        Of the joints as they are measured, or as they should be where nothing is.
    reference : Tensor of shape (..., n_joints)
        [rad or m].
    frames : mapping of str to Frame
        Where objects are seen, or were seen last.
    unseen : mapping of str to Tensor of bool of shape (...)
        Which robots do not see an object now; objects that were given at the start alone are
        seen by none.
    holding : Holding
        What the robots hold.
    contacts : mapping of str to Tensor of bool of shape (...)
        Links whose contact is measured.
    arrived : Tensor of bool of shape (...)
        Robots whose joints are where the reference is, at rest.
    """

    time: Tensor
    state: RobotState
    reference: Tensor
    frames: Mapping[str, Frame]
    unseen: Mapping[str, Tensor]
    holding: Holding
    contacts: Mapping[str, Tensor]
    arrived: Tensor


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
        """After a tick."""
        held = moment.holding.held.get(hold.frame)
        link, thing = moment.state.pose(hold.link), moment.frames[hold.frame]
        holds = self.holds & False
        if held is not None:
            index = moment.holding.kinematics.links.index(hold.link)
            holds = holds | (held.carrier.to(holds.device) == index)
        new = holds & ~self.holds
        begun = replace(
            self,
            link=choose(new, link, self.link),
            thing=choose(new, thing, self.thing),
            holds=holds,
            carries=self.carries & holds & ~new,
        )
        off, way = begun.off(hold, moment)
        along = holds & (way >= MOVED / LOST) & (off < (SHARE * way).clamp(max=1.0))
        return replace(
            begun, carries=torch.where(unseen(hold, moment), begun.carries, along)
        )

    def without(self, robots: Tensor) -> Self:
        """After some robots (B,) begin to do it again."""
        kept = ~robots.reshape(self.holds.shape).to(self.holds.device)
        return replace(self, holds=self.holds & kept, carries=self.carries & kept)

    def off(self, hold: Hold, moment: Moment) -> tuple[Tensor, Tensor]:
        """How far the object is from where the link has it, or had it, and that from here.

        In units of what counts as lost.
        """
        there, seen = self.carried(hold, moment), moment.frames[hold.frame]
        return (
            there.change(seen, LOST, LOST_TURN),
            self.thing.change(there, LOST, LOST_TURN),
        )

    def carried(self, hold: Hold, moment: Moment) -> Frame:
        """Where the object would be if the link had it from then on."""
        return moment.state.pose(hold.link).compose(self.thing.seen_from(self.link))


@dataclass(frozen=True, eq=False)
class Gates:
    """Where B robots are among the gates of a skill; immutable.

    Parameters
    ----------
    gates : tuple of Gate
    closed : array of shape (G + 1,)
        Time beyond which robots do not go, by the number of gates behind them [s].
    index : int array of shape (B,)
        That number.
    waited, met_for : array of shape (B,)
        For how long they have stood at a gate, and its conditions were met [s].
    met : bool array of shape (B,)
        Whether they were when they were last asked for.
    tries : int array of shape (B, G)
        How often that took too long.
    failed : bool array of shape (B,)
        Robots that have given up.
    resumed, returned : bool array of shape (B,)
        Robots that go on at this tick after they stood; of these, those that go back.
    goto, fade : array of shape (B,)
        Where their time is set to, NaN if it is not, and how long it takes to the beginning of
        a separate skill, 0 if none begins [s].
    texts : mapping of int to str
        What robots wait for, or why they gave up.
    grips : mapping of Hold to Grip
        Of the objects that conditions ask for.
    """

    gates: tuple[Gate, ...]
    closed: Array
    index: NDArray[np.int_]
    waited: Array
    met_for: Array
    met: Flags
    tries: NDArray[np.int_]
    failed: Flags
    resumed: Flags
    returned: Flags
    goto: Array
    fade: Array
    texts: Mapping[int, str] = MappingProxyType({})
    grips: Mapping[Hold, Grip] = field(default_factory=dict)

    @classmethod
    def start(cls, gates: tuple[Gate, ...], time: Array, end: float, enforced: bool) -> Self:
        """At times (B,) of a skill; without enforcement all conditions count as met."""
        known = tuple(gate for gate in gates if time.min() < gate.time <= end)
        last = float(np.nextafter(end, -np.inf))  # at the end itself a robot is done
        stops = [
            min(gate.time, last) if enforced and gate.until else np.inf for gate in known
        ]
        closed = np.minimum.accumulate([np.inf, *stops[::-1]])[::-1]
        none = np.zeros(len(time), bool)
        zero = none * 0.0
        return cls(
            known, closed, none.astype(int), zero, zero, none,
            np.zeros((len(time), len(known)), int), none, none, none, zero + np.nan, zero,
        )  # fmt: skip

    @property
    def stop(self) -> Array:
        """Times beyond which robots do not go (B,) [s]."""
        return self.closed[self.index]

    @property
    def since(self) -> Array:
        """Beginnings of the skills in which robots are (B,) [s]."""
        return np.array([-np.inf, *(gate.time + gate.fade for gate in self.gates)])[self.index]

    def advance(self, time: Array, dt: Array, ready: Flags, moment: Moment | None) -> Self:
        """After a tick.

        Parameters
        ----------
        time : array of shape (B,)
            In the skill [s].
        dt : array of shape (B,)
            Duration of the tick [s].
        ready : bool array of shape (B,)
            Robots that follow their references, of which inputs are accepted.
        moment : Moment, optional
            What is known; without it, as when somebody looks ahead, gates stay as they are.
        """
        none = np.zeros(len(time), bool)
        new = replace(
            self, resumed=none, returned=none, goto=none * np.nan, fade=none * 0.0
        )._crossed(time)
        if moment is not None:
            new = replace(new, grips=new._gripped(moment))
        stands = time >= new.stop
        at = stands & ready & ~self.failed
        if not stands.any():
            return replace(new, waited=none * 0.0, met_for=none * 0.0, texts={})
        met, texts = new._asked(at, moment) if moment is not None else (new.met, new.texts)
        texts = {row: text for row, text in {**self.texts, **texts}.items() if stands[row]}
        new = replace(
            new,
            waited=np.where(at, new.waited + dt, stands * new.waited),
            met_for=np.where(at, met * (new.met_for + dt), stands * new.met_for),
            met=met,
            texts=texts,
        )
        return new if moment is None else new._decided(at)

    def _crossed(self, time: Array) -> Self:
        """Robots beyond gates without conditions have passed them."""
        new = self
        for number, gate in enumerate(self.gates):
            open_ = self.closed[number] > gate.time
            rows = (new.index == number) & (time > gate.time)
            if open_ and rows.any():
                new = new._opened(rows, np.maximum(time, gate.onward))
        return new

    def _opened(self, rows: Flags, time: Array) -> Self:
        """Some robots have passed the next gate, and go on from a time."""
        fades = np.array([*(gate.fade for gate in self.gates), 0.0])[self.index]
        return replace(
            self,
            index=self.index + rows,
            fade=np.where(rows, fades, self.fade),
            goto=np.where(rows & (fades > 0), time, self.goto),
            waited=np.where(rows, 0.0, self.waited),
            met_for=np.where(rows, 0.0, self.met_for),
        )

    def _gripped(self, moment: Moment) -> Mapping[Hold, Grip]:
        """The links and objects that conditions ask for."""
        grips = dict(self.grips)
        for hold in {hold for gate in self.gates for hold in _asked_holds(gate)}:
            if hold.frame in moment.frames:
                link, thing = moment.state.pose(hold.link), moment.frames[hold.frame]
                none = moment.arrived & False
                before = grips.get(hold) or Grip(link, thing, none, none)
                grips[hold] = before.update(hold, moment)
        return grips

    def _asked(self, at: Flags, moment: Moment) -> tuple[Flags, Mapping[int, str]]:
        """Of robots at their gates, whether conditions are met, and which one is not."""
        met, texts = at.copy(), dict[int, str]()
        for number in np.unique(self.index[at]):
            rows = at & (self.index == number)
            for condition in self.gates[number].until:
                flags, why = _verdict(condition, self.gates[number], moment, self.grips)
                met &= np.where(rows, flags, True)
                for row in np.flatnonzero(rows & ~flags):
                    name = getattr(condition, "__name__", condition)
                    texts.setdefault(int(row), f"{name!r} not met|{why(int(row))}")
        return met, texts

    def _decided(self, at: Flags) -> Self:
        """Robots go on, go back, or give up."""
        number = np.minimum(self.index, len(self.gates) - 1)
        limit = np.array([(gate.timeout, gate.retries, gate.back) for gate in self.gates])
        timeout, retries, back = limit[number].T
        opens = at & self.met & (self.met_for >= LOST_TIME)
        late = at & ~self.met & (self.waited >= timeout)
        tries = self.tries.copy()
        tries[np.flatnonzero(late), number[late]] += 1
        fails = late & (tries[np.arange(len(at)), number] > retries)
        goes = late & ~fails
        onward = np.array([gate.onward for gate in self.gates])[number]
        new = self._opened(opens, onward)
        texts = dict(new.texts)
        for row in np.flatnonzero(fails).tolist():
            count = tries[row, number[row]]
            tried = f" after {count} tries" if count > 1 else ""
            texts[row] = texts[row].replace(" not met|", f" not met{tried}|", 1)
        times = [gate.time for gate in self.gates]
        where = torch.from_numpy(goes)
        return replace(
            new,
            index=np.where(goes, np.searchsorted(times, back, side="right"), new.index),
            goto=np.where(goes, back, new.goto),
            waited=np.where(goes, 0.0, new.waited),
            met_for=np.where(goes, 0.0, new.met_for),
            tries=tries,
            failed=self.failed | fails,
            resumed=opens | goes,
            returned=goes,
            texts={row: text for row, text in texts.items() if not (opens | goes)[row]},
            grips={h: grip.without(where) for h, grip in new.grips.items()},
        )

    @property
    def reasons(self) -> Mapping[int, str]:
        """What robots wait for, or why they gave up, in words."""
        return {row: text.replace("|", ": ", 1) for row, text in self.texts.items()}


def _asked_holds(gate: Gate) -> tuple[Hold, ...]:
    """Holds whose objects have to be watched for a gate."""
    return gate.held * ("held" in gate.until) + gate.freed * ("free" in gate.until)


def unseen(hold: Hold, moment: Moment) -> Tensor:
    """Robots (...) that do not see the object of a hold now."""
    return moment.unseen.get(hold.frame, moment.arrived & False)


def _verdict(
    condition: Condition, gate: Gate, moment: Moment, grips: Mapping[Hold, Grip]
) -> tuple[Flags, Callable[[int], str]]:
    """For which robots (B,) a condition is met, and why not for one of them."""
    if condition == "arrived":
        return _rows(moment.arrived), lambda row: "joints move, or are not at their reference"
    if condition in ("held", "free"):
        holds = gate.held if condition == "held" else gate.freed
        each = [(hold, *_of_hold(condition, hold, moment, grips.get(hold))) for hold in holds]
        met = np.logical_and.reduce([flags for _, flags, _ in each])
        return met, lambda row: next(why(row) for _, flags, why in each if not flags[row])
    if isinstance(condition, str):
        link = condition.removeprefix(CONTACT)
        if link not in moment.contacts:
            return _rows(moment.arrived & False), lambda row: "no contact is measured there"
        touching = moment.contacts[link].expand(moment.arrived.shape)
        return _rows(touching), lambda row: f"{link} touches nothing"
    try:
        found = torch.as_tensor(condition(moment), dtype=torch.bool)
        return _rows(found.expand(moment.arrived.shape)), lambda row: "it is false"
    except Exception as error:  # of a user's function, which must not stop robots' loop
        text = repr(error)
        return _rows(moment.arrived & False), lambda row: f"it raised {text}"


def _of_hold(
    condition: str, hold: Hold, moment: Moment, grip: Grip | None
) -> tuple[Flags, Callable[[int], str]]:
    """For which robots an object is held, or free."""
    name, link = hold.frame, hold.link
    hidden = _rows(unseen(hold, moment))
    if grip is None:
        return hidden & False, lambda row: f"it is not known where {name} is"
    off, way = (_rows(each) for each in grip.off(hold, moment))
    carried, seen = grip.carried(hold, moment), moment.frames[name]
    shape = moment.arrived.shape
    apart = _rows((carried.position - seen.position).norm(dim=-1).expand(shape))
    if condition == "free":
        met = ~_rows(grip.holds) & ~hidden & (off >= 1)
    else:
        met = _rows(grip.carries)

    def why(row: int) -> str:
        if hidden[row]:
            return f"{name} is not seen"
        if condition == "held" and way[row] < MOVED / LOST:
            return f"{link} has not carried {name} by {100 * MOVED:.0f} cm yet"
        return f"{name} is {1e3 * apart[row]:.0f} mm from where {link} would carry it"

    return met, why


def _rows(values: Tensor) -> Any:
    """Values (...) of robots in one dimension."""
    return values.numpy(force=True).reshape(-1)
