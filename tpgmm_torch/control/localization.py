"""Where in a skill a robot is: a belief over instants, from what the mixture says of them.

The mixture is a joint density of time and of every operator's local coordinates. Conditioned
on time it gives references; what is observed has at the instant t the likelihood

    p(x | t) = sum_i h_i(t) prod_j N(x_j | mu_ij(t), Sigma_ij),

with conditional means that are linear in t, so that the exponents of all instants follow from
three numbers of each component.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields

import numpy as np
import torch
from numpy.typing import NDArray

from tpgmm_torch import quaternions
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.operators import Operator, Stack
from tpgmm_torch.operators.stack import leaves
from tpgmm_torch.regression.conditionals import Conditionals, TimeMarginals
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.robots.kinematics import RobotState

__all__ = ["Coordinates", "Instants", "Localizer", "Look", "local_mode", "move"]

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


class Localizer:
    """The instants of a skill, and what the mixture says of observations there.

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
        self._by_names: dict[frozenset[str], Instants] = {}

    def look(self, state: RobotState, frames: Mapping[str, Frame]) -> Look:
        """See robots; operators say nothing whose frames or links are not there.

        Parameters
        ----------
        state : RobotState
            Of B robots, with what they carry.
        frames : mapping of str to Frame
            Of shapes () or (B,).
        """
        if len(state.joints) == 1:  # one robot is sooner computed without a batch
            state = state[0]
            frames = {name: f[0] if f.batch_shape else f for name, f in frames.items()}
        return Look(self.at(frozenset((*frames, *state.links))), state, frames)

    def at(self, names: frozenset[str]) -> Instants:
        """What the mixture says of all instants.

        Parameters
        ----------
        names : frozenset of str
            The frames and links that are there.
        """
        if names not in self._by_names:
            with torch.inference_mode(False):
                self._by_names[names] = Instants(self._regression, names, self.instants)
        return self._by_names[names]


class Look:
    """Robots as they are seen at a moment; made by :meth:`Localizer.look`.

    Parameters
    ----------
    instants : Instants
        What the mixture says of them, given the frames and links that are there.
    state : RobotState
        Of B robots, or one without a batch.
    frames : mapping of str to Frame
    """

    def __init__(
        self, instants: Instants, state: RobotState, frames: Mapping[str, Frame]
    ) -> None:
        self._instants, self._state, self._frames = instants, state, frames

    def log_likelihood(self, window: slice = slice(None)) -> Array:
        """Of instants (B, G), up to a constant of each robot: of all, or in a window.

        Nothing is said of robots of which an observation is not a number.
        """
        with torch.inference_mode():
            terms = self._instants.exponents(self._state, self._frames)
            along = self._instants.along_paths(self._state, self._frames, window)
        return self._instants.log_likelihood(*terms, along, window)

    def reference(self, time: Array) -> Estimate | None:
        """What the skill would tell the robots at times (B,) [s]; None if it says nothing."""
        regression, state = self._instants.regression, self._state
        if regression is None:
            return None
        with torch.inference_mode():
            times = torch.as_tensor(time).to(state.joints).view(state.joints.shape[:-1])
            return regression.step(times, state, self._frames)


