"""Rows as the standardised points that EM walks through."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray

from tpgmm_torch.em.block_gaussians import Chunk, Standardization
from tpgmm_torch.em.points import Points, StoredPoints
from tpgmm_torch.large_data.prefetch import prefetched
from tpgmm_torch.large_data.processes import ALONE, Processes
from tpgmm_torch.large_data.row_batches import Rows

__all__ = ["RowPoints"]

#: Rows that are put in order of time and standardised at a time.
PIECE = 2**14


class RowPoints(Points):
    """Points made of rows anew in each pass: nothing is kept.

    Parameters
    ----------
    rows : Rows
    n_points : int
        Number of rows in this process.
    units : Standardization
        On the device where the points shall be.
    n_components : int
        Of the mixtures that are evaluated, which decides how large a chunk is.
    dtype : torch.dtype
    group_size : int, default=1
        So many consecutive rows belong together.
    time_feature : int, optional
        The column by which the rows of a batch are sorted.
    processes : Processes, optional
        Who has a share of the points.
    """

    def __init__(
        self,
        rows: Rows,
        n_points: int,
        units: Standardization,
        n_components: int,
        dtype: torch.dtype,
        *,
        group_size: int = 1,
        time_feature: int | None = None,
        processes: Processes = ALONE,
    ) -> None:
        self.widths = tuple(len(shift) for shift in units.shifts)
        self.dtype, self.device = dtype, units.shifts[0].device
        self.time_feature, self.processes = time_feature, processes
        self._rows, self._units, self._group_size = rows, units, group_size
        self._n_components = n_components
        self._count(n_points)

    def __iter__(self) -> Iterator[Chunk]:
        """One pass over the rows; those not in memory are prepared one piece ahead."""
        pieces = self._pieces()
        for chunks in pieces if self._rows.in_memory else prefetched(pieces):
            yield from chunks

    def _pieces(self) -> Iterator[list[Chunk]]:
        step = max(1, PIECE // self._group_size) * self._group_size
        for batch in self._rows.batches():
            order = self._order(batch)
            for start in range(0, len(batch), step):
                part = slice(start, start + step)
                rows, chosen = (batch[part], None) if order is None else (batch, order[part])
                yield self._units.chunks(
                    rows, self._n_components, self.dtype, self._group_size, chosen
                )

    def stored(self) -> StoredPoints:
        """The same points kept in memory, standardised once."""
        return StoredPoints(list(self), self.time_feature, self.processes)

    def numbers(self) -> NDArray[np.intp]:
        """Which row each point is, (n_points,), in the order of a pass."""
        found, start = [], 0
        for batch in self._rows.batches():
            order = self._order(batch)
            found.append(start + (np.arange(len(batch)) if order is None else order))
            start += len(batch)
        return np.concatenate(found)

    def _order(self, batch: NDArray[np.floating]) -> NDArray[np.intp] | None:
        """Row numbers by time, groups staying together; None if they are in order already."""
        if self.time_feature is None:
            return None
        times = batch[:: self._group_size, self.time_feature]
        if (np.diff(times) >= 0).all():
            return None
        groups = np.argsort(times, kind="stable")
        first = groups[:, None] * self._group_size
        return (first + np.arange(self._group_size)).ravel()
