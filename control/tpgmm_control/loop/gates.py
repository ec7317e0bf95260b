"""Stage *gate*: robots that wait at a time of their skill, go on, go back, or give up."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import repeat
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
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
        """After a tick."""
        link, thing = moment.state.pose(hold.link), moment.frames[hold.frame]
        holds = moment.no_robot
        if (held := moment.holding.held.get(hold.frame)) is not None:
            index = moment.holding.kinematics.links.index(hold.link)
            holds = holds | (held.carrier.to(holds.device) == index)
        new = holds & ~self.holds
        grip = replace(
            self, link=choose(new, link, self.link), thing=choose(new, thing, self.thing)
        )
        there = grip.carried(hold, moment)
        off, way = (one.change(there, LOST, LOST_TURN) for one in (thing, grip.thing))
        along = (way >= MOVED / LOST) & (off < (SHARE * way).clamp(max=1.0))
        known = torch.where(moment.unseen[hold.frame], self.carries & ~new, along)
        return replace(grip, holds=holds, carries=holds & known)

    def kept(self, robots: Tensor) -> Self:
        """For some robots (...) alone."""
        return replace(self, holds=self.holds & robots, carries=self.carries & robots)

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
    tries : int array of shape (B, G)
        How often that took too long.
    failed : bool array of shape (B,)
        Robots that have given up.
    goto, fade : array of shape (B,)
        Where the time of robots is set to at this tick, NaN if it is not, and how long it takes
        to the beginning of a separate skill, 0 if none begins [s].
    reasons : mapping of int to str
        What robots wait for, or why they gave up.
    grips : mapping of Hold to Grip
        Of the objects that conditions ask for.
    """

    gates: tuple[Gate, ...]
    closed: Array
    index: NDArray[np.int_]
    waited: Array
    met_for: Array
    tries: NDArray[np.int_]
    failed: Flags
    goto: Array
    fade: Array
    reasons: Mapping[int, str] = field(default_factory=dict)
    grips: Mapping[Hold, Grip] = field(default_factory=dict)

    @classmethod
    def start(cls, gates: tuple[Gate, ...], time: Array, end: float, enforced: bool) -> Self:
        """At times (B,) of a skill; without enforcement all conditions count as met."""
        first = float(time.min())
        later = (gate for gate in gates if first < gate.time <= end)
        known = tuple(replace(gate, back=max(gate.back, first)) for gate in later)
        last = np.nextafter(end, -np.inf)  # at the end itself a robot is done
        stops = [min(g.time, last) if enforced and g.until else np.inf for g in known]
        closed = np.minimum.accumulate([np.inf, *stops[::-1]])[::-1]
        zero, tries = np.zeros(len(time)), np.zeros((len(time), len(known)), int)
        none = zero > 0
        return cls(known, closed, none.astype(int), zero, zero, tries, none, zero, zero)

    @property
    def stop(self) -> Array:
        """Times beyond which robots do not go (B,) [s]."""
        return self.closed[self.index]

    @property
    def since(self) -> Array:
        """Beginnings of the skills in which robots are (B,) [s]."""
        return np.array([-np.inf, *(gate.time + gate.fade for gate in self.gates)])[self.index]

    @property
    def returned(self) -> Flags:
        """Robots that go back at this tick."""
        return np.isfinite(self.goto) & (self.fade == 0)

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
        new = replace(self, goto=np.full_like(time, np.nan), fade=np.zeros_like(time))
        for number, gate in enumerate(self.gates):  # those without conditions
            if self.closed[number] > gate.time:
                rows = (new.index == number) & (time > gate.time)
                new = new._opened(rows, np.maximum(time, gate.onward))
        stands = time >= new.stop
        at = stands & ready & ~self.failed
        new = replace(new, waited=np.where(at, new.waited + dt, stands * new.waited))
        if moment is None:
            return replace(new, met_for=new.met_for + (at & (new.met_for > 0)) * dt)
        waits = (stands & ~at) | self.failed
        kept = {row: text for row, text in self.reasons.items() if waits[row]}
        new = replace(
            new, grips=new._gripped(moment), met_for=stands * new.met_for, reasons=kept
        )
        return new._decided(at, dt, moment) if at.any() else new

    def _opened(self, rows: Flags, time: Any) -> Self:
        """Some robots have passed the next gate, and go on from a time."""
        if not rows.any():
            return self
        fades = np.where(rows, np.array([*(g.fade for g in self.gates), 0.0])[self.index], 0)
        return replace(
            self,
            index=self.index + rows,
            fade=self.fade + fades,
            goto=np.where(fades > 0, time, self.goto),
        )

    def _gripped(self, moment: Moment) -> Mapping[Hold, Grip]:
        """The links and objects that conditions ask for."""
        grips, no_robot = dict(self.grips), moment.no_robot
        for hold in (hold for gate in self.gates for _, hold in gate.holds):
            if hold.frame in moment.frames:
                if hold not in grips:
                    link, thing = moment.state.pose(hold.link), moment.frames[hold.frame]
                    grips[hold] = Grip(link, thing, no_robot, no_robot)
                grips[hold] = grips[hold].update(hold, moment)
        return grips

    def _decided(self, at: Flags, dt: Array, moment: Moment) -> Self:
        """Robots at their gates wait, go on, go back, or give up."""
        why = self._asked(at, moment)
        number = np.minimum(self.index, len(self.gates) - 1)
        each = np.array([(g.timeout, g.retries, g.back, g.onward) for g in self.gates])
        timeout, retries, back, onward = each[number].T
        met = at & np.array([not text for text in why])
        met_for = np.where(at, met * (self.met_for + dt), self.met_for)
        late = at & ~met & (self.waited >= timeout)
        tries = self.tries + late[:, None] * np.eye(len(self.gates), dtype=int)[number]
        count = tries[np.arange(len(at)), number]
        fails, goes, opens = late & (count > retries), late & (count <= retries), met
        opens = opens & (met_for >= LOST_TIME)
        reasons = dict(self.reasons)
        for row in np.flatnonzero(at & ~goes & ~opens).tolist():
            after = f" after {count[row]} tries" if fails[row] and count[row] > 1 else ""
            text = f"met for {met_for[row]:.1f} s of {LOST_TIME:g} s"
            reasons[row] = why[row].replace(" not met", f" not met{after}", 1) or text
        kept = torch.from_numpy(~goes).view(moment.arrived.shape)
        times = [gate.time for gate in self.gates]
        return replace(
            self,
            index=np.where(goes, np.searchsorted(times, back, side="right"), self.index),
            waited=np.where(goes | opens, 0.0, self.waited),
            met_for=np.where(goes | opens, 0.0, met_for),
            tries=tries,
            failed=self.failed | fails,
            goto=np.where(goes, back, self.goto),
            reasons=reasons,
            grips={hold: grip.kept(kept) for hold, grip in self.grips.items()},
        )._opened(opens, onward)

    def _asked(self, at: Flags, moment: Moment) -> list[str]:
        """Why robots (B,) at their gates may not go on; empty where they may."""
        why = [""] * len(at)
        for number in np.unique(self.index[at]).tolist():
            unmet = list(self._unmet(self.gates[number], moment))
            for row in np.flatnonzero(at & (self.index == number)).tolist():
                why[row] = next(filter(None, (texts[row] for texts in unmet)), "")
        return why

    def _unmet(self, gate: Gate, moment: Moment) -> Iterator[list[str]]:
        """Of each condition, why robots (B,) do not meet it; empty where they do."""
        for one in gate.until:
            if one in ("held", "free"):
                holds = (hold for name, hold in gate.holds if name == one)
                found = [self._holds(hold, moment, one == "free") for hold in holds]
            else:
                found = [_met(one, moment)]
            name = one if isinstance(one, str) else getattr(one, "__name__", "a function")
            for met, whys in found:
                rows = zip(_rows(met), whys, strict=False)
                yield ["" if ok else f"{name!r} not met: {why}" for ok, why in rows]

    def _holds(self, hold: Hold, moment: Moment, free: bool) -> tuple[Tensor, Iterable[str]]:
        """Which robots (...) hold an object, or have let it go, and why others do not."""
        name, grip = hold.frame, self.grips.get(hold)
        if grip is None:
            return moment.no_robot, repeat(f"{name} is nowhere")
        there, seen, unseen = grip.carried(hold, moment), moment.frames[name], moment.unseen
        lost = there.change(seen, LOST, LOST_TURN) >= 1
        apart = 1e3 * (there.position - seen.position).norm(dim=-1)
        away = (f"{one:.0f} mm from where {hold.link} would carry it" for one in _rows(apart))
        whys = (
            f"{name} is {'not seen' if hidden else far}"
            for far, hidden in zip(away, _rows(unseen[name]), strict=True)
        )
        return ~grip.holds & ~unseen[name] & lost if free else grip.carries, whys


def _met(condition: Condition, moment: Moment) -> tuple[Tensor, Iterable[str]]:
    """Which robots (...) meet a condition but those of objects, and why others do not."""
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
