"""Demonstrations as the rows that a mixture learns from, read once.

Where one responsibility is for an instant, EM asks of the M points of that instant only for
their mean log-density and their moments, block by block: both are functions of their mean and
scatter. A few points with the same mean and scatter per block therefore stand for all, however
many demonstrations there are: data beyond memory become a table of the length of one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.mixture.processes import ALONE, Processes
from tpgmm_torch.mixture.row_file import ColumnMoments, RowFile, Rows
from tpgmm_torch.operators import Operator
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.training import local_data
from tpgmm_torch.training.hold_detection import demonstrated_holds
from tpgmm_torch.training.mixture_settings import block_widths
from tpgmm_torch.training.operator_completion import with_force_axes, with_mean_orientations
from tpgmm_torch.training.shares import Share


@dataclass(frozen=True, eq=False)
class TrainingRows:
    """Time and local coordinates of all operators, side by side.

    Parameters
    ----------
    rows : array of shape (n, sum_j (1 + D_j)), or RowFile
        Rows that this process learns from.
    group_size : int
        Number of consecutive rows that share one responsibility.
    time : Tensor of shape (T,)
        Time grid of the demonstration of median duration [s].
    n_demonstrations : int
        Of all processes.
    operators : tuple of Operator
        With the mean orientations of the demonstrations.
    holds : tuple of Hold
        From when to when the robot holds which object.
    processes : Processes
        Among which the rows are spread.
    stored : array of shape (sum_m T_m, sum_j (1 + D_j)), or RowFile
        Rows of the demonstrations of this process, one after the other.
    edges : array of int, of shape (M + 1,)
        Where the demonstrations of this process begin in them, and the last ends.
    """

    rows: Rows
    group_size: int
    time: Tensor
    n_demonstrations: int
    operators: tuple[Operator, ...]
    holds: tuple[Hold, ...]
    processes: Processes
    stored: Rows
    edges: NDArray[np.intp]

    def at_phases(self, count: int) -> Tensor:
        """Select rows of all demonstrations of all processes at equal phase.

        Parameters
        ----------
        count : int
            Of instants.

        Returns
        -------
        Tensor of shape (M, count, sum_j (1 + D_j))
        """
        episodes = (torch.from_numpy(self.stored[i:j]) for i, j in pairwise(self.edges))
        thinned = torch.stack([local_data.at_phases(rows, count) for rows in episodes])
        return torch.cat(self.processes.gather(thinned.double()))

    def within(self, begin: float, end: float) -> Self:
        """Select the rows, in memory, whose time is from ``begin`` to before ``end`` [s].

        Raises
        ------
        DataError
            If there are less than two instants.
        """
        inside = (self.time >= begin) & (self.time < end)
        rows, stored = self.rows[:], self.stored[:]
        chosen, kept = ((x[:, 0] >= begin) & (x[:, 0] < end) for x in (rows, stored))
        if int(inside.sum()) < 2 or not chosen.any():
            raise DataError(f"there are no two instants between {begin:.4g} and {end:.4g} s")
        edges = np.append(0, np.cumsum(kept))[self.edges]
        return replace(
            self, rows=rows[chosen], time=self.time[inside], stored=stored[kept], edges=edges
        )


def read_rows(
    share: Share,
    operators: Sequence[Operator],
    kinematics: Kinematics,
    *,
    responsibilities: str = "auto",
    watch: Callable[[Demonstration], object] = id,
) -> TrainingRows:
    """Compute the local coordinates of all demonstrations, each once.

    Rows of one list stay in memory, those of more go to a temporary file. The first batch of
    all decides on holds, mean orientations, and the side of quaternions.

    Parameters
    ----------
    share : Share
        Demonstrations of this process.
    operators : sequence of Operator
        In whose local coordinates it is seen.
    kinematics : Kinematics
        On which the operators act.
    responsibilities : {"auto", "instant", "point"}
        Whether one is for all points of an instant, as of the estimator.
    watch : callable, optional
        Sees each demonstration, too.

    Raises
    ------
    DataError
        If ``responsibilities="instant"`` and the demonstrations have different time grids.
    """
    processes = share.processes
    holds = processes.gather(demonstrated_holds(share.first, operators, kinematics))[0]
    motions = [local_data.Motion.of(one, kinematics, holds) for one in share.first]
    completed = with_mean_orientations(with_force_axes(operators, motions), motions, kinematics)
    operators = processes.gather(completed)[0]
    later = ((one, local_data.Motion.of(one, kinematics, holds)) for one in share.read_rest())
    pairs = chain(zip(share.first, motions, strict=True), later)
    seen = ((d, m, [m.coordinates(one, kinematics) for one in operators]) for d, m in pairs)
    first = next(seen)
    shown = processes.gather([block.cpu() for block in first[-1]])[0]
    side = local_data.like([block.to(kinematics.lower) for block in shown])
    stored: Any = [] if share.in_memory else RowFile()
    lengths = [0]
    for demonstration, motion, blocks in chain([first], seen):
        watch(demonstration)
        rows = local_data.match_rows(motion, blocks, operators, kinematics, side).cpu().numpy()
        lengths.append(len(rows))
        stored.append(rows)
    stored, edges = np.concatenate(stored) if share.in_memory else stored, np.cumsum(lengths)
    # what varies by rounding alone becomes constant
    moments = ColumnMoments.of(stored, processes)
    reference = processes.gather(stored[: edges[1]])[0]
    ends = np.stack((moments.smallest, moments.largest)).astype(reference.dtype)
    low, high = torch.from_numpy(ends)
    constant = local_data.constant_columns(low, high, operators, kinematics).numpy()
    stored[:, constant] = reference[0, constant]
    reference = np.where(constant, reference[0], reference)
    time, number = _typical_time(stored, edges, processes)
    time = time.to(kinematics.lower)
    every = tuple(operators)
    found = TrainingRows(stored, 1, time, number, every, holds, processes, stored, edges)
    widths = block_widths(operators, kinematics)
    return _group_instants(found, reference, responsibilities, widths)


def _group_instants(
    rows: TrainingRows, first: NDArray[Any], responsibilities: str, widths: Sequence[int]
) -> TrainingRows:
    """Group rows of one instant where the demonstrations have one time grid.

    Parameters
    ----------
    first : array of shape (T, sum_j (1 + D_j))
        Of the first demonstration of all.
    """
    stored, processes, number = rows.stored, rows.processes, rows.n_demonstrations
    grid = (np.array_equal(stored[i:j, 0], first[:, 0]) for i, j in pairwise(rows.edges))
    aligned = all(processes.gather(all(grid)))
    if responsibilities == "instant" and not aligned:
        raise DataError(
            "responsibilities='instant' needs demonstrations of one common time grid: "
            "align them (tpgmm_torch.alignment), or use 'auto' or 'point'"
        )
    if not aligned or responsibilities == "point" or number == 1:
        return rows
    if isinstance(stored, np.ndarray):
        instants = stored.reshape(number, *first.shape).swapaxes(0, 1)
        return replace(rows, rows=instants.reshape(stored.shape), group_size=number)
    points, size = equivalent_rows(stored, first, widths, processes)
    part = processes.share(range(len(points) // size))
    return replace(rows, rows=points[part[0] * size : (part[-1] + 1) * size], group_size=size)


def _typical_time(
    stored: Rows, edges: NDArray[np.intp], processes: Processes
) -> tuple[Tensor, int]:
    """Find the time grid of median duration, and count the demonstrations of all."""
    spans = [(float(stored[i, 0]), float(stored[j - 1, 0])) for i, j in pairwise(edges)]
    entries = [(begin, end - begin, processes.rank, i) for i, (begin, end) in enumerate(spans)]
    everyone = list(chain.from_iterable(processes.gather(entries)))
    begins, durations, owners, places = zip(*everyone, strict=True)
    chosen = typical(begins, durations)
    place = places[chosen] if owners[chosen] == processes.rank else 0
    times = processes.gather(stored[edges[place] : edges[place + 1], 0])
    return torch.from_numpy(times[owners[chosen]].copy()), len(everyone)


def typical(begins: Sequence[float], durations: Sequence[float]) -> int:
    """Find the demonstration that has the median duration.

    Parameters
    ----------
    begins, durations : sequence of float
        Of each [s]; segments that begin later than the first by more than a tenth do not count.
    """
    late = min(begins) + 0.1 * max(durations)
    whole = [number for number, begin in enumerate(begins) if begin <= late]
    return sorted(whole, key=lambda number: durations[number])[len(whole) // 2]


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
        episode = np.asarray(rows[start : start + len(origin)], dtype=np.float64)
        deviation = torch.from_numpy(episode) - origin
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
