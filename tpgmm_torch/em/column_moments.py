"""Mean, variance and range of columns, gathered batch by batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from tpgmm_torch.em.parameters import Standardization

__all__ = ["ColumnMoments"]

Array = NDArray[np.float64]

#: Numbers at a time when moments are summed: a processor's cache full.
PART = 2**16


@dataclass(frozen=True)
class ColumnMoments:
    """Moments and range of each column, in float64.

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
        parts = []
        for start in range(0, len(rows), step):
            part = np.asarray(rows[start : start + step], dtype=np.float64)
            # from the first row on: a constant column then varies by nothing at all
            deviation = part - part[0]
            shift = deviation.mean(0)
            scatter = np.square(deviation - shift).sum(0)
            parts.append(cls(len(part), part[0] + shift, scatter, part.min(0), part.max(0)))
        return cls.merge(parts)

    @classmethod
    def merge(cls, parts: Sequence[ColumnMoments]) -> ColumnMoments:
        """Moments of all rows, from those of parts (Chan, Golub, LeVeque 1983)."""
        total, *others = parts
        for part in others:
            count = total.count + part.count
            difference = part.mean - total.mean
            between = difference**2 * (total.count * part.count / count)
            total = cls(
                count,
                total.mean + difference * (part.count / count),
                total.scatter + part.scatter + between,
                np.minimum(total.smallest, part.smallest),
                np.maximum(total.largest, part.largest),
            )
        return total

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
