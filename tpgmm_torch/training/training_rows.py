"""Demonstrations that do not fit into memory, or are spread over processes.

They are read once, batch by batch; what is kept of them are their local data, in a temporary
file, or, where one responsibility is for an instant, a few points per instant.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch.alignment.base import retime
from tpgmm_torch.alignment.features import quaternion_columns
from tpgmm_torch.data.arrays import as_array
from tpgmm_torch.data.demonstrations import Demonstration, check_demonstrations
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.large_data.processes import ALONE, Processes, column_moments
from tpgmm_torch.large_data.row_batches import Rows, StoredRows
from tpgmm_torch.large_data.row_file import RowFile
from tpgmm_torch.operators import Operator
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.training.equivalent_points import Instants
from tpgmm_torch.training.local_data import at_equal_phase, constant_columns, local_data

__all__ = [
    "LearningRows",
    "LeaveOut",
    "at_phases",
    "check_shares",
    "checked_batches",
    "gather_rows",
    "on_grid",
    "rows_in_memory",
    "share_one_grid",
    "split_batches",
    "typical_time",
]

#: Duration [s], first row and end of a demonstration in a file.
Span = tuple[float, int, int]
#: Which demonstrations are not to be learned from, counted over all processes: of their local
#: data (M, T, sum_j (1 + D_j)) at equal phase, and the time (T,) of a typical one.
LeaveOut = Callable[[Tensor, Tensor], Collection[int]]
#: Numbers that all demonstrations are compared by, those of all processes together,
LARGEST_TABLE = 2**26
#: but not at fewer instants than one in so many seconds.
COARSEST = 0.25


@dataclass(frozen=True)
class LearningRows:
    """What a mixture is learned from.

    Parameters
    ----------
    rows : Rows
        Local data of all operators side by side, of this process.
    group_size : int
        So many consecutive rows share one responsibility.
    time : Tensor of shape (T,)
        Time grid of a typical demonstration.
    n_demonstrations : int
        Of all processes.
    processes : Processes
        Among which the rows are spread.
    """

    rows: Rows
    group_size: int
    time: Tensor
    n_demonstrations: int
    processes: Processes


def checked_batches(
    batches: Iterable[Sequence[Demonstration]],
) -> Iterator[list[Demonstration]]:
    """Batches of like demonstrations, checked as they come; empty ones are left out.

    Parameters
    ----------
    batches : iterable of sequence of Demonstration
        They are walked through once.

    Yields
    ------
    list of Demonstration
        With their joints in the order of the first demonstration of all.

    Raises
    ------
    DataError, ShapeError
        If demonstrations differ in joints or frames from those before; the message says in
        which batch.
    """
    first: list[Demonstration] = []
    for number, batch in enumerate(batches):
        if isinstance(batch, Sequence) and not batch:
            continue
        try:
            checked = check_demonstrations([*first, *batch])[len(first) :]
        except (ValueError, TypeError) as error:
            after = ", counted after the first of all" if first else ""
            kind = type(error) if isinstance(error, DataError) else DataError
            raise kind(f"batch {number} of demonstrations{after}: {error}") from error
        first = first or [checked[0]]
        yield checked


def split_batches(X: Any) -> tuple[Any, Iterable[Sequence[Demonstration]] | None]:
    """Tell demonstrations from batches of demonstrations.

    Returns
    -------
    object
        The demonstrations, or None where there are batches.
    iterable of sequence of Demonstration, or None
        The batches, if X has such.
    """
    if isinstance(X, Sequence):
        found = bool(X) and isinstance(X[0], Sequence)
        return (None, X) if found else (X, None)
    if not isinstance(X, Iterable):
        return X, None
    if not isinstance(X, Iterator):
        first = next(iter(X), None)
        return (None, X) if isinstance(first, Sequence) else (list(X), None)
    first = next(X, None)
    if isinstance(first, Sequence):  # they are read once: an iterator will do
        return None, chain([first], X)
    return ([] if first is None else list(chain([first], X))), None


def check_shares(batch: Sequence[Demonstration] | None, processes: Processes) -> None:
    """Refuse a share without demonstrations, and shares that differ in joints or frames.

    Parameters
    ----------
    batch : sequence of Demonstration or None
        The first of this process, None if it has none.

    Raises
    ------
    DataError
        In all processes, whichever of them it is.
    """
    text = ""
    if batch is not None:
        first = batch[0]
        joints = list(first.joint_names or [f"{first.n_joints} without names"])
        text = f"joints {joints}, frames {sorted(first.frames)}"
    texts = processes.gather(text)
    if "" in texts:
        without = [rank for rank, text in enumerate(texts) if not text]
        where = f" in process(es) {without} of {processes.count}"
        raise DataError(
            f"there are no demonstrations{where if processes.count > 1 else ''}: each process "
            "needs at least one"
        )
    for rank, text in enumerate(texts):
        if text != texts[0]:
            raise DataError(
                f"process {rank} has demonstrations with {text}, process 0 with {texts[0]}"
            )


def rows_in_memory(
    demonstrations: Sequence[Demonstration],
    operators: Sequence[Operator],
    kinematics: Kinematics,
    *,
    responsibilities: str = "auto",
    holds: Sequence[Hold] = (),
) -> LearningRows:
    """What a mixture learns from demonstrations that are in memory, in this process alone.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
    operators : sequence of Operator
    kinematics : Kinematics
    responsibilities : {"auto", "instant", "point"}
    holds : sequence of Hold, default=()
        Objects that the robot held.

    Raises
    ------
    DataError
        If ``responsibilities="instant"`` and the demonstrations have different time grids.
    """
    rows = local_data(demonstrations, operators, kinematics, holds=holds)
    aligned = share_one_grid(demonstrations)
    if responsibilities == "instant":
        _check_aligned(aligned)
    group_size = len(rows) if aligned and responsibilities != "point" else 1
    together = torch.cat(rows) if group_size == 1 else torch.stack(rows, 1).flatten(0, 1)
    points = StoredRows(together.cpu().numpy())
    time = typical_time(demonstrations).to(rows[0])
    return LearningRows(points, group_size, time, len(rows), ALONE)


def share_one_grid(demonstrations: Sequence[Demonstration]) -> bool:
    """Whether all have the time grid of the first.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
    """
    first = demonstrations[0].time
    return all(torch.equal(item.time, first) for item in demonstrations)


def typical_time(demonstrations: Sequence[Demonstration]) -> Tensor:
    """The time grid of the demonstration of median duration.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
    """
    return sorted(demonstrations, key=lambda d: d.duration)[len(demonstrations) // 2].time


def on_grid(
    demonstration: Demonstration, grid: Tensor, kinematics: Kinematics
) -> tuple[Demonstration, int]:
    """A demonstration at the instants of a skill that it shows, and which is the first.

    Parameters
    ----------
    demonstration : Demonstration
        In the time of the skill, all of it or a segment.
    grid : Tensor of shape (T,)
        The instants [s].
    kinematics : Kinematics

    Raises
    ------
    DataError
        If it is not in the time of the skill.
    """
    time, instants = demonstration.time, grid.to(demonstration.time)
    if torch.equal(time, instants):
        return demonstration, 0
    step = float(instants.diff().max())
    early, late = float(time[0] - instants[0]), float(time[-1] - instants[-1])
    inside = ((instants >= time[0]) & (instants <= time[-1])).nonzero()[:, 0]
    if early < -step or late > step or len(inside) < 2:
        raise DataError(
            f"a demonstration goes from {float(time[0]):.4g} to {float(time[-1]):.4g} s, the "
            f"skill from {float(instants[0]):.4g} to {float(instants[-1]):.4g} s: bring it "
            "into the time of the skill, tpgmm_torch.corrections.in_skill_time(model, ...)"
        )
    there = instants[inside]
    blocks = quaternion_columns(demonstration, kinematics)
    return retime(demonstration, as_array(there), there, blocks), int(inside[0])


def gather_rows(
    batches: Iterable[Sequence[Demonstration]],
    operators: Sequence[Operator],
    kinematics: Kinematics,
    file: RowFile,
    processes: Processes,
    *,
    responsibilities: str = "auto",
    holds: Sequence[Hold] = (),
    leave_out: LeaveOut | None = None,
) -> LearningRows:
    """Read all demonstrations once, and keep what a mixture learns from.

    Parameters
    ----------
    batches : iterable of sequence of Demonstration
        Of this process, at least one.
    operators : sequence of Operator
    kinematics : Kinematics
    file : RowFile
        Where the local data go.
    processes : Processes
    responsibilities : {"auto", "instant", "point"}
    holds : sequence of Hold, default=()
        Objects that the robot held, the same in all processes.
    leave_out : callable, optional
        What is not to be learned from, see :data:`LeaveOut`; nothing is left out by default.

    Raises
    ------
    DataError
        If a process has nothing left to learn from, or if ``responsibilities="instant"`` and
        the demonstrations have different time grids.
    """
    expected = None
    spans: list[Span] = []
    aligned = True
    for batch in batches:
        if expected is None:
            # process 0 has the first demonstration of all, whose hemispheres all follow
            blocks = [operator.local(batch[0], kinematics, holds) for operator in operators]
            first = [tensor.cpu() for tensor in (batch[0].time, *blocks)]
            grid, *blocks = processes.gather(first)[0]
            expected = at_equal_phase([block.to(kinematics.lower) for block in blocks])
        aligned = aligned and all(torch.equal(item.time.cpu(), grid) for item in batch)
        for demonstration, rows in zip(
            batch, local_data(batch, operators, kinematics, expected, holds), strict=True
        ):
            spans.append((demonstration.duration, file.n_rows, file.n_rows + len(rows)))
            file.append(rows.cpu().numpy())
    aligned = all(processes.gather(aligned))
    if responsibilities == "instant":
        _check_aligned(aligned)
    widths = [1 + operator.dimension(kinematics) for operator in operators]
    turns = [bool(operator.rotation_vector_starts(kinematics)) for operator in operators]
    reference = _make_constant(file, spans, widths, turns, processes)
    time = _typical_time(file, spans, processes)
    if leave_out is not None:
        kept = _kept(file, spans, time, processes, leave_out)
        if sum(processes.gather(len(kept))) < sum(processes.gather(len(spans))):
            spans = file.keep(kept)
            reference = _make_constant(file, spans, widths, turns, processes)
            time = _typical_time(file, spans, processes)
    time = time.to(kinematics.lower)
    n_demonstrations = sum(processes.gather(len(spans)))
    if responsibilities == "point" or not aligned:
        return LearningRows(file, 1, time, n_demonstrations, processes)
    instants = Instants(reference, widths)
    instants.add(file)
    points, size = instants.points(processes)
    own = processes.share(range(len(points) // size))
    share = StoredRows(points[own[0] * size : (own[-1] + 1) * size])
    return LearningRows(share, size, time, n_demonstrations, processes)


def _make_constant(
    file: RowFile,
    spans: Sequence[Span],
    widths: Sequence[int],
    turns: Sequence[bool],
    processes: Processes,
) -> NDArray[np.float64]:
    """Make constant what varies by rounding alone; the first demonstration of all (T, ...)."""
    moments = column_moments(file, processes)
    first = processes.gather(file.read(*spans[0][1:]))[0]
    low, high = (
        torch.from_numpy(x.astype(first.dtype)) for x in (moments.smallest, moments.largest)
    )
    constant = constant_columns(low, high, widths, turns).numpy()
    file.make_constant(constant, first[0])
    together: NDArray[np.float64] = np.where(constant, first[0], first)
    return together


def at_phases(rows: Tensor, count: int) -> Tensor:
    """As many rows (count, ...) of one demonstration, at equal distances from first to last.

    Parameters
    ----------
    rows : Tensor of shape (T, ...)
    count : int
    """
    return rows[((len(rows) - 1) * torch.linspace(0, 1, count)).round().long()]


def _kept(
    file: RowFile,
    spans: Sequence[Span],
    time: Tensor,
    processes: Processes,
    leave_out: LeaveOut,
) -> list[Span]:
    """Those of the demonstrations of this process that are to be learned from."""
    counts = processes.gather(len(spans))
    width = file.read(0, 1).shape[1]
    fewest = math.ceil(float(time[-1] - time[0]) / COARSEST) + 1
    count = min(len(time), max(LARGEST_TABLE // (sum(counts) * width), fewest))
    table = [at_phases(torch.from_numpy(file.read(*span)), count) for _, *span in spans]
    everyone = processes.concatenate(torch.stack(table).double())
    left = set(leave_out(everyone, at_phases(time, count)))
    before = sum(counts[: processes.rank])
    kept = [span for m, span in enumerate(spans, before) if m not in left]
    if without := [rank for rank, n in enumerate(processes.gather(len(kept))) if n == 0]:
        raise DataError(
            f"all demonstrations of process(es) {without} are unlike the others and left out: "
            "start fewer processes, or learn from all, robust=False"
        )
    return kept


def _check_aligned(aligned: bool) -> None:
    """Refuse demonstrations that do not share one time grid."""
    if not aligned:
        raise DataError(
            "responsibilities='instant' needs demonstrations of one common time grid: "
            "align them (tpgmm_torch.alignment), or use 'auto' or 'point'"
        )


def _typical_time(file: RowFile, spans: Sequence[Span], processes: Processes) -> Tensor:
    """The time grid of the demonstration of median duration, of those of all processes."""
    everyone = [
        (duration, rank, start, stop)
        for rank, each in enumerate(processes.gather(spans))
        for duration, start, stop in each
    ]
    everyone.sort(key=lambda span: span[0])
    _, owner, start, stop = everyone[len(everyone) // 2]
    time = file.read(start, stop)[:, 0] if processes.rank == owner else None
    return torch.from_numpy(processes.gather(time)[owner])
