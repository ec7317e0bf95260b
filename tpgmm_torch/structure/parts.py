"""Parts of a skill, chained in one mixture: each with its own operators and components.

A part is learned from what was shown between its two boundaries. Side by side, weighted by how
long the parts last, their components are one mixture over time and the local coordinates of all
operators: time chooses among them, as it does among the components of one part, and so
references go smoothly from part to part. Where an operator does not matter, its covariance
given time is that wide that it says next to nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import pairwise
from numbers import Real
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch.data.arrays import as_array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture
from tpgmm_torch.operators import Operator, Stack
from tpgmm_torch.operators.stack import leaves
from tpgmm_torch.robots.kinematics import Kinematics

__all__ = [
    "Part",
    "chained",
    "check_cuts",
    "components_of_parts",
    "matters",
    "parse_parts",
    "part_of",
    "stretches",
    "united",
]

#: Standard deviation of a coordinate that does not matter, in units of the one that it has over
#: the whole skill.
WIDE = 10.0


@dataclass(frozen=True)
class Part:
    """A part of a skill.

    Parameters
    ----------
    begin, end : float
        From when to when, in the time of the skill [s].
    reason : str
        Why it begins then.
    operators : tuple of Operator
        Those that matter in it, of stacks their members; those of the joints always do.
    n_components : int
    """

    begin: float
    end: float
    reason: str
    operators: tuple[Operator, ...]
    n_components: int


def part_of(parts: Sequence[Part], time: NDArray[np.floating]) -> NDArray[np.int64]:
    """Which of the ``parts`` instants belong to, by number; 0 where there are none.

    Parameters
    ----------
    parts : sequence of Part
    time : array of shape (T,)
        In the time of the skill [s].
    """
    return np.searchsorted([part.begin for part in parts[1:]], time, side="right")


def stretches(
    demonstrations: Sequence[Demonstration], parts: Sequence[Part], like: Tensor | None = None
) -> list[list[Demonstration]]:
    """What demonstrations show of each part; of one, all.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
    parts : sequence of Part
    like : Tensor, optional
        Of the precision in which time is compared.
    """
    if len(parts) == 1:
        return [list(demonstrations)]
    numbers = [
        part_of(parts, as_array(one.time if like is None else one.time.to(like)))
        for one in demonstrations
    ]
    return [
        [
            one.at_steps(torch.from_numpy(own == number))
            for one, own in zip(demonstrations, numbers, strict=True)
        ]
        for number in range(len(parts))
    ]


def united(lists: Sequence[Sequence[Operator]]) -> tuple[Operator, ...]:
    """The operators of all parts, each once; what is a member of a stack is there already.

    Parameters
    ----------
    lists : sequence of sequence of Operator
        Those of each part.
    """
    every = list(dict.fromkeys(operator for own in lists for operator in own))
    stacked = {leaf for one in every if isinstance(one, Stack) for leaf in one.leaves}
    stacks = [one for one in every if isinstance(one, Stack)]
    inside = [
        one for one in stacks if any(set(one.leaves) < set(other.leaves) for other in stacks)
    ]
    return tuple(one for one in every if one not in stacked and one not in inside)


def check_cuts(cuts: Sequence[Any], demonstrations: Sequence[Demonstration]) -> list[float]:
    """Boundaries of parts that are given, as instants in the time of the skill.

    Parameters
    ----------
    cuts : sequence of float or str
        Instants [s], or events of the demonstrations by name or pattern, of which the median
        over the demonstrations counts.
    demonstrations : sequence of Demonstration

    Raises
    ------
    UnknownNameError
        If an event is missing in a demonstration.
    DataError
        If they are not within the demonstrations, one after the other.
    """
    times: list[tuple[float, str]] = []
    for cut in cuts:
        if isinstance(cut, Real):
            times.append((float(cut), f"{float(cut):g} s"))
            continue
        known = demonstrations[0].events
        for name in [name for name in known if fnmatchcase(name, str(cut))] or [str(cut)]:
            for one in demonstrations:
                if name not in one.events:
                    raise UnknownNameError("event", name, "a demonstration", one.events)
            times.append((float(np.median([one.events[name] for one in demonstrations])), name))
    begin = max(float(one.time[0]) for one in demonstrations)
    end = min(float(one.time[-1]) for one in demonstrations)
    edges = [(begin, "the beginning"), *times, (end, "the end")]
    for (early, first), (late, second) in pairwise(edges):
        if not early < late:
            raise DataError(
                f"parts follow on each other between {begin:.4g} and {end:.4g} s: {second} at "
                f"{late:.4g} s is not after {first} at {early:.4g} s"
            )
    return [time for time, _ in times]


def parse_parts(text: str | None) -> str | list[float | str] | None:
    """Where a skill has parts, as a text has it: "auto", or instants and events.

    Parameters
    ----------
    text : str or None
        Joined by commas.

    Examples
    --------
    >>> parse_parts("4.2, grasp")
    [4.2, 'grasp']
    """
    if text is None or text == "auto":
        return text
    cuts: list[float | str] = []
    for word in map(str.strip, text.split(",")):
        try:
            cuts.append(float(word))
        except ValueError:
            cuts.append(word)
    return cuts


def components_of_parts(number: int, instants: Sequence[int]) -> list[int]:
    """How many of the components each part has: as its share of the instants.

    Parameters
    ----------
    number : int
        Of all components.
    instants : sequence of int
        Of each part.

    Raises
    ------
    DataError
        If there are fewer components than parts.

    Examples
    --------
    >>> components_of_parts(10, [50, 30, 20, 2])
    [4, 3, 2, 1]
    """
    if number < len(instants):
        raise DataError(
            f"{len(instants)} parts need a component each, n_components is {number}: raise it, "
            "or give fewer parts"
        )
    shares = number * np.array(instants) / np.sum(instants)
    counts = np.maximum(np.floor(shares), 1).astype(int)
    while counts.sum() < number:
        counts[int((shares - counts).argmax())] += 1
    while counts.sum() > number:  # of parts that were given one, the longest pay
        counts[int(np.where(counts > 1, counts - shares, -np.inf).argmax())] -= 1
    return [int(count) for count in counts]


def matters(part: Part, operator: Operator, kinematics: Kinematics) -> NDArray[np.bool_]:
    """Which coordinates of an operator matter in a part.

    Parameters
    ----------
    part : Part
    operator : Operator
        A member of a stack, or a whole one.
    kinematics : Kinematics
    """
    members = leaves([operator])
    counts = [one in part.operators for one in members]
    return np.repeat(counts, [one.dimension(kinematics) for one in members])


def chained(
    mixtures: Sequence[BlockGaussianMixture],
    parts: Sequence[Part],
    counts: Sequence[int],
    operators: Sequence[Operator],
    kinematics: Kinematics,
    variances: Sequence[Tensor],
) -> BlockGaussianMixture:
    """One mixture of the components of all parts.

    Parameters
    ----------
    mixtures : sequence of BlockGaussianMixture
        Fitted, one per part, with a block for each operator.
    parts : sequence of Part
    counts : sequence of int
        How many rows each was learned from.
    operators : sequence of Operator
        Of all parts.
    kinematics : Kinematics
    variances : sequence of Tensor of shape (1 + D_j,)
        Of the columns of each block over the whole skill.
    """
    shares = np.array(counts) / np.sum(counts)
    whole = BlockGaussianMixture(**mixtures[0].get_params())
    whole.n_components = sum(part.n_components for part in parts)
    whole.weights_ = torch.cat(
        [share * one.weights_ for share, one in zip(shares, mixtures, strict=True)]
    )
    blocks = range(len(operators))
    whole.means_ = [torch.cat([one.means_[j] for one in mixtures]) for j in blocks]
    whole.unshrunk_covariances = [
        torch.cat([one.unshrunk_covariances[j] for one in mixtures]) for j in blocks
    ]
    whole.covariances_ = []
    for j, (operator, variance) in enumerate(zip(operators, variances, strict=True)):
        own = [
            _widened(one.covariances_[j], matters(part, operator, kinematics), variance)
            for one, part in zip(mixtures, parts, strict=True)
        ]
        whole.covariances_.append(torch.cat(own))
    whole.n_features_in_ = mixtures[0].n_features_in_
    whole.n_iter_ = max(one.n_iter_ for one in mixtures)
    whole.converged_ = all(one.converged_ for one in mixtures)
    bounds = [one.lower_bound_ + np.log(s) for s, one in zip(shares, mixtures, strict=True)]
    whole.lower_bound_ = float(shares @ bounds)
    whole.lower_bounds_ = [whole.lower_bound_]
    return whole


def _widened(covariances: Tensor, matters: NDArray[np.bool_], variances: Tensor) -> Tensor:
    """Covariances (K, 1 + D, 1 + D), given time wide and alone where they do not matter."""
    if matters.all():
        return covariances
    time = covariances[:, :1, :1]
    slope = covariances[:, 1:, :1] / time
    given = covariances[:, 1:, 1:] - slope @ slope.mT * time
    own = torch.from_numpy(matters).to(covariances)
    variance = torch.maximum(variances[1:].to(covariances), given.diagonal(dim1=1, dim2=2))
    given = given * own[:, None] * own + torch.diag_embed((1 - own) * WIDE**2 * variance)
    widened = covariances.clone()
    widened[:, 1:, 1:] = given + slope @ slope.mT * time
    return widened
