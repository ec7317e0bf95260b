"""Rows as the standardised points that EM walks through."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch.em.parameters import Standardization
from tpgmm_torch.em.points import Chunk, Points, standardized_chunks
from tpgmm_torch.large_data.processes import ALONE, Processes
from tpgmm_torch.large_data.row_batches import Rows, read_ahead

__all__ = ["RowPoints"]

#: Rows that are put in order of time and standardised at a time.
PIECE = 2**14


class RowPoints(Points):
    """Points made of rows: anew in each pass, or once where the rows are in memory.

    Parameters
    ----------
    rows : Rows
        Of this process.
    total : int
        Number of rows of all processes.
    units : Standardization
        On the device where the points shall be.
    n_components : int
        Of all mixtures that are evaluated, which decides how large a chunk is.
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
        total: int,
        units: Standardization,
        n_components: int,
        dtype: torch.dtype,
        *,
        group_size: int = 1,
        time_feature: int | None = None,
        processes: Processes = ALONE,
    ) -> None:
        self.widths, self.total = units.widths, total
        self.dtype, self.device = dtype, units.shifts[0].device
        self._rows, self._units, self._group_size = rows, units, group_size
        self._time_feature, self._processes = time_feature, processes
        self._n_components = n_components
        self._kept: list[Chunk] = []

    def __iter__(self) -> Iterator[Chunk]:
        """One pass over the rows; those not in memory are prepared one piece ahead."""
        if self._rows.in_memory:
            self._kept = self._kept or [chunk for piece in self._pieces() for chunk in piece]
            yield from self._kept
        else:
            for piece in read_ahead(self._pieces()):
                yield from piece

    def combine(self, *sums: Tensor) -> tuple[Tensor, ...]:
        """Add float64 sums over all processes."""
        return self._processes.sum(*sums)

    def concatenate(self, rows: Tensor) -> Tensor:
        """Rows of all processes, in their order."""
        return self._processes.concatenate(rows)

    def numbers(self) -> NDArray[np.intp]:
        """Which row of this process each point is, (n,), in the order of a pass."""
        numbers, start = [], 0
        for batch in self._rows.batches():
            numbers.append(start + self._order(batch))
            start += len(batch)
        return np.concatenate(numbers)

    def _pieces(self) -> Iterator[list[Chunk]]:
        step = max(1, PIECE // self._group_size) * self._group_size
        for batch in self._rows.batches():
            order = self._order(batch)
            for start in range(0, len(batch), step):
                yield standardized_chunks(
                    batch[order[start : start + step]],
                    self._units,
                    self._n_components,
                    self.dtype,
                    self._group_size,
                )

    def _order(self, batch: NDArray[np.floating]) -> NDArray[np.intp]:
        """Row numbers by time, groups staying together."""
        if self._time_feature is None:
            return np.arange(len(batch))
        groups = np.argsort(batch[:: self._group_size, self._time_feature], kind="stable")
        first = groups[:, None] * self._group_size
        return (first + np.arange(self._group_size)).ravel()
