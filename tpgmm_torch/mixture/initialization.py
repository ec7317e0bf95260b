"""Where expectation-maximisation starts: points assigned to components."""

from __future__ import annotations

import numpy as np
import torch
from numpy.random import RandomState
from sklearn.cluster import KMeans
from torch import Tensor

from tpgmm_torch.data.arrays import Array
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.mixture import expectation_maximization as em
from tpgmm_torch.mixture.points import Points


def draw_starts(
    method: str,
    n_starts: int,
    n_components: int,
    points: Points,
    family: em.CovarianceFamily,
    rng: RandomState,
) -> list[em.Parameters]:
    """Draw starts: the Gaussians of the points that each component was given.

    Parameters
    ----------
    method : {"time", "kmeans", "random"}
        Equal bins along time, bins of random sizes from the second start on; clusters of
        scikit-learn's k-means (one run); the nearest of some distinct points drawn at random.
    n_starts, n_components : int
        Number of starts, and of components of each.
    points : Points
        What the mixture is learned from.
    family : CovarianceFamily
        Of covariances, with their regularisation.
    rng : RandomState
        In the same state in all processes.

    Raises
    ------
    DataError
        If there are fewer distinct points than components.
    """
    rows = points.sample()[0].cpu().numpy()
    # points that differ on a random line are distinct; column by column, since a product of
    # matrices rounds equal rows differently
    line = RandomState(0).standard_normal(rows.shape[1])
    places = sum(weight * column for weight, column in zip(line, rows.T, strict=True))
    _, distinct = np.unique(places, return_index=True)
    if len(distinct) < n_components:
        raise DataError(
            f"n_components={n_components}, but the data hold only {len(distinct)} distinct "
            f"point(s) among n_samples = {points.total}; use at most that many components, or "
            "more data"
        )

    def centers() -> Array:
        if method == "kmeans":
            return KMeans(n_components, n_init=1, random_state=rng).fit(rows).cluster_centers_
        return rows[rng.choice(distinct, n_components, replace=False)]

    if method == "time":
        labellers = _bins_along_time(n_starts, n_components, points, rng)
    else:
        found = [torch.from_numpy(centers()) for _ in range(n_starts)]
        labellers = [nearest(start_centers.to(points.shift)) for start_centers in found]
    steps = (em.labelled_step(points, labeller, n_components) for labeller in labellers)
    return [em.m_step(step, family, floor=False) for step in steps]


def _bins_along_time(
    n_starts: int, n_bins: int, points: Points, rng: RandomState
) -> list[em.Labeller]:
    """Make equal bins, and bins of random sizes from the second start on."""
    # groups stay together, unless they are too few
    group_size = points.group_size if points.total // points.group_size >= n_bins else 1
    sample, numbers = points.sample(group_size)
    times = sample[:, 0].to(points.dtype)
    sizes = [bin_sizes(len(times), n_bins, rng if k else None) for k in range(n_starts)]
    return [time_bins(times, numbers, sizes_of_start, group_size) for sizes_of_start in sizes]


def bin_sizes(n_points: int, n_bins: int, rng: RandomState | None = None) -> list[int]:
    """Divide ``n_points`` points into bins, each of at least one.

    Parameters
    ----------
    n_bins : int
        At most ``n_points``.
    rng : RandomState, optional
        Where given, sizes differ at random, by about a third; else by one at most.

    Examples
    --------
    >>> bin_sizes(11, 3)
    [3, 4, 4]
    """
    if rng is None:
        return np.diff(np.arange(n_bins + 1) * n_points // n_bins).tolist()
    shares = rng.dirichlet(np.full(n_bins, 10.0))
    return (1 + rng.multinomial(n_points - n_bins, shares)).tolist()


def time_bins(times: Tensor, numbers: Tensor, sizes: list[int], group_size: int) -> em.Labeller:
    """Bin along time, with quantiles of a sample of the points as limits.

    They hold points in the given proportions: exactly, if the sample is all points. Points of
    equal time are in the order of their numbers, so that no bin is empty.

    Parameters
    ----------
    times : Tensor of shape (n,)
        Of the sample, ascending in their numbers.
    numbers : Tensor of shape (n,)
        Which group each point of the sample is.
    sizes : list of int
        Numbers of points of the sample in the bins.
    group_size : int
        So many consecutive points have one time, that of their first.
    """
    firsts = times.argsort(stable=True)[np.cumsum(sizes)[:-1]]
    limits, limit_numbers = times[firsts, None], numbers[firsts, None]

    def labels(rows: Tensor, row_numbers: Tensor) -> Tensor:
        time, number = rows[::group_size, 0], row_numbers[::group_size] // group_size
        beyond = (time > limits) | ((time == limits) & (number >= limit_numbers))
        return beyond.sum(0).repeat_interleave(group_size)

    return labels


def nearest(centers: Tensor) -> em.Labeller:
    """Label points by the nearest of some centers (K, sum D_j)."""
    # differences, not norms and products: a center is nearest to itself, rounding or not
    mode = "donot_use_mm_for_euclid_dist"
    return lambda rows, _: torch.cdist(rows.to(centers), centers, compute_mode=mode).argmin(1)
