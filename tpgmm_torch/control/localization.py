"""Where in a skill a robot is: a belief over instants, from what the mixture says of them.

The mixture is a joint density of time and of every operator's local coordinates. Conditioned
on time it gives references; what is observed has at the instant t the likelihood

    p(x | t) = sum_i h_i(t) prod_j N(x_j | mu_ij(t), Sigma_ij),

with conditional means that are linear in t, so that the exponents of all instants follow from
three numbers of each component.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import torch
from numpy.typing import NDArray

from tpgmm_torch import quaternions
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.operators import Canonical, Operator, Stack
from tpgmm_torch.regression.conditionals import Conditionals, TimeMarginals
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.robots.kinematics import RobotState

__all__ = ["Likelihood", "local_mode", "move"]

Array = NDArray[np.float64]
#: Seconds between instants, at least: below, neighbours look alike.
STEP = 0.04
#: At most that many instants, for long skills.
MOST = 4096
#: Standard deviation that is added to coordinates, as a share of how far those of a kind move
#: in the skill: what robots do in new situations is not as exact as what was shown.
SLACK = 0.03
#: Components with less than that share of an instant's weight say nothing there.
NEGLIGIBLE = 1e-6
#: How far around its highest point a mode of the belief reaches [s].
MODE = 0.3
#: Variance that the belief gains per second, beside moving along [s^2/s].
SPREAD = 0.016


class Likelihood:
    """The likelihood of a skill's instants.

    Parameters
    ----------
    regression : Regression
        The skill.
    begin, end : float
        When it begins and ends [s].

    Attributes
    ----------
    instants : array of shape (G,)
        Evenly spaced, from the beginning to the end [s].
    step : float
        Between them [s].
    """

    def __init__(self, regression: Regression, begin: float, end: float) -> None:
        self._regression = regression
        count = min(MOST, max(2, round((end - begin) / STEP) + 1))
        self.instants = np.linspace(begin, end, count, dtype=np.float64)
        self.step = float(self.instants[1] - self.instants[0])
        self._by_names: dict[frozenset[str], _Observed] = {}

    def __call__(self, joints: Array, frames: Mapping[str, Frame]) -> Array:
        """Log-likelihood of all instants (B, G), up to a constant of each robot.

        Operators say nothing whose frames or links are not there; nothing is said of robots of
        which something else is not a number.

        Parameters
        ----------
        joints : array of shape (B, n_joints)
            Where the robots stand.
        frames : mapping of str to Frame
            Of shapes () or (B,).
        """
        names = frozenset(frames)
        if names not in self._by_names:
            with torch.inference_mode(False):
                self._by_names[names] = _Observed(self._regression, names, self.instants)
        return self._by_names[names](joints, frames)


class _Observed:
    """The likelihood given certain frames."""

    def __init__(self, regression: Regression, frames: frozenset[str], instants: Array) -> None:
        kinematics = regression.kinematics
        self._kinematics = kinematics
        first = regression.conditionals[0]
        marginals = TimeMarginals.of(
            regression.log_weights, first.time_mean, first.time_variance
        )
        times = torch.as_tensor(instants).to(first.mean)
        activation = torch.log_softmax(marginals.log_activation(times[:, None]), -1)
        log_h: Array = activation.numpy(force=True).astype(np.float64)
        weights = np.exp(log_h)
        width = int((weights > NEGLIGIBLE).sum(1).max())
        self._heaviest = np.argsort(-log_h, 1)[:, :width]  # (G, A)
        self._log_h: Array = np.take_along_axis(log_h, self._heaviest, 1)
        centre = first.time_mean.numpy(force=True).astype(np.float64)
        self._elapsed = instants[:, None] - centre[self._heaviest]
        tasks: list[Operator] = []
        parts: list[_Coordinates] = []
        canonical: list[_Coordinates] = []
        for operator, one in zip(regression.operators, regression.conditionals, strict=True):
            leaves = operator.leaves if isinstance(operator, Stack) else (operator,)
            sizes = [leaf.dimension(kinematics) for leaf in leaves]
            there = [
                set(leaf.links()) <= set(kinematics.links)
                and set(leaf.references()) <= frames | set(kinematics.links)
                for leaf in leaves
            ]
            columns = np.repeat(there, sizes)
            groups = np.repeat(np.arange(len(leaves)), sizes)[columns]
            seen = [leaf for leaf, known in zip(leaves, there, strict=True) if known]
            if not seen:
                continue
            starts = Stack(*seen).quaternion_starts(kinematics)
            coordinates = _Coordinates(one, weights, columns, groups, starts, first)
            if all(type(leaf) is Canonical for leaf in seen):
                canonical.append(coordinates)
            else:
                tasks += seen
                parts.append(coordinates)
        self._task = Stack(*tasks) if tasks else None
        self._parts, self._canonical = parts, canonical
        self._constant = sum((part.constant for part in [*parts, *canonical]), np.zeros(1))
        self._curvature = sum((part.curvature for part in [*parts, *canonical]), np.zeros(1))

    def __call__(self, joints: Array, frames: Mapping[str, Frame]) -> Array:
        terms = [part(joints) for part in self._canonical]
        if self._task is not None:
            known = np.isfinite(joints).all(-1, keepdims=True)
            state = self._kinematics.state(np.where(known, joints, 0.0))
            local = np.where(known, _local(self._task, state, frames), np.nan)
            column = 0
            for part in self._parts:
                terms.append(part(local[..., column : column + part.size]))
                column += part.size
        if not terms:
            return np.zeros((len(joints), len(self._elapsed)))
        square, slope = (sum(each) for each in zip(*terms, strict=True))
        # -0.5 |W (x - mu(t))|^2 as a polynomial of the time since the component's mean
        index, elapsed = self._heaviest, self._elapsed
        base = self._log_h + (self._constant[index] - 0.5 * elapsed**2 * self._curvature[index])
        exponent = base - 0.5 * square.T[:, index] + elapsed * slope.T[:, index]
        most = exponent.max(-1)
        total = most + np.log(np.exp(exponent - most[..., None]).sum(-1))
        return np.where(np.isfinite(most).all(-1, keepdims=True), total, 0.0)


class _Coordinates:
    """Some coordinates of an operator, as K Gaussians that move with time."""

    def __init__(
        self,
        one: Conditionals,
        weights: Array,
        columns: NDArray[np.bool_],
        groups: NDArray[np.int_],
        starts: Iterable[int],
        first: Conditionals,
    ) -> None:
        mean, gain, covariance = (
            tensor.numpy(force=True).astype(np.float64)
            for tensor in (one.recentred(first.time_mean), one.gain, one.covariance)
        )
        mean, gain = mean[:, columns], gain[:, columns]
        covariance = covariance[:, columns][:, :, columns]
        # how far coordinates move in the skill, alike for those of one leaf
        moved = (weights @ mean).var(0)
        slack = SLACK**2 * np.array([moved[groups == group].mean() for group in groups])
        factor = np.linalg.cholesky(covariance + np.diag(slack))
        self.size = mean.shape[1]
        self._white = np.linalg.inv(factor)  # (K, D, D)
        self._mean = mean
        self._rate = (self._white @ gain[..., None])[..., 0]
        self._blocks = quaternions.quaternion_blocks(tuple(starts), self.size).numpy()
        self.constant = -np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(1)
        self.curvature = (self._rate**2).sum(1)

    def __call__(self, local: Array) -> tuple[Array, Array]:
        """``|W (x - mu)|^2`` and ``(W gain)^T W (x - mu)`` of each component, (K, B)."""
        if len(self._blocks):
            # of q and -q, which are one rotation, the one that is nearer
            inner = (local * self._mean[:, None]) @ self._blocks.T
            local = local * (1 + (np.copysign(1.0, inner) - 1) @ self._blocks)
        white = self._white @ np.swapaxes(local - self._mean[:, None], 1, 2)  # (K, D, B)
        return (white**2).sum(1), (self._rate[:, :, None] * white).sum(1)


def _local(task: Stack, state: RobotState, frames: Mapping[str, Frame]) -> Array:
    """Local coordinates (B, D): ``M^T (x - c)`` is sooner computed than by each operator."""
    at = task.linearize(state, frames)
    if at.present is None or at.matrix is None:
        return task.coordinates(state, frames).numpy(force=True)
    moved = (at.matrix.mT @ at.displacement.unsqueeze(-1)).squeeze(-1)
    return (at.present - moved).numpy(force=True)


def move(belief: Array, shift: Array, spread: Array) -> Array:
    """A belief that moves along and grows wider; what leaves at the ends stays there.

    Parameters
    ----------
    belief : array of shape (B, G)
    shift : array of shape (B,)
        How many instants it moves on, in fractions, not below zero.
    spread : array of shape (B,)
        The variance that it gains [instants^2]; more than 0.5 is 0.5.
    """
    size = belief.shape[1]
    aside = np.minimum(spread, 0.5) / 2
    reach = int(np.ceil(shift.max(initial=0.0))) + 1
    moved = np.zeros((len(belief), size + reach + 1))
    for offset in range(-1, reach + 1):
        apart = offset - shift
        kernel = np.zeros_like(shift)
        for side, share in ((-1, aside), (0, 1 - 2 * aside), (1, aside)):
            kernel += share * np.maximum(0, 1 - np.abs(apart - side))
        moved[:, offset + 1 : offset + 1 + size] += kernel[:, None] * belief
    moved[:, 1] += moved[:, 0]
    moved[:, size] += moved[:, size + 1 :].sum(1)
    return moved[:, 1 : size + 1]


def local_mode(belief: Array, instants: Array) -> Array:
    """Mean of the highest mode [s], (B,): that of two places would be neither.

    Parameters
    ----------
    belief : array of shape (B, G)
    instants : array of shape (G,)
    """
    highest = instants[belief.argmax(1)]
    inside = np.where(np.abs(instants - highest[:, None]) <= MODE, belief, 0.0)
    return np.asarray((inside @ instants) / inside.sum(1))
