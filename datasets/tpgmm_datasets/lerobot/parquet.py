"""Parquet files, with errors that name the file instead of pyarrow's own."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tpgmm_datasets.errors import DatasetError
from tpgmm_torch.atomic import open_whole

#: Rows that are decoded at a time: what bounds the memory of an iteration.
BATCH_ROWS = 1 << 16
#: Rows times columns of what is read whole, and rows times values of an episode: beyond, the
#: memory would fill, however small the file is.
MOST_READ = 2_000_000
MOST_IN_EPISODE = 20_000_000
OVERFULL = (OverflowError, MemoryError)


@contextmanager
def _name_errors(file: Path) -> Iterator[None]:
    try:
        yield
    # what pyarrow raises on corrupted bytes is not one class: text that is no UTF-8, sizes
    # that overflow, columns that vanish
    except (pa.ArrowException, OSError, ValueError, KeyError, *OVERFULL) as error:
        if isinstance(error, DatasetError):
            raise
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        cause = "it is corrupted, truncated, or the set was never finalised"
        message = f"this is not a complete parquet file: {cause} ({reason})"
        raise DatasetError(message, check="missing", file=file) from error


def open_parquet(
    path: Path, root: Path, columns: Sequence[str], optional: Sequence[str] = ()
) -> pq.ParquetFile:
    """Open a parquet file, page checksums verified where it has them.

    Raises
    ------
    DatasetError
        If it is missing or unreadable, or a column is not in it, or one is twice.
    """
    file = path.relative_to(root)
    try:
        with open_whole(path):
            pass
    except (OSError, ValueError) as error:
        absent = isinstance(error, FileNotFoundError)
        message = "the file is missing" if absent else str(error)
        raise DatasetError(message, check="missing", file=file) from error
    with _name_errors(file):
        # buffering ahead would hold the whole file
        parquet = pq.ParquetFile(path, pre_buffer=False, page_checksum_verification=True)
        present = parquet.schema_arrow.names
    for column in (*columns, *(name for name in optional if name in present)):
        if present.count(column) != 1:
            there = [name for name in present if not name.startswith("stats/")]
            message = f"it has {present.count(column)} columns of that name; it has {there}"
            raise DatasetError(message, file=file, column=column)
    return parquet


def read_columns(path: Path, root: Path, columns: Sequence[str]) -> pa.Table:
    """Read some columns of a parquet file whole; errors are those of ``open_parquet``."""
    file = path.relative_to(root)
    with open_parquet(path, root, columns) as parquet, _name_errors(file):
        if (rows := parquet.metadata.num_rows) * len(columns) > MOST_READ:
            message = f"it has {rows} rows; at most {MOST_READ // len(columns)} are read"
            raise DatasetError(message, file=file)
        table = parquet.read(columns=list(columns), use_threads=False).select(list(columns))
        table.validate(full=True)
        return table


def episode_tables(
    parquet: pq.ParquetFile, file: Path, columns: Sequence[str]
) -> Iterator[tuple[int, pa.Table]]:
    """Yield the runs of rows of one episode in a data file, decoding a bounded part at a time.

    Parameters
    ----------
    parquet : pyarrow.parquet.ParquetFile
        The file, from :func:`open_parquet`.
    file : Path
        How errors call it.
    columns : sequence of str
        What to read; ``episode_index`` among them.

    Yields
    ------
    (int, pyarrow.Table)
        The index and rows of an episode. An episode whose rows are not contiguous comes
        more than once.

    Raises
    ------
    DatasetError
        If the file is unreadable.
    """
    with _name_errors(file):
        if parquet.metadata.num_rows <= BATCH_ROWS:
            batches = iter([parquet.read(list(columns))])  # faster than batches
        else:
            batches = parquet.iter_batches(BATCH_ROWS, columns=list(columns))
    current = -1
    parts: list[pa.Table] = []
    while (batch := _next(batches, file)) is not None:
        table = batch.select(list(columns))
        index = _episode_index(table, file)
        cuts = [0, *(np.flatnonzero(np.diff(index)) + 1), len(index)]
        for start, stop in itertools.pairwise(cuts):
            if stop > start and index[start] != current and parts:
                yield current, pa.concat_tables(parts)
                parts = []
            if stop > start:
                current = int(index[start])
                parts.append(table.slice(start, stop - start))
    if parts:
        yield current, pa.concat_tables(parts)


def _next(batches: Iterator[Any], file: Path) -> Any:
    with _name_errors(file):
        batch = next(batches, None)
        if batch is not None:
            batch.validate(full=True)
        return pa.table(batch) if isinstance(batch, pa.RecordBatch) else batch


def _episode_index(table: pa.Table, file: Path) -> np.ndarray[Any, Any]:
    column = table["episode_index"]
    if not pa.types.is_integer(column.type) or column.null_count:
        raise DatasetError("not all are whole numbers", file=file, column="episode_index")
    values: np.ndarray[Any, Any] = column.to_numpy()
    return values
