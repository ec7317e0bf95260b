"""Demonstrations as the rows that a mixture learns from, read once."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, Self

import numpy as np
import torch
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
    one_constant,
)
from tpgmm_torch.training.mean_orientations import with_mean_orientations

__all__ = ["TrainingRows", "batches_of", "read_rows", "share_one_grid", "typical_time"]

#: Duration [s], first row and end of a demonstration in a file.
Span = tuple[float, int, int]


@dataclass(frozen=True, eq=False)
class TrainingRows:
    """Time and local coordinates of all operators, side by side.

    Parameters
    ----------
    rows : array of shape (n, sum_j (1 + D_j)), or RowFile
        Of this process.
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
    parts : tuple of Tensor of shape (T_m, sum_j (1 + D_j))
        The rows of each demonstration, if all are in memory.
    file : RowFile, optional
        Where the rows are, or came from, of more than one batch.
    spans : tuple of Span
        Where the demonstrations of this process are in the file.
    """

    rows: Rows
    group_size: int
    time: Tensor
    n_demonstrations: int
    operators: tuple[Operator, ...]
    holds: tuple[Hold, ...]
    processes: Processes
    parts: tuple[Tensor, ...] = ()
    file: RowFile | None = None
    spans: tuple[Span, ...] = ()

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
        thinned = [at_phases(rows, count) for rows in self._each()]
        return torch.cat(self.processes.gather(torch.stack(thinned).double().cpu()))

    def _each(self) -> Iterator[Tensor]:
        """The rows of each demonstration of this process, (T_m, sum_j (1 + D_j))."""
        if self.file is None:
            yield from self.parts
        else:
            for _, *rows in self.spans:
                yield torch.from_numpy(self.file[slice(*rows)])

    def within(self, begin: float, end: float) -> Self:
        """Those rows, in memory, whose time is from ``begin`` to before ``end`` [s].

        Raises
        ------
        DataError
            If there are less than two instants.
        """
        inside = (self.time >= begin) & (self.time < end)
        rows = self.rows[:]
        own = (rows[:, 0] >= begin) & (rows[:, 0] < end)
        if int(inside.sum()) < 2 or not own.any():
            raise DataError(f"there are no two instants between {begin:.4g} and {end:.4g} s")
        parts = tuple(x[(x[:, 0] >= begin) & (x[:, 0] < end)] for x in self._each())
        time = self.time[inside]
        return replace(self, rows=rows[own], time=time, parts=parts, file=None)


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
    completed = with_mean_orientations(operators, motions, kinematics)
    completed = processes.gather(completed)[0]
    local = [[motion.coordinates(one, kinematics) for one in completed] for motion in motions]
    grid, *templates = processes.gather([head[0].time.cpu(), *(x.cpu() for x in local[0])])[0]
    expected = like([template.to(kinematics.lower) for template in templates])
    known = completed, kinematics, expected
    rows = [
        local_rows(motion.time, x, *known) for motion, x in zip(motions, local, strict=True)
    ]
    aligned = share_one_grid(head, grid)
    following = next(walk, None)
    if following is None and processes.count == 1:
        rows, time = one_constant(rows, completed, kinematics), typical_time(head)
        size = _group_size(aligned, responsibilities, len(rows))
        together = torch.cat(rows) if size == 1 else torch.stack(rows, 1).flatten(0, 1)
        stored = together.cpu().numpy()
        time = time.to(kinematics.lower)
        return TrainingRows(
            stored, size, time, len(rows), completed, holds, processes, tuple(rows)
        )
    file = RowFile()
    spans = _write(file, head, rows, [])
    while following is not None:
        aligned = aligned and share_one_grid(following, grid)
        rows = []
        for one in following:
            motion = Motion.of(one, kinematics, holds)
            x = [motion.coordinates(operator, kinematics) for operator in completed]
            rows.append(local_rows(motion.time, x, *known))
        _write(file, following, rows, spans)
        following = next(walk, None)
    return _gathered(
        file, spans, all(processes.gather(aligned)), responsibilities, kinematics,
        TrainingRows(file, 1, grid, 0, completed, holds, processes, file=file),
    )  # fmt: skip


def _write(
    file: RowFile, batch: Sequence[Demonstration], rows: Sequence[Tensor], spans: list[Span]
) -> list[Span]:
    for one, own in zip(batch, rows, strict=True):
        spans.append((one.duration, len(file), len(file) + len(own)))
        file.append(own.cpu().numpy())
    return spans


def _gathered(
    file: RowFile,
    spans: Sequence[Span],
    aligned: bool,
    responsibilities: str,
    kinematics: Kinematics,
    data: TrainingRows,
) -> TrainingRows:
    """What the rows in the files of all processes are learned as."""
    processes, operators = data.processes, data.operators
    n_demonstrations = sum(processes.gather(len(spans)))
    size = _group_size(aligned, responsibilities, n_demonstrations)
    moments = ColumnMoments.of(file, processes)
    first = processes.gather(file[slice(*spans[0][1:])])[0]
    low, high = (
        torch.from_numpy(x.astype(first.dtype)) for x in (moments.smallest, moments.largest)
    )
    widths, turns = columns_of(operators, kinematics)
    constant = constant_columns(low, high, widths, turns).numpy()
    file[:, constant] = first[0, constant]
    everyone = [
        (duration, rank, start, stop)
        for rank, each in enumerate(processes.gather(spans))
        for duration, start, stop in each
    ]
    everyone.sort(key=lambda span: span[0])
    _, owner, start, stop = everyone[len(everyone) // 2]
    typical = file[start:stop, 0] if processes.rank == owner else None
    time = torch.from_numpy(processes.gather(typical)[owner]).to(kinematics.lower)
    data = replace(data, time=time, n_demonstrations=n_demonstrations, spans=tuple(spans))
    if size == 1:
        return data
    instants = Instants(np.where(constant, first[0], first), widths)
    instants.add(file)
    points, size = instants.points(processes)
    own = processes.share(range(len(points) // size))
    share = points[own[0] * size : (own[-1] + 1) * size]
    return replace(data, rows=share, group_size=size)


def _group_size(aligned: bool, responsibilities: str, n_demonstrations: int) -> int:
    """How many rows share a responsibility: one, or all demonstrations at an instant."""
    if responsibilities == "instant" and not aligned:
        raise DataError(
            "responsibilities='instant' needs demonstrations of one common time grid: "
            "align them (tpgmm_torch.alignment), or use 'auto' or 'point'"
        )
    return n_demonstrations if aligned and responsibilities != "point" else 1


def share_one_grid(demonstrations: Sequence[Demonstration], grid: Tensor) -> bool:
    """Whether the time of all demonstrations is one grid.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
    grid : Tensor of shape (T,)
    """
    return all(torch.equal(one.time.cpu(), grid) for one in demonstrations)


def typical_time(demonstrations: Sequence[Demonstration]) -> Tensor:
    """The time grid of the demonstration of median duration.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
        Segments that begin later than the first by more than a tenth do not count.

    Returns
    -------
    Tensor of shape (T,)
    """
    begin = min(float(one.time[0]) for one in demonstrations)
    late = begin + 0.1 * max(one.duration for one in demonstrations)
    whole = [one for one in demonstrations if one.time[0] <= late]
    return sorted(whole, key=lambda one: one.duration)[len(whole) // 2].time
