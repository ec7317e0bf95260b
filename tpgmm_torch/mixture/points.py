"""Standardised rows in chunks, the same in each pass: what expectation-maximisation sees."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch.mixture.processes import Processes
from tpgmm_torch.mixture.row_file import FILE_ROWS, Rows

#: Standardised rows, columns (x_1; 1; ...; x_P; 1) of shape (sum D_j + P, n), and their numbers
#: (n,) among those of all processes.
Chunk = tuple[Tensor, Tensor]

#: Whitened coordinates of a chunk in float64, in float32 twice as many: what a processor's
#: cache holds, and what keeps a GPU busy.
CHUNK_SIZE = {"cpu": 3 * 2**17, "gpu": 2**25}


class Points:
    """Rows of this process, standardised and in the order of time, in chunks.

    A chunk whose rows are near each other in time lets components be left out that are far
    from it. Rows in memory are prepared once, those in a file in each pass, piece by piece.

    Parameters
    ----------
    rows : array of shape (n_rows, sum D_j), or RowFile
        The first column is time.
    shift, scale : Tensor of shape (sum D_j,)
        A row x becomes ``(x - shift) / scale``. They are on the device where to compute.
    widths : sequence of int
        D_j of each block.
    n_components : int
        Of the mixture, which decides how large a chunk is.
    dtype : torch.dtype
        Of the standardised rows.
    group_size : int
        So many consecutive rows stay together.
    processes : Processes
        Among which the rows are shared.

    Attributes
    ----------
    total : int
        Number of rows of all processes.
    spans : Tensor of shape (n_chunks, 2, P)
        Least and largest value of each block's first column in each chunk.
    """

    def __init__(
        self,
        rows: Rows,
        shift: Tensor,
        scale: Tensor,
        widths: Sequence[int],
        n_components: int,
        dtype: torch.dtype,
        group_size: int,
        processes: Processes,
    ) -> None:
        self.shift, self.scale, self.widths, self.dtype = shift, scale, list(widths), dtype
        self.group_size, self.processes = group_size, processes
        counts = processes.gather(len(rows))
        self.total, self._first = sum(counts), sum(counts[: processes.rank])
        self._rows, self._kept = rows, list[Chunk]()
        whole = CHUNK_SIZE["cpu" if shift.device.type == "cpu" else "gpu"] * 8 // dtype.itemsize
        groups = whole // (n_components * len(shift)) // group_size + 1
        self._size = groups * group_size
        ends = np.cumsum(np.add(widths, 1))
        self.values = np.delete(np.arange(ends[-1]), ends - 1)  # where no ones are
        firsts = [0, *ends[:-1].tolist()]
        spans = [torch.stack(chunk[firsts].aminmax(dim=1)) for chunk, _ in self]
        self.spans = torch.stack(spans).double()

    def __iter__(self) -> Iterator[Chunk]:
        """Pass once over the rows of this process."""
        if isinstance(self._rows, np.ndarray):
            self._kept = self._kept or list(self._pass(self._rows, len(self._rows)))
            return iter(self._kept)
        return self._pass(self._rows, max(1, FILE_ROWS // self.group_size) * self.group_size)

    def _pass(self, rows: Rows, piece_size: int) -> Iterator[Chunk]:
        members = np.arange(self.group_size)
        for start in range(0, len(rows), piece_size):
            piece = rows[start : start + piece_size]
            groups = np.argsort(piece[:: self.group_size, 0], kind="stable")
            order = (groups[:, None] * self.group_size + members).ravel()
            # one allocation for all chunks of a piece: many small ones would fragment memory
            height = len(self.values) + len(self.widths)
            memory = self.scale.new_ones(len(piece) * height, dtype=self.dtype)
            numbers = torch.from_numpy(order + start + self._first).to(memory.device)
            for first in range(0, len(order), self._size):
                chunk_rows = order[first : first + self._size]
                chunk = memory[first * height :][: len(chunk_rows) * height].view(height, -1)
                chunk[self.values] = self.standardize(piece[chunk_rows]).T.to(self.dtype)
                yield chunk, numbers[first : first + len(chunk_rows)]

    def standardize(self, rows: NDArray[np.floating]) -> Tensor:
        """Standardise rows (n, sum D_j) of the data, in float64."""
        return (torch.from_numpy(rows).to(self.shift) - self.shift).div_(self.scale)

    def blocks(self, chunk: Tensor) -> tuple[Tensor, ...]:
        """Split a chunk into blocks (x_j; 1), each of shape (D_j + 1, n)."""
        return chunk.split([width + 1 for width in self.widths])

    def sample(self, every: int = 1) -> tuple[Tensor, Tensor]:
        """Draw at most ``FILE_ROWS`` rows of all processes; all where they are no more.

        Parameters
        ----------
        every : int, default=1
            Every how many rows one is used.

        Returns
        -------
        Tensor of shape (n, sum D_j)
            Standardised, in float64.
        Tensor of shape (n,)
            Their numbers among those that count.
        """
        wanted = np.arange(self.total // every)
        if len(wanted) > FILE_ROWS:
            draws = np.random.RandomState(0).randint(0, len(wanted), FILE_ROWS)
            wanted = np.unique(draws)
        places = wanted * every - self._first
        local_rows = places[(places >= 0) & (places < len(self._rows))]
        found = torch.cat(self.processes.gather(self.standardize(self._rows[local_rows]).cpu()))
        return found.to(self.shift), torch.from_numpy(wanted).to(self.shift.device)
