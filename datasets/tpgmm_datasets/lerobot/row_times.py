"""Time of the rows of an episode, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from tpgmm_datasets.errors import DatasetError
from tpgmm_torch.data.arrays import Array

#: Fractions of a period: how far a row may be off its place on the grid, and how long a step
#: may be.
OFF_GRID, LONGEST_STEP = 0.01, 1.5


def time_problems(timestamps: Array, fps: float, **where: Any) -> Iterator[DatasetError]:
    """Yield faults of the timestamps of an episode, shape (T,)."""
    where = {**where, "column": "timestamp"}
    finite = np.isfinite(timestamps)
    if not finite.all():
        at = int(np.flatnonzero(~finite)[0])
        yield DatasetError(f"row {at} is {timestamps[at]}", check="nan", **where)
        return
    steps = np.diff(timestamps.astype(np.float64))
    if (np.abs(steps * fps - 1) < 0.1).all():
        return
    usual, longest = float(np.median(steps)), int(steps.argmax())
    check = message = ""
    if (steps <= 0).any():
        check, at = "time", int(np.flatnonzero(steps <= 0)[0])
        message = "time does not increase from {:.6g} to {:.6g} s at row {}"
    elif abs(usual * fps - 1) > 0.1:
        problem = f"rows are {usual:.6g} s apart, but info.json says fps = {fps:g}"
        yield DatasetError(problem, check="metadata", **where)
        return
    elif steps[longest] * fps > LONGEST_STEP:
        check, at = "gaps", longest
        missing = round(float(steps[at]) * fps) - 1
        message = f"about {missing} rows are missing between {{:.6g}} and {{:.6g}} s (row {{}})"
    if check:
        text = message.format(timestamps[at], timestamps[at + 1], at + 1)
        yield DatasetError(text, check=check, **where)


def row_times(timestamps: Array | None, rows: int, fps: float) -> Array:
    """Return the time of each row from the start of the episode [s], float64.

    Timestamps that lie on the grid of ``fps``, as nearly all do, are replaced by it: they are
    stored with the seven digits of float32.
    """
    grid = np.arange(rows) / fps
    if timestamps is None:
        return grid
    since = timestamps.astype(np.float64) - float(timestamps[0])
    rounding = 4 * float(np.finfo(np.float32).eps) * float(np.abs(timestamps).max())
    off = np.abs(since - grid).max()
    return grid if off <= OFF_GRID / fps + rounding else since
