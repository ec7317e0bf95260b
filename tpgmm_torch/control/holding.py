"""What robots hold: where objects were last free, and what moves with a link."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Self

import torch
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.holds import Hold, check_holds
from tpgmm_torch.exceptions import UnknownNameError
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

__all__ = ["Held", "Holding", "choose"]

#: The unit of motions [m], [rad]: what moved by one with a link is carried.
MOVED, TURNED = 0.01, math.radians(5)
#: It may be that it moves with a link if its pose there changes by less than this share of it.
PERHAPS = 0.7
#: It rests if it has moved by less than this share of the link's motion, once that is so large.
RESTS, STIRRED = 0.5, 0.1
#: How fast what is seen elsewhere than it was taken to be is followed [s].
SETTLING = 1.0
#: What is seen may be late: it counts by half where a link is by this share of MOVED or TURNED
#: from where it was in the mean of so many seconds.
BEHIND, LATELY = 0.4, 0.1


@dataclass(frozen=True, eq=False)
class Held:
    """Who holds an object, and how.

    Parameters
    ----------
    carrier : int, or Tensor of int, of shape (...)
        The index of the link that holds it, for all robots or each of them; -1 if it is free.
    grasp : Frame, optional
        Its pose in that link; None if it was not held yet.
    taken : Frame, optional
        Where it was when it was taken.
    told : bool, or Tensor of bool, of shape (...)
        Whether what was told at run time counts, and no longer the holds of the model.
    stood : Frame, optional
        Where the link was when the object was last seen not to move with it: NaN if it was not
        seen since it was taken, infinite once it moves with the link; None if so for all.
    link : Frame, optional
        Where the link was first since it took it; in the mean of late, once it moves with it.
    first, last : Frame, optional
        Where it was seen first since it was taken, and last.
    rests : bool, or Tensor of bool, of shape (...)
        Whether the link has moved since then without it, and does not move it yet.
    joints : Tensor of shape (..., n_joints), optional
        Where the robots stood [rad or m], as late as it is seen; None if it is seen at once.
    shown : Frame, optional
        Its pose in the link when it was last seen not to move with it, both equally late.
    """

    carrier: int | Tensor = -1
    grasp: Frame | None = None
    taken: Frame | None = None
    told: bool | Tensor = False
    stood: Frame | None = None
    link: Frame | None = None
    first: Frame | None = None
    last: Frame | None = None
    rests: bool | Tensor = False
    joints: Tensor | None = None
    shown: Frame | None = None


@dataclass(frozen=True, eq=False)
class Holding:
    """The objects of a batch of robots, in one moment of a skill; made by :meth:`start`.

    While an object is free, its frame is where it is seen. From the tick at which a link takes
    it, its frame, as a place, stays as it was, and, as a thing, it moves with the link; when
    the link lets go, it stays where that was, until it is seen elsewhere. A hand that closes
    may shift what it holds: until that has moved by 1 cm or 5 degrees with the link, how it is
    held is seen anew. Afterwards what is seen is followed within seconds, while the link
    hardly moves: two hands that come together may have moved alike, and what is held may slip.
    While it is seen to rest although the link moves, the joints do not move it: it is not held
    yet, whatever the skill's time says. What takes the noise from its pose makes that late:
    joints become as late from when it is taken on, since how it is held is between poses of
    one moment.

    Parameters
    ----------
    kinematics : Kinematics
    holds : tuple of Hold
    objects : tuple of str
        Those that operators refer to as things.
    frames : mapping of str to Frame
        Where all objects were when they were last free, as operators take them.
    held : mapping of str to Held
        Objects that are held now, or were.
    """

    kinematics: Kinematics
    holds: tuple[Hold, ...]
    objects: tuple[str, ...]
    frames: Mapping[str, Frame]
    held: Mapping[str, Held] = field(default_factory=dict)

    @classmethod
    def start(
        cls,
        kinematics: Kinematics,
        objects: Sequence[str],
        holds: Sequence[Hold],
        frames: Mapping[str, Frame],
    ) -> Self:
        """Before anything is held.

        Parameters
        ----------
        kinematics : Kinematics
        objects : sequence of str
            Those that operators refer to as things.
        holds : sequence of Hold
            Those of the model, or others.
        frames : mapping of str to Frame
            Where the objects are.

        Raises
        ------
        UnknownNameError, DataError
            If a frame or a link is not known, or an object is held by two links at once.
        """
        # whatever is not there yet has to be seen before it is asked for
        names = frames or [hold.frame for hold in holds]
        checked = check_holds(holds, names, kinematics.links)
        return cls(kinematics, checked, tuple(objects), dict(frames))

    @property
    def carries(self) -> bool:
        """Whether an object that operators refer to as a thing may be held by some robot."""
        return any(
            name in self.held and self.held[name].grasp is not None for name in self.objects
        )

    def advance(
        self,
        time: float | Tensor,
        joints: Tensor,
        frames: Mapping[str, Frame] | None = None,
        told: Mapping[str, str | None] | None = None,
        where: Tensor | None = None,
        dt: float | Tensor = 0.0,
        shares: Mapping[str, Tensor] = MappingProxyType({}),
    ) -> Self:
        """The next moment.

        Parameters
        ----------
        time : float, or Tensor of shape () or (...)
            In the skill [s]: the holds' times are in it.
        joints : Tensor of shape (..., n_joints)
            Where the robots stand [rad or m].
        frames : mapping of str to Frame, optional
            Objects that are seen now. Those that are held may be left out; one that is seen
            exactly where it was taken, once it was carried, counts as not seen.
        told : mapping of str to str or None, optional
            For objects of which it is known, the link that holds them from now on; None if
            they are free from now on. The model's holds of that object no longer count.
        where : Tensor of bool, of shape (...), optional
            For which robots that is told; by default for all.
        dt : float, or Tensor of shape (...), default=0
            Since the last moment [s].
        shares : mapping of str to Tensor of shape (...), optional
            Of objects that are seen late, how much of what they do now is in where they are
            seen; the rest is what was seen before.

        Raises
        ------
        UnknownNameError
            If what is told names a frame or link that does not exist.
        """
        for name in told or ():
            if name not in self.frames and name not in (frames or ()):
                raise UnknownNameError("frame", name, "the situation", self.frames)
        if not self.holds and not self.held and not told:
            return self if not frames else replace(self, frames={**self.frames, **frames})
        places, held, seen = {**self.frames, **(frames or {})}, dict(self.held), frames or {}
        time = time.item() if isinstance(time, Tensor) and not time.ndim else time
        state: RobotState | None = None
        for name in dict.fromkeys((*(hold.frame for hold in self.holds), *held, *(told or ()))):
            if name not in places:
                continue
            before = held.get(name, FREE)
            if name in seen and before.stood is not None:
                held[name] = before = _later(before, joints, shares.get(name))
            carrier, is_told = self._carrier(name, time, before, told or {}, where)
            place = self.frames.get(name, places[name])
            if _equal(carrier, before.carrier):
                pose = _unless(before.taken, seen.get(name, place), place)
                places[name] = choose(_held(carrier), place, pose)
                if is_told is not before.told:
                    held[name] = replace(before, told=is_told)
            else:
                state = self.kinematics.state(joints) if state is None else state
                now = self._now(name, place, before, seen.get(name), state)
                held[name] = self._taken(before, carrier, is_told, now, state)
                still = _held(before.carrier) & _held(carrier)
                places[name] = choose(still, place, now)
            if name in seen and before.stood is not None and before.taken is not None:
                live = _held(carrier) & torch.as_tensor(carrier == before.carrier)
                live = live & ~_same(seen[name], before.taken)
                if bool(live.any()):
                    state = self.kinematics.state(joints) if state is None else state
                    held[name] = self._seen(held[name], seen[name], live, state, dt)
        same = held.keys() == self.held.keys() and all(held[n] is self.held[n] for n in held)
        return replace(self, frames=places, held=self.held if same else held)

    def free(self, name: str, like: Tensor) -> Tensor:
        """For which robots an object is free: bool, of the shape of ``like``."""
        carrier = self.held.get(name, FREE).carrier
        return torch.as_tensor(carrier, device=like.device).expand(like.shape) < 0

    def busy(self, like: Tensor) -> Tensor:
        """Which robots hold something: bool, of the shape of ``like``."""
        return torch.stack(
            [
                torch.zeros_like(like, dtype=torch.bool),
                *(~self.free(n, like) for n in self.held),
            ]
        ).any(0)

    def taken(self, name: str, index: int, where: Tensor, place: Frame, grasp: Frame) -> Self:
        """A link holds an object that was at a place before, as if that had been told.

        Parameters
        ----------
        name : str
            The object.
        index : int
            Of the link.
        where : Tensor of bool, of shape (...)
            For which robots.
        place, grasp : Frame
            Where the object was when it was last free; its pose in the link now.
        """
        before = self.held.get(name, FREE)
        old, stood = grasp if before.grasp is None else before.grasp, before.stood
        now = replace(
            before,
            carrier=_choose_index(where, index, before.carrier),
            grasp=choose(where, grasp, old),
            taken=choose(where, place, place if before.taken is None else before.taken),
            told=where | torch.as_tensor(before.told),
            stood=None if stood is None else choose(where, _constant(stood, math.inf), stood),
            joints=_anew(before.joints, where),
        )
        frames = {**self.frames, name: choose(where, place, self.frames[name])}
        return replace(self, frames=frames, held={**self.held, name: now})

    def untold(self, name: str, where: Tensor) -> Self:
        """The holds of the skill count again for an object, whatever was told before.

        Parameters
        ----------
        name : str
        where : Tensor of bool, of shape (...)
            For which robots.
        """
        before = self.held[name]
        told = torch.as_tensor(before.told)
        if not bool((told & where).any()):
            return self
        return replace(self, held={**self.held, name: replace(before, told=told & ~where)})

    def carried(self, name: str, state: RobotState) -> Frame:
        """Where an object is that is or was held, if its link has it still."""
        return self._with(state, name, self.held[name]).pose(name)

    def state(self, state: RobotState) -> RobotState:
        """The state of the robots with what they hold, as operators refer to it.

        Parameters
        ----------
        state : RobotState
            Of the robots alone.
        """
        for name in self.objects:
            if name in self.held and self.held[name].grasp is not None:
                state = self._with(state, name, self.held[name])
        return state

    def _carrier(
        self,
        name: str,
        time: float | Tensor,
        before: Held,
        told: Mapping[str, str | None],
        where: Tensor | None,
    ) -> tuple[int | Tensor, bool | Tensor]:
        """Who holds an object now, and for which robots that was told."""
        carrier: int | Tensor = -1
        for hold in self.holds:
            if hold.frame == name:
                now = (hold.begin <= time) & (time < hold.end)
                carrier = _choose_index(now, self.kinematics.links.index(hold.link), carrier)
        carrier = _choose_index(before.told, before.carrier, carrier)
        if name not in told:
            return carrier, before.told
        link = told[name]
        if link is not None and link not in self.kinematics.links:
            raise UnknownNameError("link", link, "the robot", self.kinematics.links)
        index = -1 if link is None else self.kinematics.links.index(link)
        if where is None:
            return index, True
        return _choose_index(where, index, carrier), before.told | where

    def _now(
        self, name: str, place: Frame, before: Held, seen: Frame | None, state: RobotState
    ) -> Frame:
        """Where an object is that is taken or let go."""
        known = place if before.grasp is None else self._with(state, name, before).pose(name)
        return known if seen is None else _unless(before.taken, seen, known)

    def _taken(
        self,
        before: Held,
        carrier: int | Tensor,
        told: bool | Tensor,
        now: Frame,
        state: RobotState,
    ) -> Held:
        """Who holds an object from now on, and how."""
        grasp, stood = before.grasp, before.stood
        for index in _indices(carrier):
            other = now.seen_from(state.pose(self.kinematics.links[index]))
            grasp = other if grasp is None else grasp
            stood = _constant(other, math.inf) if stood is None else stood
            news = torch.as_tensor(carrier == index) & torch.as_tensor(before.carrier != index)
            grasp = choose(news, other, grasp)
            stood = choose(news, _constant(stood, math.nan), stood)
        taken = now
        if before.taken is not None:
            still = _held(before.carrier) | ~torch.as_tensor(_held(carrier))
            taken = choose(still, before.taken, now)
        news = torch.as_tensor(_held(carrier)) & ~torch.as_tensor(_held(before.carrier))
        return replace(
            before, carrier=carrier, grasp=grasp, taken=taken, told=told, stood=stood,
            joints=_anew(before.joints, news),
        )  # fmt: skip

    def _seen(
        self, held: Held, seen: Frame, live: Tensor, state: RobotState, dt: float | Tensor
    ) -> Held:
        """The same after a look at what is held, for robots that see it."""
        assert held.grasp is not None and held.stood is not None
        grasp, moving = held.grasp, held.stood.position.isinf().all(-1)
        dt, links = torch.as_tensor(dt, dtype=grasp.position.dtype), held.link
        then = state
        if held.joints is not None:
            late = torch.where(held.joints.isnan(), state.joints, held.joints)
            then = self.kinematics.state(late)
        for index in _indices(held.carrier) if bool(moving.any()) else ():
            link = then.pose(self.kinematics.links[index])
            before = link if links is None else links
            here = live & moving & torch.as_tensor(held.carrier == index)
            behind = before.change(link, MOVED, TURNED) / BEHIND
            share = (dt / SETTLING).clamp(max=1.0) / (1 + behind.square())
            grasp = choose(here, between(grasp, seen.seen_from(link), share), grasp)
            links = choose(here, between(before, link, (dt / LATELY).clamp(max=1.0)), before)
        held = replace(held, grasp=grasp, link=links)
        if bool((moving | torch.as_tensor(held.carrier < 0)).all()):
            return held
        return self._shifted(held, seen, live & ~moving, state, then)

    def _shifted(
        self, held: Held, seen: Frame, live: Tensor, state: RobotState, then: RobotState
    ) -> Held:
        """The same after a look at what may be shifted in its link, for robots that see it.

        Whether it moves with its link is asked of where the robots stood ``then``, as late as
        it is seen. While it rests, it is not late, and in the hand where that is now.
        """
        assert held.grasp is not None and held.stood is not None
        grasp, stood, rests = held.grasp, held.stood, torch.as_tensor(held.rests)
        begins, links, first = stood.position.isnan().all(-1), held.link, held.first
        shown = grasp if held.shown is None else choose(begins, grasp, held.shown)
        for index in _indices(held.carrier):
            link, now = (s.pose(self.kinematics.links[index]) for s in (then, state))
            together = seen.seen_from(link)
            here = live & torch.as_tensor(held.carrier == index)
            links = link if links is None else choose(here & begins, link, links)
            first = seen if first is None else choose(here & begins, seen, first)
            stirred = links.change(link, MOVED, TURNED)
            still = (stirred > STIRRED) & (first.change(seen, MOVED, TURNED) < RESTS * stirred)
            rests = torch.where(here, (rests & ~begins) | still, rests)
            moved = held.stood.change(link, MOVED, TURNED)
            along = shown.change(together, MOVED, TURNED) < PERHAPS * moved  # false of NaN
            goes = here & along & (moved >= 1)
            grasp = choose(goes, together, choose(here & ~along, seen.seen_from(now), grasp))
            shown = choose(here & ~along, together, shown)
            stood = choose(here & ~along, link, stood)
            stood = choose(goes, _constant(stood, math.inf), stood)
        moving = stood.position.isinf().all(-1)
        held = replace(held, grasp=grasp, stood=stood, link=links)
        if bool((moving | torch.as_tensor(held.carrier < 0)).all()):
            return replace(held, first=None, last=None, rests=False, shown=None)
        last = seen if held.last is None else choose(live, seen, held.last)
        return replace(held, first=first, last=last, rests=rests & ~moving, shown=shown)

    def _with(self, state: RobotState, name: str, held: Held) -> RobotState:
        """A state with an object as a link: free for some robots, held by others."""
        assert held.grasp is not None
        links = self.kinematics.links
        if isinstance(held.carrier, int) and held.carrier >= 0:
            state = state.with_link(name, links[held.carrier], held.grasp)
        else:
            state = state.with_link(name, None, self.frames[name])
            for index in _indices(held.carrier):
                where = torch.as_tensor(held.carrier == index)
                state = state.with_link(name, links[index], held.grasp, where)
        if held.last is None:
            return state
        # a hand that turned upright what does not turn with it would turn for ever
        rests = torch.as_tensor(held.rests) & torch.as_tensor(held.carrier >= 0)
        return state.with_link(name, None, held.last, rests) if bool(rests.any()) else state


FREE = Held()


def _later(held: Held, joints: Tensor, share: Tensor | None) -> Held:
    """With joints that are as late as the object is seen."""
    if share is None:
        return held if held.joints is None else replace(held, joints=None)
    last = joints if held.joints is None else held.joints
    last = torch.where(last.isnan(), joints, last)
    return replace(held, joints=last + share.unsqueeze(-1) * (joints - last))


def _anew(late: Tensor | None, where: Tensor) -> Tensor | None:
    """Late joints that begin with the next look: an object that rested is not late."""
    return late if late is None else late.masked_fill(where.unsqueeze(-1), math.nan)


def _constant(like: Frame, value: float) -> Frame:
    """No pose, but a number in place of its position."""
    return Frame._from(torch.full_like(like.position, value), like.orientation)


def _indices(carrier: int | Tensor) -> list[int]:
    """The links that hold something."""
    each = [carrier] if isinstance(carrier, int) else carrier.unique().tolist()
    return [index for index in each if index >= 0]


def _held(carrier: int | Tensor) -> bool | Tensor:
    return carrier >= 0


def _equal(one: int | Tensor, other: int | Tensor) -> bool:
    same = one == other
    return bool(same.all()) if isinstance(same, Tensor) else same


def _choose_index(where: bool | Tensor, one: int | Tensor, other: int | Tensor) -> int | Tensor:
    if isinstance(where, bool):
        return one if where else other
    return torch.where(where, torch.as_tensor(one), torch.as_tensor(other))


def _unless(stale: Frame | None, seen: Frame, known: Frame) -> Frame:
    """What is seen; what is known where that is exactly a pose of before."""
    if stale is None or seen is known:
        return seen
    return choose(_same(seen, stale), known, seen)


def _same(one: Frame, other: Frame) -> Tensor:
    """Where poses are exactly the same."""
    same = (one.position == other.position).all(-1)
    return same & (one.orientation == other.orientation).all(-1)


def choose(where: bool | Tensor, one: Frame, other: Frame) -> Frame:
    """One pose for some robots, the other for the rest.

    Parameters
    ----------
    where : bool, or Tensor of bool, of shape (...)
        For which robots the first.
    one, other : Frame
    """
    if isinstance(where, bool):
        return one if where else other
    mask = where[..., None]
    position = torch.where(mask, one.position, other.position)
    return Frame._from(position, torch.where(mask, one.orientation, other.orientation))


def between(one: Frame, other: Frame, share: Tensor) -> Frame:
    """Some of the way from one pose to another.

    Parameters
    ----------
    one, other : Frame
    share : Tensor of shape (...)
        Of the way, from 0 to 1.
    """
    share = share.unsqueeze(-1)
    position = one.position + share * (other.position - one.position)
    turn = quaternions.match_hemisphere(other.orientation, one.orientation)
    return Frame._from(
        position, quaternions.normalize(one.orientation + share * (turn - one.orientation))
    )
