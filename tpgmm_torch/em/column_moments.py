"""Mean, variance and range of columns, gathered batch by batch."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from tpgmm_torch.em.block_gaussians import Standardization
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.large_data.processes import ALONE, Processes

__all__ = ["ColumnMoments"]

Array = NDArray[np.float64]

#: Numbers at a time when moments are summed: a processor's cache full.
PART = 2**16


@dataclass(frozen=True)
class ColumnMoments:
    """What is known of each column, in float64.

    Parameters
    ----------
    count : int
        Number of rows, at least 1.
    mean, scatter : array of shape (n_features,)
        Mean, and sum of squared deviations from it.
    smallest, largest : array of shape (n_features,)
    """

    count: int
    mean: Array
    scatter: Array
    smallest: Array
    largest: Array

    @classmethod
    def of(cls, rows: NDArray[np.floating]) -> ColumnMoments:
        """Of rows (n, n_features) in memory, n >= 1."""
        n_parts = max(1, rows.size // PART)
        step = -(-len(rows) // n_parts)
        total = None
        for start in range(0, len(rows), step):
            part = np.asarray(rows[start : start + step], dtype=np.float64)
            # from the first row on: a constant column then varies by nothing at all
            deviation = part - part[0]
            shift = deviation.mean(0)
            scatter = np.square(deviation - shift).sum(0)
            own = cls(len(part), part[0] + shift, scatter, part.min(0), part.max(0))
            total = own if total is None else total.merged(own)
        assert total is not None
        return total

    @classmethod
    def of_batches(
        cls, batches: Iterable[NDArray[np.floating]], processes: Processes = ALONE
    ) -> ColumnMoments:
        """Of batches of rows, in all processes together.

        Parameters
        ----------
        batches : iterable of array of shape (n, n_features)
            This process's.
        processes : Processes

        Raises
        ------
        DataError
            If there are no rows, here or in another process, if the processes' rows have
            different numbers of columns, or if the variance overflows.
        """
        total = None
        with np.errstate(over="ignore", invalid="ignore"):
            for batch in batches:
                own = cls.of(batch)
                total = own if total is None else total.merged(own)
        total = cls._over_processes(total, processes)
        if not np.isfinite(total.scatter).all():
            raise DataError("the variance of the data overflows; divide the data by a constant")
        return total

    @classmethod
    def _over_processes(cls, own: ColumnMoments | None, processes: Processes) -> ColumnMoments:
        width = 0 if own is None else len(own.mean)
        widths = processes.concatenate(torch.tensor([float(width)], dtype=torch.float64))
        found = [int(value) for value in widths.tolist()]
        if 0 in found:
            where = f" in process(es) {_places(found, 0)} of {processes.count}"
            raise DataError(f"there are no rows{where if processes.count > 1 else ''}")
        if len(set(found)) > 1:
            raise DataError(f"the processes' rows have {found} columns: all need the same ones")
        assert own is not None
        if processes.count == 1:
            return own
        packed = np.concatenate([[own.count], own.mean, own.scatter, own.smallest, own.largest])
        gathered = processes.concatenate(torch.from_numpy(packed)[None]).numpy()
        parts = [
            cls(int(row[0]), *np.split(row[1:], 4))  # type: ignore[arg-type]
            for row in gathered
        ]
        total = parts[0]
        for part in parts[1:]:
            total = total.merged(part)
        return total

    def merged(self, other: ColumnMoments) -> ColumnMoments:
        """Moments of the rows of both (Chan, Golub, LeVeque 1983)."""
        count = self.count + other.count
        apart = other.mean - self.mean
        return ColumnMoments(
            count,
            self.mean + apart * (other.count / count),
            self.scatter + other.scatter + apart**2 * (self.count * other.count / count),
            np.minimum(self.smallest, other.smallest),
            np.maximum(self.largest, other.largest),
        )

    def standardization(self, widths: Sequence[int], *, isotropic: bool) -> Standardization:
        """The units in which each column, or with ``isotropic`` each block, has deviation 1.

        A constant column takes the mean variance of its block, or 1 where that is zero too.

        Parameters
        ----------
        widths : sequence of int
            Widths of the blocks.
        isotropic : bool
            Scale all columns of a block alike.
        """
        variance = self.scatter / self.count
        largest = np.maximum(np.abs(self.largest), np.abs(self.smallest))
        # what rounding leaves of a constant column is no variance
        variance[np.sqrt(variance) <= 10 * np.finfo(np.float64).eps * largest] = 0.0
        scales = []
        for block in np.split(variance, np.cumsum(widths)[:-1]):
            fallback = block.mean() or 1.0
            constant = np.full_like(block, True, dtype=bool) if isotropic else block == 0
            scales.append(torch.from_numpy(np.sqrt(np.where(constant, fallback, block))))
        return Standardization(
            torch.split(torch.from_numpy(self.mean), list(widths)), tuple(scales)
        )


def _places(values: Sequence[int], value: int) -> list[int]:
    return [place for place, found in enumerate(values) if found == value]
