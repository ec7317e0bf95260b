"""A skill that is done in several ways, of which the situation decides."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch.checks.summary import TrainingSummary
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.frames import Frames
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.robots.kinematics import Bounds, RobotState
from tpgmm_torch.skills.skill import CompositeSkill

__all__ = ["Ways"]

#: Instants of a coarse reproduction that shows whether a way can be gone.
INSTANTS = 40


@dataclass(frozen=True)
class WayChoice:
    """Which way suits a situation, and why.

    Parameters
    ----------
    way : int
    probabilities : array of shape (n_ways,)
        ``p_k ~ weight_k exp(-novelty_k^2 / 2 - misfit_k)``.
    novelty : array of shape (n_ways,)
        Of the situation to each way; 1 is that of its least usual demonstration.
    misfit : array of shape (n_ways,)
        By how much less likely the way's reproduction is, in its worst moment, than any of its
        demonstrations ever was [nats]: large where the arm does not reach, or stands at its
        limits.
    """

    way: int
    probabilities: Array
    novelty: Array
    misfit: Array

    def __str__(self) -> str:
        others = ", ".join(
            f"way {k}: p = {p:.2g}, novelty {n:.2g}, misfit {m:.2g}"
            for k, (p, n, m) in enumerate(
                zip(self.probabilities, self.novelty, self.misfit, strict=True)
            )
        )
        return f"way {self.way} ({others})"


@dataclass(frozen=True, eq=False)
class Ways(CompositeSkill):
    """Several ways of one skill; each robot goes the likeliest in its situation.

    The mean of passing an obstacle on the left and on the right goes through it: each way is a
    skill of its own. One is chosen by how often it was shown, how like the situation is to
    those it was shown in, and whether the robot can do it there (:meth:`choose`).

    Parameters
    ----------
    skills : sequence of Regression
        Of one robot, with one beginning and end.
    weights : sequence of float, optional
        Share of the demonstrations of each; equal by default.
    limits : sequence of float, optional
        The largest surprise of the demonstrations of each [nats],
        :meth:`Regression.surprise`; 0 by default.
    chosen : Tensor of shape (...), optional
        The way of each robot, as :meth:`Skill.start` chooses it.

    Raises
    ------
    DataError
        If they do not fit together.
    """

    skills: tuple[Regression, ...]
    weights: tuple[float, ...] = ()
    limits: tuple[float, ...] = ()
    chosen: Tensor | None = None

    def __post_init__(self) -> None:
        skills, count = tuple(self.skills), len(self.skills)
        weights = tuple(map(float, self.weights)) or (1.0 / max(count, 1),) * count
        limits = tuple(map(float, self.limits)) or (0.0,) * count
        if not count or not count == len(weights) == len(limits):
            raise DataError(
                f"{count} ways with {len(weights)} weights and {len(limits)} limits: there is "
                "one of each for every way"
            )
        if min(weights) <= 0 or not all(map(math.isfinite, (*weights, *limits))):
            raise DataError(
                f"weights and limits are finite, weights positive: got {weights} and {limits}"
            )
        for one in skills:
            if one.kinematics.joint_names != skills[0].kinematics.joint_names:
                raise DataError("the ways are of different robots")
        vars(self).update(skills=skills, weights=weights, limits=limits)

    @property
    def summary(self) -> TrainingSummary | None:
        """See :attr:`Skill.summary`; None until the way is chosen."""
        return None if self.chosen is None else self.representative.summary

    @property
    def representative(self) -> Regression:
        """The way of all robots, or of the first."""
        return self.skills[0 if self.chosen is None else int(self.chosen.flatten()[0])]

    def start(self, joints: Tensor, frames: Frames) -> Self:
        """Choose the way of each robot.

        Parameters
        ----------
        joints : Tensor of shape (..., n_joints)
            Start postures.
        frames : mapping of str to Frame
            Of shapes that broadcast with the batch.
        """
        ways = torch.tensor([one.way for one in self.choose(joints, frames)])
        return replace(self, chosen=ways.reshape(joints.shape[:-1]))

    def of_robots(self, robots: Tensor) -> Self:
        """See :meth:`Skill.of_robots`."""
        some = super().of_robots(robots)
        if some.chosen is None or some.chosen.ndim == 0:
            return some
        return replace(some, chosen=some.chosen[robots])

    def choose(self, joints: Any, frames: Frames) -> list[WayChoice]:
        """Return the way for each robot, and why; each way is tried on a coarse grid of time.

        Parameters
        ----------
        joints : array-like of shape (..., n_joints)
        frames : mapping of str to Frame

        Returns
        -------
        list of WayChoice
            Of all robots.
        """
        starts = self.kinematics.joint_tensor(joints)
        batch = starts.shape[:-1]
        rows = starts.reshape(-1, starts.shape[-1])
        poses = {name: frame.to(rows) for name, frame in frames.items()}
        here = {n: f.expand(batch).flatten() if batch else f for n, f in poses.items()}
        with torch.inference_mode():
            misfits = [self._misfit(k, rows, here) for k in range(len(self.skills))]
        novelties = [_novelty(one, rows, here) for one in self.skills]
        misfit, novelty = np.stack(misfits, -1), np.stack(novelties, -1)
        score = np.log(self.weights) - novelty**2 / 2 - misfit
        shares = np.exp(score - score.max(1, keepdims=True))
        shares /= shares.sum(1, keepdims=True)
        parts = zip(score.argmax(1).tolist(), shares, novelty, misfit, strict=True)
        return [WayChoice(*part) for part in parts]

    def _misfit(self, way: int, joints: Tensor, frames: Frames) -> Array:
        """Compute how much less likely a reproduction is than demonstrations, (B,) [nats]."""
        skill, worst = self.skills[way], torch.zeros(len(joints), dtype=torch.float64)
        bounds = skill.kinematics.lower, skill.kinematics.upper
        for now in torch.linspace(skill.begin, skill.end, INSTANTS).to(joints):
            joints = skill.estimate(now, joints, frames, bounds).joints
            worst = worst.maximum(skill.surprise(now, joints, frames).double())
        return as_array((worst - self.limits[way]).clamp(min=0.0))

    def estimate(
        self, time: Tensor, state: Tensor | RobotState, frames: Frames, bounds: Bounds = None
    ) -> Estimate:
        """See :meth:`Skill.estimate`: each robot's by its way."""
        if self.chosen is None:
            joints = state.joints if isinstance(state, RobotState) else state
            return self.start(joints, frames).estimate(time, state, frames, bounds)
        return super().estimate(time, state, frames, bounds)

    def shares(self, time: Tensor) -> Tensor:
        """1 (..., n_ways) for the way of each robot, 0 for others; the first if unknown."""
        ways = torch.zeros((), dtype=torch.long) if self.chosen is None else self.chosen
        shares = torch.eye(len(self.skills), dtype=time.dtype, device=time.device)
        return shares[ways.to(time.device)]

    def leading(self, times: Tensor) -> Tensor:
        """Return the way of each robot, (..., 1): at all times the same."""
        return super().leading(times).unsqueeze(-1)

    def time_of(self, index: int, time: Tensor) -> Tensor:
        """Return a time of the skill, on the clock of one of its ways."""
        own = self.skills[index]
        share = (time - self.begin) / (self.end - self.begin)
        return own.begin + share * (own.end - own.begin)


def _novelty(skill: Regression, joints: Tensor, frames: Frames) -> Array:
    """Novelty (B,) of situations to one way."""
    if skill.summary is None:
        return np.zeros(len(joints))
    return np.broadcast_to(skill.summary.novelty(joints, frames), len(joints))
