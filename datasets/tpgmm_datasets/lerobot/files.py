"""A series of parquet files that grow to a size and are kept in chunks of folders."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

import pyarrow as pa
import pyarrow.parquet as pq

__all__ = ["METADATA_KEY", "FileSeries"]

#: Under this key the data files repeat what ``info.json`` declares, so that an edit of the
#: one is noticed by the other.
METADATA_KEY = b"tpgmm_datasets"


class FileSeries:
    """Append tables to ``template`` with increasing numbers, after those of a set that grows.

    Parameters
    ----------
    root : Path
        Folder of the set.
    template : str
        Path of a file, with ``chunk_index`` and ``file_index``.
    file_bytes : int
        A file is closed before it grows beyond this, if it holds anything.
    chunk_files : int
        Number of files in a folder.
    before : Path
        Folder of the set as it was; ``root`` for a new one.
    metadata : str, optional
        Kept in each file under :data:`METADATA_KEY`.
    """

    def __init__(
        self,
        root: Path,
        template: str,
        file_bytes: int,
        chunk_files: int,
        before: Path,
        metadata: str | None = None,
    ) -> None:
        self.root, self.template = root, template
        self.file_bytes, self.chunk_files = file_bytes, chunk_files
        self.metadata = None if metadata is None else {METADATA_KEY: metadata.encode()}
        self.place = (0, 0)
        while (before / self._path().relative_to(root)).exists():
            self._advance()
        self.writer: pq.ParquetWriter | None = None

    def write(self, table: pa.Table, place: str | None = None) -> tuple[int, int]:
        """Write a table as row group; returns the numbers of chunk and file it went to.

        With ``place``, two columns of that prefix tell the table itself where it is.
        """
        path = self._path()
        if self.writer is not None and path.stat().st_size + table.nbytes > self.file_bytes:
            self.close()
            self._advance()
        if place is not None:
            for name, number in zip(("chunk_index", "file_index"), self.place, strict=True):
                numbers = pa.array([number] * len(table), pa.int64())
                table = table.append_column(place + name, numbers)
        table = table.replace_schema_metadata(self.metadata)
        if self.writer is None:
            path = self._path()
            path.parent.mkdir(parents=True, exist_ok=True)
            self.writer = pq.ParquetWriter(
                path, table.schema, compression="snappy", write_page_checksum=True
            )
        self.writer.write_table(table)
        return self.place

    def close(self) -> None:
        """Finish the file that is open, if one is."""
        if self.writer is not None:
            self.writer.close()
            self.writer = None

    def __enter__(self) -> FileSeries:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _path(self) -> Path:
        chunk, file = self.place
        return self.root / self.template.format(chunk_index=chunk, file_index=file)

    def _advance(self) -> None:
        chunk, file = self.place
        last = file + 1 >= self.chunk_files
        self.place = (chunk + 1, 0) if last else (chunk, file + 1)
