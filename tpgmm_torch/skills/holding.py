"""Objects that robots hold: their poses when they were last free, and in the hand."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from types import MappingProxyType
from typing import Self

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.frames import Frame, Frames
from tpgmm_torch.data.holds import Hold, check_holds
from tpgmm_torch.exceptions import UnknownNameError
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

#: The unit of motions [m], [rad]: an object that moves by one with a link is carried.
MOVED, TURNED = 0.01, math.radians(5)
#: It may move with a link if its pose there changes by less than this share of the motion.
PERHAPS = 0.7
#: Time in which the grasp settles to where an object is seen in the hand [s].
SETTLING = 1.0

NOBODY, NO, YES = torch.tensor(-1), torch.tensor(False), torch.tensor(True)


@dataclass(frozen=True, eq=False)
class Held:
    """Which link holds an object, and how.

    Parameters
    ----------
    carrier : Tensor of int, of shape () or (...)
        The index of the link that holds it, for all robots or each of them; -1 if it is free.
    grasp : Frame, optional
        Its pose in that link; None if it was not held yet.
    taken : Frame, optional
        Its pose when it was taken.
    given : Tensor of bool, of shape () or (...)
        Whether the carrier was given at run time, in place of the skill's holds.
    apart : Frame, optional
        Pose of the link when the object was last seen not to move with it: NaN if it was not
        seen since it was taken, infinite once it moves with the link; None if so for all.
    link : Frame, optional
        First pose of the link since it took it; the mean of late ones, once it moves with it.
    first, last : Frame, optional
        Where it was seen first since it was taken, and last.
    rests : Tensor of bool, of shape () or (...)
        Whether the link has moved since then without it, and does not move it yet.
    joints : Tensor of shape (..., n_joints), optional
        Postures as late as the object is seen [rad or m]; None if it is seen at once.
    shown : Frame, optional
        Its pose in the link when it was last seen not to move with it, both equally late.
    """

    carrier: Tensor = NOBODY
    grasp: Frame | None = None
    taken: Frame | None = None
    given: Tensor = NO
    apart: Frame | None = None
    link: Frame | None = None
    first: Frame | None = None
    last: Frame | None = None
    rests: Tensor = NO
    joints: Tensor | None = None
    shown: Frame | None = None

    @property
    def is_held(self) -> Tensor:
        """True where a link holds it, of shape () or (...)."""
        return self.carrier >= 0

    @property
    def carriers(self) -> list[int]:
        """The links that hold it."""
        return [index for index in self.carrier.unique().tolist() if index >= 0]

    @property
    def moves_along(self) -> Tensor:
        """True where it was seen to move with its link (...)."""
        assert self.apart is not None
        return self.apart.position.isinf().all(-1)

    def later(self, seen: Frame | None, joints: Tensor, share: Tensor | None) -> Self:
        """With postures as late as the object is seen, of which a share is new."""
        if seen is None:
            return self
        if self.apart is None or share is None:
            return self if self.joints is None else replace(self, joints=None)
        last = joints if self.joints is None else self.joints
        last = torch.where(last.isnan(), joints, last)
        return replace(self, joints=last + share.unsqueeze(-1) * (joints - last))


FREE = Held()


@dataclass(frozen=True, eq=False)
class Holding:
    """The objects of a batch of robots at one tick of a skill; made by :meth:`start`.

    While an object is free, its frame is where it is seen. From the tick at which a link takes
    it, its frame, as a place, stays as it was, and, as a thing, it moves with the link; when
    the link lets go, it stays where that was, until it is seen elsewhere. A hand that closes
    may shift what it holds: until that has moved by 1 cm or 5 degrees with the link, the grasp
    is where it is seen. Afterwards the grasp settles to where it is seen within seconds, while
    the link hardly moves: two hands that come together may have moved alike, and an object may
    slip. While it is seen to rest although the link moves, the joints do not move it: it is
    not held yet, whatever the skill's time says, until it is not seen any more. Filters make
    its pose late: joints become as late from when it is taken on, since the grasp is between
    poses of one moment.

    Parameters
    ----------
    kinematics : Kinematics
    holds : tuple of Hold
    objects : tuple of str
        Those that operators refer to as things, or that are solids among obstacles.
    frames : mapping of str to Frame
        Poses of all objects when they were last free, as operators take them.
    held : mapping of str to Held
        Objects that are held now, or were.
    """

    kinematics: Kinematics
    holds: tuple[Hold, ...]
    objects: tuple[str, ...]
    frames: Frames
    held: Mapping[str, Held] = field(default_factory=dict)

    @classmethod
    def start(
        cls,
        kinematics: Kinematics,
        objects: Sequence[str],
        holds: Sequence[Hold],
        frames: Frames,
    ) -> Self:
        """Before anything is held.

        Parameters
        ----------
        kinematics : Kinematics
        objects : sequence of str
            Those that operators refer to as things.
        holds : sequence of Hold
        frames : mapping of str to Frame
            Poses of the objects.

        Raises
        ------
        UnknownNameError, DataError
            If a frame or a link is not known, or an object is held by two links at once.
        """
        # objects without a pose have to be seen before they are needed
        names = frames or [hold.frame for hold in holds]
        checked = check_holds(holds, names, kinematics.links)
        return cls(kinematics, checked, tuple(objects), dict(frames))

    @property
    def carries(self) -> bool:
        """True if one of the objects may be held by some robot."""
        return any(
            name in self.held and self.held[name].grasp is not None for name in self.objects
        )

    def advance(
        self,
        time: float | Tensor,
        joints: Tensor,
        frames: Frames | None = None,
        given: Mapping[str, str | None] | None = None,
        where: Tensor | None = None,
        dt: float | Tensor = 0.0,
        shares: Mapping[str, Tensor] = MappingProxyType({}),
    ) -> Self:
        """Return the next tick.

        Parameters
        ----------
        time : float, or Tensor of shape () or (...)
            In the skill [s]: the holds' times are in it.
        joints : Tensor of shape (..., n_joints)
            Postures of the robots [rad or m].
        frames : mapping of str to Frame, optional
            Objects that are seen now. Those that are held may be left out; one that is seen
            exactly where it was taken, once it was carried, counts as not seen.
        given : mapping of str to str or None, optional
            The link that holds an object from now on; None if it is free from now on. The
            skill's holds of that object no longer count.
        where : Tensor of bool, of shape (...), optional
            For which robots that is given; by default for all.
        dt : float, or Tensor of shape (...), default=0
            Since the last tick [s].
        shares : mapping of str to Tensor of shape (...), optional
            Of objects that are seen late, the share of the last reading in their poses.

        Raises
        ------
        UnknownNameError
            If a frame or link does not exist.
        """
        seen, given = frames or {}, given or {}
        if unknown := given.keys() - self.frames.keys() - seen.keys():
            raise UnknownNameError("frame", unknown.pop(), "the situation", self.frames)
        names = {hold.frame: None for hold in self.holds} | dict.fromkeys((*self.held, *given))
        if not names:
            return replace(self, frames={**self.frames, **seen}) if seen else self
        places, held = {**self.frames, **seen}, dict(self.held)
        state_now = cache(lambda: self.kinematics.state(joints))
        for name in filter(places.__contains__, names):
            pose = seen.get(name)
            before = self.held.get(name, FREE).later(pose, joints, shares.get(name))
            carrier = self._carrier(name, torch.as_tensor(time), before, given, where)
            place = self.frames.get(name, places[name])
            after, places[name] = self._change_carrier(
                name, before, carrier, place, pose, state_now
            )
            after = self._on_reading(before, after, pose, state_now, dt)
            if after is not FREE:
                held[name] = after
        return replace(self, frames=places, held=self.held if held == self.held else held)

    def free(self, name: str, like: Tensor) -> Tensor:
        """Check for which robots an object is free: bool, of the shape of ``like``."""
        carrier = self.held.get(name, FREE).carrier
        return carrier.to(like.device).expand(like.shape) < 0

    def busy(self, like: Tensor) -> Tensor:
        """Check which robots hold something: bool, of the shape of ``like``."""
        none = torch.zeros_like(like, dtype=torch.bool)
        return torch.stack([none, *(~self.free(n, like) for n in self.held)]).any(0)

    def take(self, name: str, index: int, where: Tensor, place: Frame, grasp: Frame) -> Self:
        """Return a link holds an object, as if that had been given.

        Parameters
        ----------
        name : str
            The object.
        index : int
            Of the link.
        where : Tensor of bool, of shape (...)
            For which robots.
        place, grasp : Frame
            Pose of the object when it was last free; its pose in the link now.
        """
        before = self.held.get(name, FREE)
        apart = before.apart
        now = replace(
            before,
            carrier=torch.where(where, index, before.carrier),
            grasp=choose(where, grasp, before.grasp),
            taken=choose(where, place, before.taken),
            given=where | before.given,
            apart=None if apart is None else choose(where, _constant(apart, math.inf), apart),
            joints=_restart_lag(before.joints, where),
        )
        frames = {**self.frames, name: choose(where, place, self.frames[name])}
        return replace(self, frames=frames, held={**self.held, name: now})

    def clear_override(self, name: str, where: Tensor) -> Self:
        """Return the skill's holds of an object count again, whatever was given before.

        Parameters
        ----------
        name : str
        where : Tensor of bool, of shape (...)
            For which robots.
        """
        before = self.held[name]
        if not bool((before.given & where).any()):
            return self
        now = replace(before, given=before.given & ~where)
        return replace(self, held={**self.held, name: now})

    def release(self, robots: Tensor, seen: Frames) -> Self:
        """Some robots hold nothing, and objects are where they are seen.

        From the next tick on the skill says what they hold.

        Parameters
        ----------
        robots : Tensor of bool, of shape (...)
        seen : mapping of str to Frame
        """
        frames, held = dict(self.frames), dict(self.held)
        for name in frames.keys() & seen.keys():
            frames[name] = choose(robots, seen[name], frames[name])
        for name, before in held.items():
            carrier = torch.where(robots, -1, before.carrier)
            held[name] = replace(before, carrier=carrier, given=before.given & ~robots)
        return replace(self, frames=frames, held=held)

    def restart(self, robots: Tensor, joints: Tensor) -> Self:
        """Objects that some robots hold are, as places, where they are now.

        Parameters
        ----------
        robots : Tensor of bool, of shape (...)
            For which a separate skill begins.
        joints : Tensor of shape (..., n_joints)
            Their postures [rad or m].
        """
        frames, state = dict(self.frames), self.kinematics.state(joints)
        for name, held in self.held.items():
            where = robots & held.is_held
            if bool(where.any()):
                frames[name] = choose(where, self.locate(name, state), frames[name])
        return replace(self, frames=frames)

    def locate(self, name: str, state: RobotState) -> Frame:
        """Pose of an object that is or was held, if its link has it still."""
        return self._with(state, name, self.held[name]).pose(name)

    def state(self, state: RobotState) -> RobotState:
        """Add to the state of the robots the objects that they hold, as operators need them.

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
        time: Tensor,
        before: Held,
        given: Mapping[str, str | None],
        where: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """Return the link that holds an object now, and for which robots that was given."""
        links, carrier = self.kinematics.links, NOBODY
        for hold in self.holds:
            if hold.frame == name:
                now = (hold.begin <= time) & (time < hold.end)
                carrier = torch.where(now, links.index(hold.link), carrier)
        carrier = torch.where(before.given, before.carrier, carrier)
        if name not in given:
            return carrier, before.given
        link = given[name]
        if link is not None and link not in links:
            raise UnknownNameError("link", link, "the robot", links)
        index = -1 if link is None else links.index(link)
        if where is None:
            return torch.tensor(index), torch.tensor(True)
        return torch.where(where, index, carrier), before.given | where

    def _change_carrier(
        self,
        name: str,
        before: Held,
        now_held: tuple[Tensor, Tensor],
        place: Frame,
        seen: Frame | None,
        state_now: Callable[[], RobotState],
    ) -> tuple[Held, Frame]:
        """Return an object after its carrier may have changed, and its place."""
        carrier, given = now_held
        if bool((carrier == before.carrier).all()):
            pose = _unless(before.taken, place if seen is None else seen, place)
            same = given is before.given
            after = before if same else replace(before, given=given)
            return after, choose(carrier >= 0, place, pose)
        state = state_now()
        known = place if before.grasp is None else self._with(state, name, before).pose(name)
        now = known if seen is None else _unless(before.taken, seen, known)
        holds, held = carrier >= 0, before.is_held
        grasp, apart = before.grasp, before.apart
        for index in replace(before, carrier=carrier).carriers:
            other = now.seen_from(state.pose(self.kinematics.links[index]))
            apart = _constant(other, math.inf) if apart is None else apart
            news = (carrier == index) & (before.carrier != index)
            grasp = choose(news, other, grasp)
            apart = choose(news, _constant(apart, math.nan), apart)
        after = replace(
            before,
            carrier=carrier,
            grasp=grasp,
            taken=choose(~held & holds, now, before.taken),
            given=given,
            apart=apart,
            joints=_restart_lag(before.joints, holds & ~held),
        )
        return after, choose(held & holds, place, now)

    def _on_reading(
        self,
        before: Held,
        held: Held,
        seen: Frame | None,
        state_now: Callable[[], RobotState],
        dt: float | Tensor,
    ) -> Held:
        """Return an object after it was seen, by robots that held it before."""
        if seen is None or before.taken is None or before.apart is None:
            return held
        unseen = _same(seen, before.taken)
        live = held.is_held & (held.carrier == before.carrier) & ~unseen
        if bool((held.rests & unseen).any()):  # it may be lifted by now
            held = replace(held, rests=held.rests & ~unseen)
        return self._observe(held, seen, live, state_now(), dt) if bool(live.any()) else held

    def _observe(
        self, held: Held, seen: Frame, live: Tensor, state: RobotState, dt: float | Tensor
    ) -> Held:
        """Return a held object after it was seen by some robots."""
        assert held.grasp is not None
        grasp, link_pose, moving = held.grasp, held.link, held.moves_along
        dt, then = torch.as_tensor(dt, dtype=grasp.position.dtype), state
        if held.joints is not None:
            late = torch.where(held.joints.isnan(), state.joints, held.joints)
            then = self.kinematics.state(late)
        for index in held.carriers if bool(moving.any()) else ():
            link = then.pose(self.kinematics.links[index])
            before = link if link_pose is None else link_pose
            here = live & moving & (held.carrier == index)
            # seen poses may be late: one counts by half where the link is by 0.4 units from
            # its mean of the last 0.1 s
            behind = before.change(link, MOVED, TURNED) / 0.4
            share = (dt / SETTLING).clamp(max=1.0) / (1 + behind.square())
            grasp = choose(here, between(grasp, seen.seen_from(link), share), grasp)
            mean = between(before, link, (dt / 0.1).clamp(max=1.0))
            link_pose = choose(here, mean, before)
        held = replace(held, grasp=grasp, link=link_pose)
        if bool((moving | ~held.is_held).all()):
            return held
        return self._estimate_grasp(held, seen, live & ~moving, state, then)

    def _estimate_grasp(
        self, held: Held, seen: Frame, live: Tensor, state: RobotState, then: RobotState
    ) -> Held:
        """Estimate the grasp of an object that may be shifted in its link, after a reading.

        Whether it moves with its link is asked of the posture ``then``, as late as it is seen.
        While it rests, it is not late, and its grasp is that of the posture now.
        """
        assert held.grasp is not None and held.apart is not None
        grasp, apart, rests = held.grasp, held.apart, held.rests
        begins, first_link, first = apart.position.isnan().all(-1), held.link, held.first
        shown = choose(begins, grasp, held.shown)
        for index in held.carriers:
            link, now = (s.pose(self.kinematics.links[index]) for s in (then, state))
            together, here = seen.seen_from(link), live & (held.carrier == index)
            first_link = choose(here & begins, link, first_link)
            first = choose(here & begins, seen, first)
            # it rests if it moved by less than half of the link's motion
            stirred = first_link.change(link, MOVED, TURNED)
            still = (stirred > 0.1) & (first.change(seen, MOVED, TURNED) < 0.5 * stirred)
            rests = torch.where(here, (rests & ~begins) | still, rests)
            moved = held.apart.change(link, MOVED, TURNED)
            along = shown.change(together, MOVED, TURNED) < PERHAPS * moved  # false of NaN
            goes, lies = here & along & (moved >= 1), here & ~along
            grasp = choose(goes, together, choose(lies, seen.seen_from(now), grasp))
            shown = choose(lies, together, shown)
            apart = choose(lies, link, apart)
            apart = choose(goes, _constant(apart, math.inf), apart)
        held = replace(held, grasp=grasp, apart=apart, link=first_link)
        moving = held.moves_along
        if bool((moving | ~held.is_held).all()):
            return replace(held, first=None, last=None, rests=NO, shown=None)
        last = choose(live, seen, held.last)
        return replace(held, first=first, last=last, rests=rests & ~moving, shown=shown)

    def _with(self, state: RobotState, name: str, held: Held) -> RobotState:
        """Return a state with an object as a link: free for some robots, held by others."""
        assert held.grasp is not None
        links = self.kinematics.links
        if not held.carrier.ndim and bool(held.is_held):
            state = state.with_link(name, links[int(held.carrier)], held.grasp)
        else:
            state = state.with_link(name, None, self.frames[name])
            for index in held.carriers:
                where = held.carrier == index
                state = state.with_link(name, links[index], held.grasp, where)
        if held.last is None:
            return state
        # a hand that turned an object upright which does not turn with it would turn for ever
        rests = held.rests & held.is_held
        return state.with_link(name, None, held.last, rests) if bool(rests.any()) else state


