"""The E step: one pass over the points, for one mixture or for several at once.

The components share their responsibilities across the blocks (section II-B of the paper):

    gamma_k(x) ∝ pi_k prod_j N(x_j | mu_kj, Sigma_kj)

A pass gathers the moments that the M step needs. Mixtures that are learned together, such as
restarts or the folds of a cross-validation, share it: points are read, and expanded, once for
all of them. What a fold leaves out has responsibilities, but none that count.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import repeat

import torch
from torch import Tensor

from tpgmm_torch.em.block_gaussians import Chunk, Parameters, Whitener
from tpgmm_torch.em.component_gating import Gate, Selection
from tpgmm_torch.em.points import Points, Subset
from tpgmm_torch.em.sufficient_statistics import (
    Features,
    PackedStatistics,
    Statistics,
    WhitenedStatistics,
    packs,
)

__all__ = ["Expectation", "Workspace", "expect", "log_densities"]

#: Logarithm of the smallest responsibility; what is smaller counts as that.
SMALLEST = {torch.float64: -500.0, torch.float32: -60.0}


@dataclass(frozen=True)
class Expectation:
    """What one pass over the points leaves: all that the M step needs.

    Attributes
    ----------
    parameters : Parameters
        The mixture that gave the responsibilities.
    moments : tuple of Tensor of shape (K, D_j + 1, D_j + 1)
        Per block ``sum_n gamma (y; 1) (y; 1)^T`` in whitened coordinates, float64.
    bound : float
        Mean log-density of the points.
    rounding : float
        By how much, relative to 1 and to the bound, the bound may be off.
    least : Tensor of shape (n_chunks,)
        Least log-density of each chunk of this process.
    """

    parameters: Parameters
    moments: tuple[Tensor, ...]
    bound: float
    rounding: float
    least: Tensor

    @property
    def mass(self) -> Tensor:
        """Number of points that each component answers for, shape (K,)."""
        return self.moments[0][:, -1, -1]


class Workspace:
    """What passes over the same points leave for later ones.

    Parameters
    ----------
    points : Points
    """

    def __init__(self, points: Points) -> None:
        self.gate = Gate()
        self.features = Features(points.widths, points.n_points)


def expect(
    mixtures: Sequence[Parameters],
    points: Points,
    *,
    group_size: int = 1,
    workspace: Workspace | None = None,
    previous: Sequence[Expectation] = (),
    subsets: Sequence[Subset] = (),
) -> list[Expectation]:
    """E step: one pass over the points.

    Parameters
    ----------
    mixtures : sequence of Parameters
        Of equal numbers of components.
    points : Points
    group_size : int, default=1
        So many consecutive points have one responsibility together: that of the geometric
        mean of their densities. The chunks end where groups end.
    workspace : Workspace, optional
        What earlier passes over the same points left; without it all components are evaluated.
    previous : sequence of Expectation, optional
        One per mixture, from a pass with nearby mixtures and with this workspace, which tells
        the gate what to expect.
    subsets : sequence of Subset, optional
        One per mixture: the points that it is learned from, where these are not all.

    Returns
    -------
    list of Expectation
        One per mixture.
    """
    gated = workspace is not None
    workspace = workspace or Workspace(points)
    parties = _parties(mixtures, points, workspace, previous, subsets, gated=gated)
    for index, chunk in enumerate(points):
        if gated:
            workspace.gate.record(index, chunk)
        for party in parties:
            party.take(index, chunk, group_size)
    sums = points.combine(*(total for party in parties for total in party.sums))
    found: dict[int, Expectation] = {}
    for party in parties:
        own, sums = sums[: len(party.sums)], sums[len(party.sums) :]
        found |= zip(party.numbers, party.expectations(own, points.total), strict=True)
    return [found[number] for number in range(len(mixtures))]


def log_densities(parameters: Parameters, chunk: Chunk, group_size: int = 1) -> Tensor:
    """Log-density of each point, evaluated in whitened coordinates.

    Parameters
    ----------
    parameters : Parameters
    chunk : tuple of Tensor of shape (D_j + 1, n)
    group_size : int, default=1
        See :func:`expect`.

    Returns
    -------
    Tensor of shape (n,)
    """
    joint = Whitener(parameters, chunk[0].dtype)(chunk)[0]
    _share(joint, group_size, None)
    return torch.logsumexp(joint, 0)


def _parties(
    mixtures: Sequence[Parameters],
    points: Points,
    workspace: Workspace,
    previous: Sequence[Expectation],
    subsets: Sequence[Subset],
    *,
    gated: bool,
) -> "list[_Party]":
    """Those that can be packed together, the others one by one: they have nothing to share."""
    joined = Parameters.joined(mixtures)
    whitener = Whitener(joined, points.dtype)
    packed = packs(whitener, len(mixtures), workspace.features, points.total, points.dtype)
    together = [number for number, fits in enumerate(packed) if fits]
    alone = [number for number, fits in enumerate(packed) if not fits]
    parties = []
    for numbers in ([together] if together else []) + [[number] for number in alone]:
        if len(numbers) < len(mixtures):
            joined = Parameters.joined([mixtures[number] for number in numbers])
            whitener = Whitener(joined, points.dtype)
        statistics = (
            PackedStatistics(whitener, workspace.features)
            if packed[numbers[0]]
            else WhitenedStatistics(whitener, points.dtype)
        )
        selections: Iterator[Selection | None] = repeat(None)
        if gated:
            last = [previous[number].least for number in numbers if previous]
            guess = torch.stack(last, 1) if last else None
            peaks = whitener.peaks.unflatten(0, (len(numbers), -1))
            selections = workspace.gate.selections(joined, peaks, guess)
        chosen = [mixtures[number] for number in numbers]
        own = [subsets[number] for number in numbers] if subsets else []
        parties.append(_Party(numbers, chosen, statistics, selections, own))
    return parties


class _Party:
    """Mixtures that are evaluated together, and what a pass gathers for them."""

    def __init__(
        self,
        numbers: Sequence[int],
        mixtures: Sequence[Parameters],
        statistics: Statistics,
        selections: Iterator[Selection | None],
        subsets: Sequence[Subset],
    ) -> None:
        self.numbers, self.mixtures, self._subsets = numbers, mixtures, subsets
        #: Which points count, (S, n_points), and how many have been taken.
        self._members = torch.stack([s.chosen for s in subsets]) if subsets else None
        self._taken = 0
        self._statistics, self._selections = statistics, selections
        self._total = torch.zeros_like(mixtures[0].weights[:1]).repeat(len(mixtures))
        self._least: list[list[float]] = []

    @property
    def sums(self) -> tuple[Tensor, ...]:
        """All that has to be added over the processes."""
        return (*self._statistics.sums, self._total)

    def take(self, index: int, chunk: Chunk, group_size: int) -> None:
        """Add the chunk with this number."""
        self._statistics.load(index, chunk)
        selection, n = next(self._selections), chunk[0].shape[1]
        members = None
        if self._members is not None:
            members = self._members.narrow(1, self._taken, n)
        self._taken += n
        components = None if selection is None else selection.components
        responsibilities, densities, least = self._evaluate(components, group_size, members)
        if selection is not None and not selection.confirmed(least):
            components = Selection.above(selection.ceilings, least).components
            responsibilities, densities, least = self._evaluate(components, group_size, members)
        self._statistics.gather(responsibilities, components)
        self._total += densities.sum(1, dtype=torch.float64)
        self._least.append(least)

    def _evaluate(
        self, components: Tensor | None, group_size: int, members: Tensor | None
    ) -> tuple[Tensor, Tensor, list[float]]:
        """Responsibilities (S * A, n), log-densities (S, n), and the least of them (S).

        Both are zero for points that do not count.
        """
        joint = self._statistics.joint(components)
        joint = joint.view(len(self.numbers), -1, joint.shape[1])
        _share(joint, group_size, members)
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
        return responsibilities.view(-1, joint.shape[2]), densities, least.amin(1).tolist()

    def expectations(self, sums: Sequence[Tensor], n_points: int) -> Iterator[Expectation]:
        """One per mixture, from the sums over all processes and the number of their points."""
        *gathered, total = sums
        moments = self._statistics.moments(*gathered)
        counts = [subset.total for subset in self._subsets] or [n_points]
        bounds = (total / total.new_tensor(counts)).tolist()
        least = total.new_tensor(self._least).view(-1, len(total))
        n_components = len(self.mixtures[0].weights)
        for place, parameters in enumerate(self.mixtures):
            own = slice(place * n_components, (place + 1) * n_components)
            yield Expectation(
                parameters,
                tuple(moment[own] for moment in moments),
                bounds[place],
                self._statistics.rounding,
                least[:, place],
            )


def _share(joint: Tensor, group_size: int, members: Tensor | None) -> None:
    """Give the points (..., n) of a group the mean of their logarithms, in place.

    With ``members`` (S, n), the mean of those that count, of joint (S, A, n).
    """
    if group_size > 1:
        grouped = joint.unflatten(-1, (-1, group_size))
        if members is None:
            mean = grouped.mean(-1, keepdim=True)
        else:
            counted = members.unsqueeze(1).unflatten(-1, (-1, group_size)).to(joint)
            mean = (grouped * counted).sum(-1, keepdim=True)
            mean = mean / counted.sum(-1, keepdim=True).clamp_(min=1)
        grouped.copy_(mean)
