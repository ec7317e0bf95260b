"""All demonstrations at one instant, replaced by a few points that teach the same.

Where one responsibility is for an instant, EM asks of the M points of that instant only for
their mean log-density and their moments, block by block: both are functions of their mean and
scatter. A few points with the same mean and scatter per block therefore stand for all, however
many demonstrations there are: data beyond memory become a table of the length of one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch.mixture.processes import ALONE, Processes
from tpgmm_torch.mixture.row_file import Rows

__all__ = ["Instants", "equivalent_points"]

Array = NDArray[np.float64]


class Instants:
    """Mean and scatter of all demonstrations at each instant, gathered one by one.

    Parameters
    ----------
    reference : array of shape (T, sum D_j)
        Rows near all others, the same in all processes: deviations are taken from it.
    widths : sequence of int
        D_j of each block.
    """

    def __init__(self, reference: Array, widths: Sequence[int]) -> None:
        self._reference = torch.from_numpy(np.asarray(reference, dtype=np.float64))
        self._widths = list(widths)
        self._count = 0
        self._sum = torch.zeros_like(self._reference)
        self._squares = [
            self._sum.new_zeros(len(self._sum), width, width) for width in self._widths
        ]

    def add(self, rows: Rows) -> None:
        """Add demonstrations of T rows each, one after the other in ``rows``."""
        length = len(self._reference)
        for start in range(0, len(rows), length):
            demonstration = np.asarray(rows[start : start + length], dtype=np.float64)
            self._add(torch.from_numpy(demonstration) - self._reference)

    def _add(self, deviation: Tensor) -> None:
        self._count += 1
        self._sum += deviation
        for square, block in zip(self._squares, deviation.split(self._widths, 1), strict=True):
            square += block[:, :, None] * block[:, None, :]

    def points(self, processes: Processes = ALONE) -> tuple[Array, int]:
        """Rows that stand for the demonstrations of all processes, and how many per instant.

        Returns
        -------
        array of shape (T * n, sum D_j)
            The n points of each instant together.
        int
            How many points stand for an instant, n.
        """
        counted = torch.tensor(float(self._count), dtype=torch.float64)
        count, total, *squares = processes.sum(counted, self._sum, *self._squares)
        size = max(self._widths) + 1
        blocks = []
        for mean, square in zip((total / count).split(self._widths, 1), squares, strict=True):
            scatter = square / count - mean[:, :, None] * mean[:, None, :]
            blocks.append(equivalent_points(mean, scatter, size))
        points = self._reference[:, None] + torch.cat(blocks, -1)
        return points.flatten(0, 1).numpy(), size


def equivalent_points(mean: Tensor, scatter: Tensor, size: int) -> Tensor:
    """Points with given mean and mean squared deviation.

    Parameters
    ----------
    mean : Tensor of shape (T, D)
    scatter : Tensor of shape (T, D, D)
        Positive semi-definite.
    size : int
        How many points, more than D.

    Returns
    -------
    Tensor of shape (T, size, D)
    """
    # in units of the deviations, so that rounding is relative to each coordinate
    scale = scatter.diagonal(dim1=1, dim2=2).clamp(min=0).sqrt()
    unit = torch.where(scale > 0, scale, 1.0)
    values, vectors = torch.linalg.eigh(scatter / (unit[:, :, None] * unit[:, None, :]))
    root = scale[..., None] * vectors * values.clamp(min=0).sqrt()[:, None]  # R R^T = scatter
    # orthonormal directions that are orthogonal to (1, ..., 1): their points have mean zero
    ones = torch.eye(size, dtype=mean.dtype)
    ones[:, 0] = 1.0
    directions = torch.linalg.qr(ones).Q[:, 1 : mean.shape[1] + 1]
    return mean[:, None] + size**0.5 * directions @ root.mT
