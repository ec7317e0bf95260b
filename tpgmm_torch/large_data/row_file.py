"""Rows that are computed once and read many times, kept in a temporary file."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tpgmm_torch.large_data.row_batches import Batch, Rows

__all__ = ["RowFile"]

#: Rows that are read at a time.
BATCH_ROWS = 2**16


class RowFile(Rows):
    """Rows in a file of the system's folder for temporary ones; it goes with the block.

    Use it in a ``with`` statement. ``TMPDIR`` says where that folder is.

    Examples
    --------
    >>> with RowFile() as rows:
    ...     rows.append(np.ones((2, 3)))
    ...     rows.append(np.zeros((1, 3)))
    ...     [batch.shape for batch in rows], rows.n_rows
    ([(3, 3)], 3)
    """

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(prefix="tpgmm-")  # noqa: SIM115 - closed on exit
        self._width = 0
        self._dtype: np.dtype[Any] = np.dtype(np.float64)
        self._constant: NDArray[np.bool_] = np.zeros(0, dtype=bool)
        self._values: Batch = np.zeros(0)
        self.n_rows = 0

    def append(self, rows: Batch) -> None:
        """Write rows (n, n_features), of the same width and precision as those before."""
        self._width, self._dtype = rows.shape[1], rows.dtype
        self._file.write(np.ascontiguousarray(rows).tobytes())
        self.n_rows += len(rows)

    def make_constant(self, columns: NDArray[np.bool_], values: Batch) -> None:
        """From now on read ``values`` (n_features,) in the columns where the mask is set."""
        self._constant, self._values = columns, values

    def keep(self, spans: Sequence[tuple[float, int, int]]) -> list[tuple[float, int, int]]:
        """Forget all rows but those of some demonstrations, and what was made constant.

        Parameters
        ----------
        spans : sequence of (float, int, int)
            Anything, first row and end of each, in their order.

        Returns
        -------
        list of (float, int, int)
            Where they are now.
        """
        row_bytes, end, moved = self._width * self._dtype.itemsize, 0, []
        for length, start, stop in spans:
            self._file.seek(start * row_bytes)
            content = self._file.read((stop - start) * row_bytes)
            self._file.seek(end * row_bytes)
            self._file.write(content)
            moved.append((length, end, end + stop - start))
            end += stop - start
        self._file.truncate(end * row_bytes)
        self.n_rows, self._constant = end, np.zeros(0, dtype=bool)
        return moved

    def batches(self) -> Iterator[Batch]:
        """One pass over the file."""
        for start in range(0, self.n_rows, BATCH_ROWS):
            yield self.read(start, start + BATCH_ROWS)

    def read(self, start: int, stop: int) -> Batch:
        """The rows from ``start`` on, up to ``stop``."""
        row_bytes = self._width * self._dtype.itemsize
        self._file.seek(start * row_bytes)
        content = bytearray(self._file.read((stop - start) * row_bytes))
        batch: Batch = np.frombuffer(content, self._dtype).reshape(-1, self._width)
        if self._constant.any():
            batch[:, self._constant] = self._values[self._constant]
        return batch

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *reason: Any) -> None:
        self._file.close()