class Instants:
    """The mixture at all instants, as far as certain frames and links are concerned.

    Parameters
    ----------
    regression : Regression
        The skill.
    names : frozenset of str
        The frames and links that are there.
    instants : array of shape (G,)
        When they are [s].

    Attributes
    ----------
    heaviest : int array of shape (G, A)
        The components that count at each instant; ``log_h`` are their logarithmic weights, and
        ``elapsed`` is the time since their means [s].
    parts : list of tuple
        Operators, and their coordinates as Gaussians.
    constant, curvature : array of shape (K,)
        Of the exponent of each component as a polynomial of that time.
    """

    def __init__(self, regression: Regression, names: frozenset[str], instants: Array) -> None:
        kinematics = regression.kinematics
        first = regression.conditionals[0]
        marginals = TimeMarginals.of(
            regression.log_weights, first.time_mean, first.time_variance
        )
        times = torch.as_tensor(instants).to(first.mean)
        activation = torch.log_softmax(marginals.log_activation(times[:, None]), -1)
        log_h: Array = activation.numpy(force=True).astype(np.float64)
        weights = np.exp(log_h)
        width = int((weights > NEGLIGIBLE).sum(1).max())
        self.heaviest: NDArray[np.int64] = np.argsort(-log_h, 1)[:, :width]  # (G, A)
        self.log_h: Array = np.take_along_axis(log_h, self.heaviest, 1)
        centre = first.time_mean.numpy(force=True).astype(np.float64)
        self.elapsed = instants[:, None] - centre[self.heaviest]
        operators: list[Operator] = []
        conditionals: list[Conditionals] = []
        self.parts: list[tuple[Operator, Coordinates]] = []
        self._followers: list[tuple[Operator, Coordinates]] = []  # along paths
        self._times = times
        for operator, one in zip(regression.operators, regression.conditionals, strict=True):
            members = leaves([operator])
            sizes = [leaf.dimension(kinematics) for leaf in members]
            there = [names.issuperset((*leaf.links(), *leaf.references())) for leaf in members]
            seen = [leaf for leaf, known in zip(members, there, strict=True) if known]
            if not seen:
                continue
            if len(seen) < len(members):
                operator = Stack(*seen)
                columns = torch.from_numpy(np.flatnonzero(np.repeat(there, sizes)))
                one = one.marginal(columns)
            operators.append(operator)
            conditionals.append(one)
            starts = operator.quaternion_starts(kinematics)
            sizes = [leaf.dimension(kinematics) for leaf in seen]
            paths = operator.path_variances(kinematics)
            part = Coordinates(one, weights, sizes, starts, first, paths)
            follows = operator.at(times[0]) is not operator
            (self._followers if follows else self.parts).append((operator, part))
        self._operators = operators
        self.regression: Regression | None = regression
        if operators != list(regression.operators):
            settings = {f.name: getattr(regression, f.name) for f in fields(Regression)}
            settings |= {"operators": operators, "conditionals": conditionals}
            self.regression = Regression(**settings) if operators else None
        nothing = np.zeros(len(centre))
        both = [*self.parts, *self._followers]
        self.constant = sum((part.constant for _, part in both), nothing)
        self.curvature = sum((part.curvature for _, part in self.parts), nothing)

    def exponents(self, state: RobotState, frames: Mapping[str, Frame]) -> tuple[Array, Array]:
        """``|W (x - mu)|^2`` and its slope over time, summed over the operators, (B, K)."""
        square: Array = np.zeros((1, len(self.constant)))
        slope = square
        for operator, part in self.parts:
            local = np.atleast_2d(_local(operator, state, frames))
            one, other = part(local)
            square, slope = square + one.T, slope + other.T
        return square, slope

    def along_paths(
        self, state: RobotState, frames: Mapping[str, Frame], window: slice
    ) -> Array:
        """``-0.5 |W (x(t) - mu(t))|^2`` of coordinates that follow paths, (B, G, A) or 0."""
        exponent: Array = np.zeros((1, 1, 1))
        index, elapsed = self.heaviest[window], self.elapsed[window]
        for operator, part in self._followers:
            at = operator.at(self._times[window, None])
            local = at.coordinates(state, frames).numpy(force=True)  # (G, B, D)
            exponent = exponent + part.at_instants(local, index, elapsed)
        return exponent

    def log_likelihood(self, square: Array, slope: Array, along: Array, window: slice) -> Array:
        """``log p(x | t)`` at the instants of a window, (B, G), up to a constant."""
        # -0.5 |W (x - mu(t))|^2 as a polynomial of the time since the component's mean
        index, elapsed = self.heaviest[window], self.elapsed[window]
        base = self.log_h[window] + self.constant[index]
        base -= 0.5 * elapsed**2 * self.curvature[index]
        exponent = base - 0.5 * square[:, index] + elapsed * slope[:, index] + along
        most = exponent.max(-1)
        total = most + np.log(np.exp(exponent - most[..., None]).sum(-1))
        return np.where(np.isfinite(most).all(-1, keepdims=True), total, 0.0)


