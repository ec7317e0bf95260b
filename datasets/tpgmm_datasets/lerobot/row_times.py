"""Time of the rows of an episode, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from tpgmm_datasets.errors import DatasetError
from tpgmm_torch.data.arrays import Array

__all__ = ["row_times", "time_problems"]

#: Fractions of a period: how far a row may be off its place on the grid, and how long a step
#: may be.
OFF_GRID, LONGEST_STEP = 0.01, 1.5


def time_problems(timestamps: Array, fps: float, **where: Any) -> Iterator[DatasetError]:
    """What is wrong with the timestamps of an episode, shape (T,)."""
    where = {**where, "column": "timestamp"}
    finite = np.isfinite(timestamps)
    if not finite.all():
        at = int(np.flatnonzero(~finite)[0])
        yield DatasetError(f"row {at} is {timestamps[at]}", check="nan", **where)
        return
    steps = np.diff(timestamps.astype(np.float64))
    if (np.abs(steps * fps - 1) < 0.1).all():
        return
    if (steps <= 0).any():
        at = int(np.flatnonzero(steps <= 0)[0])
        yield DatasetError(
            f"time does not increase from {timestamps[at]:.6g} to {timestamps[at + 1]:.6g} s "
            f"at row {at + 1}",
            check="time",
            **where,
        )
        return
    usual = float(np.median(steps))
    if abs(usual * fps - 1) > 0.1:
        yield DatasetError(
            f"rows are {usual:.6g} s apart, but info.json says fps = {fps:g}",
            check="metadata",
            **where,
        )
        return
    if steps.max() * fps > LONGEST_STEP:
        at = int(steps.argmax())
        missing = round(float(steps[at]) * fps) - 1
        yield DatasetError(
            f"about {missing} rows are missing between {timestamps[at]:.6g} and "
            f"{timestamps[at + 1]:.6g} s (row {at + 1})",
            check="gaps",
            **where,
        )


def row_times(timestamps: Array | None, rows: int, fps: float) -> Array:
    """Time of each row from the start of the episode [s], float64.

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
