"""Demonstrations that do not fit into memory, or are spread over processes.

They are read once, batch by batch; what is kept of them are their local data, in a temporary
file, or, where one responsibility is for an instant, a few points per instant.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch.data.demonstrations import Demonstration, check_demonstrations
from tpgmm_torch.em.column_moments import ColumnMoments
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.large_data.processes import ALONE, Processes
from tpgmm_torch.large_data.row_batches import Rows, StoredRows
from tpgmm_torch.large_data.row_file import SpooledRows
from tpgmm_torch.operators import Operator
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.training.equivalent_points import Instants
from tpgmm_torch.training.local_data import at_equal_phase, constant_columns, local_data

__all__ = [
    "DemonstrationBatches",
    "LearningRows",
    "check_like",
    "gather_rows",
    "rows_in_memory",
    "share_one_grid",
    "split_batches",
    "typical_time",
]


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
    processes : Processes
        Among which the rows are spread.
    """

    rows: Rows
    group_size: int
    time: Tensor
    processes: Processes


class DemonstrationBatches:
    """Batches of like demonstrations, checked as they come.

    Parameters
    ----------
    batches : iterable of sequence of Demonstration

    Raises
    ------
    DataError, ShapeError
        While walking: if demonstrations differ in joints or frames from those before; the
        message says in which batch.
    """

    def __init__(self, batches: Iterable[Sequence[Demonstration]]) -> None:
        self._batches = batches

    def __iter__(self) -> Iterator[list[Demonstration]]:
        """One pass; joints are in the order of the first demonstration, none is empty."""
        first: Demonstration | None = None
        for number, batch in enumerate(self._batches):
            if isinstance(batch, Sequence) and not batch:
                continue
            known = [] if first is None else [first]
            try:
                checked = check_demonstrations([*known, *batch])[len(known) :]
            except (ValueError, TypeError) as error:
                after = ", counted after the first of all" if known else ""
                kind = type(error) if isinstance(error, DataError) else DataError
                raise kind(f"batch {number} of demonstrations{after}: {error}") from error
            first = first or checked[0]
            yield checked


