"""Rows of numbers as a source of batches, in memory or not, that is walked through repeatedly.

What a user gives is checked here, at every pass: a source that changes between passes would
make EM climb on shifting ground.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.utils import check_array
from torch import Tensor

from tpgmm_torch.exceptions import DataError, ShapeError

__all__ = ["BatchedRows", "Rows", "StoredRows", "are_batches", "read_ahead"]

Batch = NDArray[np.floating[Any]]

#: Smaller batches are put together until they have so many rows: work on few is overhead.
FEWEST_ROWS = 2**14


def are_batches(X: object) -> bool:
    """Whether X is an iterable of batches of rows, and no array itself.

    Examples
    --------
    >>> are_batches([[1.0, 2.0], [3.0, 4.0]]), are_batches([np.ones((2, 3)), np.ones((4, 3))])
    (False, True)
    """
    if isinstance(X, (str, bytes, dict)) or hasattr(X, "__array__") or hasattr(X, "shape"):
        return False
    if hasattr(X, "__dataframe__") or not isinstance(X, Iterable):
        return False
    if isinstance(X, Sequence):
        return len(X) > 0 and getattr(X[0], "ndim", 0) == 2
    return True


def read_ahead[T](source: Iterable[T]) -> Iterator[T]:
    """Walk through ``source`` in a thread of its own, one item ahead of who asks.

    Yields
    ------
    object
        The same items in the same order; two are in memory, one in use and one being read.

    Raises
    ------
    Exception
        What the source raises, itself, with a note of how many items came before it.

    Examples
    --------
    >>> list(read_ahead(range(3)))
    [0, 1, 2]
    """
    iterator, count = iter(source), 0
    with ThreadPoolExecutor(1, thread_name_prefix="tpgmm-reader") as reader:
        try:
            following = reader.submit(lambda: [*islice(iterator, 1)])
            while item := following.result():
                following = reader.submit(lambda: [*islice(iterator, 1)])
                count += 1
                yield item[0]
        except Exception as error:
            error.add_note(f"while reading ahead, after {count} batches")
            raise


class Rows:
    """Batches of rows that can be walked through again and again.

    Attributes
    ----------
    in_memory : bool
        Whether all rows are in memory anyway.
    n_rows : int
        How many rows this process has; known after the first pass.
    """

    in_memory: bool = False
    n_rows: int = 0

    def batches(self) -> Iterator[Batch]:
        """One pass: arrays of shape (n, n_features), n >= 1, of float64 or float32, finite."""
        raise NotImplementedError

    def __iter__(self) -> Iterator[Batch]:
        """The same; what is not in memory is read by a thread, one batch ahead."""
        return self.batches() if self.in_memory else read_ahead(self.batches())


class StoredRows(Rows):
    """Rows in memory.

    Parameters
    ----------
    rows : array of shape (n_samples, n_features)
    """

    in_memory = True

    def __init__(self, rows: Batch) -> None:
        self.rows, self.n_rows = rows, len(rows)

    def batches(self) -> Iterator[Batch]:
        """All rows at once."""
        yield self.rows


class BatchedRows(Rows):
    """Rows that come in batches from somewhere.

    Parameters
    ----------
    source : iterable of array-like of shape (n, n_features)
        It has to start anew at each ``iter(source)``, with the same batches. Batches without
        rows are passed over.
    group_size : int, default=1
        The rows of each batch must be a multiple of it.

    Raises
    ------
    DataError
        If the source is an iterator, which can be walked through only once. In a pass: if a
        batch is no finite array of numbers, or the source has changed since the last pass.
    ShapeError
        In a pass: if a batch has other columns than those before, or parts a group.
    """

    def __init__(self, source: Iterable[Any], group_size: int = 1) -> None:
        if isinstance(source, Iterator):
            raise DataError(
                f"{type(source).__name__} can be walked through only once, and EM needs a pass "
                "in each iteration: give an object whose __iter__ starts anew, or a list"
            )
        self._source, self._group_size = source, group_size
        self._width = 0

    def batches(self) -> Iterator[Batch]:
        """One pass, small batches put together."""
        parts: list[Batch] = []
        count = passed = 0
        for number, given in enumerate(self._source):
            batch = self._checked(given, number)
            if len(batch):
                parts.append(batch)
            count += len(batch)
            passed += len(batch)
            if count >= FEWEST_ROWS:
                yield parts[0] if len(parts) == 1 else np.concatenate(parts)
                parts, count = [], 0
        if self.n_rows not in (0, passed):
            raise DataError(
                f"the source of the data gave {self.n_rows} rows before, and {passed} now: it "
                "must give the same batches in each pass"
            )
        self.n_rows = passed
        if parts:
            yield np.concatenate(parts)

    def _checked(self, given: Any, number: int) -> Batch:
        values = given.detach().cpu().numpy() if isinstance(given, Tensor) else given
        try:
            batch: Batch = check_array(
                values, dtype=[np.float64, np.float32], ensure_min_samples=0
            )
        except (ValueError, TypeError) as error:
            raise DataError(f"batch {number}: {error}") from error
        self._width = self._width or batch.shape[1]
        if batch.shape[1] != self._width:
            raise ShapeError(
                f"batch {number} has {batch.shape[1]} columns, those before have {self._width}"
            )
        if len(batch) % self._group_size:
            raise ShapeError(
                f"batch {number} has {len(batch)} rows, which is no multiple of "
                f"group_size={self._group_size}: a batch holds whole groups"
            )
        return batch
