"""Gaussian mixture regression in joint space: Algorithm 1's movement synthesis.

Every component of every operator is first conditioned on time, which commutes with the affine
map (1) and with the product (2) and does not depend on the robot; what is left to do at each
tick is to linearise the operators at q_{t-1}, to project the conditionals, to fuse them, and to
mix the components.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from tpgmm_torch import gaussians
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.trajectories import Candidate
from tpgmm_torch.operators import Linearization, Operator
from tpgmm_torch.regression.active_components import Windows
from tpgmm_torch.regression.component_tables import Tables
from tpgmm_torch.regression.joint_limits import within
from tpgmm_torch.regression.local_mixtures import LocalMixture
from tpgmm_torch.regression.projections import Projection, hemispheres
from tpgmm_torch.regression.task_update import TaskUpdate
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

__all__ = ["Estimate", "Regression"]

#: Robots at a time on a processor, whose cache then holds what is between the operations.
PART = 512


@dataclass(frozen=True, eq=False)
class Estimate:
    """The joint references of one control tick.

    Parameters
    ----------
    joints : Tensor of shape (..., n_joints)
        Mean of the fused mixture, the reference q_hat_t.
    covariance : Tensor of shape (..., n_joints, n_joints)
    activation : Tensor of shape (..., K)
        Mixing weights h_i of the components.
    candidates : tuple of Candidate
        Each operator's own estimate; empty unless asked for.
    """

    joints: Tensor
    covariance: Tensor
    activation: Tensor
    candidates: tuple[Candidate, ...] = ()


@dataclass(frozen=True, eq=False)
class Regression:
    """A fitted mixture, ready to be asked for joint references.

    Parameters
    ----------
    kinematics : Kinematics
    operators : sequence of Operator
    mixtures : sequence of LocalMixture
        One per operator.
    log_weights : Tensor of shape (K,)
        Logarithms of the mixing coefficients pi_i.
    fusion : {"information", "covariance"}
    activation : {"time", "product"}
    epsilon : float
        Added to the diagonal of projected covariances by the covariance form [rad^2].
    prior_std : float
        Standard deviation of the prior N(q_{t-1}, .) that closes the information form where
        no operator determines every joint [rad].
    negligible : float
        Components with less than that share of the largest weight are left out: the mean moves
        by at most the weight left out times how far apart the components' means are. 0 keeps
        all.
    """

    kinematics: Kinematics
    operators: Sequence[Operator]
    mixtures: Sequence[LocalMixture]
    log_weights: Tensor
    fusion: str = "information"
    activation: str = "time"
    epsilon: float = 1e-4
    prior_std: float = 10.0
    negligible: float = 1e-9

    def step(
        self,
        time: Tensor,
        state: RobotState,
        frames: Mapping[str, Frame],
        candidates: bool = False,
        bounds: tuple[Tensor, Tensor] | None = None,
    ) -> Estimate:
        """References at ``time`` (scalar or of the batch's shape) from the state q_{t-1}.

        ``bounds`` are the lowest and the highest joints allowed, (..., n_joints) each.
        """
        if self._update is None:
            joints, covariance, activation = self._fused(time, state, frames)
        else:
            joints, covariance, activation = self._update(self._tables, time, state, frames)
        estimate = self.bounded(joints, covariance, activation, bounds)
        if not candidates:
            return estimate
        return replace(estimate, candidates=self.candidates(time, state, frames, estimate))

    def tick(
        self,
        time: Tensor,
        joints: Tensor,
        frames: Mapping[str, Frame],
        bounds: tuple[Tensor, Tensor] | None = None,
    ) -> Estimate:
        """:meth:`step` from joint vectors: kinematics included, without candidates."""
        if not isinstance(joints, Tensor):
            joints = self.kinematics.joint_tensor(joints)
        counts = [frame.position.numel() // 3 for frame in frames.values()]
        count = max(joints.numel() // self.kinematics.n_joints, time.numel(), *counts)
        if count <= PART or time.is_cuda or self._update is None:
            return self.step(time, self.kinematics.state(joints), frames, False, bounds)
        return self.bounded(*self._in_parts(self._update, time, joints, frames), bounds)

    def _in_parts(
        self,
        update: TaskUpdate,
        time: Tensor,
        joints: Tensor,
        frames: Mapping[str, Frame],
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Part by part, of robots that are at about the same time: few components count."""
        joints = self.kinematics.joint_tensor(joints)
        names = update.task.references() if update.task is not None else ()
        poses = {name: frames[name] for name in names if name in frames}
        shapes = [pose.batch_shape for pose in poses.values()]
        batch = torch.broadcast_shapes(joints.shape[:-1], time.shape, *shapes)
        rows = [joints, *(p.position for p in poses.values())]
        rows += [p.orientation for p in poses.values()]
        if time.ndim:
            rows.append(time.unsqueeze(-1))
        rows = [row.expand(*batch, row.shape[-1]).reshape(-1, row.shape[-1]) for row in rows]
        if time.ndim:
            order = rows[-1].squeeze(-1).argsort()
            rows = [row[order] for row in rows]
        results = []
        for start, *given in zip(*(row.split(PART) for row in rows), strict=True):
            now = given.pop().squeeze(-1) if time.ndim else time
            pairs = zip(given[: len(poses)], given[len(poses) :], strict=True)
            here = {name: Frame._from(*p) for name, p in zip(poses, pairs, strict=True)}
            results.append(update(self._tables, now, self.kinematics.state(start), here))
        means, covariances, activations = zip(*results, strict=True)
        back = order.argsort() if time.ndim else slice(None)
        mean = torch.cat(means)[back].reshape(*batch, -1)
        covariance = torch.cat(covariances)[back].reshape(*mean.shape, -1)
        if time.ndim == 0:
            return mean, covariance, activations[0]
        return mean, covariance, torch.cat(activations)[back].reshape(*batch, -1)

    @staticmethod
    def bounded(
        joints: Tensor,
        covariance: Tensor,
        activation: Tensor,
        bounds: tuple[Tensor, Tensor] | None,
    ) -> Estimate:
        """The estimate, given that joints keep within bounds if there are some."""
        if bounds is not None:
            joints = within(joints, covariance, *bounds)
        return Estimate(joints, covariance, activation)

    def expected(self, operator: int, time: Tensor) -> Tensor:
        """Local coordinates (T, D_j) that one operator expects at times of shape (T,)."""
        weights = self._time_activation(time).exp()
        return (weights[..., None] * self.mixtures[operator].at(time)).sum(-2)

    def candidates(
        self,
        time: Tensor,
        state: RobotState,
        frames: Mapping[str, Frame],
        estimate: Estimate,
    ) -> tuple[Candidate, ...]:
        """Eq. (1) for each operator, mixed over the components, and each one's share.

        ``estimate`` is what was found at ``time`` from the state q_{t-1}.
        """
        active = self._active(time)
        weights = estimate.activation[..., active]
        alone = []
        for at, mean, _, covariance in self._local(active, time, state, frames):
            # mixing commutes with the affine map, and is less work before it
            mean, covariance = gaussians.moment_match(weights, mean, covariance)
            columns = mean[..., None, :, None]
            one = Projection.of(at, columns, covariance[..., None, :, :]).in_joint_space()
            step, covariance = one.targets[..., 0, :, 0], one.covariance[..., 0, :, :]
            covariance = covariance.expand_as(estimate.covariance)
            alone.append((step.expand_as(estimate.joints), covariance))
        variances = torch.stack([c.diagonal(dim1=-2, dim2=-1) for _, c in alone])
        # where J^+ has no row but rounding, an operator does not touch the joint and has no say
        touched = variances > 1e-12 * variances.amax(-1, keepdim=True)
        precisions = touched / torch.where(touched, variances, 1.0)
        total = precisions.sum(0)
        shares = precisions / torch.where(total > 0, total, 1.0)
        return tuple(
            Candidate(state.joints + step, covariance, share)
            for (step, covariance), share in zip(alone, shares, strict=True)
        )

    def _time_activation(self, time: Tensor) -> Tensor:
        """``log h_i(t)`` from pi_i N(t | mu_t, sigma_tt), the time marginal taken once."""
        mixture = self.mixtures[0]
        apart = (time[..., None] - mixture.time_mean).square() / mixture.time_variance
        log_h = self.log_weights - 0.5 * (apart + mixture.time_variance.log())
        return torch.log_softmax(log_h, dim=-1)

    @cached_property
    def _update(self) -> TaskUpdate | None:
        """The update of a prior over the joints, where that is what is asked for."""
        usual = self.fusion == "information" and self.activation == "time"
        if not usual or not TaskUpdate.serves(self.operators, self.kinematics):
            return None
        # what is made while inference mode is on could not serve where gradients are wanted
        with torch.inference_mode(False):
            return TaskUpdate(self.kinematics, self.operators, self.mixtures, self.log_weights)

    @cached_property
    def _windows(self) -> Windows:
        time = self.mixtures[0]
        return Windows(self.log_weights, time.time_mean, time.time_variance, self.negligible)

    @cached_property
    def _selected(self) -> dict[tuple[int, ...], Tables]:
        return {}

    def _active(self, time: Tensor) -> tuple[int, ...]:
        """Components that count at one instant, or from the first to the last of several."""
        if self.activation == "time" and self.negligible != 0 and time.ndim == 0:
            return self._windows.at(time.item())
        every = tuple(range(len(self.log_weights)))
        if self.activation != "time" or self.negligible == 0 or len(every) == 1:
            return every
        learning = self.log_weights.requires_grad or self.mixtures[0].mean.requires_grad
        if learning or time.numel() == 0:  # windows would cost more than they save
            return every
        return self._windows.between(*(float(bound) for bound in time.detach().aminmax()))

    def _tables(self, time: Tensor) -> Tables:
        """Of the components that count."""
        assert self._update is not None
        active = self._active(time)
        if active not in self._selected:
            with torch.inference_mode(False):
                self._selected[active] = self._select(self._update, active)
        return self._selected[active]

    def _select(self, update: TaskUpdate, active: tuple[int, ...]) -> Tables:
        return update.tables.select(active)

    def _fused(
        self, time: Tensor, state: RobotState, frames: Mapping[str, Frame]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Eq. (2) for operators of any kind, in the form and with the weights asked for."""
        active = self._active(time)
        projections = []
        for at, mean, gain, covariance in self._local(active, time, state, frames):
            columns = mean.unsqueeze(-1)
            if self.activation != "time":
                columns = torch.stack(torch.broadcast_tensors(mean, gain), dim=-1)
            projections.append(Projection.of(at, columns, covariance))
        if self.fusion == "covariance":
            projections = [p.in_joint_space(self.epsilon) for p in projections]
        precision, vector, square = self._sum(projections, state)
        if self.activation == "time":
            log_h = torch.log_softmax(self._time_activation(time)[..., active], dim=-1)
        else:
            log_h = self._product_activation(time, precision, vector, square)
        step, covariances = gaussians.from_information(precision, vector[..., 0])
        weights = log_h.exp()
        mean, covariance = gaussians.moment_match(weights, step, covariances)
        activation = weights.new_zeros(*weights.shape[:-1], len(self.log_weights))
        activation[..., active] = weights
        return state.joints + mean, covariance, activation

    def _product_activation(
        self, time: Tensor, precision: Tensor, vector: Tensor, square: Tensor
    ) -> Tensor:
        """``log h_i(t)`` from the time marginal of the product, eq. (2)'s own.

        Integrating the joints out of the product leaves a quadratic in the time t + delta:
        the operators' time marginals plus how much they disagree about the joints.
        """
        factor = gaussians.cholesky(precision, "the precision of the product")
        white = torch.linalg.solve_triangular(factor, vector, upper=False)
        disagreement = square - white.mT @ white
        slope, curvature = disagreement[..., 0, 1], disagreement[..., 1, 1]
        for mixture in self.mixtures:
            apart = time[..., None] - mixture.time_mean
            slope = slope + apart / mixture.time_variance
            curvature = curvature + 1 / mixture.time_variance
        log_h = self.log_weights + 0.5 * (curvature.log() - slope.square() / curvature)
        return torch.log_softmax(log_h, dim=-1)

    def _local(
        self,
        active: tuple[int, ...],
        time: Tensor,
        state: RobotState,
        frames: Mapping[str, Frame],
    ) -> Iterator[tuple[Linearization, Tensor, Tensor, Tensor]]:
        """Each operator here, and means, time derivatives and covariances of components.

        They are those that count, on the side of the present quaternions.
        """
        mixtures = self.mixtures
        if len(active) < len(self.log_weights):
            index = torch.tensor(active, device=time.device)
            mixtures = [mixture.select(index) for mixture in mixtures]
        for operator, mixture in zip(self.operators, mixtures, strict=True):
            mean, gain, covariance = mixture.at(time), mixture.gain, mixture.covariance
            starts = operator.quaternion_starts(self.kinematics)
            if starts:
                signs = hemispheres(mean, operator.coordinates(state, frames), starts)
                mean, gain = signs * mean, signs * gain
                covariance = signs[..., None] * covariance * signs[..., None, :]
            yield operator.linearize(state, frames), mean, gain, covariance

    def _sum(
        self, projections: Sequence[Projection], state: RobotState
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Sums over the operators, in terms of the step ``q - q_{t-1}``."""
        terms = [
            gaussians.information(p.jacobian, p.targets, p.covariance) for p in projections
        ]
        precision, vector, square = (
            sum(parts[1:], start=parts[0]) for parts in zip(*terms, strict=True)
        )
        if self.fusion == "information" and not any(
            o.determines_joints for o in self.operators
        ):
            like = state.joints
            identity = torch.eye(like.shape[-1], dtype=like.dtype, device=like.device)
            precision = precision + identity / self.prior_std**2
        return precision, vector, square
