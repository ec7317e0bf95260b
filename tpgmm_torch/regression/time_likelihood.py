"""Likelihood of the times of a skill, given what is observed of robots and objects.

The mixture is a joint density of time and of every operator's local coordinates. Conditioned
on time it gives references; what is observed has at the time t the likelihood

    p(x | t) = sum_i h_i(t) prod_j N(x_j | mu_ij(t), Sigma_ij),

with conditional means that are linear in t, so that the exponents of all times follow from
three numbers of each component.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.frames import Frames
from tpgmm_torch.operators import Operator, Stack
from tpgmm_torch.operators.base import leaves
from tpgmm_torch.regression.conditionals import Conditionals, TimeMarginals
from tpgmm_torch.robots.kinematics import Kinematics, RobotState


class TimeLikelihood:
    """The likelihood over a grid of times, of the operators of a mixture.

    Parameters
    ----------
    kinematics : Kinematics
    operators : sequence of Operator
    conditionals : sequence of Conditionals
        The components' Gaussians given time, one for each operator.
    marginals : TimeMarginals
        The components' weights over time.
    times : Tensor of shape (G,)
        The grid [s].
    slack : float
        Standard deviation that is added to coordinates, as a share of how far those of a kind
        move in the skill: robots in new situations are not as exact as demonstrations.
    negligible : float
        Components with a smaller share of the weight at a time are left out there.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        operators: Sequence[Operator],
        conditionals: Sequence[Conditionals],
        marginals: TimeMarginals,
        times: Tensor,
        slack: float = 0.03,
        negligible: float = 1e-6,
    ) -> None:
        self._times = times.to(conditionals[0].mean)
        activation = torch.log_softmax(marginals.log_activation(self._times[:, None]), -1)
        log_h = _array(activation)
        weights = np.exp(log_h)  # (G, K)
        width = int((weights > negligible).sum(1).max())
        self._heaviest: NDArray[np.int64] = np.argsort(-log_h, 1)[:, :width]  # (G, A)
        self._log_h: Array = np.take_along_axis(log_h, self._heaviest, 1)
        first = conditionals[0]
        grid = times.numpy(force=True).astype(np.float64)
        self._elapsed = grid[:, None] - _array(first.time_mean)[self._heaviest]
        self._parts: list[tuple[Operator, _Coordinates]] = []
        self._along_paths: list[tuple[Operator, _Coordinates]] = []
        nothing = np.zeros(len(first.time_mean))
        self._constant, self._curvature = nothing, nothing
        for operator, one in zip(operators, conditionals, strict=True):
            part = _Coordinates(operator, one, kinematics, first, weights, slack)
            self._constant = self._constant + part.constant
            if operator.at(self._times[0]) is not operator:
                self._along_paths.append((operator, part))
                continue
            self._parts.append((operator, part))
            self._curvature = self._curvature + part.curvature

    def __call__(self, state: RobotState, frames: Frames, window: slice = slice(None)) -> Array:
        """``log p(x | t)`` at the times of a window, (B, G), up to a constant of each robot.

        Parameters
        ----------
        state : RobotState
            Of B robots, or of one without a batch.
        frames : mapping of str to Frame
        window : slice
        """
        square: Array = np.zeros((1, len(self._constant)))  # of each component, and its slope
        slope = square
        for operator, part in self._parts:
            one, other = part.exponent(
                np.atleast_2d(_local(operator, part.starts, state, frames))
            )
            square, slope = square + one.T, slope + other.T
        # -0.5 |W (x - mu(t))|^2 as a polynomial of the time since the component's mean
        index, elapsed = self._heaviest[window], self._elapsed[window]
        exponent = self._log_h[window] + self._constant[index]
        exponent = exponent - 0.5 * elapsed**2 * self._curvature[index]
        exponent = exponent - 0.5 * square[:, index] + elapsed * slope[:, index]
        for operator, part in self._along_paths:
            at = operator.at(self._times[window, None])
            local = at.coordinates(state, frames).numpy(force=True)  # (G, B, D)
            exponent = exponent + part.at_times(local, index, elapsed)
        most = exponent.max(-1)
        total = most + np.log(np.exp(exponent - most[..., None]).sum(-1))
        return np.where(np.isfinite(most).all(-1, keepdims=True), total, 0.0)


class _Coordinates:
    """Local coordinates of an operator, as K Gaussians whose means move with time."""

    def __init__(
        self,
        operator: Operator,
        one: Conditionals,
        kinematics: Kinematics,
        first: Conditionals,
        weights: Array,
        slack: float,
    ) -> None:
        self._mean, self._gain = _array(one.recenter(first.time_mean)), _array(one.gain)
        sizes = [leaf.dimension(kinematics) for leaf in leaves([operator])]
        groups = np.repeat(np.arange(len(sizes)), sizes)
        # how far coordinates move in the skill, alike for those of one leaf
        moved = (weights @ self._mean).var(0) + np.array(operator.path_variances(kinematics))
        added = slack**2 * np.array([moved[groups == group].mean() for group in groups])
        factor = np.linalg.cholesky(_array(one.covariance) + np.diag(added))
        self._white: Array = np.linalg.inv(factor)  # (K, D, D)
        self._rate = (self._white @ self._gain[..., None])[..., 0]
        self.starts = operator.quaternion_starts(kinematics)
        self.constant = -np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(1)
        self.curvature = (self._rate**2).sum(1)

    def exponent(self, local: Array) -> tuple[Array, Array]:
        """``|W (x - mu)|^2`` and ``(W gain)^T W (x - mu)`` of each component, (K, B)."""
        if self.starts:  # of q and -q, which are one rotation, the one that is nearer
            both = torch.from_numpy(local), torch.from_numpy(self._mean[:, None])
            local = quaternions.match_hemisphere(*both, self.starts).numpy()
        white = self._white @ np.swapaxes(local - self._mean[:, None], 1, 2)  # (K, D, B)
        return (white**2).sum(1), (self._rate[:, :, None] * white).sum(1)

    def at_times(self, local: Array, index: NDArray[np.int64], elapsed: Array) -> Array:
        """``-0.5 |W (x - mu)|^2`` (B, G, A) of coordinates (G, B, D), of components (G, A)."""
        expected = self._mean[index] + self._gain[index] * elapsed[..., None]
        residual = local[:, :, None] - expected[:, None]  # (G, B, A, D)
        white = np.einsum("gaij,gbaj->gbai", self._white[index], residual)
        square: Array = (white**2).sum(-1).swapaxes(0, 1)
        return -0.5 * square


def _local(
    operator: Operator, starts: Sequence[int], state: RobotState, frames: Frames
) -> Array:
    """Local coordinates (..., D); those of a stack of poses are faster read from its map."""
    if isinstance(operator, Stack):
        at = operator.linearize(state, frames)
        if at.present is not None and at.matrix is not None:
            # R^T (x - p), which is -M^T c, and the present quaternions
            local = -(at.matrix.mT @ at.displacement.unsqueeze(-1)).squeeze(-1)
            columns = [start + i for start in starts for i in range(4)]
            local[..., columns] = at.present[..., columns].expand_as(local[..., columns])
            return _array(local)
    return _array(operator.coordinates(state, frames))


def _array(tensor: Tensor) -> Array:
    return tensor.numpy(force=True).astype(np.float64)
