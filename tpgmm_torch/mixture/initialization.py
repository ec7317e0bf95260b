"""Where EM starts, if nobody says it: from points assigned to components.

A start is the mixture of the Gaussians of the points that each component was given. Points are
walked through in batches; only a sample of bounded size is ever kept.
"""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from sklearn.cluster import KMeans
from torch import Tensor

from tpgmm_torch.em.covariance_family import CovarianceFamily
from tpgmm_torch.em.parameters import Parameters, Standardization
from tpgmm_torch.exceptions import DataError, ShapeError
from tpgmm_torch.large_data.processes import ALONE, Processes
from tpgmm_torch.large_data.row_batches import Rows

__all__ = [
    "bin_sizes",
    "check_distinct",
    "draw_starts",
    "gaussians_of",
    "sample_rows",
    "time_bins",
]

Floats = NDArray[np.floating]
Labels = NDArray[np.int64]
#: Gives each row of a standardised batch (n, n_features) a component. The second argument is
#: the number of its first row among those of all processes.
Labeller = Callable[[Floats, int], Labels]

#: Starts are found from so many points at most; of more, from a sample of that size.
LARGEST_SAMPLE = 2**16

#: Rows at a time when moments are gathered.
PIECE = 2**14


def check_distinct(
    rows: Rows, n_rows: int, n_components: int, processes: Processes = ALONE
) -> None:
    """Refuse data with fewer different rows than components; it stops as soon as it knows.

    Parameters
    ----------
    rows : Rows
        Of this process.
    n_rows : int
        Number of rows of all processes.
    n_components : int

    Raises
    ------
    DataError
        If the data hold fewer distinct points than components.
    """
    distinct = np.concatenate(processes.gather(_distinct_rows(rows, n_components)))
    count = len(np.unique(distinct, axis=0))
    if count < n_components:
        raise DataError(
            f"n_components={n_components}, but the data hold only {count} distinct point(s) "
            f"among n_samples = {n_rows}; use at most that many components, or more data"
        )


def _distinct_rows(rows: Rows, count: int) -> Floats:
    """So many distinct rows, or all if there are fewer."""
    distinct: Floats = np.empty((0, 0))
    for batch in rows:
        found = batch[_distinct(batch, count)[:count]]
        both = np.concatenate([distinct, found]) if len(distinct) else found
        distinct = np.unique(both, axis=0)[:count]
        if len(distinct) == count:
            break
    return distinct


def _distinct(rows: Floats, count: int) -> NDArray[np.intp]:
    """Numbers of distinct rows: of at least ``count``, if there are so many."""
    # distinct on a random line means distinct, and a sort of numbers costs less than of rows.
    # The sum goes column by column: a product of matrices rounds equal rows differently.
    line = np.random.RandomState(0).standard_normal(rows.shape[1]).astype(rows.dtype)
    places = sum(weight * column for weight, column in zip(line, rows.T, strict=True))
    _, first = np.unique(places, return_index=True)
    if len(first) < count:
        _, first = np.unique(rows, axis=0, return_index=True)
    return first


def sample_rows(
    rows: Rows,
    n_rows: int,
    rng: np.random.RandomState,
    processes: Processes = ALONE,
    columns: slice = slice(None),
    every: int = 1,
) -> tuple[Floats, Labels]:
    """At most ``LARGEST_SAMPLE`` rows of all processes, all of them where they are no more.

    Parameters
    ----------
    rows : Rows
        Of this process.
    n_rows : int
        Number of rows of all processes.
    rng : RandomState
        In the same state in all processes.
    columns : slice, optional
        Those that are wanted.
    every : int, default=1
        Only every so many rows count, from the first of each batch on.

    Returns
    -------
    array of shape (n, n_features)
    array of int, of shape (n,)
        Their numbers among those that count.
    """
    n_rows //= every
    wanted: Labels = np.arange(n_rows)
    if n_rows > LARGEST_SAMPLE:
        # drawing without replacement would need a permutation of all rows
        wanted = np.unique(rng.randint(0, n_rows, LARGEST_SAMPLE, dtype=np.int64))
    start = first_row(rows, processes) // every
    parts = []
    for batch in rows:
        counting = batch[::every, columns]
        first, last = np.searchsorted(wanted, (start, start + len(counting)))
        parts.append(np.asarray(counting[wanted[first:last] - start], dtype=np.float64))
        start += len(counting)
    return np.concatenate(processes.gather(np.concatenate(parts))), wanted


