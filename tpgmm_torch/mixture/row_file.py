"""Rows in a temporary file: read once from wherever they come, then indexed like an array."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.utils import check_array
from torch import Tensor

from tpgmm_torch.exceptions import DataError, ShapeError

__all__ = ["FILE_ROWS", "RowFile", "Rows", "pieces"]

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
        """The rows of batches of shape (n, n_features), checked as they are read once.

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
    """All rows in float64, so many at a time as are read from a file at once.

    Parameters
    ----------
    rows : array of shape (n, n_features), or RowFile
    """
    for start in range(0, len(rows), FILE_ROWS):
        yield np.asarray(rows[start : start + FILE_ROWS], dtype=np.float64)
