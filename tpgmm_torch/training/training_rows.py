"""Demonstrations as the rows that a mixture learns from, read once."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch.data.demonstrations import Demonstration, check_demonstrations
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.mixture.column_moments import ColumnMoments
from tpgmm_torch.mixture.processes import ALONE, Processes
from tpgmm_torch.mixture.row_file import RowFile, Rows
from tpgmm_torch.operators import Operator
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.training.equivalent_points import Instants
from tpgmm_torch.training.hold_detection import demonstrated_holds
from tpgmm_torch.training.local_data import (
    Motion,
    at_phases,
    columns_of,
    constant_columns,
    like,
    local_rows,
)
from tpgmm_torch.training.mean_orientations import with_mean_orientations

__all__ = ["TrainingRows", "batches_of", "read_rows", "typical"]


@dataclass(frozen=True)
class Span:
    """Begin and duration [s] of a demonstration, and its rows among all of its process."""

    begin: float
    duration: float
    start: int
    stop: int


@dataclass(frozen=True, eq=False)
class TrainingRows:
    """Time and local coordinates of all operators, side by side.

    Parameters
    ----------
    rows : array of shape (n, sum_j (1 + D_j)), or RowFile
        What this process learns from.
    group_size : int
        So many consecutive rows share one responsibility.
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
    spans : tuple of Span
        Where each demonstration is in them.
    """

    rows: Rows
    group_size: int
    time: Tensor
    n_demonstrations: int
    operators: tuple[Operator, ...]
    holds: tuple[Hold, ...]
    processes: Processes
    stored: Rows
    spans: tuple[Span, ...]

    def at_phases(self, count: int) -> Tensor:
        """Rows of all demonstrations of all processes at equal phase.

        Parameters
        ----------
        count : int
            Of instants.

        Returns
        -------
        Tensor of shape (M, count, sum_j (1 + D_j))
        """
        each = (torch.from_numpy(self.stored[one.start : one.stop]) for one in self.spans)
        thinned = torch.stack([at_phases(rows, count) for rows in each])
        return torch.cat(self.processes.gather(thinned.double()))

    def within(self, begin: float, end: float) -> Self:
        """Those rows, in memory, whose time is from ``begin`` to before ``end`` [s].

        Raises
        ------
        DataError
            If there are less than two instants.
        """
        inside = (self.time >= begin) & (self.time < end)
        rows, stored = self.rows[:], self.stored[:]
        own, kept = ((x[:, 0] >= begin) & (x[:, 0] < end) for x in (rows, stored))
        if int(inside.sum()) < 2 or not own.any():
            raise DataError(f"there are no two instants between {begin:.4g} and {end:.4g} s")
        before = np.concatenate(([0], np.cumsum(kept)))
        spans = tuple(
            replace(one, start=int(before[one.start]), stop=int(before[one.stop]))
            for one in self.spans
        )
        return replace(
            self, rows=rows[own], time=self.time[inside], stored=stored[kept], spans=spans
        )


def batches_of(X: Any, processes: Processes = ALONE) -> Iterator[list[Demonstration]]:
    """Demonstrations in batches, checked as they come; a list of them is one batch.

    Parameters
    ----------
    X : iterable of Demonstration, or of sequence of Demonstration
        Batches are read once.
    processes : Processes
        All of which need demonstrations of the same joints and frames.

    Yields
    ------
    list of Demonstration

    Raises
    ------
    DataError, ShapeError
        If there is none, or some differ from those before in joints or frames; the message
        says in which batch.
    """
    first: list[Demonstration] = []
    several = False
    for number, batch in enumerate(_split(X)):
        several = several or number > 0
        try:
            checked = check_demonstrations([*first, *batch])[len(first) :]
        except (ValueError, TypeError) as error:
            if not several:
                raise
            kind = type(error) if isinstance(error, DataError) else DataError
            raise kind(f"batch {number} of demonstrations: {error}") from error
        if not first:
            first = checked[:1]
            _check_alike(first[0], processes)
        yield checked
    if not first:
        _check_alike(None, processes)


def _split(X: Any) -> Iterator[Sequence[Demonstration]]:
    """The batches of X, without empty ones; X itself if it holds demonstrations."""
    if not isinstance(X, Iterable):
        check_demonstrations(X)  # says what is wrong
    walk = iter(X)
    first = next(walk, None)
    if isinstance(first, Sequence):
        yield from (batch for batch in chain([first], walk) if len(batch))
    elif first is not None:
        yield list(chain([first], walk))


def _check_alike(first: Demonstration | None, processes: Processes) -> None:
    """Refuse, in all processes, shares without demonstrations, or of other joints or frames."""
    text = ""
    if first is not None:
        joints = list(first.joint_names or [f"{first.n_joints} without names"])
        text = f"joints {joints}, frames {sorted(first.frames)}"
    texts = processes.gather(text)
    if "" in texts:
        without = [rank for rank, text in enumerate(texts) if not text]
        where = f" in process(es) {without} of {processes.count}" if processes.count > 1 else ""
        raise DataError(
            f"there are no demonstrations, X is empty{where}: "
            "expected at least one demonstration"
        )
    for rank, other in enumerate(texts):
        if other != texts[0]:
            raise DataError(
                f"process {rank} has demonstrations with {other}, process 0 with {texts[0]}"
            )


def read_rows(
    batches: Iterable[Sequence[Demonstration]],
    operators: Sequence[Operator],
    kinematics: Kinematics,
    *,
    responsibilities: str = "auto",
    processes: Processes = ALONE,
) -> TrainingRows:
    """Compute the local coordinates of all demonstrations, each once.

    Rows of one batch stay in memory, those of several go to a temporary file.
    The first batch of all decides on holds, mean orientations, and the side of quaternions.

    Parameters
    ----------
    batches : iterable of sequence of Demonstration
        Of this process, at least one.
    operators : sequence of Operator
    kinematics : Kinematics
    responsibilities : {"auto", "instant", "point"}
    processes : Processes

    Raises
    ------
    DataError
        If ``responsibilities="instant"`` and the demonstrations have different time grids.
    """
    walk = iter(batches)
    head = next(walk)
    holds = processes.gather(demonstrated_holds(head, operators, kinematics))[0]
    motions = [Motion.of(one, kinematics, holds) for one in head]
    operators = with_mean_orientations(operators, motions, kinematics)
    operators = processes.gather(operators)[0]

    def coordinates(motion: Motion) -> list[Tensor]:
        return [motion.coordinates(one, kinematics) for one in operators]

    local = list(map(coordinates, motions))
    templates = processes.gather([x.cpu() for x in local[0]])[0]
    expected = like([template.to(kinematics.lower) for template in templates])
    known = operators, kinematics, expected
    later = next(walk, None)
    alone = later is None and processes.count == 1

    following = (
        Motion.of(one, kinematics, holds)
        for one in chain.from_iterable(chain([later or ()], walk))
    )
    each = chain(zip(motions, local, strict=True), ((m, coordinates(m)) for m in following))
    rows = (local_rows(motion.time, x, *known) for motion, x in each)
    stored, spans, aligned = _stored(rows, alone, processes)
    first = _made_constant(stored, spans[0], operators, kinematics, processes)
    n_demonstrations = sum(processes.gather(len(spans)))
    if responsibilities == "instant" and not aligned:
        raise DataError(
            "responsibilities='instant' needs demonstrations of one common time grid: "
            "align them (tpgmm_torch.alignment), or use 'auto' or 'point'"
        )
    if not aligned or responsibilities == "point" or n_demonstrations == 1:
        learned, size = stored, 1
    elif alone:
        learned, size = _instants_together(stored[:], n_demonstrations), n_demonstrations
    else:
        learned, size = _equivalent(stored, first, columns_of(*known[:2])[0], processes)
    time = _typical_time(stored, spans, processes).to(kinematics.lower)
    return TrainingRows(
        learned, size, time, n_demonstrations, tuple(operators), holds, processes, stored,
        tuple(spans),
    )  # fmt: skip


def _instants_together(rows: NDArray[Any], number: int) -> NDArray[Any]:
    """Rows of some demonstrations of equal length, those of one instant one after the other."""
    width = rows.shape[1]
    return rows.reshape(number, -1, width).swapaxes(0, 1).reshape(-1, width)


def _stored(
    each: Iterator[Tensor], alone: bool, processes: Processes
) -> tuple[Rows, list[Span], bool]:
    """All rows, where each demonstration is in them, and whether all have one time grid."""
    kept: Any = [] if alone else RowFile()
    spans, count, aligned, grid = list[Span](), 0, True, None
    for rows in each:
        values = rows.cpu().numpy()
        time = values[:, 0]
        grid = processes.gather(time)[0] if grid is None else grid
        aligned = aligned and np.array_equal(time, grid)
        begin, end = float(time[0]), float(time[-1])
        spans.append(Span(begin, end - begin, count, count + len(values)))
        count += len(values)
        kept.append(values)
    return np.concatenate(kept) if alone else kept, spans, all(processes.gather(aligned))


def _made_constant(
    stored: Rows,
    span: Span,
    operators: Sequence[Operator],
    kinematics: Kinematics,
    processes: Processes,
) -> NDArray[Any]:
    """Rows of the first demonstration of all; what varies by rounding alone is as in it."""
    moments = ColumnMoments.of(stored, processes)
    first = processes.gather(stored[span.start : span.stop])[0]
    low, high = (
        torch.from_numpy(x.astype(first.dtype)) for x in (moments.smallest, moments.largest)
    )
    constant = constant_columns(low, high, *columns_of(operators, kinematics)).numpy()
    stored[:, constant] = first[0, constant]
    return np.where(constant, first[0], first)


def _equivalent(
    stored: Rows, reference: NDArray[Any], widths: Sequence[int], processes: Processes
) -> tuple[Rows, int]:
    """The share of a process of points that stand for all demonstrations at each instant."""
    instants = Instants(reference, widths)
    instants.add(stored)
    points, size = instants.points(processes)
    own = processes.share(range(len(points) // size))
    return points[own[0] * size : (own[-1] + 1) * size], size


def _typical_time(stored: Rows, spans: Sequence[Span], processes: Processes) -> Tensor:
    everyone = [
        (rank, one) for rank, each in enumerate(processes.gather(spans)) for one in each
    ]
    begins, durations = zip(*((one.begin, one.duration) for _, one in everyone), strict=True)
    owner, one = everyone[typical(begins, durations)]
    time = stored[one.start : one.stop, 0].copy() if processes.rank == owner else None
    return torch.from_numpy(processes.gather(time)[owner])


def typical(begins: Sequence[float], durations: Sequence[float]) -> int:
    """Which demonstration has the median duration.

    Parameters
    ----------
    begins, durations : sequence of float
        Of each [s]; segments that begin later than the first by more than a tenth do not count.
    """
    late = min(begins) + 0.1 * max(durations)
    whole = [number for number, begin in enumerate(begins) if begin <= late]
    return sorted(whole, key=lambda number: durations[number])[len(whole) // 2]
