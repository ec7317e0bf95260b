"""Numbers and tables of the pages of a comparison, as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from tpgmm_evaluation.jobs import POLICIES
from tpgmm_evaluation.report.tables import wilson
from tpgmm_evaluation.variants import NAMED, Variant
from tpgmm_torch.atomic import replacing


def order_policies(policies: Iterable[str]) -> list[str]:
    """Return each policy once, in the order of the report, variants behind what they vary."""

    def place(policy: str) -> tuple[int, int, str]:
        base = Variant.parse(policy).base
        rank = 2 + [*NAMED].index(policy) if policy in NAMED else int(policy != base)
        return POLICIES.index(base), rank, policy

    return sorted(set(policies), key=place)


def describe_variant(policy: str) -> str:
    """Describe a policy that has no description of its own."""
    variant = Variant.parse(policy)
    if not variant.overrides:
        return f"`{policy}`"
    return f"{variant.base} with {', '.join(f'`{item}`' for item in variant.overrides)}"


def write_page(path: Path, text: str) -> Path:
    """Write a text in one step; return the path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        file.write_text(text.rstrip("\n") + "\n", encoding="utf-8")
    return path


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Format a table in Markdown."""
    lines = (head, ["---"] * len(head), *rows)
    return "\n".join(f"| {' | '.join(map(str, cells))} |" for cells in lines)


def rate(successes: pd.Series[bool]) -> str:
    """Format the share of successes."""
    return rate_of(int(successes.sum()), len(successes))


def rate_of(successes: int, trials: int) -> str:
    """Format successes with the 95 % interval of their share."""
    low, high = wilson(successes, trials)
    interval = f"{100 * low:.0f} to {100 * high:.0f} %"
    return f"{successes}/{trials} = {share(successes, trials)} ({interval})"


def share(successes: int, trials: int) -> str:
    """Format a share in percent; 100 and 0 only where it is all, or none."""
    percent = 100 * successes / trials
    digits = 1 if 99.5 <= percent < 100 or 0 < percent < 0.5 else 0
    return f"{percent:.{digits}f} %"


def spread(values: pd.Series[Any], digits: int) -> str:
    """Format median and 95th percentile."""
    # not interpolated: a figure may be infinite
    late = values.quantile(0.95, interpolation="higher")
    return f"{values.median():.{digits}f} / {late:.{digits}f}"


#: Columns of the table of costs, with their digits.
COSTS = {
    "training [CPU s]": ("training_seconds", 1),
    "parameters": ("parameters", 0),
    "on disk [MB]": ("megabytes", 1),
    "rate [Hz]": ("fps", 0),
    "action, median [ms]": ("step_median_ms", 2),
    "99 % [ms]": ("step_p99_ms", 2),
    "actions per chunk": ("chunk_size", 0),
    "chunk, median [ms]": ("chunk_median_ms", 2),
    "chunk, 99 % [ms]": ("chunk_p99_ms", 2),
    "evaluation [CPU s/episode]": ("per_episode", 2),
}


def cost_table(cells: pd.DataFrame) -> str:
    """Tabulate costs of training and acting, from a :func:`~.tables.cell_table`."""
    most = cells.groupby(["env", "policy"]).demonstrations.transform("max")
    cells = cells[cells.demonstrations == most]
    cells = cells.assign(
        per_episode=cells.evaluation_cpu_seconds / cells.episodes, megabytes=cells.bytes / 1e6
    )
    rows = [
        [policy, *(_range(cells[key][cells.policy == policy], n) for key, n in COSTS.values())]
        for policy in order_policies(cells.policy)
    ]
    return table(["policy", *COSTS], rows)


def _range(values: pd.Series[Any], digits: int) -> str:
    values = values.dropna()
    if values.empty:
        return "-"
    middle, low, high = (
        f"{value:,.{digits}f}".replace(",", " ")
        for value in (values.median(), values.min(), values.max())
    )
    return middle if low == high else f"{middle} ({low} to {high})"
