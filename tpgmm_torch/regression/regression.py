"""Gaussian mixture regression in joint space: Algorithm 1's movement synthesis.

Every component of every operator is first conditioned on time, which commutes with the affine
map (1) and with the product (2) and does not depend on the robot; what is left to do at each
tick is to linearise the operators at q_{t-1}, to project the conditionals, to fuse them, and to
mix the components.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch import gaussians, quaternions
from tpgmm_torch.checks.summary import TrainingSummary
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.frames import Frames
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.data.trajectories import Candidate
from tpgmm_torch.motion.command_gaps import CommandGaps
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.operators import Linearization, Operator, Stack
from tpgmm_torch.operators.base import carried_objects, frame_names, leaves, of_joints
from tpgmm_torch.operators.wrench import ExpectedForce, Wrench
from tpgmm_torch.regression.conditionals import (
    ActiveComponents,
    Components,
    Conditionals,
    TimeMarginals,
    predictive_scale,
)
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.fusion import KalmanUpdate, Projection
from tpgmm_torch.regression.fusion_forms import CovarianceFusion, Fusion, InformationFusion
from tpgmm_torch.regression.joint_limits import keep_within
from tpgmm_torch.regression.one_robot import OneRobot
from tpgmm_torch.regression.posture import PostureSearch, Residual
from tpgmm_torch.regression.prior import prior_widths
from tpgmm_torch.regression.time_likelihood import TimeLikelihood
from tpgmm_torch.robots.kinematics import Kinematics, RobotState
from tpgmm_torch.training.learning import Learned

__all__ = ["Regression"]

#: Robots at a time on a processor: few enough that its cache holds what is between the
#: operations, and that this memory is not given back and asked for again each time.
PART = 256

#: The covariance of an operator, as a share of what it would be one priority below.
STRICT = 1e-4


@dataclass(frozen=True, eq=False)
class Regression:
    """A fitted mixture conditioned on time: a :class:`~tpgmm_torch.skills.skill.Skill`.

    Parameters
    ----------
    kinematics : Kinematics
    operators : sequence of Operator
    conditionals : sequence of Conditionals
        The components' Gaussians given time, one for each operator.
    log_weights : Tensor of shape (K,)
        Logarithms of the mixing coefficients pi_i.
    fusion : InformationFusion or CovarianceFusion
        The form of the product (2), and its settings.
    n_samples : float, optional
        Of each component, if joints shall give way by what few of them leave unknown, see
        :attr:`scaled_conditionals`.
    begin, end : float
        Start and end of the skill [s].
    holds : tuple of Hold
        Intervals in which a link holds an object.
    motion_bounds : MotionBounds, optional
        Of position, speed, acceleration and jerk.
    peaks : tuple of two Tensor of shape (n_joints,), optional
        Accelerations [rad/s^2] and jerks [rad/s^3] of the demonstrations.
    summary : TrainingSummary, optional
        Distance of a situation from the demonstrations.
    time : Tensor of shape (T,), optional
        Time grid of a typical demonstration [s].
    gaps : CommandGaps, optional
        What servos need beyond postures.
    """

    kinematics: Kinematics
    operators: Sequence[Operator]
    conditionals: Sequence[Conditionals]
    log_weights: Tensor
    fusion: Fusion = field(default_factory=InformationFusion)
    n_samples: float | None = None
    begin: float = -math.inf
    end: float = math.inf
    holds: tuple[Hold, ...] = ()
    motion_bounds: MotionBounds | None = None
    peaks: tuple[Tensor, Tensor] | None = None
    summary: TrainingSummary | None = None
    time: Any = None
    gaps: CommandGaps | None = None

    @classmethod
    def of(cls, learned: Learned, fusion: Fusion, *, moderated: bool) -> Self:
        """Return a learned mixture, conditioned on time (eqs 1 to 3).

        Parameters
        ----------
        learned : Learned
        fusion : InformationFusion or CovarianceFusion
        moderated : bool
            Whether joints give way by what the demonstrations leave unknown.
        """
        mixture, kinematics = learned.mixture, learned.kinematics
        bounded = not kinematics.quaternion_starts
        return cls(
            kinematics,
            learned.operators,
            list(map(Conditionals.of, mixture.means_, mixture.covariances_)),
            mixture.weights_.log(),
            fusion=fusion,
            n_samples=learned.n_demonstrations if moderated else None,
            begin=float(learned.time[0]),
            end=float(learned.time[-1]),
            holds=learned.holds,
            motion_bounds=MotionBounds.of(kinematics, learned.peaks) if bounded else None,
            peaks=learned.peaks,
            summary=learned.summary,
            time=learned.time,
            gaps=learned.gaps,
        )

    def estimate(
        self,
        time: Tensor,
        state: Tensor | RobotState,
        frames: Frames,
        bounds: tuple[Tensor, Tensor] | None = None,
        *,
        candidates: bool = False,
    ) -> Estimate:
        """See :meth:`Skill.estimate`; with each operator's own estimate, if ``candidates``.

        Many robots run part by part, of those that are at about the same time: few components
        count for them.
        """
        if candidates:
            state = self._state(state)
        found = None if candidates else self._estimate_one(time, state, frames)
        if found is None:
            found = self._estimate_many(time, state, frames)
        found = keep_within(found, bounds)
        if candidates:
            own = self.candidates(time, self._state(state), frames, found)
            found = replace(found, candidates=own)
        return found

    def _estimate_one(
        self, time: Tensor, state: Tensor | RobotState, frames: Frames
    ) -> Estimate | None:
        """Estimate a single robot in numpy; None where that does not serve."""
        if time.ndim or (one := self._one_robot) is None:
            return None
        return one(self._components_at(time), time, state, frames)

    def _estimate_many(
        self, time: Tensor, state: Tensor | RobotState, frames: Frames
    ) -> Estimate:
        joints = state.joints if isinstance(state, RobotState) else state
        poses = {name: frames[name] for name in self.frame_names if name in frames}
        shapes = [joints.shape[:-1], *(pose.batch_shape for pose in poses.values())]
        batch = gaussians.common_shape(*shapes, *([time.shape] if time.ndim else []))
        if batch.numel() <= PART or time.is_cuda:
            return self._estimate_together(time, state, frames)
        return self._in_parts(batch, time, state, poses)

    def fuse(
        self, components: Components, time: Tensor, state: RobotState, frames: Frames
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Eqs (1), (2) and regression: the mixture of some components, fused, given time.

        Returns
        -------
        joints : Tensor of shape (..., n_joints)
        covariance : Tensor of shape (..., n_joints, n_joints)
        weights : Tensor of shape (..., A)
            Mixing weights h_i of these components.
        """
        if self._update is not None:
            [stacked] = components.conditionals
            steps, covariances = self._update(stacked, time, state, frames)
            log_h = self._log_activation(components, time)
        else:
            sums = self._sum(components, time, state, frames)
            steps, covariances = gaussians.from_information(sums[0], sums[1][..., 0])
            if self.fusion.activation == "time":
                log_h = self._log_activation(components, time)
            else:
                log_h = self._product_activation(components, time, sums)
        weights = torch.softmax(log_h, -1)
        step, covariance = gaussians.moment_match(weights, steps, covariances)
        return state.joints + step, covariance, weights

    def expect(self, operator: int, time: Tensor) -> Tensor:
        """Local coordinates (T, D_j) that one operator expects at times of shape (T,)."""
        means = self.conditionals[operator].at(time)
        return (self.weights_at(time).unsqueeze(-2) @ means).squeeze(-2)

    def weights_at(self, time: Tensor) -> Tensor:
        """Mixing weights h_i (..., K) at times of shape (...)."""
        return torch.softmax(self.marginals.log_activation(time.unsqueeze(-1)), -1)

    def expected_forces(self, time: Tensor) -> tuple[ExpectedForce, ...]:
        """Expect a force for each :class:`Wrench`; see :meth:`Skill.expected_forces`."""
        first, found = len(self._of_joints[0]), []
        pairs = zip(self.operators[first:], self.conditionals[first:], strict=True)
        for operator, one in pairs:
            assert isinstance(operator, Wrench)
            parts = self.weights_at(time), one.at(time), one.covariance
            mean, covariance = gaussians.moment_match(*parts)
            share = mean[..., -1].clamp(0.0, 1.0)
            moments = mean[..., :-1], covariance[..., :-1, :-1]
            found.append(ExpectedForce(operator, *moments, share))
        return tuple(found)

    def log_likelihood(
        self, times: Tensor, state: RobotState, frames: Frames, window: slice = slice(None)
    ) -> Tensor:
        """Log-density of observed robots at times; see :meth:`Skill.log_likelihood`."""
        key = times.numpy(force=True).tobytes()
        if key not in self._likelihoods:
            parts = self.kinematics, *self._of_joints, self.marginals
            with torch.inference_mode(False):
                self._likelihoods[key] = TimeLikelihood(*parts, times)
        with torch.inference_mode():
            return torch.from_numpy(self._likelihoods[key](state, frames, window))

    def command_gaps(self, time: Array) -> tuple[Array, Array] | None:
        """Return what servos need beyond postures; see :meth:`Skill.command_gaps`."""
        return None if self.gaps is None else self.gaps.at(time)

    def restrict_to(self, names: frozenset[str]) -> Regression | None:
        """Return the mixture of observed operators; see :meth:`Skill.restrict_to`.

        Of a stack of operators, those of which all frames and links are observed are kept.
        """
        if names not in self._restrictions:
            self._restrictions[names] = self._restrict_to(names)
        return self._restrictions[names]

    def _restrict_to(self, names: frozenset[str]) -> Regression | None:
        pairs = zip(self.operators, self.conditionals, strict=True)
        every = enumerate(self._part(operator, one, names) for operator, one in pairs)
        kept = {index: part for index, part in every if part is not None}
        operators, fusion = tuple(operator for operator, _ in kept.values()), self.fusion
        if list(operators) == list(self.operators):
            return self
        if not of_joints(operators):
            return None
        if fusion.priorities is not None:
            fusion = replace(fusion, priorities=[fusion.priorities[k] for k in kept])
        _, conditionals = zip(*kept.values(), strict=True)
        return replace(self, operators=operators, conditionals=conditionals, fusion=fusion)

    def _part(
        self, operator: Operator, one: Conditionals, names: frozenset[str]
    ) -> tuple[Operator, Conditionals] | None:
        """Return the part of an operator that needs no other frames and links than these."""
        members = leaves([operator])
        there = [names.issuperset((*leaf.links(), *leaf.references())) for leaf in members]
        if all(there):
            return operator, one
        if not any(there):
            return None
        sizes = [leaf.dimension(self.kinematics) for leaf in members]
        columns = torch.from_numpy(np.flatnonzero(np.repeat(there, sizes)))
        seen = [leaf for leaf, known in zip(members, there, strict=True) if known]
        return Stack(*seen), one.marginal(columns)

    def start(self, joints: Tensor, frames: Frames) -> Regression:
        """Return the same for all robots; see :meth:`Skill.start`."""
        return self

    def of_robots(self, robots: Tensor) -> Regression:
        """See :meth:`Skill.of_robots`."""
        return self

    def advance(self, estimate: Estimate) -> Regression:
        """Return the same at all ticks; see :meth:`Skill.advance`."""
        return self

    def posture_search(self) -> PostureSearch:
        """Search for the nearest posture; see :meth:`Skill.posture_search`."""
        return self._search

    @cached_property
    def _search(self) -> PostureSearch:
        kinematics, (own, _) = self.kinematics, self._of_joints
        terms = [Residual.of(operator, kinematics) for operator in own]
        return PostureSearch(kinematics, terms, self.scaled_conditionals, self.free_precision)

    def log_density(
        self, time: Tensor, local: Sequence[Tensor], n_samples: float | None = None
    ) -> Tensor:
        """``log sum_i pi_i N(t | i) prod_j N(X_t^(j) | t, i)``: time counts once.

        Parameters
        ----------
        time : Tensor of shape (T,)
        local : sequence of Tensor of shape (T, D_j)
            Local coordinates of each operator, or of the first ones.
        n_samples : float, optional
            Of a component: Student's t in place of the normal law N(X_t^(j) | t, i), see
            :meth:`Conditionals.log_density`.

        Returns
        -------
        Tensor of shape (T,)
        """
        total = self.marginals.log_activation(time.unsqueeze(-1)) - 0.5 * math.log(2 * math.pi)
        for one, coordinates in zip(self.conditionals, local, strict=False):
            total = total + one.log_density(coordinates, time, n_samples)
        return torch.logsumexp(total, -1)

    def surprise(self, time: Tensor, joints: Tensor, frames: Frames) -> Tensor:
        """Compute how much less likely local coordinates are than those expected [nats].

        Parameters
        ----------
        time : Tensor of shape (...)
        joints : Tensor of shape (..., n_joints)
        frames : mapping of str to Frame

        Returns
        -------
        Tensor of shape (...)
        """
        state, batch = self.kinematics.state(joints), joints.shape[:-1]
        times = time.expand(batch).flatten()
        local, expected = [], []
        for j, operator in enumerate(self._of_joints[0]):
            rows = operator.at(time).coordinates(state, frames)
            rows = rows.expand(*batch, -1).reshape(len(times), -1)
            wanted = self.expect(j, times)
            starts = operator.quaternion_starts(self.kinematics)
            local.append(quaternions.hemisphere_signs(rows, wanted, starts) * rows)
            expected.append(wanted)
        most = self.log_density(times, expected, self.n_samples)
        return (most - self.log_density(times, local, self.n_samples)).reshape(batch)

    def candidates(
        self, time: Tensor, state: RobotState, frames: Frames, estimate: Estimate
    ) -> tuple[Candidate, ...]:
        """Eq. (1) for each operator of joints, mixed over the components, and its share.

        ``estimate`` is that of ``time`` and the state q_{t-1}.
        """
        index = self._components_at(time).index
        weights = estimate.activation[..., index]
        conditionals = [one.select(index) for one in self._of_joints[1]]
        means, covariances = [], []
        for at, mean, _, covariance in self._local(conditionals, time, state, frames):
            # mixing commutes with the affine map, and is less work before it
            mean, covariance = gaussians.moment_match(weights, mean, covariance)
            columns = mean[..., None, :, None]
            one = Projection.of(at, columns, covariance[..., None, :, :]).in_joint_space()
            means.append((state.joints + one.targets[..., 0, :, 0]).expand_as(estimate.joints))
            covariances.append(one.covariance[..., 0, :, :].expand_as(estimate.covariance))
        variances = torch.stack([c.diagonal(dim1=-2, dim2=-1) for c in covariances])
        # where J^+ has no row but rounding, an operator does not touch the joint and has no say
        touched = variances > 1e-12 * variances.amax(-1, keepdim=True)
        precisions = touched / torch.where(touched, variances, 1.0)
        total = precisions.sum(0)
        shares = precisions / torch.where(total > 0, total, 1.0)
        return tuple(map(Candidate, means, covariances, shares))

    @cached_property
    def _of_joints(self) -> tuple[tuple[Operator, ...], Sequence[Conditionals]]:
        """The operators that have rows in joint space, and their conditionals."""
        operators = of_joints(self.operators)
        return operators, self.conditionals[: len(operators)]

    @cached_property
    def scaled_conditionals(self) -> tuple[Conditionals, ...]:
        """The conditionals as they are fused: with covariances that say who gives way.

        Those of what has priority are scaled down. As that scale goes to zero, the product (2)
        becomes a strict hierarchy: the mean is the one of the higher operators, and in the null
        space of their Jacobians that of the lower. A scale above zero is its damping.

        Those of joints beside other operators are scaled up, by :func:`predictive_scale` of the
        samples. What hands do in the frame of an object is asked for in every situation alike;
        where the joints are then depends on the situation, and few of them show too little of
        it: where a new one is turned otherwise, joints would hold the hands back.
        """
        operators, conditionals = self._of_joints
        priorities = self.fusion.priorities or [0] * len(operators)
        levels = sorted(set(priorities))
        alone = all(leaf.is_posture for leaf in leaves(operators))
        wider = 1.0 if alone else math.sqrt(predictive_scale(self.n_samples))
        fused = []
        # what is made while inference mode is on could not serve where gradients are wanted
        with torch.inference_mode(False):
            parts = zip(conditionals, operators, priorities, strict=True)
            for one, operator, priority in parts:
                members = leaves([operator])
                widths = [wider if leaf.is_posture else 1.0 for leaf in members]
                sizes = [leaf.dimension(self.kinematics) for leaf in members]
                scale = one.covariance.new_tensor(np.repeat(widths, sizes))
                own = STRICT ** levels.index(priority)
                covariance = one.covariance * scale[:, None] * scale * own
                fused.append(replace(one, covariance=covariance))
        return tuple(fused)

    @cached_property
    def _update(self) -> KalmanUpdate | None:
        """The update of a prior over the joints, where that is what is asked for."""
        operators, information = self._of_joints[0], isinstance(self.fusion, InformationFusion)
        if not information or not KalmanUpdate.serves(operators, self.kinematics):
            return None
        # what is made while inference mode is on could not serve where gradients are wanted
        with torch.inference_mode(False):
            return KalmanUpdate(self.kinematics, operators, self.scaled_conditionals)

    @cached_property
    def _one_robot(self) -> OneRobot | None:
        """Estimates of a single robot, where they are of a kind that is served."""
        operators = self._of_joints[0]
        learning = self.log_weights.requires_grad or self.conditionals[0].mean.requires_grad
        served = isinstance(self.fusion, InformationFusion) and not learning
        if not served or not OneRobot.serves(operators, self.kinematics):
            return None
        with torch.inference_mode(False):
            if self._update is None:
                return OneRobot(self.kinematics, operators, self.free_precision)
            task = self._update.task
            return OneRobot(self.kinematics, () if task is None else (task,))

    @cached_property
    def free_precision(self) -> Tensor:
        """Precision (n_joints,) of the prior around q_{t-1}: 0 where operators determine it."""
        if any(one.determines_joints for one in self._of_joints[0]):
            return torch.zeros_like(self.kinematics.lower)
        stds, weights = self.fusion.prior_std, self.log_weights.exp()
        return prior_widths(stds, self.kinematics, *self._of_joints, weights).pow(-2)

    @cached_property
    def frame_names(self) -> tuple[str, ...]:
        """See :attr:`Skill.frame_names`."""
        return frame_names(self.operators, self.kinematics)

    @cached_property
    def carried_names(self) -> tuple[str, ...]:
        """See :attr:`Skill.carried_names`."""
        return carried_objects(self.operators, self.kinematics)

    @property
    def gates(self) -> tuple[()]:
        """See :attr:`Skill.gates`."""
        return ()

    @property
    def summaries(self) -> tuple[TrainingSummary, ...]:
        """See :attr:`Skill.summaries`."""
        return () if self.summary is None else (self.summary,)

    @cached_property
    def _likelihoods(self) -> dict[bytes, TimeLikelihood]:
        return {}

    @cached_property
    def _restrictions(self) -> dict[frozenset[str], Regression | None]:
        return {}

    @cached_property
    def marginals(self) -> TimeMarginals:
        """The components' weights over time."""
        first = self.conditionals[0]
        with torch.inference_mode(False):
            return TimeMarginals.of(self.log_weights, first.time_mean, first.time_variance)

    @cached_property
    def components(self) -> Components:
        """All components of the mixture."""
        conditionals = self.scaled_conditionals
        if self._update is not None:
            conditionals = (self._update.conditionals,)
        index = torch.arange(len(self.log_weights), device=self.log_weights.device)
        places = torch.eye(len(index), dtype=self.log_weights.dtype, device=index.device)
        return Components(index, places, self.marginals, conditionals)

    @cached_property
    def _active(self) -> ActiveComponents | None:
        """Components that count at each time, where not all do at any."""
        learning = self.log_weights.requires_grad or self.conditionals[0].mean.requires_grad
        fusion = self.fusion
        if fusion.activation != "time" or fusion.negligible == 0 or learning:
            return None  # while learning, it would cost more than it saves
        return ActiveComponents(self.marginals, fusion.negligible)

    @cached_property
    def _selections(self) -> dict[tuple[int, ...], Components]:
        return {}

    def _components_at(self, time: Tensor) -> Components:
        """Those that count at one of the times."""
        if self._active is None or time.numel() == 0:
            return self.components
        if time.ndim == 0:
            active = self._active.at(time.item())
        else:
            counts = self._active.counts(time).flatten(0, -2).any(0)
            active = tuple(counts.nonzero()[:, 0].tolist())
        if active not in self._selections:
            with torch.inference_mode(False):
                self._selections[active] = self._select(active)
        return self._selections[active]

    def _select(self, active: tuple[int, ...]) -> Components:
        return self.components.select(active)

    def _log_activation(self, components: Components, time: Tensor) -> Tensor:
        """``log h_i(t)``, up to a constant, from the components' time marginal, taken once."""
        log_h = components.marginals.log_activation(time.unsqueeze(-1))
        if time.ndim and self._active is not None:  # of each time, what it has alone
            counts = self._active.counts(time)[..., components.index]
            log_h = log_h.masked_fill(~counts, -torch.inf)
        return log_h

    def _product_activation(
        self, components: Components, time: Tensor, sums: tuple[Tensor, Tensor, Tensor]
    ) -> Tensor:
        """``log h_i(t)``, up to a constant, from the time marginal of the product (2).

        Integrating the joints out of the product leaves a quadratic in the time t + delta:
        the operators' time marginals plus how much they disagree about the joints.
        """
        precision, vector, square = sums
        white = gaussians.whiten(precision, vector, "the precision of the product")
        disagreement = square - white.mT @ white
        slope, curvature = disagreement[..., 0, 1], disagreement[..., 1, 1]
        for one in components.conditionals:
            slope = slope + (time.unsqueeze(-1) - one.time_mean) / one.time_variance
            curvature = curvature + 1 / one.time_variance
        return self.log_weights + 0.5 * (curvature.log() - slope.square() / curvature)

    def _state(self, state: Tensor | RobotState) -> RobotState:
        return state if isinstance(state, RobotState) else self.kinematics.state(state)

    def _estimate_together(
        self, time: Tensor, state: Tensor | RobotState, frames: Frames
    ) -> Estimate:
        components = self._components_at(time)
        joints, covariance, weights = self.fuse(components, time, self._state(state), frames)
        return Estimate(joints, covariance, weights @ components.places)

    def _in_parts(
        self, batch: torch.Size, time: Tensor, state: Tensor | RobotState, frames: Frames
    ) -> Estimate:
        """Estimate many robots part by part, those together that are at about the same time."""
        if isinstance(state, RobotState):
            state = state.flatten(batch)
        else:
            state = state.expand(*batch, -1).flatten(0, -2)
        poses = {name: pose.expand(batch).flatten() for name, pose in frames.items()}
        time = time.expand(batch).flatten() if time.ndim else time
        order = time.argsort() if time.ndim else torch.arange(batch.numel())
        parts = []
        for part in order.split(PART):
            here = {name: pose[part] for name, pose in poses.items()}
            now = time[part] if time.ndim else time
            parts.append(self._estimate_together(now, state[part], here))
        back = order.argsort()

        def whole(name: str) -> Tensor:
            return torch.cat([getattr(one, name) for one in parts])[back].unflatten(0, batch)

        activation = parts[0].activation  # one of all, where they are at one time
        if activation.ndim > 1:
            activation = whole("activation")
        return Estimate(whole("joints"), whole("covariance"), activation)

    def _local(
        self,
        conditionals: Sequence[Conditionals],
        time: Tensor,
        state: RobotState,
        frames: Frames,
    ) -> Iterator[tuple[Linearization, Tensor, Tensor, Tensor]]:
        """Each operator here, and means, time derivatives and covariances of components.

        Quaternions are on the side of the present ones.
        """
        for operator, one in zip(self._of_joints[0], conditionals, strict=True):
            mean, gain, covariance = one.at(time), one.gain, one.covariance
            operator = operator.at(time)
            starts = operator.quaternion_starts(self.kinematics)
            if starts:
                present = operator.coordinates(state, frames).unsqueeze(-2)
                signs = quaternions.hemisphere_signs(mean, present, starts)
                mean, gain = signs * mean, signs * gain
                covariance = signs[..., None] * covariance * signs[..., None, :]
            yield operator.linearize(state, frames), mean, gain, covariance

    def _sum(
        self, components: Components, time: Tensor, state: RobotState, frames: Frames
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Sums of the operators' information, in terms of the step ``q - q_{t-1}``."""
        terms = []
        local = self._local(components.conditionals, time, state, frames)
        for at, mean, gain, covariance in local:
            columns = mean.unsqueeze(-1)
            if self.fusion.activation != "time":
                columns = torch.stack(torch.broadcast_tensors(mean, gain), dim=-1)
            one = Projection.of(at, columns, covariance)
            if isinstance(self.fusion, CovarianceFusion):
                one = one.in_joint_space(self.fusion.epsilon)
            terms.append(gaussians.information(one.jacobian, one.targets, one.covariance))
        every = zip(*terms, strict=True)
        precision, vector, square = (sum(parts[1:], start=parts[0]) for parts in every)
        if isinstance(self.fusion, InformationFusion):
            precision = precision + self.free_precision.diag()
        return precision, vector, square