class Coordinates:
    """Some coordinates of an operator, as K Gaussians that move with time.

    Parameters
    ----------
    one : Conditionals
        Of the coordinates, given time.
    weights : array of shape (G, K)
        Of the components at each instant.
    sizes : sequence of int
        How many coordinates each leaf has.
    starts : iterable of int
        Where quaternions begin.
    first : Conditionals
        Those of the operator that time is centred for.
    paths : sequence of float
        Variances of the mean paths.

    Attributes
    ----------
    mean, rate : array of shape (K, D)
        The mean at the components' centres, and the whitened slope over time.
    white : array of shape (K, D, D)
        What whitens the coordinates.
    blocks : array of shape (Q, D)
        Where quaternions are.
    """

    def __init__(
        self,
        one: Conditionals,
        weights: Array,
        sizes: Sequence[int],
        starts: Iterable[int],
        first: Conditionals,
        paths: Sequence[float],
    ) -> None:
        mean, gain, covariance = (
            tensor.numpy(force=True).astype(np.float64)
            for tensor in (one.recentred(first.time_mean), one.gain, one.covariance)
        )
        groups = np.repeat(np.arange(len(sizes)), sizes)
        # how far coordinates move in the skill, alike for those of one leaf
        moved = (weights @ mean).var(0) + np.array(paths)
        slack = SLACK**2 * np.array([moved[groups == group].mean() for group in groups])
        factor = np.linalg.cholesky(covariance + np.diag(slack))
        self.size = mean.shape[1]
        self.white = np.linalg.inv(factor)  # (K, D, D)
        self.mean, self._gain = mean, gain
        self.rate = (self.white @ gain[..., None])[..., 0]
        self.blocks = quaternions.quaternion_blocks(tuple(starts), self.size).numpy()
        self.constant = -np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(1)
        self.curvature = (self.rate**2).sum(1)

    def __call__(self, local: Array) -> tuple[Array, Array]:
        """``|W (x - mu)|^2`` and ``(W gain)^T W (x - mu)`` of each component, (K, B)."""
        if len(self.blocks):
            # of q and -q, which are one rotation, the one that is nearer
            inner = (local * self.mean[:, None]) @ self.blocks.T
            local = local * (1 + (np.copysign(1.0, inner) - 1) @ self.blocks)
        white = self.white @ np.swapaxes(local - self.mean[:, None], 1, 2)  # (K, D, B)
        return (white**2).sum(1), (self.rate[:, :, None] * white).sum(1)

    def at_instants(self, local: Array, index: NDArray[np.int64], elapsed: Array) -> Array:
        """``-0.5 |W (x - mu)|^2`` (B, G, A) of coordinates (G, B, D), of components (G, A)."""
        expected = self.mean[index] + self._gain[index] * elapsed[..., None]
        residual = local[:, :, None] - expected[:, None]  # (G, B, A, D)
        white = np.einsum("gaij,gbaj->gbai", self.white[index], residual)
        square: Array = (white**2).sum(-1).swapaxes(0, 1)
        return -0.5 * square


def _local(operator: Operator, state: RobotState, frames: Mapping[str, Frame]) -> Array:
    """Local coordinates (..., D); of a stack of poses they are sooner had from its map."""
    if isinstance(operator, Stack):
        at = operator.linearize(state, frames)
        if at.present is not None and at.matrix is not None:
            # R^T (x - p), which is -M^T c, and the present quaternions, whose c is zero
            moved = (at.matrix.mT @ at.displacement.unsqueeze(-1)).squeeze(-1)
            return (at.present - moved).numpy(force=True)
    return operator.coordinates(state, frames).numpy(force=True)


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
