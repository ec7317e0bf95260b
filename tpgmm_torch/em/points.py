"""The points that a mixture is learned from, in passes: wherever they are stored.

EM sees the points only through :class:`Points`, chunk by chunk and pass after pass. Whether
they are in memory, on disk or spread over several processes is the business of who made them.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from tpgmm_torch.em.block_gaussians import Chunk
from tpgmm_torch.large_data.processes import ALONE, Processes

__all__ = ["Points", "StoredPoints", "Subset"]


class Points(ABC):
    """Standardised points as a source of chunks that can be walked through again and again.

    Every pass yields the same chunks in the same order. Within what the source holds in
    memory at a time (everything, or one batch), points are sorted by time where the mixture
    has a time column; points of one group are never parted, and chunks end where groups end.

    Attributes
    ----------
    widths : tuple of int
        D_j of each block.
    n_points : int
        Number of points in this process.
    total : int
        Number of points in all processes.
    offset : int
        Number of points in the processes before this one, so that ``offset + i`` numbers the
        points of all processes in one sequence.
    dtype : torch.dtype
        Of the chunks.
    device : torch.device
        Of the chunks.
    time_feature : int or None
        The column of the first block by which points are sorted.
    processes : Processes
        Who has a share of the points.
    """

    widths: tuple[int, ...]
    n_points: int
    total: int
    offset: int
    dtype: torch.dtype
    device: torch.device
    time_feature: int | None
    processes: Processes

    @abstractmethod
    def __iter__(self) -> Iterator[Chunk]:
        """One pass: chunks, each a tuple of Tensor of shape (D_j + 1, n), columns (x; 1)."""

    def combine(self, *sums: Tensor) -> tuple[Tensor, ...]:
        """Add float64 sums over all processes; every process must ask, in the same order.

        Parameters
        ----------
        *sums : Tensor
            Of the same shapes in all processes; they are not changed.

        Returns
        -------
        tuple of Tensor
            To the last bit the same in all processes.
        """
        return self.processes.sum(*sums)

    def _count(self, n_points: int) -> None:
        """Set ``n_points``, and with the other processes ``total`` and ``offset``."""
        counts = self.processes.concatenate(torch.tensor([n_points], dtype=torch.float64))
        self.n_points, self.total = n_points, int(counts.sum())
        self.offset = int(counts[: self.processes.rank].sum())


class StoredPoints(Points):
    """Points held in memory.

    Parameters
    ----------
    chunks : sequence of tuple of Tensor of shape (D_j + 1, n)
        At least one.
    time_feature : int, optional
        The column of the first block by which points are sorted.
    processes : Processes, optional
        Who has a share of the points; this process alone by default.

    Examples
    --------
    >>> chunk = (torch.tensor([[0.0, 1.0], [1.0, 1.0]]),)
    >>> points = StoredPoints([chunk])
    >>> points.widths, points.n_points, len(list(points))
    ((1,), 2, 1)
    """

    def __init__(
        self,
        chunks: Sequence[Chunk],
        time_feature: int | None = None,
        processes: Processes = ALONE,
    ) -> None:
        self.time_feature, self.processes = time_feature, processes
        self._chunks = list(chunks)
        first = self._chunks[0]
        self.widths = tuple(len(block) - 1 for block in first)
        self._count(sum(chunk[0].shape[1] for chunk in self._chunks))
        self.dtype, self.device = first[0].dtype, first[0].device

    def __iter__(self) -> Iterator[Chunk]:
        """One pass over the chunks."""
        return iter(self._chunks)


class Subset(Points):
    """Some of the points that are held in memory, as a fold of a cross-validation has.

    A pass over all points serves mixtures that learn from subsets of them, too.

    Parameters
    ----------
    points : StoredPoints
        Of this process alone.
    chosen : Tensor of bool, of shape (n_points,)
        Which of them, in their order.
    group_size : int, default=1
        How many of each group these are.

    Examples
    --------
    >>> chunk = (torch.tensor([[0.0, 1.0], [1.0, 1.0]]),)
    >>> second = Subset(StoredPoints([chunk]), torch.tensor([False, True]))
    >>> second.total, [block.tolist() for [block] in second]
    (1, [[[1.0], [1.0]]])
    """

    def __init__(self, points: StoredPoints, chosen: Tensor, group_size: int = 1) -> None:
        self.widths, self.time_feature = points.widths, points.time_feature
        self.dtype, self.device, self.processes = points.dtype, points.device, ALONE
        self.chosen, self.group_size = chosen.to(points.device), group_size
        self._points = points
        self._count(int(chosen.sum()))

    def __iter__(self) -> Iterator[Chunk]:
        """One pass over the chosen points; a chunk without any is passed over."""
        chunks = list(self._points)
        places = self.chosen.split([chunk[0].shape[1] for chunk in chunks])
        for chunk, chosen in zip(chunks, places, strict=True):
            if bool(chosen.any()):
                yield tuple(block[:, chosen] for block in chunk)
