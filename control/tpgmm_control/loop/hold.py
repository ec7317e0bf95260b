"""Stage *hold*: objects that robots hold, by the skill, as it is given, and as it is seen.

Holds that were not given are found: objects that move along with a link.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Set
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from tpgmm_control.sensing.inputs import Inputs
from tpgmm_control.sensing.states import replace_fields
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.skills.holding import (
    MOVED,
    NO,
    PERHAPS,
    SETTLING,
    TURNED,
    YES,
    Holding,
    between,
    choose,
)
from tpgmm_torch.skills.skill import Skill

#: Distance [m], angle [rad] and time [s] after which an object is lost by its link.
LOST, LOST_TURN, LOST_TIME = 0.05, math.radians(25), 0.3
#: Time between tests whether an object is lost [s].
LOST_PERIOD = 0.1
#: A link so near to an object that is not seen any more hides or holds it [m].
HIDES = 0.15


@dataclass(frozen=True, eq=False)
class Rest:
    """Where an object rested.

    Parameters
    ----------
    seen, pose : Frame
        Its last reading, and where it rested.
    joints : Tensor of shape (..., n_joints)
        Postures of the robots when it rested last [rad or m].
    away : Tensor of shape (...)
        For how long it is far from where its link would have it [s].
    since : Tensor of shape (...)
        Time since that was tested [s].
    found : bool
        Whether a hold of it was found here.
    """

    seen: Frame
    pose: Frame
    joints: Tensor
    away: Tensor
    since: Tensor
    found: bool = False

    @classmethod
    def at(cls, seen: Frame, joints: Tensor) -> Self:
        """An object that rests where it is seen, while robots have these ``joints``."""
        zero = joints.new_zeros(joints.shape[:-1])
        return cls(seen, seen, joints, zero, zero)


@dataclass(frozen=True, eq=False)
class HoldWatch:
    """Holds found in how objects move when robots move.

    An object that has moved by 1 cm (or turned by 5 degrees) from where it rested, while its
    pose in a link changed by less than 0.4 of that, is held by that link since it rested. Until
    that is clear it is taken to be where it rested: hands that follow what they carry would
    run away with it. One that moved otherwise was moved by somebody else. An object whose hold
    was found is free again once it is 5 cm from where the link would have it for 0.3 s.

    An object that the skill holds later is taken to be where it is seen, and only watched for a
    hand that takes it along too early; from the skill's own time on its hold counts again.

    Parameters
    ----------
    kinematics : Kinematics
    rests : mapping of str to Rest
        Of the objects that are seen at each tick.
    """

    kinematics: Kinematics
    rests: Mapping[str, Rest] = field(default_factory=dict)

    def update(
        self,
        names: Set[str],
        frames: Mapping[str, Frame],
        joints: Tensor,
        holding: Holding,
        dt: float | Tensor,
        free_yet: Mapping[str, Tensor],
        lost: Mapping[str, Tensor] = MappingProxyType({}),
    ) -> tuple[Self, Holding, dict[str, Frame]]:
        """The watch and the held objects after a tick, and the poses of free objects.

        Parameters
        ----------
        names : set of str
            Objects that are seen at each tick.
        frames : mapping of str to Frame
            Where they are seen, of the batch's shape.
        joints : Tensor of shape (..., n_joints)
            Postures of the robots [rad or m].
        holding : Holding
            Holds that are known.
        dt : float or Tensor of shape (...)
            Since the last tick [s].
        free_yet : mapping of str to Tensor of bool, of shape (...)
            Of objects that the skill holds, for which robots it does not yet.
        lost : mapping of str to Tensor of bool, of shape (...)
            Of objects that are not seen now, by which robots.
        """
        rests, places = dict(self.rests), dict(frames)
        holding = self._ungiven(holding, free_yet)
        known = {name for name, not_held in free_yet.items() if not bool(not_held.any())}
        for name in known:  # the skill knows where it is
            rests.pop(name, None)
        for name in names - known:
            seen, yet, gone = frames[name], free_yet.get(name, YES), lost.get(name, NO)
            rest = rests.get(name) or Rest.at(seen, joints)
            if rest.seen is not seen:
                rest, holding = self._seen(name, rest, seen, joints, holding, dt, yet & ~gone)
            elif rest.pose is seen:  # it has not moved
                stood = torch.where(gone.unsqueeze(-1), rest.joints, joints)
                rest = replace(rest, joints=stood)
            rests[name] = rest
            places[name] = seen if name in free_yet else rest.pose
        return replace_fields(self, rests=rests), holding, places

    def _ungiven(self, holding: Holding, free_yet: Mapping[str, Tensor]) -> Holding:
        """The skill's holds count again for robots for which they have begun."""
        for name, not_held in free_yet.items():
            rest = self.rests.get(name)
            if rest is not None and rest.found and not bool(not_held.all()):
                holding = holding.clear_override(name, ~not_held)
        return holding

    def _seen(
        self,
        name: str,
        rest: Rest,
        seen: Frame,
        joints: Tensor,
        holding: Holding,
        dt: float | Tensor,
        yet: Tensor,
    ) -> tuple[Rest, Holding]:
        """After a new reading of an object."""
        rest = replace_fields(rest, seen=seen, since=rest.since + dt)
        rest, holding = self._taken(name, rest, joints, holding, dt, yet)
        if rest.found and bool((due := rest.since >= LOST_PERIOD).any()):
            rest, holding = self._lost(name, rest, joints, holding, due, yet)
        return rest, holding

    def _taken(
        self,
        name: str,
        rest: Rest,
        joints: Tensor,
        holding: Holding,
        dt: float | Tensor,
        yet: Tensor,
    ) -> tuple[Rest, Holding]:
        """After a link may have taken an object along, or somebody else moved it."""
        moved = rest.pose.change(rest.seen, MOVED, TURNED)
        free = holding.free(name, moved) & yet
        settled: float | Tensor = min(dt / SETTLING, 1.0) if isinstance(dt, float) else 0.0
        if isinstance(dt, Tensor):
            settled = (dt.to(moved) / SETTLING).clamp(max=1.0)
        rests = free & (moved < 0.1)
        if bool(rests.all()):
            pose = between(rest.pose, rest.seen, settled)
            return replace_fields(rest, pose=pose, joints=joints), holding
        settles, elsewhere, found = rests, torch.zeros_like(rests), rest.found
        if bool((asked := free & ~rests).any()):
            before, now = self.kinematics.state(rest.joints), self.kinematics.state(joints)
            grasps = [rest.seen.seen_from(now.pose(link)) for link in self.kinematics.links]
            changes = [
                rest.pose.seen_from(before.pose(link)).change(grasp, MOVED, TURNED)
                for link, grasp in zip(self.kinematics.links, grasps, strict=True)
            ]
            least, holder = torch.stack(changes).min(0)
            far, alone = moved >= 1, least >= PERHAPS * moved
            held = asked & far & (least < 0.4 * moved)
            elsewhere = asked & far & alone
            settles = rests | (asked & ~far & alone)
            for index, grasp in enumerate(grasps):
                where = held & (holder == index)
                if bool(where.any()):
                    holding = holding.take(name, index, where, rest.pose, grasp)
                    found = True
        share = torch.where(settles, settled, elsewhere.to(moved))
        stood = torch.where((rests | elsewhere).unsqueeze(-1), joints, rest.joints)
        pose = between(rest.pose, rest.seen, share)
        return replace(rest, pose=pose, joints=stood, found=found), holding

    def _lost(
        self,
        name: str,
        rest: Rest,
        joints: Tensor,
        holding: Holding,
        due: Tensor,
        yet: Tensor,
    ) -> tuple[Rest, Holding]:
        """Let go objects that are far from where their links would have them."""
        carried = holding.locate(name, self.kinematics.state(joints))
        far = ~holding.free(name, rest.away) & yet
        far = far & (carried.change(rest.seen, LOST, LOST_TURN) >= 1)
        away = torch.where(due, torch.where(far, rest.away + rest.since, 0.0), rest.away)
        lost = due & (away >= LOST_TIME)
        if bool(lost.any()):
            holding = holding.advance(0.0, joints, {name: rest.seen}, {name: None}, lost)
        pose = choose(lost, rest.seen, rest.pose)
        stood = torch.where(lost.unsqueeze(-1), joints, rest.joints)
        since = rest.since.masked_fill(due, 0.0)
        return replace(rest, pose=pose, joints=stood, away=away, since=since), holding


