"""Dynamic time warping of feature sequences: which instant of one is which of the other.

Plain arrays on uniform grids; :mod:`tpgmm_torch.alignment` applies the result to
demonstrations.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from tpgmm_torch.data.arrays import Array

Floats = NDArray[np.floating[Any]]


def resample(values: Array, time: Floats, grid: Floats) -> Array:
    """Interpolate the columns of ``values`` (T, D), given at ``time`` (T,), on a ``grid``."""
    return np.stack([np.interp(grid, time, column) for column in values.T], axis=1)


def moving_average(values: Array, width: int) -> Array:
    """Smooth ``values`` (T,) or (T, D) along the first axis with a Hann kernel; the ends stay.

    Beyond the ends the sequence is continued by its point reflection, so a monotone
    sequence stays monotone and a straight line stays itself. ``width`` is half the number of
    samples that the kernel covers; 0 changes nothing.
    """
    width = min(width, len(values) - 1)
    if width < 1:
        return values
    before = 2 * values[0] - values[width:0:-1]
    after = 2 * values[-1] - values[-2 : -width - 2 : -1]
    extended = np.concatenate((before, values, after))
    kernel = np.hanning(2 * width + 3)[1:-1]
    kernel /= kernel.sum()
    columns = extended.reshape(len(extended), -1).T
    smooth = np.stack([np.convolve(column, kernel, mode="valid") for column in columns], axis=1)
    return smooth.reshape(values.shape)


def warping_path(
    reference: Array, source: Array, penalty: float = 0.0, max_slope: int = 2
) -> tuple[NDArray[np.intp], float]:
    """Find the cheapest monotone matching of two sequences, within bounds of its slope.

    The path is made of segments that advance by one in one sequence and by one to
    ``max_slope`` in the other, so no part of it is steeper than ``max_slope`` or flatter than
    its inverse (Sakoe and Chiba's slope constraint) [1]_.

    Parameters
    ----------
    reference, source : ndarray of shape (N, D) and (M, D)
        The sequences.
    penalty : float, default=0.0
        Its square is added for each step that advances in one sequence alone.
    max_slope : int, default=2
        At least one, which leaves the diagonal alone.

    Returns
    -------
    path : ndarray of shape (L, 2)
        Matched (reference, source) indices from (0, 0) on.
    cost : float
        Summed squared distances and penalties, infinite if no path reaches the end.

    References
    ----------
    .. [1] H. Sakoe, S. Chiba: Dynamic programming algorithm optimization for spoken word
       recognition. IEEE Transactions on Acoustics, Speech, and Signal Processing 26 (1978).
    """
    n, m, border = len(reference), len(source), max_slope
    costs = np.zeros((n + border, m + border))
    costs[border:, border:] = cdist(reference, source, "sqeuclidean")
    # a path begins at the last pair of the border, whose others cannot be reached
    totals = np.full_like(costs, np.inf)
    totals[border - 1, border - 1] = 0.0
    segments = [(1, 1), *((a, b) for k in range(2, border + 1) for a, b in ((1, k), (k, 1)))]

    def candidates(i: int, begin: int, end: int) -> Iterator[Array]:
        """Yield costs of the pairs (i, begin) to (i, end - 1), reached by each segment."""
        along = across = costs[i, begin:end]
        yield totals[i - 1, begin - 1 : end - 1] + along
        for k in range(2, border + 1):
            along = along + costs[i, begin - k + 1 : end - k + 1] + penalty**2
            across = across + costs[i - k + 1, begin:end] + penalty**2
            yield totals[i - 1, begin - k : end - k] + along
            yield totals[i - k, begin - 1 : end - 1] + across

    for i in range(border, n + border):
        totals[i, border:] = reduce(np.minimum, candidates(i, border, m + border))
    path = []
    i, j = n + border - 1, m + border - 1
    cost = float(totals[i, j])
    while np.isfinite(cost) and i >= border:
        a, b = segments[np.argmin([c[0] for c in candidates(i, j, j + 1)])]
        path += [(i - min(k, a - 1), j - min(k, b - 1)) for k in range(max(a, b))]
        i, j = i - a, j - b
    return np.array(path[::-1], dtype=np.intp).reshape(-1, 2) - border, cost


def warping_map(path: NDArray[np.intp], width: int = 0, min_slope: float = 1e-3) -> Array:
    """Turn a ``path`` (L, 2) into an increasing function of the reference index.

    Each reference index gets the mean of the source indices matched with it. The result is a
    staircase, whose steps would be bursts of speed: a moving average of that ``width`` removes
    them. It never runs slower than ``min_slope`` times its mean, so that an event has one
    instant. The ends of the path are kept.

    Returns
    -------
    ndarray of shape (N,)
        Fractional source indices, strictly increasing unless the path has one source index.
    """
    counts = np.bincount(path[:, 0])
    means = np.bincount(path[:, 0], weights=path[:, 1]) / counts
    means[0], means[-1] = path[0, 1], path[-1, 1]
    line = np.linspace(means[0], means[-1], len(means))
    return (1 - min_slope) * moving_average(means, width) + min_slope * line


def medoid(sequences: Sequence[Array], max_slope: int = 2, n_steps: int = 200) -> int:
    """Find the sequence with the least summed warping distance to the others.

    Parameters
    ----------
    sequences : sequence of ndarray of shape (T_m, D)
        At least one.
    max_slope : int, default=2
        As in :func:`warping_path`.
    n_steps : int, default=200
        To which longer sequences are shortened; each pair costs their square.
    """
    if len(sequences) < 3:
        return 0
    phase = np.linspace(0, 1, min(n_steps, max(map(len, sequences))))
    short = [resample(s, np.linspace(0, 1, len(s)), phase) for s in sequences]
    total = np.zeros(len(short))
    for i, j in itertools.combinations(range(len(short)), 2):
        total[[i, j]] += np.sqrt(warping_path(short[i], short[j], 0.0, max_slope)[1])
    return int(np.argmin(total))


def barycenter(
    sequences: Sequence[Array],
    start: Array,
    penalty: float = 0.0,
    max_slope: int = 2,
    *,
    tol: float = 1e-3,
    max_iter: int = 10,
) -> Array:
    """Average sequences by dynamic time warping barycentre averaging (DBA).

    Each round warps all sequences onto the average and replaces each of its points by the
    mean of the points matched with it.

    Parameters
    ----------
    sequences : sequence of ndarray of shape (T_m, D)
        At least one.
    start : ndarray of shape (N, D)
        First guess, usually the medoid.
    penalty, max_slope : float, int
        As in :func:`warping_path`.
    tol : float, default=1e-3
        It ends where the cost falls by less than this share.
    max_iter : int, default=10
        Rounds at most.

    References
    ----------
    Petitjean, Ketterlin, Gançarski: A global averaging method for dynamic time warping,
    with applications to clustering, Pattern Recognition 44(3), 2011.
    """
    average, last = start, np.inf
    for _ in range(max_iter):
        total, counts, cost = np.zeros_like(start), np.zeros(len(start)), 0.0
        for sequence in sequences:
            path, path_cost = warping_path(average, sequence, penalty, max_slope)
            np.add.at(total, path[:, 0], sequence[path[:, 1]])
            counts += np.bincount(path[:, 0], minlength=len(start))
            cost += path_cost
        if cost >= last * (1 - tol):
            break
        average, last = total / counts[:, None], cost
    return average
