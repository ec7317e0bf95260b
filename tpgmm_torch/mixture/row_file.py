"""Rows in memory or in a temporary file, and mean, variance and range of their columns."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.utils import check_array
from torch import Tensor

from tpgmm_torch.data.arrays import Array
from tpgmm_torch.exceptions import DataError, ShapeError
from tpgmm_torch.mixture.processes import ALONE, Processes

__all__ = ["RowFile"]

#: Rows that are read, drawn or kept at once: memory holds no more of a file.
FILE_ROWS = 2**16


class RowFile:
    """Rows of equal widths in a file of the system's folder for temporary ones.

    It is indexed as an array of shape (n_rows, n_features) is, and what is read is a copy:
    memory holds no more of it than that. The file goes with the object; ``TMPDIR`` says where
    it is.

    Examples
    --------
    >>> rows = RowFile()
    >>> rows.append(np.ones((2, 3)))
    >>> rows.append(np.zeros((1, 3)))
    >>> rows[1] = 5.0
    >>> len(rows), rows[1:].tolist()
    (3, [[5.0, 5.0, 5.0], [0.0, 0.0, 0.0]])
    """

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(prefix="tpgmm-")  # noqa: SIM115 - closed with it
        self.shape = (0, 0)
        self.dtype: np.dtype[Any] = np.dtype(np.float64)

    @classmethod
    def of(cls, batches: Iterable[Any]) -> Self:
        """Return the rows of batches of shape (n, n_features), checked as they are read once.

        Parameters
        ----------
        batches : iterable of array-like of shape (n, n_features)
            Arrays or tensors of numbers; those without rows are left out. All are kept in the
            precision of the first.

        Raises
        ------
        DataError
            If a batch is no finite array of numbers; what the iterable raises is raised itself.
        ShapeError
            If a batch has other columns than those before.
        """
        rows = cls()
        for number, given in enumerate(batches):
            values = given.detach().cpu().numpy() if isinstance(given, Tensor) else given
            kinds = rows.dtype if len(rows) else [np.float64, np.float32]
            try:
                batch = check_array(values, dtype=kinds, ensure_min_samples=0)
            except (ValueError, TypeError) as error:
                raise DataError(f"batch {number}: {error}") from error
            if len(rows) and batch.shape[1] != rows.shape[1]:
                raise ShapeError(
                    f"batch {number} has {batch.shape[1]} columns, those before have "
                    f"{rows.shape[1]}"
                )
            if len(batch):
                rows.append(batch)
        return rows

    def __del__(self) -> None:
        self._file.close()

    def __len__(self) -> int:
        return self.shape[0]

    def append(self, rows: NDArray[np.floating]) -> None:
        """Write rows (n, n_features), of the same width and precision as those before."""
        self._file.seek(0, 2)
        self._file.write(np.ascontiguousarray(rows).tobytes())
        self._file.flush()
        self.shape, self.dtype = (len(self) + len(rows), rows.shape[1]), rows.dtype

    def __getitem__(self, index: Any) -> NDArray[Any]:
        # mapped for this moment only: pages that stay mapped would count as memory
        return np.array(np.memmap(self._file, self.dtype, "r", shape=self.shape)[index])

    def __setitem__(self, index: Any, values: Any) -> None:
        np.memmap(self._file, self.dtype, "r+", shape=self.shape)[index] = values


#: Rows (n, n_features) in memory, or in a file.
Rows = NDArray[np.floating[Any]] | RowFile


def pieces(rows: Rows) -> Iterator[NDArray[np.float64]]:
    """Yield all rows in float64, in blocks of as many as are read from a file at once.

    Parameters
    ----------
    rows : array of shape (n, n_features), or RowFile
        In memory, or in a file.
    """
    for start in range(0, len(rows), FILE_ROWS):
        yield np.asarray(rows[start : start + FILE_ROWS], dtype=np.float64)


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
        Range of each column.
    """

    count: int
    mean: Array
    scatter: Array
    smallest: Array
    largest: Array

    @classmethod
    def of(cls, rows: Rows, processes: Processes = ALONE) -> ColumnMoments:
        """Return moments of the rows (n, n_features) of all processes.

        Raises
        ------
        DataError
            If a process has no rows, if the processes' rows have different numbers of
            columns, or if the variance overflows.
        """
        count = _count_rows(rows, processes)

        def everywhere(parts: list[Array], join: np.ufunc = np.add) -> Array:
            return np.asarray(join.reduce(processes.gather(join.reduce(parts))))

        first = processes.gather(np.asarray(rows[:1], np.float64)[0])[0]
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
        """Compute units (n_features,) in which columns, or blocks, have standard deviation 1.

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


def _count_rows(rows: Rows, processes: Processes) -> int:
    """Count the rows of all processes, which have some each, and the same columns."""
    counts, widths = zip(*processes.gather(rows.shape), strict=True)
    processes.check_share(counts, "row")
    if len(set(widths)) > 1:
        raise DataError(f"the processes' rows have {widths} columns: all need the same")
    return sum(counts)
