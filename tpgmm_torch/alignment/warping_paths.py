"""Dynamic time warping of feature sequences: which instant of one is which of the other.

Plain arrays on uniform grids; :mod:`tpgmm_torch.alignment` applies the result to
demonstrations.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from tpgmm_torch.data.arrays import Array

__all__ = ["barycenter", "medoid", "moving_average", "resample", "warping_map", "warping_path"]

Floats = NDArray[np.floating[Any]]

#: A warp never runs slower than this, relative to its mean: events have one instant each.
SLOWEST = 1e-3
#: The medoid is chosen on sequences of at most this many steps.
MEDOID_STEPS = 200
#: The barycentre has converged when a round lowers the summed cost by less, relatively.
BARYCENTER_TOLERANCE = 1e-3


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
    reference: Array,
    source: Array,
    window: int | None = None,
    penalty: float = 0.0,
    open_end: bool = False,
    max_slope: int = 2,
) -> tuple[NDArray[np.intp], float]:
    """The cheapest monotone matching of two sequences, within bounds of its slope.

    The path is made of segments that advance by one in one sequence and by one to
    ``max_slope`` in the other, so no part of it is steeper than ``max_slope`` or flatter than
    its inverse (Sakoe and Chiba's slope constraint) [1]_.

    Parameters
    ----------
    reference, source : ndarray of shape (N, D) and (M, D)
        The sequences.
    window : int, optional
        Matched indices differ by at most this.
    penalty : float, default=0.0
        Its square is added for each step that advances in one sequence alone.
    open_end : bool, default=False
        Match the whole reference with the best prefix of the source.
    max_slope : int, default=2
        At least one, which leaves the diagonal alone.

    Returns
    -------
    path : ndarray of shape (L, 2)
        Matched (reference, source) indices from (0, 0) on.
    cost : float
        Summed squared distances and penalties, infinite if no path reaches an end.

    References
    ----------
    .. [1] H. Sakoe, S. Chiba: Dynamic programming algorithm optimization for spoken word
       recognition. IEEE Transactions on Acoustics, Speech, and Signal Processing 26 (1978).
    """
    costs, totals = _accumulated(reference, source, window, penalty**2, max_slope)
    i, j = totals.shape[0] - 1, totals.shape[1] - 1
    if open_end:
        j = max_slope + int(np.argmin(totals[i, max_slope:]))
    cost = float(totals[i, j])
    if not np.isfinite(cost):
        return np.empty((0, 2), dtype=np.intp), cost
    return _backtrack(costs, totals, i, j, penalty**2, max_slope), cost


def _accumulated(
    reference: Array, source: Array, window: int | None, penalty: float, border: int
) -> tuple[Array, Array]:
    """Local costs and those of the cheapest paths to each pair, from ``border`` indices on.

    A path begins at the last pair of the border, whose others cannot be reached.
    """
    n, m = len(reference), len(source)
    costs = np.zeros((n + border, m + border))
    costs[border:, border:] = cdist(reference, source, "sqeuclidean")
    if window is not None:
        far = np.abs(np.arange(n)[:, None] - np.arange(m)) > window
        costs[border:, border:][far] = np.inf
    totals = np.full_like(costs, np.inf)
    totals[border - 1, border - 1] = 0.0
    for i in range(border, n + border):
        row, before = costs[i], totals[i - 1]
        best = before[border - 1 : -1] + row[border:]
        # of segments that advance by k in the source, then in the reference
        along, across = row[border:], row[border:]
        for k in range(2, border + 1):
            start = border - k
            along = along + row[start + 1 : start + 1 + m] + penalty
            np.minimum(best, before[start : start + m] + along, out=best)
            across = across + costs[i - k + 1, border:] + penalty
            np.minimum(best, totals[i - k, border - 1 : -1] + across, out=best)
        totals[i, border:] = best
    return costs, totals


def _backtrack(
    costs: Array, totals: Array, i: int, j: int, penalty: float, border: int
) -> NDArray[np.intp]:
    """Follow the accumulated costs back to the border; in doubt, diagonally."""
    path = []
    while i >= border:
        best, step = totals[i - 1, j - 1] + costs[i, j], (1, 1)
        along = across = costs[i, j]
        for k in range(2, border + 1):
            along = along + costs[i, j - k + 1] + penalty
            across = across + costs[i - k + 1, j] + penalty
            for total, other in (
                (totals[i - 1, j - k] + along, (1, k)),
                (totals[i - k, j - 1] + across, (k, 1)),
            ):
                if total < best:
                    best, step = total, other
        path += [(i - min(k, step[0] - 1), j - min(k, step[1] - 1)) for k in range(max(step))]
        i, j = i - step[0], j - step[1]
    return np.array(path[::-1], dtype=np.intp) - border


def warping_map(path: NDArray[np.intp], width: int = 0) -> Array:
    """Turn a ``path`` (L, 2) into an increasing function of the reference index.

    Each reference index gets the mean of the source indices matched with it. What a path
    leaves is a staircase, whose steps would be bursts of speed: a moving average of that
    ``width`` removes them. The ends of the path are kept.

    Returns
    -------
    ndarray of shape (N,)
        Fractional source indices, strictly increasing unless the path has one source index.
    """
    counts = np.bincount(path[:, 0])
    means = np.bincount(path[:, 0], weights=path[:, 1]) / counts
    means[0], means[-1] = path[0, 1], path[-1, 1]
    line = np.linspace(means[0], means[-1], len(means))
    return (1 - SLOWEST) * moving_average(means, width) + SLOWEST * line


def medoid(sequences: Sequence[Array], window: float | None = None, max_slope: int = 2) -> int:
    """Index of the sequence with the least summed warping distance to the others.

    Parameters
    ----------
    sequences : sequence of ndarray of shape (T_m, D)
        At least one.
    window : float, optional
        As a fraction of the duration.
    max_slope : int, default=2
        As in :func:`warping_path`.
    """
    if len(sequences) < 3:
        return 0
    steps = min(MEDOID_STEPS, max(map(len, sequences)))
    phase = np.linspace(0, 1, steps)
    short = [resample(s, np.linspace(0, 1, len(s)), phase) for s in sequences]
    band = None if window is None else max(1, round(window * (steps - 1)))
    total = np.zeros(len(short))
    for i, j in itertools.combinations(range(len(short)), 2):
        _, costs = _accumulated(short[i], short[j], band, 0.0, max_slope)
        total[[i, j]] += np.sqrt(costs[-1, -1])
    return int(np.argmin(total))


def barycenter(
    sequences: Sequence[Array], start: Array, n_iter: int = 10, **options: Any
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
    n_iter : int, default=10
        Largest number of rounds.
    **options
        Passed to :func:`warping_path`.

    References
    ----------
    Petitjean, Ketterlin, Gançarski: A global averaging method for dynamic time warping,
    with applications to clustering, Pattern Recognition 44(3), 2011.
    """
    average, last = start, np.inf
    for _ in range(n_iter):
        total, counts, cost = np.zeros_like(start), np.zeros(len(start)), 0.0
        for sequence in sequences:
            path, one = warping_path(average, sequence, **options)
            np.add.at(total, path[:, 0], sequence[path[:, 1]])
            counts += np.bincount(path[:, 0], minlength=len(start))
            cost += one
        if cost >= last * (1 - BARYCENTER_TOLERANCE):
            break
        average, last = total / counts[:, None], cost
    return average
