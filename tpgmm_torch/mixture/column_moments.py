"""Mean, variance and range of columns, of all processes together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tpgmm_torch.exceptions import DataError
from tpgmm_torch.mixture.processes import ALONE, Processes
from tpgmm_torch.mixture.row_file import Rows, pieces

__all__ = ["ColumnMoments"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ColumnMoments:
    """Moments and range of each column, in float64.

    Parameters
    ----------
    count : int
        Number of rows, at least 1.
    mean, scatter : array of shape (n_features,)
        Mean, and sum of squared deviations from it.
    smallest, largest : array of shape (n_features,)
    """

    count: int
    mean: Array
    scatter: Array
    smallest: Array
    largest: Array

    @classmethod
    def of(cls, rows: Rows, processes: Processes = ALONE) -> ColumnMoments:
        """Moments of the rows (n, n_features) of all processes.

        Raises
        ------
        DataError
            If a process has no rows, if the processes' rows have different numbers of
            columns, or if the variance overflows.
        """
        counts, widths = zip(*processes.gather(rows.shape), strict=True)
        if empty := [rank for rank, count in enumerate(counts) if not count]:
            where = f" in process(es) {empty} of {processes.count}"
            raise DataError(f"there are no rows{where if processes.count > 1 else ''}")
        if len(set(widths)) > 1:
            raise DataError(f"the processes' rows have {widths} columns: all need the same")

        def everywhere(own: list[Array], joined: np.ufunc = np.add) -> Array:
            return np.asarray(joined.reduce(processes.gather(joined.reduce(own))))

        count, first = sum(counts), processes.gather(np.asarray(rows[:1], np.float64)[0])[0]
        with np.errstate(over="ignore", invalid="ignore"):
            # seen from the first row, so that a constant column varies by nothing at all
            mean = first + everywhere([(part - first).sum(0) for part in pieces(rows)]) / count
            scatter = everywhere([np.square(part - mean).sum(0) for part in pieces(rows)])
        if not np.isfinite(scatter).all():
            raise DataError("the variance of the data overflows; divide the data by a constant")
        low = everywhere([part.min(0) for part in pieces(rows)], np.minimum)
        high = everywhere([part.max(0) for part in pieces(rows)], np.maximum)
        return cls(count, mean, scatter, low, high)

    def scales(self, widths: Sequence[int], *, isotropic: bool) -> Array:
        """The units (n_features,) in which each column, or block, has standard deviation 1.

        A constant column takes the mean variance of its block, or 1 where that is zero too.

        Parameters
        ----------
        widths : sequence of int
            Widths of the blocks.
        isotropic : bool
            Scale all columns of a block alike.
        """
        variance = self.scatter / self.count
        largest = np.maximum(np.abs(self.largest), np.abs(self.smallest))
        # what rounding leaves of a constant column is no variance
        variance[np.sqrt(variance) <= 10 * np.finfo(np.float64).eps * largest] = 0.0
        blocks = np.split(variance, np.cumsum(widths)[:-1])
        common = np.repeat([block.mean() or 1.0 for block in blocks], list(widths))
        return np.sqrt(common if isotropic else np.where(variance == 0, common, variance))
