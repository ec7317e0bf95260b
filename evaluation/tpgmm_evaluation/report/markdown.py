"""Numbers and tables as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import pandas as pd

from tpgmm_evaluation.report.tables import wilson

__all__ = ["listed", "rate", "share", "spread", "table"]


def rate(rows: pd.DataFrame) -> str:
    """Successes with their interval; a dash where there are no episodes."""
    successes, trials = int(rows.success.sum()), len(rows)
    if not trials:
        return "-"
    low, high = wilson(successes, trials)
    interval = f"{100 * low:.0f} to {100 * high:.0f} %"
    return f"{successes}/{trials} = {share(successes, trials)} ({interval})"


def share(successes: int, trials: int) -> str:
    """In percent; 100 and 0 only where it is all, or none."""
    percent = 100 * successes / trials
    digits = 1 if 99.5 <= percent < 100 or 0 < percent < 0.5 else 0
    return f"{percent:.{digits}f} %"


def spread(values: pd.Series[Any], digits: int) -> str:
    """Median and 95th percentile."""
    # not interpolated: a figure may be infinite
    late = values.quantile(0.95, interpolation="higher")
    return f"{values.median():.{digits}f} / {late:.{digits}f}"


def listed(values: Iterable[int]) -> str:
    """Numbers in their order."""
    return ", ".join(map(str, sorted(values)))


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table."""
    lines = (head, ["---"] * len(head), *rows)
    return "\n".join(f"| {' | '.join(map(str, cells))} |" for cells in lines)
