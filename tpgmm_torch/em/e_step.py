"""The E step: one pass over the points, for one mixture or for S of them.

The components share their responsibilities across the blocks (section II-B of the paper):

    gamma_k(x) ∝ pi_k prod_j N(x_j | mu_kj, Sigma_kj)
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import repeat
from typing import Any

import torch
from torch import Tensor

from tpgmm_torch.em.component_gating import Gate, Selection
from tpgmm_torch.em.parameters import Parameters
from tpgmm_torch.em.points import Chunk, Points
from tpgmm_torch.em.sufficient_statistics import sufficient_statistics
from tpgmm_torch.em.whitening import Whitener

__all__ = ["Expectation", "e_step", "log_densities"]

#: Logarithm of the smallest responsibility; what is smaller counts as that.
SMALLEST = {torch.float64: -500.0, torch.float32: -60.0}


@dataclass(frozen=True)
class Expectation:
    """What one pass over the points leaves of S mixtures: all that the M step needs.

    Attributes
    ----------
    parameters : Parameters
        The mixtures that gave the responsibilities.
    moments : tuple of Tensor of shape (S, K, D_j + 1, D_j + 1)
        Per block ``sum_n gamma (y; 1) (y; 1)^T`` in whitened coordinates, float64.
    bound : Tensor of shape (S,)
        Mean log-density of the points.
    n_points : Tensor of shape (S,)
        Number of points that each mixture is learned from.
    least : Tensor of shape (S, n_chunks)
        Least log-density in each chunk of this process.
    rounding : float
        By how much the bound may be off, relative to 1 and to itself.
    """

    parameters: Parameters
    moments: tuple[Tensor, ...]
    bound: Tensor
    n_points: Tensor
    least: Tensor
    rounding: float

    @property
    def mass(self) -> Tensor:
        """Number of points that each component is responsible for, shape (S, K)."""
        return self.moments[0][..., -1, -1]

    def __getitem__(self, index: Any) -> "Expectation":
        """Of some of the mixtures, or of one."""
        return Expectation(
            self.parameters[index],
            tuple(moment[index] for moment in self.moments),
            self.bound[index],
            self.n_points[index],
            self.least[index],
            self.rounding,
        )

    def replaced(self, index: Tensor, other: "Expectation") -> "Expectation":
        """The same with some of the mixtures replaced by those of another pass."""

        def put(one: Tensor, two: Tensor) -> Tensor:
            one = one.clone()
            one[index] = two
            return one

        return Expectation(
            self.parameters.map(put, other.parameters),
            tuple(map(put, self.moments, other.moments)),
            put(self.bound, other.bound),
            put(self.n_points, other.n_points),
            put(self.least, other.least),
            max(self.rounding, other.rounding),
        )


def e_step(
    parameters: Parameters,
    points: Points,
    *,
    group_size: int = 1,
    members: Tensor | None = None,
    gate: Gate | None = None,
    previous: Expectation | None = None,
) -> Expectation:
    """One pass over the points.

    Parameters
    ----------
    parameters : Parameters
        S mixtures, stacked.
    group_size : int, default=1
        So many consecutive points have one responsibility together: that of the geometric
        mean of their densities. The chunks end where groups end.
    members : Tensor of bool, of shape (S, n_points), optional
        The points that each mixture is learned from; all by default. The mean over a group is
        that of its members.
    gate : Gate, optional
        Of the same points; without it all components are evaluated at all points.
    previous : Expectation, optional
        Of a pass with nearby mixtures and with this gate, which tells it what to expect.
    """
    n_mixtures, n_components = parameters.weights.shape
    whitener = Whitener(parameters, points.dtype)
    statistics = sufficient_statistics(whitener, points.total)
    selections: Iterator[Selection | None] = repeat(None)
    if gate is not None:
        guess = None if previous is None else previous.least
        selections = gate.selections(parameters, whitener.peaks.view(n_mixtures, -1), guess)
    total = torch.zeros_like(whitener.constant[:n_mixtures])
    least: list[list[float]] = []
    start = 0
    for index, chunk in enumerate(points):
        if gate is not None:
            gate.record(index, chunk)
        counted = None
        if members is not None:
            counted = members[:, start : start + chunk[0].shape[1]]
        start += chunk[0].shape[1]
        selection = next(selections)
        components = None if selection is None else selection.components
        joint = statistics.log_joint(chunk, components).unflatten(0, (n_mixtures, -1))
        share_in_groups(joint, group_size, counted)
        responsibilities, densities, lowest = normalize(joint, counted)
        if selection is not None and not selection.holds(lowest):
            components = Selection.above(selection.ceilings, lowest).components
            joint = statistics.log_joint(chunk, components).unflatten(0, (n_mixtures, -1))
            share_in_groups(joint, group_size, counted)
            responsibilities, densities, lowest = normalize(joint, counted)
        statistics.add(responsibilities.flatten(0, 1), components)
        total += densities.sum(1, dtype=torch.float64)
        least.append(lowest)
    n_points = total.new_full((n_mixtures,), points.total)
    if members is not None:
        n_points = members.sum(1).to(total)
    *sums, total = points.combine(*statistics.sums, total)
    return Expectation(
        parameters,
        tuple(m.unflatten(0, (n_mixtures, n_components)) for m in statistics.moments(*sums)),
        total / n_points,
        n_points,
        total.new_tensor(least).T,
        statistics.rounding,
    )


def normalize(joint: Tensor, members: Tensor | None) -> tuple[Tensor, Tensor, list[float]]:
    """Responsibilities (S, A, n), log-densities (S, n), and the least of them per mixture.

    Both are zero where a point is not a member (S, n).
    """
    largest = joint.amax(1, keepdim=True)
    # exp of less is a denormal number, with which processors compute very slowly
    relative = joint.sub_(largest).clamp_(min=SMALLEST[joint.dtype]).exp_()
    norm = relative.sum(1, keepdim=True)
    densities = largest.add_(norm.log())[:, 0]
    responsibilities = relative.div_(norm)
    least = densities
    if members is not None:
        least = densities.masked_fill(~members, math.inf)
        densities.mul_(members)
        responsibilities.mul_(members.unsqueeze(1))
    return responsibilities, densities, least.amin(1).tolist()


def share_in_groups(joint: Tensor, group_size: int, members: Tensor | None) -> None:
    """Give the points (S, A, n) of a group the mean of their logarithms, in place.

    With members (S, n), the mean of those.
    """
    if group_size == 1:
        return
    grouped = joint.unflatten(-1, (-1, group_size))
    if members is None:
        grouped.copy_(grouped.mean(-1, keepdim=True))
        return
    counted = members.unsqueeze(1).unflatten(-1, (-1, group_size)).to(joint)
    mean = (grouped * counted).sum(-1, keepdim=True)
    grouped.copy_(mean / counted.sum(-1, keepdim=True).clamp_(min=1))


def log_densities(
    parameters: Parameters, chunk: Chunk, group_size: int = 1, members: Tensor | None = None
) -> Tensor:
    """Log-density of each point under one mixture, infinite where it is not a member.

    Parameters
    ----------
    parameters : Parameters
    chunk : tuple of Tensor of shape (D_j + 1, n)
    group_size : int, default=1
        See :func:`e_step`.
    members : Tensor of bool, of shape (n,), optional

    Returns
    -------
    Tensor of shape (n,)
    """
    joint = Whitener(parameters, chunk[0].dtype).log_joint(chunk)[0][None]
    counted = None if members is None else members[None]
    share_in_groups(joint, group_size, counted)
    densities = torch.logsumexp(joint[0], 0)
    return densities if members is None else densities.masked_fill(~members, math.inf)
