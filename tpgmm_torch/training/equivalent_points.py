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

__all__ = ["equivalent_points", "equivalent_rows"]

Array = NDArray[np.float64]


def equivalent_rows(
    rows: Rows, reference: Array, widths: Sequence[int], processes: Processes = ALONE
) -> tuple[Array, int]:
    """Replace the demonstrations of all processes by rows, some per instant.

    Parameters
    ----------
    rows : array of shape (M T, sum D_j), or RowFile
        Demonstrations of T rows each, one after the other.
    reference : array of shape (T, sum D_j)
        Rows near all others, the same in all processes: deviations are taken from it.
    widths : sequence of int
        D_j of each block.
    processes : Processes
        Among which the rows are spread.

    Returns
    -------
    array of shape (T * n, sum D_j)
        The n points of each instant together.
    int
        How many points stand for an instant, n.
    """
    origin = torch.from_numpy(np.asarray(reference, dtype=np.float64))
    own_total = torch.zeros_like(origin)
    own_squares = [origin.new_zeros(len(origin), width, width) for width in widths]
    for start in range(0, len(rows), len(origin)):
        one = np.asarray(rows[start : start + len(origin)], dtype=np.float64)
        deviation = torch.from_numpy(one) - origin
        own_total += deviation
        for square, block in zip(own_squares, deviation.split(list(widths), 1), strict=True):
            square += block[:, :, None] * block[:, None, :]
    own_count = origin.new_tensor(len(rows) / len(origin))
    count, total, *squares = processes.sum(own_count, own_total, *own_squares)
    size, blocks = max(widths) + 1, []
    for mean, square in zip((total / count).split(list(widths), 1), squares, strict=True):
        scatter = square / count - mean[:, :, None] * mean[:, None, :]
        blocks.append(equivalent_points(mean, scatter, size))
    points = origin[:, None] + torch.cat(blocks, -1)
    return points.flatten(0, 1).numpy(), size


def equivalent_points(mean: Tensor, scatter: Tensor, size: int) -> Tensor:
    """Make points of given mean and mean squared deviation.

    Parameters
    ----------
    mean : Tensor of shape (T, D)
        Of the points of each instant.
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
