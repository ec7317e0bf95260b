"""Components that have lost their data, and points where they start again."""

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch.em.covariance_family import CovarianceFamily
from tpgmm_torch.em.e_step import Expectation, log_densities
from tpgmm_torch.em.parameters import Parameters
from tpgmm_torch.em.points import Points

__all__ = ["dead_components", "reseed", "worst_points"]

#: Components start again at one of so many points at most.
MOST_CANDIDATES = 2**14


def dead_components(
    expectation: Expectation, family: CovarianceFamily, dtype: torch.dtype
) -> Tensor:
    """Which components of S mixtures have lost their data, shape (S, K).

    Either nothing is left of its mass, or at most two points are, without any spread
    beyond the regularisation, though there is data enough to give each component more.

    Parameters
    ----------
    expectation : Expectation
    family : CovarianceFamily
    dtype : torch.dtype
        Precision of the points.
    """
    mass, n_points = expectation.mass, expectation.n_points[:, None]
    vanished = mass < 10 * torch.finfo(dtype).eps * n_points
    few = (mass <= 2) & (n_points > 2 * mass.shape[1])
    factors = expectation.parameters.factors
    spread = torch.stack([f.square().sum((-2, -1)) for f in factors]).sum(0)
    floor = torch.stack([diagonal.sum(-1) for diagonal in family.diagonals]).sum(0)
    return vanished | (few & (spread <= 2 * floor[..., None]))


def reseed(
    parameters: Parameters,
    dead: Tensor,
    explaining: Parameters,
    points: Points,
    rng: np.random.RandomState,
    group_size: int = 1,
    members: Tensor | None = None,
) -> Parameters:
    """Move dead components to badly explained points, with the others' mean covariance.

    The points are drawn among the twentieth of the data with the lowest density: the very
    worst are often outliers, on which the component would die again.

    Parameters
    ----------
    parameters : Parameters
        One mixture, as the M step left it.
    dead : Tensor of bool, of shape (K,)
    explaining : Parameters
        The mixture of the E step, which explains points well or badly.
    rng : RandomState
        In the same state in all processes.
    group_size : int, default=1
        See :func:`tpgmm_torch.em.e_step.e_step`.
    members : Tensor of bool, of shape (n_points,), optional
        The points that the mixture is learned from; all by default.
    """
    n_dead = int(dead.sum())
    n_points = points.total if members is None else int(members.sum())
    n_candidates = max(n_dead, min(n_points // 20, MOST_CANDIDATES))
    worst = worst_points(explaining, points, n_candidates, group_size, members)
    places = worst[rng.choice(len(worst), n_dead, replace=False)]
    weights = torch.where(dead, 1 / len(dead), parameters.weights)
    share = torch.where(dead, 0.0, parameters.weights)
    share = share / share.sum()
    means, covariances = [], []
    for mean, covariance, place in zip(
        parameters.means,
        parameters.covariances,
        places.split(points.widths, dim=1),
        strict=True,
    ):
        means.append(mean.masked_scatter(dead[:, None], place.contiguous()))
        pooled = torch.einsum("k,kij->ij", share, covariance)
        covariances.append(torch.where(dead[:, None, None], pooled, covariance))
    return Parameters.from_covariances(weights / weights.sum(), means, covariances)


def worst_points(
    parameters: Parameters,
    points: Points,
    count: int,
    group_size: int = 1,
    members: Tensor | None = None,
) -> Tensor:
    """The points of lowest density, in one pass that keeps no more than it needs.

    Parameters
    ----------
    parameters : Parameters
        One mixture.
    points : Points
        Of all processes where there are several.
    count : int
        How many; all, if there are fewer.
    group_size, members
        As for :func:`reseed`.

    Returns
    -------
    Tensor of shape (count, sum D_j)
        By density.
    """
    worst = torch.zeros(0, 1 + sum(points.widths), dtype=torch.float64, device=points.device)
    start = 0
    for chunk in points:
        stop = start + chunk[0].shape[1]
        counted = None if members is None else members[start:stop]
        densities = log_densities(parameters, chunk, group_size, counted)
        rows = torch.cat([densities[None], *(block[:-1] for block in chunk)]).T.double()
        worst = _lowest(torch.cat([worst, rows[torch.isfinite(rows[:, 0])]]), count)
        start = stop
    return _lowest(points.concatenate(worst).to(points.device), count)[:, 1:]


def _lowest(rows: Tensor, count: int) -> Tensor:
    return rows[rows[:, 0].argsort(stable=True)[:count]]
