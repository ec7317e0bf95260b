"""Rows that are computed once and read many times, kept in a temporary file."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tpgmm_torch.large_data.row_batches import Batch, Rows

__all__ = ["SpooledRows"]

#: Rows that are read at a time.
BATCH_ROWS = 2**16


class SpooledRows(Rows):
    """Rows in a file of the system's folder for temporary ones; it goes with the block.

    Use it in a ``with`` statement. ``TMPDIR`` says where that folder is.

    Examples
    --------
    >>> with SpooledRows() as rows:
    ...     rows.append(np.ones((2, 3)))
    ...     rows.append(np.zeros((1, 3)))
    ...     [batch.shape for batch in rows], rows.n_rows
    ([(3, 3)], 3)
    """

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="tpgmm-")
        self._path = Path(self._folder.name) / "rows"
        self._file = self._path.open("wb")
        self._width = 0
        self._dtype: np.dtype[Any] = np.dtype(np.float64)
        self._constant: NDArray[np.bool_] | None = None
        self._values: Batch | None = None
        self.n_rows = 0

    def append(self, rows: Batch) -> None:
        """Write rows (n, n_features), of the same width and precision as those before."""
        self._width, self._dtype = rows.shape[1], rows.dtype
        np.ascontiguousarray(rows).tofile(self._file)
        self.n_rows += len(rows)

    def make_constant(self, columns: NDArray[np.bool_], values: Batch) -> None:
        """From now on read ``values`` (n_features,) in the columns where the mask is set."""
        self._constant, self._values = columns, values

    def batches(self) -> Iterator[Batch]:
        """One pass over the file."""
        self._file.flush()
        count = BATCH_ROWS * self._width
        with self._path.open("rb") as file:
            while len(numbers := np.fromfile(file, self._dtype, count)):
                batch = numbers.reshape(-1, self._width)
                if self._constant is not None and self._values is not None:
                    batch[:, self._constant] = self._values[self._constant]
                yield batch

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *reason: Any) -> None:
        self._file.close()
        self._folder.cleanup()
