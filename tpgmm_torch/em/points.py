"""The points that a mixture is learned from, in passes: wherever they are stored.

EM sees the points only through :class:`Points`, chunk by chunk and pass after pass.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch.em.parameters import Standardization

__all__ = ["Chunk", "Points", "StoredPoints", "standardized_chunks"]

#: One chunk of points: for each block the columns (x; 1), shape (D_j + 1, n).
Chunk = tuple[Tensor, ...]

#: Whitened coordinates of a chunk, in float64, in float32 twice as many: what a processor's
#: cache can keep, and what a GPU is busy with.
CHUNK_SIZE = {"cpu": 3 * 2**17, "gpu": 2**25}


class Points(ABC):
    """Standardised points as a source of chunks that can be walked through again and again.

    Every pass yields the same chunks in the same order. Chunks whose points are near each
    other in time let EM leave out components that are far away; they end where groups end.

    Attributes
    ----------
    widths : tuple of int
        D_j of each block.
    total : int
        Number of points, with those of other processes where there are such.
    dtype : torch.dtype
        Of the chunks.
    device : torch.device
        Of the chunks.
    """

    widths: tuple[int, ...]
    total: int
    dtype: torch.dtype
    device: torch.device

    @abstractmethod
    def __iter__(self) -> Iterator[Chunk]:
        """One pass: chunks, each a tuple of Tensor of shape (D_j + 1, n), columns (x; 1)."""

    def combine(self, *sums: Tensor) -> tuple[Tensor, ...]:
        """Add float64 sums over all points to those of other processes; by default none."""
        return sums

    def concatenate(self, rows: Tensor) -> Tensor:
        """Rows (n, ...) with those of other processes after each other; by default none."""
        return rows


class StoredPoints(Points):
    """Points held in memory.

    Parameters
    ----------
    chunks : sequence of tuple of Tensor of shape (D_j + 1, n)
        At least one.

    Examples
    --------
    >>> chunk = (torch.tensor([[0.0, 1.0], [1.0, 1.0]]),)
    >>> points = StoredPoints([chunk])
    >>> points.widths, points.total, len(list(points))
    ((1,), 2, 1)
    """

    def __init__(self, chunks: Sequence[Chunk]) -> None:
        self._chunks = list(chunks)
        first = self._chunks[0]
        self.widths = tuple(len(block) - 1 for block in first)
        self.total = sum(chunk[0].shape[1] for chunk in self._chunks)
        self.dtype, self.device = first[0].dtype, first[0].device

    def __iter__(self) -> Iterator[Chunk]:
        """One pass over the chunks."""
        return iter(self._chunks)


def standardized_chunks(
    rows: NDArray[np.floating],
    units: Standardization,
    n_components: int,
    dtype: torch.dtype,
    group_size: int = 1,
) -> list[Chunk]:
    """Standardise rows (n, n_features) in float64, and cut them between groups.

    Parameters
    ----------
    rows : array of shape (n, n_features)
    units : Standardization
        On the device where the chunks shall be.
    n_components : int
        Of all mixtures that are evaluated, which decides how large a chunk is.
    dtype : torch.dtype
        Of the chunks.
    group_size : int, default=1
        So many consecutive rows stay together.
    """
    standard = units.rows(rows)
    widths = [width + 1 for width in units.widths]
    whole = CHUNK_SIZE["cpu" if standard.device.type == "cpu" else "gpu"] * 8 // dtype.itemsize
    packed = sum(width * (width + 1) // 2 for width in widths)  # if they are expanded
    size = whole // min(n_components * sum(widths), packed) // group_size * group_size
    size += group_size
    chunks = []
    for part in standard.split(int(size)):
        blocks = []
        for width, columns in zip(widths, part.split(units.widths, 1), strict=True):
            block = standard.new_ones(width, len(part), dtype=dtype)
            block[:-1] = columns.T
            blocks.append(block)
        chunks.append(tuple(blocks))
    return chunks
