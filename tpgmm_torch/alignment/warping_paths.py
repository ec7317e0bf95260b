"""Dynamic time warping of feature sequences: which instant of one is which of the other.

Plain arrays on uniform grids; :mod:`tpgmm_torch.alignment` applies the result to
demonstrations. The accumulated costs come from dtaidistance.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tpgmm_torch.data.arrays import Array
from tpgmm_torch.exceptions import DependencyError

__all__ = ["barycenter", "medoid", "moving_average", "resample", "warping_map", "warping_path"]

Floats = NDArray[np.floating[Any]]

#: A warp never runs slower than this, relative to its mean: events have one instant each.
SLOWEST = 1e-3
#: The medoid is chosen on sequences of at most this many steps.
MEDOID_STEPS = 400
#: The barycentre has converged when a round lowers the summed cost by less, relatively.
BARYCENTER_TOLERANCE = 1e-3


def _dtaidistance() -> Any:
    try:
        from dtaidistance import dtw_cc, dtw_ndim
    except ImportError as error:
        raise DependencyError(
            "dynamic time warping needs dtaidistance with its C library: "
            "pip install 'tpgmm-torch[data]'"
        ) from error
    del dtw_cc
    return dtw_ndim


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
) -> tuple[NDArray[np.intp], float]:
    """The cheapest monotone matching of two sequences.

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

    Returns
    -------
    path : ndarray of shape (L, 2)
        Matched (reference, source) indices from (0, 0) on.
    cost : float
        Summed squared distances and penalties, infinite if the window reaches no end.
    """
    n, m = len(reference), len(source)
    # dtaidistance widens the window by the difference in length: with equal lengths it is
    # exact. The costs of prefixes do not depend on what is appended here.
    band = None if window is None else window + 1
    length = max(n, m)
    if band is not None and length == 2 * band:
        length += 1  # dtaidistance 2.5 misplaces costs at exactly this size
    padded = [
        np.ascontiguousarray(np.pad(s, ((0, length - len(s)), (0, 0)), mode="edge"))
        for s in (reference, source)
    ]
    _, costs = _dtaidistance().warping_paths_fast(
        *padded, window=band, penalty=penalty, psi_neg=False, keep_int_repr=True
    )
    end = 1 + int(np.argmin(costs[n, 1 : m + 1])) if open_end else m
    cost = float(costs[n, end])
    if not np.isfinite(cost):
        return np.empty((0, 2), dtype=np.intp), cost
    return _backtrack(costs, n, end, penalty**2), cost


def _backtrack(costs: Array, i: int, j: int, penalty: float) -> NDArray[np.intp]:
    """Follow the accumulated costs, which have a border of infinity, back to (1, 1)."""
    path = [(i, j)]
    while i > 1 or j > 1:
        diagonal = costs.item(i - 1, j - 1)
        up, left = costs.item(i - 1, j) + penalty, costs.item(i, j - 1) + penalty
        if diagonal <= up and diagonal <= left:
            i, j = i - 1, j - 1
        elif up <= left:
            i -= 1
        else:
            j -= 1
        path.append((i, j))
    return np.array(path[::-1], dtype=np.intp) - 1


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


def medoid(sequences: Sequence[Array], window: float | None = None) -> int:
    """Index of the sequence with the least summed warping distance to the others.

    Parameters
    ----------
    sequences : sequence of ndarray of shape (T_m, D)
        At least one.
    window : float, optional
        As a fraction of the duration.
    """
    if len(sequences) < 3:
        return 0
    steps = min(MEDOID_STEPS, max(map(len, sequences)))
    phase = np.linspace(0, 1, steps)
    short = [
        np.ascontiguousarray(resample(s, np.linspace(0, 1, len(s)), phase)) for s in sequences
    ]
    band = None if window is None else 1 + max(1, round(window * (steps - 1)))
    distance = _dtaidistance().distance_fast
    total = np.zeros(len(short))
    for i, j in itertools.combinations(range(len(short)), 2):
        total[[i, j]] += distance(short[i], short[j], window=band)
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
