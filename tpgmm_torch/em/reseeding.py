"""Components that have lost their data, and where they are placed anew."""

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch.em.block_gaussians import Family, Parameters
from tpgmm_torch.em.e_step import Expectation, log_densities
from tpgmm_torch.em.points import Points

__all__ = ["degenerate", "obituary", "place_anew"]

#: Components placed anew go to one of so many points at most.
MOST_PLACES = 2**14


def degenerate(expectation: Expectation, family: Family, points: Points) -> Tensor:
    """Which components have lost their data, shape (K,).

    Either nothing is left of its mass, or at most two points are, without any spread
    beyond the regularisation, though there is data enough to give each component more.

    Parameters
    ----------
    expectation : Expectation
    family : Family
    points : Points
    """
    mass = expectation.mass
    vanished = mass < 10 * torch.finfo(points.dtype).eps * points.total
    few = mass <= 2
    if points.total <= 2 * len(mass) or not bool(few.any()):
        return vanished
    spread = torch.stack([f.square().sum((1, 2)) for f in expectation.parameters.factors])
    lambda_trace = sum(float(diagonal.sum()) for diagonal in family.diagonals)
    return vanished | (few & (spread.sum(0) <= 2 * lambda_trace))


def place_anew(
    parameters: Parameters,
    dead: Tensor,
    expectation: Expectation,
    points: Points,
    rng: np.random.RandomState,
    group_size: int = 1,
) -> Parameters:
    """Move dead components to badly explained points, with the others' mean covariance.

    The points are drawn among the twentieth of the data with the lowest density: the very
    worst are often outliers, on which the component would die again.

    Parameters
    ----------
    parameters : Parameters
        What the M step made of the expectation.
    dead : Tensor of shape (K,)
    expectation : Expectation
        Whose mixture explains points well or badly.
    points : Points
    rng : RandomState
        In the same state in all processes.
    group_size : int, default=1
        See :func:`tpgmm_torch.em.e_step.expect`.
    """
    needed = int(dead.sum())
    n_worst = max(needed, min(points.total // 20, MOST_PLACES))
    worst = worst_points(expectation.parameters, points, n_worst, group_size)
    places = worst[rng.choice(len(worst), needed, replace=False)]
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
    parameters: Parameters, points: Points, n_worst: int, group_size: int = 1
) -> Tensor:
    """The points of lowest density in all processes, by density, (n_worst, sum D_j).

    One pass, which keeps no more than it needs.
    """
    kept = torch.zeros(0, 1 + sum(points.widths), dtype=torch.float64, device=points.device)
    waiting: list[Tensor] = []
    for chunk in points:
        densities = log_densities(parameters, chunk, group_size)
        rows = torch.cat([densities[None], *(block[:-1] for block in chunk)]).T.double()
        if len(kept) == n_worst:
            rows = rows[rows[:, 0] < kept[-1, 0]]
        waiting.append(rows)
        if sum(map(len, waiting)) >= n_worst:
            kept, waiting = _lowest(torch.cat([kept, *waiting]), n_worst), []
    own = _lowest(torch.cat([kept, *waiting]), n_worst)
    together = points.processes.concatenate(own).to(points.device)
    return _lowest(together, n_worst)[:, 1:]


def _lowest(rows: Tensor, count: int) -> Tensor:
    return rows[rows[:, 0].argsort(stable=True)[:count]]


def obituary(dead: Tensor, expectation: Expectation, points: Points, n_iter: int) -> str:
    """What was placed anew, in words.

    Parameters
    ----------
    dead : Tensor of shape (K,)
    expectation : Expectation
    points : Points
    n_iter : int
        The iteration.
    """
    components = dead.nonzero()[:, 0].tolist()
    # to the digits that do not depend on what the gate left out
    masses = ", ".join(f"{round(float(expectation.mass[k]), 9):.3g}" for k in components)
    return (
        f"component(s) {components} in iteration {n_iter} "
        f"(left: {masses} of {points.total} points)"
    )
