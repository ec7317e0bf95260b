"""Numbered parquet files in chunks of folders."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

#: Under this key the data files repeat what ``info.json`` declares, so that an edit of the
#: one is noticed by the other.
METADATA_KEY = b"tpgmm_datasets"


def file_path(template: str, chunk: int, file: int) -> str:
    """Return the path of a file, of a ``template`` with ``chunk_index`` and ``file_index``."""
    return template.format(chunk_index=chunk, file_index=file)


def chunked_files(folder: Path) -> list[Path]:
    """List the parquet files in the chunks of a folder, without hidden ones."""
    return sorted(folder.glob("[!.]*/[!.]*.parquet"))


def free_place(root: Path, template: str, chunk_files: int) -> tuple[int, int]:
    """Find numbers of chunk and file of the first that is not in the folder.

    Parameters
    ----------
    root : Path
        Folder of the set.
    template : str
        As of :func:`file_path`.
    chunk_files : int
        Number of files in a folder.
    """
    number = 0
    while (root / file_path(template, *divmod(number, chunk_files))).exists():
        number += 1
    return divmod(number, chunk_files)


def write_tables(
    path: Path, tables: Iterable[pa.Table], metadata: dict[bytes, bytes] | None = None
) -> None:
    """Write one or more tables into a parquet file, each a row group.

    Parameters
    ----------
    path : Path
        The file; its folder is made.
    tables : iterable of pyarrow.Table
        Rows of one schema.
    metadata : dict of bytes to bytes, optional
        Kept in the file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    writer: pq.ParquetWriter | None = None
    try:
        for table in tables:
            marked = table.replace_schema_metadata(metadata)
            if writer is None:
                options = {"compression": "snappy", "write_page_checksum": True}
                writer = pq.ParquetWriter(path, marked.schema, **options)
            writer.write_table(marked)
    finally:
        if writer is not None:
            writer.close()
