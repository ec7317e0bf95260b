"""Bins along time with equal numbers of points, exact and without sorting all points.

The limits of the bins are order statistics. They are found by counting: points are counted in
intervals of time, then again in finer ones around the limits, until few enough different times
are left to be kept.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from tpgmm_torch.large_data.processes import ALONE, Processes
from tpgmm_torch.large_data.row_batches import Rows

__all__ = ["TimeBins", "bin_sizes"]

Array = NDArray[np.float64]
Labels = NDArray[np.int64]
#: Gives the points of a batch, by their times, their bins; batches have to come in order.
Labeller = Callable[[NDArray[np.floating]], Labels]

#: Most different times that are kept at once.
MOST_TIMES = 2**20
#: Into so many intervals the times are counted.
INTERVALS = 2**16


def bin_sizes(
    n_points: int, n_bins: int, rng: np.random.RandomState | None = None
) -> NDArray[np.int64]:
    """Sizes of bins that together hold ``n_points`` points, each at least one.

    Parameters
    ----------
    n_points : int
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


@dataclass(frozen=True)
class TimeBins:
    """Bins of given sizes along time; points of equal time are taken in their order.

    Parameters
    ----------
    limits : array of shape (n_bins - 1,)
        The time of the first point of each bin but the first.
    before : array of shape (n_bins - 1,)
        How many points of exactly that time still belong to the bins before.
    earlier : array of shape (n_bins - 1,)
        How many points of exactly that time the processes before this one have.
    """

    limits: Array
    before: Labels
    earlier: Labels

    @classmethod
    def of_rows(
        cls,
        rows: Rows,
        column: int,
        sizes: Sequence[int] | Labels,
        processes: Processes = ALONE,
    ) -> TimeBins:
        """Find the limits, mostly in one pass over the rows of this process.

        Where there are many different times, in three.

        Parameters
        ----------
        rows : Rows
        column : int
            The one that holds time.
        sizes : sequence of int
            Numbers of points in the bins, of all processes together.
        processes : Processes
        """
        ranks = np.cumsum(sizes)[:-1]
        edges, counts = np.array([-np.inf, np.inf]), np.array([np.sum(sizes)])
        while True:
            ends = np.cumsum(counts)
            place = np.searchsorted(ends, ranks, side="right")  # the interval of each rank
            chosen = np.unique(place)
            found = _distinct(rows, column, edges, chosen, processes)
            if found is not None:
                break
            edges = _finer(rows, column, edges, chosen, processes)
            counts = _counts(rows, column, edges, processes)
        times, everywhere, here_before = found
        # of the points in chosen intervals, so many come before each rank
        skipped = np.cumsum(np.where(np.isin(np.arange(len(counts)), chosen), 0, counts))
        within = ranks - skipped[place]
        ends = np.cumsum(everywhere)
        index = np.searchsorted(ends, within, side="right")
        return cls(times[index], within - (ends - everywhere)[index], here_before[index])

    def labeller(self) -> Labeller:
        """What gives the points of one pass, batch by batch, their bins."""
        tied = np.unique(self.limits)
        _, first = np.unique(self.limits, return_index=True)
        seen = self.earlier[first].copy() if len(tied) else self.earlier

        def labels(times: NDArray[np.floating]) -> Labels:
            times = np.asarray(times, dtype=np.float64)
            bins = np.searchsorted(self.limits, times, side="left").astype(np.int64)
            for place, limit in enumerate(tied):
                (equal,) = np.nonzero(times == limit)
                number = seen[place] + np.arange(len(equal))
                seen[place] += len(equal)
                passed = self.before[self.limits == limit]
                bins[equal] += np.searchsorted(passed, number, side="right")
            return bins

        return labels


def _times(rows: Rows, column: int) -> Iterator[Array]:
    for batch in rows:
        yield np.asarray(batch[:, column], dtype=np.float64)


def _counts(rows: Rows, column: int, edges: Array, processes: Processes) -> Labels:
    """Points in each interval (edge, next edge], of all processes."""
    counts = np.zeros(len(edges) - 1, dtype=np.int64)
    for times in _times(rows, column):
        places = np.searchsorted(edges[1:-1], times, side="left")
        counts += np.bincount(places, minlength=len(counts))
    (total,) = processes.sum(torch.from_numpy(counts).double())
    return total.numpy().astype(np.int64)


def _distinct(
    rows: Rows, column: int, edges: Array, chosen: Labels, processes: Processes
) -> tuple[Array, Labels, Labels] | None:
    """Different times in the chosen intervals, or None if they are too many to keep.

    With them come how many points have each, in all processes and in those before this one.
    """
    wanted = np.zeros(len(edges) - 1, dtype=bool)
    wanted[chosen] = True
    values: Array = np.empty(0)
    counts: Labels = np.empty(0, dtype=np.int64)
    waiting: list[tuple[Array, Labels]] = []
    size = 0
    for times in _times(rows, column):
        if not wanted.all():
            times = times[wanted[np.searchsorted(edges[1:-1], times, side="left")]]
        waiting.append(np.unique(times, return_counts=True))
        size += len(waiting[-1][0])
        if size > MOST_TIMES:  # not at every batch: merging costs as much as there is
            values, counts = _merged([(values, counts), *waiting])
            waiting, size = [], 0
            if len(values) > MOST_TIMES:
                break
    values, counts = _merged([(values, counts), *waiting])
    sizes = processes.concatenate(torch.tensor([len(values)], dtype=torch.float64))
    if float(sizes.max()) > MOST_TIMES:
        return None
    ranks = np.full(len(values), processes.rank)
    table = np.stack([values, counts, ranks], 1).astype(np.float64)
    everyone = processes.concatenate(torch.from_numpy(table)).numpy()
    times, place = np.unique(everyone[:, 0], return_inverse=True)
    before = everyone[:, 2] < processes.rank
    total = np.bincount(place, everyone[:, 1], len(times)).astype(np.int64)
    earlier = np.bincount(place[before], everyone[before, 1], len(times)).astype(np.int64)
    return times, total, earlier


def _merged(parts: Sequence[tuple[Array, Labels]]) -> tuple[Array, Labels]:
    values, place = np.unique(np.concatenate([part[0] for part in parts]), return_inverse=True)
    counts = np.concatenate([part[1] for part in parts])
    return values, np.bincount(place, counts, len(values)).astype(np.int64)


def _finer(
    rows: Rows, column: int, edges: Array, chosen: Labels, processes: Processes
) -> Array:
    """Edges that cut the chosen intervals into finer ones."""
    if not np.isfinite(edges).all():
        ends = [(times.min(), times.max()) for times in _times(rows, column)]
        own = torch.tensor([[min(e[0] for e in ends), max(e[1] for e in ends)]])
        extremes = processes.concatenate(own.double()).numpy()
        low = np.nextafter(extremes[:, 0].min(), -np.inf)
        return np.linspace(low, extremes[:, 1].max(), INTERVALS + 1)
    each = max(2, INTERVALS // len(chosen))
    parts = [np.linspace(edges[i], edges[i + 1], each + 1) for i in chosen]
    return np.unique(np.concatenate([edges, *parts]))
