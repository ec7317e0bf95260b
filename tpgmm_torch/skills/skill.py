"""The protocol of a skill: what controllers, clocks and rollouts run."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, Protocol, Self

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch import gaussians
from tpgmm_torch.checks.summary import TrainingSummary
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.frames import Frames
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.data.trajectories import Candidate
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.operators.wrench import ExpectedForce
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.posture import PostureSearch
from tpgmm_torch.robots.kinematics import Bounds, Kinematics, RobotState
from tpgmm_torch.skills.gate import Gate

__all__ = ["Skill"]


class Skill(Protocol):
    """A motion that can be run: Gaussian estimates of the joints over time.

    A fitted mixture conditioned on time (:class:`Regression`) is a skill. So are wrappers that
    hold other skills and condition, chain or choose between their estimates. Skills are
    immutable; whatever one remembers from tick to tick is in the skill that :meth:`advance`
    returns. Those who subclass this protocol inherit what is not abstract.
    """

    @property
    def kinematics(self) -> Kinematics:
        """The robot."""
        ...

    @property
    def begin(self) -> float:
        """Start of the skill [s]."""
        ...

    @property
    def end(self) -> float:
        """End of the skill [s]."""
        ...

    @property
    def frame_names(self) -> tuple[str, ...]:
        """Frames that :meth:`estimate` needs."""
        ...

    @property
    def carried_names(self) -> tuple[str, ...]:
        """Those frames that move with a link of the robot while it holds them."""
        return ()

    @property
    def holds(self) -> tuple[Hold, ...]:
        """Intervals in which a link holds an object."""
        return ()

    @property
    def gates(self) -> tuple[Gate, ...]:
        """Times beyond which the skill does not go on until conditions are met, ascending."""
        return ()

    @property
    def motion_bounds(self) -> MotionBounds | None:
        """Bounds of position, speed, acceleration and jerk; None if there are none."""
        return None

    @property
    def time(self) -> Tensor:
        """Time grid of references (T,) [s]."""
        ...

    @property
    def peaks(self) -> tuple[Tensor, Tensor] | None:
        """Largest accelerations and jerks (n_joints,) of the demonstrations, or None."""
        return None

    def command_gaps(self, time: Array) -> tuple[Array, Array] | None:
        """Return what servos need beyond postures at times; None if that is not known.

        Parameters
        ----------
        time : array of shape (B,)
            In the skill [s].

        Returns
        -------
        tuple of two array of shape (B, n_joints), or None
            As :meth:`CommandGaps.at`.
        """
        return None

    @property
    def summary(self) -> TrainingSummary | None:
        """Distance of a situation from the demonstrations; None if that is not known."""
        return None

    @property
    def summaries(self) -> tuple[TrainingSummary, ...]:
        """Those of which one is of the situation: several, until a way is chosen."""
        return () if self.summary is None else (self.summary,)

    def estimate(
        self, time: Tensor, state: Tensor | RobotState, frames: Frames, bounds: Bounds = None
    ) -> Estimate:
        """Estimate the joints at a time, given the state q_{t-1} and the objects' poses.

        Parameters
        ----------
        time : Tensor of shape () or (...)
            In the skill, for all robots or of each one [s].
        state : Tensor of shape (..., n_joints), or RobotState
            Joints [rad or m], or the state with the objects that robots hold.
        frames : mapping of str to Frame
            Of shapes that broadcast with the batch.
        bounds : tuple of two Tensor of shape (..., n_joints), optional
            The lowest and the highest joints allowed [rad or m].

        Raises
        ------
        DataError, ShapeError, UnknownNameError
            If frames are missing or do not fit the robots, or there is no finite estimate.
        """
        ...

    def candidates(
        self, time: Tensor, state: RobotState, frames: Frames, estimate: Estimate
    ) -> tuple[Candidate, ...]:
        """Estimate the joints by each operator alone; none by default.

        Parameters
        ----------
        time, state, frames
            As for :meth:`estimate`.
        estimate : Estimate
            That it made of them.
        """
        return ()

    def expected_forces(self, time: Tensor) -> tuple[ExpectedForce, ...]:
        """Expect forces that links exert at a time; none by default.

        Parameters
        ----------
        time : Tensor of shape () or (...)
            In the skill, for all robots or of each one [s].
        """
        return ()

    def log_likelihood(
        self, times: Tensor, state: RobotState, frames: Frames, window: slice = slice(None)
    ) -> Tensor:
        """Log-density of observed robots at each time, up to a constant of each robot.

        Parameters
        ----------
        times : Tensor of shape (G,)
            An ascending grid from the beginning of the skill to its end [s].
        state : RobotState
            Of B robots, or of one without a batch.
        frames : mapping of str to Frame
            Of shapes () or (B,).
        window : slice, optional
            The part of the grid that is asked for.

        Returns
        -------
        Tensor of shape (B, G)
            Of the times in the window; zeros for robots with an observation that is not finite.
        """
        ...

    def restrict_to(self, names: frozenset[str]) -> Skill | None:
        """Return the skill of those operators whose frames and links are observed.

        Parameters
        ----------
        names : frozenset of str
            The frames and links that are observed.

        Returns
        -------
        Skill or None
            None if no operator is left.
        """
        return self

    def posture_search(self) -> PostureSearch | None:
        """Search for the nearest posture where an estimate cannot be followed, or None."""
        return None

    def start(self, joints: Tensor, frames: Frames) -> Skill:
        """Return the skill for robots that begin with these postures and objects.

        Parameters
        ----------
        joints : Tensor of shape (..., n_joints)
        frames : mapping of str to Frame
        """
        return self

    def of_robots(self, robots: Tensor) -> Skill:
        """Return the skill for some robots of the batch.

        Parameters
        ----------
        robots : Tensor of bool of the batch shape
        """
        return self

    def advance(self, estimate: Estimate) -> Skill:
        """Return the skill for the next tick, with what it remembers of its last estimate.

        Parameters
        ----------
        estimate : Estimate
            What :meth:`estimate` returned at this tick.
        """
        after: Skill | None = estimate.after
        return self if after is None else after


class CompositeSkill(Skill):
    """A skill made of others of one robot, and mixed of them by their weights.

    Their state is handed on: where one of them starts, advances or is of fewer robots,
    that of which it is a part does.

    Attributes
    ----------
    skills : tuple of Skill
    """

    skills: tuple[Skill, ...]

    @property
    def representative(self) -> Skill:
        """The skill whose holds, gates, bounds and demonstrations stand for all."""
        return self.skills[0]

    @property
    def kinematics(self) -> Kinematics:
        """See :attr:`Skill.kinematics`."""
        return self.skills[0].kinematics

    @property
    def begin(self) -> float:
        """See :attr:`Skill.begin`."""
        return self.skills[0].begin

    @property
    def end(self) -> float:
        """See :attr:`Skill.end`."""
        return self.skills[0].end

    @property
    def time(self) -> Tensor:
        """See :attr:`Skill.time`."""
        return self.skills[0].time

    @property
    def holds(self) -> tuple[Hold, ...]:
        """See :attr:`Skill.holds`."""
        return self.representative.holds

    @property
    def gates(self) -> tuple[Gate, ...]:
        """See :attr:`Skill.gates`."""
        return self.representative.gates

    @property
    def motion_bounds(self) -> MotionBounds | None:
        """See :attr:`Skill.motion_bounds`."""
        return self.representative.motion_bounds

    @property
    def peaks(self) -> tuple[Tensor, Tensor] | None:
        """See :attr:`Skill.peaks`."""
        return self.representative.peaks

    def command_gaps(self, time: Array) -> tuple[Array, Array] | None:
        """See :meth:`Skill.command_gaps`: those of the skills, mixed by their shares."""
        at = torch.from_numpy(time).to(self.kinematics.lower)
        known = [
            one.command_gaps(as_array(self.time_of(k, at))) for k, one in enumerate(self.skills)
        ]
        if all(one is None for one in known):
            return None
        none = np.zeros((2, len(time), self.kinematics.n_joints))
        several = np.stack([none if one is None else np.stack(one) for one in known])
        shares = as_array(self.shares(at).expand(len(time), -1)).T
        gap, extent = (several * shares[:, None, :, None]).sum(0)
        return gap, extent

    @property
    def summary(self) -> TrainingSummary | None:
        """See :attr:`Skill.summary`."""
        return self.representative.summary

    @property
    def summaries(self) -> tuple[TrainingSummary, ...]:
        """See :attr:`Skill.summaries`."""
        known = super().summaries
        return known or tuple(found for one in self.skills for found in one.summaries)

    @property
    def frame_names(self) -> tuple[str, ...]:
        """See :attr:`Skill.frame_names`."""
        return tuple(dict.fromkeys(name for one in self.skills for name in one.frame_names))

    @property
    def carried_names(self) -> tuple[str, ...]:
        """See :attr:`Skill.carried_names`."""
        return tuple(dict.fromkeys(name for one in self.skills for name in one.carried_names))

    def shares(self, time: Tensor) -> Tensor:
        """Return the weights (..., n_skills) of the skills at times (...), or of robots."""
        raise NotImplementedError

    def leading(self, times: Tensor) -> Tensor:
        """Return the skill with the largest share at times (T,), as (T,) or (..., 1)."""
        return self.shares(times).argmax(-1)

    def time_of(self, index: int, time: Tensor) -> Tensor:
        """Return a time of this skill on the clock of one of its skills."""
        return time

    def with_skills(self, skills: Iterable[Skill]) -> Self:
        """Replace the skills, if they are others."""
        others = tuple(skills)
        if all(one is other for one, other in zip(self.skills, others, strict=True)):
            return self
        whole: Any = self
        made: Self = replace(whole, skills=others)
        return made

    def start(self, joints: Tensor, frames: Frames) -> Self:
        """See :meth:`Skill.start`."""
        return self.with_skills(one.start(joints, frames) for one in self.skills)

    def of_robots(self, robots: Tensor) -> Self:
        """See :meth:`Skill.of_robots`."""
        return self.with_skills(one.of_robots(robots) for one in self.skills)

    def estimate(
        self, time: Tensor, state: Tensor | RobotState, frames: Frames, bounds: Bounds = None
    ) -> Estimate:
        """See :meth:`Skill.estimate`; the activation is that of the skills."""
        shares, skills = self.shares(time.to(self.kinematics.lower)), list(self.skills)
        active = shares.reshape(-1, len(self.skills)).any(0).nonzero()[:, 0].tolist()
        several = []
        for k in active:
            one = skills[k].estimate(self.time_of(k, time), state, frames, bounds)
            several.append(one)
            skills[k] = skills[k].advance(one)
        after = self.with_skills(skills)
        if len(active) == 1:
            return replace(several[0], activation=shares, candidates=(), after=after)
        batch = gaussians.common_shape(
            shares.shape[:-1], *(one.joints.shape[:-1] for one in several)
        )
        shares = shares.expand(*batch, -1)
        means = torch.stack([one.joints.expand(*batch, -1) for one in several], -2)
        covariances = torch.stack(
            [one.covariance.expand(*batch, *one.covariance.shape[-2:]) for one in several], -3
        )
        mean, covariance = gaussians.moment_match(shares[..., active], means, covariances)
        return Estimate(mean, covariance, shares, after=after)

    def expected_forces(self, time: Tensor) -> tuple[ExpectedForce, ...]:
        """See :meth:`Skill.expected_forces`; of one operator, the mean of the skills."""
        time = time.to(self.kinematics.lower)
        shares, found = self.shares(time), dict[Any, ExpectedForce]()
        for k, skill in enumerate(self.skills):
            weight = shares[..., k]
            for one in skill.expected_forces(self.time_of(k, time)):
                part = one.scale(weight)
                before = found.get(one.operator)
                found[one.operator] = part if before is None else before.plus(part)
        return tuple(found.values())

    def log_likelihood(
        self, times: Tensor, state: RobotState, frames: Frames, window: slice = slice(None)
    ) -> Tensor:
        """See :meth:`Skill.log_likelihood`: of the skill with the largest share."""
        each = torch.stack(
            [
                one.log_likelihood(self.time_of(k, times), state, frames, window)
                for k, one in enumerate(self.skills)
            ],
            -1,
        )
        own = self.leading(times[window]).to(each.device)
        return each.gather(-1, own.expand(each.shape[:-1]).unsqueeze(-1)).squeeze(-1)