def _restart_lag(late: Tensor | None, where: Tensor) -> Tensor | None:
    """Late joints that begin with the next reading: an object that rested is not late."""
    return late if late is None else late.masked_fill(where.unsqueeze(-1), math.nan)


def _constant(like: Frame, value: float) -> Frame:
    """No pose, but a number in place of its position."""
    return Frame.from_checked(torch.full_like(like.position, value), like.orientation)


def _unless(stale: Frame | None, seen: Frame, known: Frame) -> Frame:
    """Return the seen pose; the known one where that is exactly an earlier one."""
    if stale is None or seen is known:
        return seen
    return choose(_same(seen, stale), known, seen)


def _same(one: Frame, other: Frame) -> Tensor:
    """Check which poses are exactly the same."""
    same = (one.position == other.position).all(-1)
    return same & (one.orientation == other.orientation).all(-1)


def choose(where: Tensor, one: Frame, other: Frame | None) -> Frame:
    """One pose for some robots, the other for the rest.

    Parameters
    ----------
    where : Tensor of bool, of shape () or (...)
        For which robots the first.
    one, other : Frame
        There may be no other yet: then the first is for all.
    """
    if other is None:
        return one
    if not where.ndim:
        return one if bool(where) else other
    mask = where[..., None]
    position = torch.where(mask, one.position, other.position)
    return Frame.from_checked(position, torch.where(mask, one.orientation, other.orientation))


def between(one: Frame, other: Frame, share: float | Tensor) -> Frame:
    """Return a pose between two others.

    Parameters
    ----------
    one, other : Frame
    share : float or Tensor of shape (...)
        Of the way, from 0 to 1.
    """
    position, turn = one.position, one.orientation
    alone = isinstance(share, float) or not share.ndim
    if alone and one.is_single and other.is_single:  # of few numbers numpy is faster
        start, end = (
            np.array([*each.position.tolist(), *each.orientation.tolist()])
            for each in (one, other)
        )
        end[3:] *= math.copysign(1.0, start[3:] @ end[3:])
        pose = start + float(share) * (end - start)
        pose[3:] /= math.sqrt(pose[3:] @ pose[3:])
        whole = torch.from_numpy(pose).to(position)
        return Frame.from_checked(whole[:3], whole[3:])
    share = torch.as_tensor(share, dtype=position.dtype, device=position.device).unsqueeze(-1)
    inner = (other.orientation * turn).sum(-1, keepdim=True)
    near = quaternions.hemisphere_sign(inner) * other.orientation
    return Frame.from_checked(
        position + share * (other.position - position),
        quaternions.normalize(turn + share * (near - turn)),
    )