def first_row(rows: Rows, processes: Processes) -> int:
    """Number of this process's first row among those of all, known after the first pass."""
    return sum(processes.gather(rows.n_rows)[: processes.rank])


def gaussians_of(
    rows: Rows,
    units: Standardization,
    labellers: Sequence[Labeller],
    family: CovarianceFamily,
    n_components: int,
    processes: Processes = ALONE,
    group_size: int = 1,
) -> list[Parameters]:
    """The mixtures of the Gaussians of labelled points, in one pass for all labellings.

    Parameters
    ----------
    rows : Rows
        Of this process.
    units : Standardization
    labellers : sequence of callable
        Each gives every component at least one point of one of the processes.
    family : CovarianceFamily
    n_components : int
    group_size : int, default=1
        So many consecutive rows are labelled in one call.
    """
    widths = units.widths
    cuts = np.cumsum([width + 1 for width in widths])[:-1]
    ones = np.cumsum(widths)
    sums = [
        [np.zeros((n_components, width + 1, width + 1)) for width in widths] for _ in labellers
    ]
    step = max(1, PIECE // group_size) * group_size
    number = first_row(rows, processes)
    for batch in rows:
        for start in range(0, len(batch), step):
            piece = units.rows(batch[start : start + step]).cpu().numpy()
            columns = np.insert(piece, ones, 1.0, axis=1)  # (x; 1), block after block
            for labeller, totals in zip(labellers, sums, strict=True):
                labels = labeller(piece, number)
                ordered = columns[np.argsort(labels, kind="stable")]
                ends = np.cumsum(np.bincount(labels, minlength=n_components))
                for component, own in enumerate(np.split(ordered, ends[:-1])):
                    for total, block in zip(totals, np.split(own, cuts, 1), strict=True):
                        total[component] += block.T @ block
            number += len(piece)
    flat = processes.sum(*(torch.from_numpy(total) for totals in sums for total in totals))
    count = len(widths)
    return [_mixture(flat[i : i + count], family) for i in range(0, len(flat), count)]


def _mixture(sums: Sequence[Tensor], family: CovarianceFamily) -> Parameters:
    """Weights, means and covariances from the sums of (x; 1)(x; 1)^T, (K, D_j + 1, D_j + 1)."""
    sums = [total.to(family.diagonals[0]) for total in sums]
    mass = sums[0][:, -1, -1]
    weights = mass / mass.sum()
    means, covariances = [], []
    for block, moment in enumerate(sums):
        mean = moment[:, :-1, -1] / mass[:, None]
        scatter = moment[:, :-1, :-1] / mass[:, None, None] - mean[..., None] * mean[:, None]
        means.append(mean)
        covariances.append(family.add(family.restrict(scatter, weights), block))
    return Parameters.from_covariances(weights, means, covariances)


def draw_starts(
    method: str,
    n_starts: int,
    rows: Rows,
    n_rows: int,
    units: Standardization,
    family: CovarianceFamily,
    rng: np.random.RandomState,
    *,
    n_components: int,
    time_feature: int = 0,
    group_size: int = 1,
    processes: Processes = ALONE,
) -> list[Parameters]:
    """So many starts, not yet brought into the family; see :func:`check_distinct`.

    Parameters
    ----------
    method : {"time", "kmeans", "random"}
        Equal bins along time, bins of random sizes from the second start on; clusters of
        scikit-learn's k-means (one run); the nearest of some distinct points drawn at random.
    n_starts : int
    rows : Rows
        Of this process.
    n_rows : int
        Number of rows of all processes.
    units : Standardization
    family : CovarianceFamily
    rng : RandomState
        In the same state in all processes.
    n_components : int
    time_feature : int, default=0
        Column that holds time.
    group_size : int, default=1
        So many consecutive rows belong together.
    processes : Processes, optional

    Raises
    ------
    ShapeError
        If the first block has no such column.
    """
    if method == "time":
        width = units.widths[0]
        if time_feature >= width:
            raise ShapeError(
                f"time_feature={time_feature} is no column of the first block, "
                f"which has {width}"
            )
        # groups stay together, unless they are too few
        size = group_size if n_rows // group_size >= n_components else 1
        # the same sample whatever has been drawn before
        column = slice(time_feature, time_feature + 1)
        times, numbers = sample_rows(
            rows, n_rows, np.random.RandomState(0), processes, column, size
        )
        shift, scale = (
            float(torch.cat(part)[time_feature]) for part in (units.shifts, units.scales)
        )
        times = (times[:, 0] - shift) / scale
        labellers = [
            time_bins(
                times, numbers, bin_sizes(len(times), n_components, rng if start else None),
                time_feature, size,
            )
            for start in range(n_starts)
        ]  # fmt: skip
    else:
        sample, _ = sample_rows(rows, n_rows, rng, processes)
        sample = units.rows(sample).cpu().numpy()
        centers = _cluster_centers if method == "kmeans" else _distinct_points
        labellers = [_nearest(centers(sample, n_components, rng)) for _ in range(n_starts)]
    return gaussians_of(rows, units, labellers, family, n_components, processes, group_size)


def bin_sizes(n_points: int, n_bins: int, rng: np.random.RandomState | None = None) -> Labels:
    """Sizes of bins that together hold ``n_points`` points, each at least one.

    Parameters
    ----------
    n_bins : int
        At most ``n_points``.
    rng : RandomState, optional
        Where given, sizes differ at random, by about a third; else by one at most.

    Examples
    --------
    >>> bin_sizes(11, 3).tolist()
    [3, 4, 4]
    """
    if rng is None:
        return np.diff(np.arange(n_bins + 1) * n_points // n_bins)
    shares = rng.dirichlet(np.full(n_bins, 10.0))
    return 1 + rng.multinomial(n_points - n_bins, shares)


def time_bins(
    times: Floats, numbers: Labels, sizes: Labels, column: int, group_size: int = 1
) -> Labeller:
    """Bins along time whose limits are quantiles of a sample of the points.

    They hold points in the given proportions: exactly, if the sample is all points. Points of
    equal time are in the order of their numbers, so that no bin is empty.

    Parameters
    ----------
    times : array of shape (n,)
        Of the sample, in standardised units.
    numbers : array of int, of shape (n,)
        Which group each point of the sample is.
    sizes : array of int, of shape (n_bins,)
        Numbers of points of the sample in the bins.
    column : int
        The one that holds time.
    group_size : int, default=1
        So many consecutive rows have one time, that of their first.
    """
    firsts = np.lexsort((numbers, times))[np.cumsum(sizes)[:-1]]
    limits = list(zip(times[firsts], numbers[firsts], strict=True))

    def labels(piece: Floats, first: int) -> Labels:
        own = piece[::group_size, column]
        number = first // group_size + np.arange(len(own))
        bins = np.zeros(len(own), dtype=np.int64)
        for limit, limit_number in limits:
            bins += (own > limit) | ((own == limit) & (number >= limit_number))
        return bins.repeat(group_size)

    return labels


def _nearest(centers: Floats) -> Labeller:
    # differences, not norms and products: a center is nearest to itself, rounding or not
    return lambda piece, _: cdist(piece, centers, "sqeuclidean").argmin(1)


def _cluster_centers(sample: Floats, count: int, rng: np.random.RandomState) -> Floats:
    centers: Floats = KMeans(count, n_init=1, random_state=rng).fit(sample).cluster_centers_
    return centers


def _distinct_points(sample: Floats, count: int, rng: np.random.RandomState) -> Floats:
    distinct = _distinct(sample, count)
    if len(distinct) < count:
        raise DataError(
            f"a sample of {len(sample)} points holds only {len(distinct)} distinct ones, "
            f"fewer than n_components={count}; use init_params='time'"
        )
    return sample[rng.choice(distinct, count, replace=False)]