def split_batches(X: Any) -> tuple[Any, Iterable[Sequence[Demonstration]] | None]:
    """Tell demonstrations from batches of demonstrations.

    Parameters
    ----------
    X : iterable of Demonstration, or of sequences of Demonstration

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


def check_like(batch: Sequence[Demonstration] | None, processes: Processes) -> None:
    """Refuse a share without demonstrations, and shares that differ in joints or frames.

    Parameters
    ----------
    batch : sequence of Demonstration or None
        The first of this process, None if it has none.
    processes : Processes

    Raises
    ------
    DataError
        In all processes, whichever of them it is.
    """
    if batch is None:
        own = ""
    else:
        first = batch[0]
        joints = list(first.joint_names or [f"{first.n_joints} without names"])
        own = f"joints {joints}, frames {sorted(first.frames)}"
    found = processes.texts(own)
    without = [rank for rank, text in enumerate(found) if not text]
    if without:
        where = f" in process(es) {without} of {processes.count}"
        raise DataError(
            f"there are no demonstrations{where if processes.count > 1 else ''}: each process "
            "needs at least one"
        )
    for rank, text in enumerate(found):
        if text != found[0]:
            raise DataError(
                f"process {rank} has demonstrations with {text}, process 0 with {found[0]}"
            )


def rows_in_memory(
    demonstrations: Sequence[Demonstration],
    operators: Sequence[Operator],
    kinematics: Kinematics,
    *,
    responsibilities: str = "auto",
) -> LearningRows:
    """What a mixture learns from demonstrations that are in memory, in this process alone.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
    operators : sequence of Operator
    kinematics : Kinematics
    responsibilities : {"auto", "instant", "point"}

    Raises
    ------
    DataError
        If ``responsibilities="instant"`` and the demonstrations have different time grids.
    """
    rows = local_data(demonstrations, operators, kinematics)
    aligned = share_one_grid(demonstrations)
    if responsibilities == "instant":
        _check_aligned(aligned)
    group_size = len(rows) if aligned and responsibilities != "point" else 1
    together = torch.cat(rows) if group_size == 1 else torch.stack(rows, 1).flatten(0, 1)
    points = StoredRows(together.cpu().numpy())
    return LearningRows(points, group_size, typical_time(demonstrations).to(rows[0]), ALONE)


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


def gather_rows(
    batches: Iterable[Sequence[Demonstration]],
    operators: Sequence[Operator],
    kinematics: Kinematics,
    spool: SpooledRows,
    processes: Processes,
    *,
    responsibilities: str = "auto",
) -> LearningRows:
    """Read all demonstrations once, and keep what a mixture learns from.

    Parameters
    ----------
    batches : iterable of sequence of Demonstration
        Of this process, at least one.
    operators : sequence of Operator
    kinematics : Kinematics
    spool : SpooledRows
        Where the local data go.
    processes : Processes
    responsibilities : {"auto", "instant", "point"}

    Raises
    ------
    DataError
        If ``responsibilities="instant"`` and the demonstrations have different time grids.
    """
    reference, grid = None, torch.empty(0)
    durations: list[float] = []
    lengths: list[int] = []
    uneven = 0.0
    for batch in batches:
        if reference is None:
            reference, grid = _first(batch[0], operators, kinematics, processes)
            widths = [1 + operator.dimension(kinematics) for operator in operators]
            sides = at_equal_phase([block[:, 1:] for block in reference.split(widths, 1)])
        uneven += sum(not _equal(demonstration.time, grid) for demonstration in batch)
        durations += [demonstration.duration for demonstration in batch]
        lengths += map(len, batch)
        for rows in local_data(batch, operators, kinematics, sides):
            spool.append(rows.cpu().numpy())
    assert reference is not None
    moments = ColumnMoments.of_batches(spool, processes)
    smallest, largest = (
        torch.from_numpy(ends).to(reference) for ends in (moments.smallest, moments.largest)
    )
    constant = constant_columns(smallest, largest, widths)
    spool.make_constant(constant.cpu().numpy(), reference[0].cpu().numpy())
    (total,) = processes.sum(torch.tensor(uneven, dtype=torch.float64))
    time = _typical_time(spool, durations, lengths, processes).to(reference)
    if responsibilities == "point" or (total > 0 and responsibilities == "auto"):
        return LearningRows(spool, 1, time, processes)
    _check_aligned(float(total) == 0)
    instants = Instants(torch.where(constant, reference[0], reference).cpu().numpy(), widths)
    instants.add(spool)
    points, size = instants.points(processes)
    own = processes.share(range(len(points) // size))
    share = StoredRows(points[own[0] * size : (own[-1] + 1) * size])
    return LearningRows(share, size, time, processes)


def _check_aligned(aligned: bool) -> None:
    """Refuse demonstrations that do not share one time grid."""
    if not aligned:
        raise DataError(
            "responsibilities='instant' needs demonstrations of one common time grid: "
            "align them (tpgmm_torch.alignment), or use 'auto' or 'point'"
        )


def _first(
    demonstration: Demonstration,
    operators: Sequence[Operator],
    kinematics: Kinematics,
    processes: Processes,
) -> tuple[Tensor, Tensor]:
    """Rows and times of the first demonstration of all, that of process 0."""
    time = demonstration.time.to(kinematics.lower)
    blocks = []
    for operator in operators:
        blocks += [time[:, None], operator.local(demonstration, kinematics)]
    rows, exact = torch.cat(blocks, 1), demonstration.time.double().cpu()
    if processes.rank > 0:
        rows, exact = rows[:0], exact[:0]
    rows = processes.concatenate(rows.double().cpu()).to(rows)
    return rows, processes.concatenate(exact)


def _equal(time: Tensor, grid: Tensor) -> bool:
    return torch.equal(time.double().cpu(), grid)


def _typical_time(
    spool: SpooledRows, durations: list[float], lengths: list[int], processes: Processes
) -> Tensor:
    """The time grid of the demonstration of median duration, of those of all processes."""
    owners = torch.full((len(durations),), processes.rank, dtype=torch.float64)
    own = torch.tensor([durations, lengths], dtype=torch.float64).T
    everyone = processes.concatenate(torch.cat([own, owners[:, None]], 1))
    chosen = int(torch.sort(everyone[:, 0], stable=True).indices[len(everyone) // 2])
    owner, before = everyone[chosen, 2], everyone[:chosen]
    time = np.empty(0)
    if int(owner) == processes.rank:
        start = int(before[before[:, 2] == owner, 1].sum())
        time = _slice(spool, start, start + int(everyone[chosen, 1]))
    return processes.concatenate(torch.from_numpy(time))


def _slice(rows: Rows, start: int, stop: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """First column of the rows from ``start`` to ``stop``."""
    parts, at = [], 0
    for batch in rows:
        parts.append(batch[max(0, start - at) : max(0, stop - at), 0])
        at += len(batch)
        if at >= stop:
            break
    return np.concatenate(parts).astype(np.float64)
