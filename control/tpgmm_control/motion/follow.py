"""Stage *follow*: the only place that writes references, within the bounds at every tick."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from torch import Tensor

from tpgmm_control.motion.follower import Follower, Seconds
from tpgmm_torch.motion.motion_bounds import MotionBounds


@dataclass(frozen=True, eq=False)
class Following:
    """References of a batch of robots; immutable.

    The first reference is where the robots stand. Without bounds each wanted posture is the
    next reference.

    Parameters
    ----------
    bounds : MotionBounds, optional
    reference, velocity : Tensor of shape (..., n_joints)
    follower : Follower, optional
        None without bounds, and before the first step of robots that begin in motion.
    wanted : Tensor of shape (..., n_joints)
        The posture that was wanted last.
    lost : Tensor of bool of shape (...), optional
        Robots without a finite posture, which come to rest.
    """

    bounds: MotionBounds | None
    reference: Tensor
    velocity: Tensor
    follower: Follower | None
    wanted: Tensor
    lost: Tensor | None = None

    @classmethod
    def start(cls, bounds: MotionBounds | None, joints: Tensor, at_rest: bool) -> Self:
        """Where robots stand (..., n_joints)."""
        follower = None if bounds is None or not at_rest else Follower.at(bounds, joints)
        return cls(bounds, joints, torch.zeros_like(joints), follower, joints)

    def advance(
        self,
        wanted: Tensor,
        goal: Tensor,
        dt: Seconds,
        halted: Tensor | None,
        late: Tensor | None,
        first: bool,
        fitting: Follower | None = None,
    ) -> Self:
        """The next references.

        Parameters
        ----------
        wanted : Tensor of shape (..., n_joints)
            What the skill wants.
        goal : Tensor of shape (..., n_joints)
            Where the references go: the same, but for robots that are waited for.
        dt : float or array of shape (...)
            Duration of the tick [s].
        halted, late : Tensor of bool of shape (...), optional
            Robots that come to rest, and robots for which no time has passed.
        first : bool
            Whether it is the first tick.
        fitting : Follower, optional
            The next one towards ``wanted``, if it is known.
        """
        if self.bounds is None or first:  # the first reference is where robots stand
            new = replace(self, wanted=wanted, lost=None)
            within = self.bounds is not None
            return new if within else new._unbounded(goal, dt, halted, late, first)
        if halted is not None:  # what is not finite brings a robot to rest
            goal = torch.where(halted.unsqueeze(-1), torch.nan, goal)
        last = self.follower or self._moving(self.bounds, goal, dt)
        follower = fitting
        if follower is None or follower.aim is not goal:
            follower = last.advance(goal, dt)
        lost = None if follower.reference is goal else ~goal.isfinite().all(-1)
        if late is not None:
            follower = follower.undone(late, last)
        moved = follower.reference, follower.velocity, follower, wanted, lost
        return type(self)(self.bounds, *moved)

    def _unbounded(
        self, goal: Tensor, dt: Seconds, halted: Tensor | None, late: Tensor | None, first: bool
    ) -> Self:
        """Each goal is the next reference."""
        for still in (halted, late):
            if still is not None:
                goal = torch.where(still.unsqueeze(-1), self.reference, goal)
        velocity = self.velocity if first else (goal - self.reference) / _column(dt, goal)
        return replace(self, reference=goal, velocity=velocity)

    def _moving(self, bounds: MotionBounds, goal: Tensor, dt: Seconds) -> Follower:
        """A follower that moves as the skill begins; a gap to there is no speed."""
        moving = (goal - self.wanted) / _column(dt, goal)
        return Follower.at(
            bounds, self.reference, moving.clamp(-bounds.velocity, bounds.velocity)
        )


def _column(dt: Seconds, like: Tensor) -> float | Tensor:
    """Durations for the joints of each robot."""
    return torch.as_tensor(dt).to(like).unsqueeze(-1) if isinstance(dt, np.ndarray) else dt
