"""Seeing that a robot carries something, of which nobody told."""

from __future__ import annotations

import math
from collections.abc import Mapping, Set
from dataclasses import dataclass, field, replace
from typing import Self

import torch
from torch import Tensor

from tpgmm_torch.control.holding import (
    MOVED,
    PERHAPS,
    SETTLING,
    TURNED,
    Holding,
    between,
    choose,
)
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["HoldWatch", "Rest"]

#: What moved by less rests.
RESTING = 0.1
#: It moves with a link if its pose there changes by less than this share of the motion.
WITH = 0.4
#: A link has lost what is so far from where it would have it [m], [rad], for so long [s].
LOST, LOST_TURN, LOST_TIME = 0.05, math.radians(25), 0.3
#: How often that is looked at [s].
LOOK = 0.1


@dataclass(frozen=True, eq=False)
class Rest:
    """Where an object rested.

    Parameters
    ----------
    seen, pose : Frame
        As it was seen last, and where it rested.
    joints : Tensor of shape (..., n_joints)
        Where the robots stood when it rested last [rad or m].
    away : Tensor of shape (...)
        For how long it is far from where its link would have it [s].
    since : float or Tensor of shape (...)
        The last look at that [s].
    """

    seen: Frame
    pose: Frame
    joints: Tensor
    away: Tensor
    since: float | Tensor = 0.0


@dataclass(frozen=True, eq=False)
class HoldWatch:
    """What objects do when robots move: finds holds of which nobody told.

    An object that has moved by 1 cm (or turned by 5 degrees) from where it rested, while its
    pose in a link changed by less than 0.4 of that, is held by that link since it rested. Until
    that is clear it is taken to be where it rested: hands that follow what they carry would
    run away with it. One that moved otherwise was moved by somebody else. What was found to be
    held is free again once it is 5 cm from where the link would have it for 0.3 s.

    An object that the skill holds later is taken to be where it is seen, and only watched for a
    hand that takes it along too early; from the skill's own time on its hold counts again.

    Parameters
    ----------
    kinematics : Kinematics
    rests : mapping of str to Rest
        Of the objects that are seen at each tick.
    found : frozenset of str
        Objects whose holds were found here.
    """

    kinematics: Kinematics
    rests: Mapping[str, Rest] = field(default_factory=dict)
    found: frozenset[str] = frozenset()

    def look(
        self,
        names: Set[str],
        frames: Mapping[str, Frame],
        joints: Tensor,
        holding: Holding,
        dt: float | Tensor,
        free_yet: Mapping[str, Tensor],
    ) -> tuple[Self, Holding, dict[str, Frame]]:
        """What is held after one more look, and where objects are taken to be.

        Parameters
        ----------
        names : set of str
            Objects that are seen at each tick.
        frames : mapping of str to Frame
            Where they are seen, of the batch's shape.
        joints : Tensor of shape (..., n_joints)
            Where the robots stand [rad or m].
        holding : Holding
            What is known to be held.
        dt : float or Tensor of shape (...)
            Since the last look [s].
        free_yet : mapping of str to Tensor of bool, of shape (...)
            Of objects that the skill holds, for which robots it does not yet.
        """
        rests, found, places = dict(self.rests), self.found, dict(frames)
        for name, not_held in free_yet.items():
            if name in found and not bool(not_held.all()):
                holding = holding.ungiven(name, ~not_held)
            if not bool(not_held.any()):  # the skill knows where it is
                found, names = found - {name}, names - {name}
                rests.pop(name, None)
        for name in names:
            seen, rest, yet = frames[name], rests.get(name), free_yet.get(name, True)
            if rest is None:
                rests[name] = Rest(seen, seen, joints, joints.new_zeros(joints.shape[:-1]))
            elif rest.seen is not seen:
                rest = replace(rest, seen=seen, since=rest.since + dt)
                rest, holding, taken = self._taken(name, rest, joints, holding, dt, yet)
                found = found | {name} if taken else found
                due = rest.since >= LOOK
                if name in found and (due if isinstance(due, bool) else bool(due.any())):
                    rest, holding = self._lost(name, rest, joints, holding, due, yet)
                rests[name], places[name] = rest, rest.pose
            elif rest.pose is seen:  # it has not moved
                rests[name] = replace(rest, joints=joints)
            else:
                places[name] = rest.pose
            if name in free_yet:
                places[name] = seen
        return replace(self, rests=rests, found=found), holding, places

    def _taken(
        self,
        name: str,
        rest: Rest,
        joints: Tensor,
        holding: Holding,
        dt: float | Tensor,
        yet: bool | Tensor,
    ) -> tuple[Rest, Holding, bool]:
        """Whether a link has taken an object along, or somebody else has moved it."""
        moved = rest.pose.change(rest.seen, MOVED, TURNED)
        free = holding.free(name, moved) & yet
        rests = free & (moved < RESTING)
        settles, held, elsewhere = rests, torch.zeros_like(rests), torch.zeros_like(rests)
        if bool((asked := free & ~rests).any()):
            before, now = self.kinematics.state(rest.joints), self.kinematics.state(joints)
            grasps = [rest.seen.seen_from(now.pose(link)) for link in self.kinematics.links]
            changes = torch.stack(
                [
                    rest.pose.seen_from(before.pose(link)).change(grasp, MOVED, TURNED)
                    for link, grasp in zip(self.kinematics.links, grasps, strict=True)
                ]
            )
            least, holder = changes.min(0)
            far, alone = moved >= 1, least >= PERHAPS * moved
            held = asked & far & (least < WITH * moved)
            elsewhere = asked & far & alone
            settles = rests | (asked & ~far & alone)
            for index, grasp in enumerate(grasps):
                where = held & (holder == index)
                if bool(where.any()):
                    holding = holding.taken(name, index, where, rest.pose, grasp)
        settled = dt / SETTLING
        settled = settled.clamp(max=1.0) if isinstance(settled, Tensor) else min(1.0, settled)
        share = torch.where(settles, settled, elsewhere.to(moved))
        stood = torch.where((rests | elsewhere).unsqueeze(-1), joints, rest.joints)
        pose = between(rest.pose, rest.seen, share)
        return replace(rest, pose=pose, joints=stood), holding, bool(held.any())

    def _lost(
        self,
        name: str,
        rest: Rest,
        joints: Tensor,
        holding: Holding,
        due: bool | Tensor,
        yet: bool | Tensor,
    ) -> tuple[Rest, Holding]:
        """Let go what is not where its link would have it, of robots that are due."""
        carried = holding.carried(name, self.kinematics.state(joints))
        due = torch.as_tensor(due, device=joints.device)
        far = ~holding.free(name, rest.away) & yet
        far = far & (carried.change(rest.seen, LOST, LOST_TURN) >= 1)
        away = torch.where(due, torch.where(far, rest.away + rest.since, 0.0), rest.away)
        lost = due & (away >= LOST_TIME)
        if bool(lost.any()):
            holding = holding.advance(0.0, joints, {name: rest.seen}, {name: None}, lost)
        pose = choose(lost, rest.seen, rest.pose)
        stood = torch.where(lost.unsqueeze(-1), joints, rest.joints)
        since = rest.since.masked_fill(due, 0.0) if isinstance(rest.since, Tensor) else 0.0
        return replace(rest, pose=pose, joints=stood, away=away, since=since), holding