@dataclass(frozen=True, eq=False)
class Holds:
    """The objects of a batch of robots, and where they were last free; immutable.

    Parameters
    ----------
    holding : Holding
    watch : HoldWatch
        Finds holds that nobody gave.
    first : mapping of str to float
        Start of the first hold of each object in the skill [s].
    given : frozenset of str
        Objects whose holds were given at run time.
    hidden : mapping of str to Tensor of bool, of shape (...)
        Of objects that are not seen now, for which robots that is no reason to stand: a hand
        was at it, or held it since. It is where it was, or where it was let go.
    """

    holding: Holding
    watch: HoldWatch
    first: Mapping[str, float]
    given: frozenset[str] = frozenset()
    hidden: Mapping[str, Tensor] = field(default_factory=dict)

    @classmethod
    def start(cls, skill: Skill, frames: Mapping[str, Frame]) -> Self:
        """Before anything is held, with poses of all objects."""
        holding = Holding.start(skill.kinematics, skill.carried_names, skill.holds, frames)
        first: dict[str, float] = {}
        for hold in holding.holds:
            first[hold.frame] = min(hold.begin, first.get(hold.frame, math.inf))
        return cls(holding, HoldWatch(skill.kinematics), first)

    def of_solids(self, names: Iterable[str]) -> Self:
        """The holds, where these objects are solids among obstacles."""
        objects = tuple(dict.fromkeys((*self.holding.objects, *names)))
        return replace(self, holding=replace(self.holding, objects=objects))

    def advance(
        self,
        time: Tensor,
        joints: Tensor,
        frames: Mapping[str, Frame] | None,
        holds: Mapping[str, str | None] | None,
        dt: float | Tensor,
        inputs: Inputs | None,
    ) -> Self:
        """The next tick.

        Parameters
        ----------
        time : Tensor of shape () or (...)
            In the skill [s].
        joints : Tensor of shape (..., n_joints)
            Measured postures.
        frames : mapping of str to Frame, optional
            Objects that are seen now.
        holds : mapping of str to str or None, optional
            Links that hold objects from now on, None if they are free from now on.
        dt : float or Tensor of shape (...)
            Since the last tick [s].
        inputs : Inputs, optional
            Which objects are seen at each tick, and how late.
        """
        given, watch, holding = self.given.union(holds or ()), self.watch, self.holding
        lost: Mapping[str, Tensor] = {}
        if inputs is not None:
            lost = inputs.lost
            if inputs.poses and not holds:
                now = time.expand(joints.shape[:-1])
                told = self.first.keys() & given
                watch, holding, frames = watch.update(
                    inputs.poses.keys() - told, inputs.frames, joints, holding, dt,
                    {name: now < begin for name, begin in self.first.items()}, lost,
                )  # fmt: skip
        if frames is not None:
            frames = _seen_frames(frames, holding, lost)
        shares = inputs.shares if inputs is not None and holding.held else {}
        holding = holding.advance(time, joints, frames, holds, dt=dt, shares=shares)
        new = replace_fields(self, holding=holding, watch=watch, given=given)
        if not (lost or self.hidden):
            return new
        assert inputs is not None
        return replace(new, hidden=new._hidden(joints, lost, inputs, dt))

    def restarted(self, robots: Tensor, joints: Tensor) -> Self:
        """For some robots a separate skill begins; see :meth:`Holding.restart`."""
        return replace(self, holding=self.holding.restart(robots, joints))

    def released(self, robots: Tensor, joints: Tensor, seen: Mapping[str, Frame]) -> Self:
        """Some robots do something again: they hold nothing, and objects are where they are.

        Parameters
        ----------
        robots : Tensor of bool, of shape (...)
        joints : Tensor of shape (..., n_joints)
            Measured postures [rad or m].
        seen : mapping of str to Frame
            Where objects are seen, or were seen last.
        """
        where = robots.unsqueeze(-1)
        rests = {
            name: replace(
                rest,
                pose=choose(robots, rest.seen, rest.pose),
                joints=torch.where(where, joints, rest.joints),
                away=rest.away.masked_fill(robots, 0.0),
            )
            for name, rest in self.watch.rests.items()
        }
        holding = self.holding.release(robots, seen)
        return replace(self, holding=holding, watch=replace(self.watch, rests=rests))

    def _hidden(
        self, joints: Tensor, lost: Mapping[str, Tensor], inputs: Inputs, dt: float | Tensor
    ) -> dict[str, Tensor]:
        """Of objects that are not seen now, for which robots a hand is the reason."""
        hidden = {}
        for name, gone in lost.items():
            known = self.hidden.get(name, gone & False) | ~self.holding.free(name, gone)
            now = torch.from_numpy(np.asarray(inputs.poses[name].age)) <= dt
            if bool((gone & now & ~known).any()):
                state, place = self.watch.kinematics.state(joints), inputs.frames[name].position
                links = [state.position(link) for link in self.watch.kinematics.links]
                away = torch.stack([(link - place).norm(dim=-1) for link in links])
                known = known | (now & (away.amin(0) < HIDES))
            hidden[name] = gone & known
        return hidden

    def known(self, like: Tensor) -> dict[str, Any]:
        """For which robots (...) it is known where each object is, seen or not."""
        known = {name: ~self.holding.free(name, like[..., 0]) for name in self.holding.held}
        for name, where in self.hidden.items():
            known[name] = where | known.get(name, where)
        return {name: np.asarray(where.numpy(force=True)) for name, where in known.items()}

    def busy(self, like: Tensor) -> Any:
        """Robots (B,) that hold something."""
        busy = self.holding.busy(torch.zeros(like.shape[:-1]))
        return busy.numpy(force=True).reshape(-1)


def _seen_frames(
    frames: Mapping[str, Frame], holding: Holding, lost: Mapping[str, Tensor]
) -> Mapping[str, Frame]:
    """Frames in which objects that were taken, and are not seen, are where they were taken.

    For :meth:`Holding.advance` they then count as not seen.
    """
    seen = dict(frames)
    for name in lost.keys() & seen.keys() & holding.held.keys():
        taken = holding.held[name].taken
        if taken is not None:
            seen[name] = choose(lost[name], taken, seen[name])
    return seen
