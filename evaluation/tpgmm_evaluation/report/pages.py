"""Common parts of the pages of a comparison: numbers, tables and remarks as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from lerobot_env_bimanual.bottle.measures import Figure
from tpgmm_evaluation.cells import Cell
from tpgmm_evaluation.jobs import POLICIES
from tpgmm_evaluation.report.tables import wilson
from tpgmm_evaluation.variants import EVEN_CLOCK, OPEN_LOOP, Variant
from tpgmm_torch.atomic import replacing

__all__ = [
    "block", "bullets", "by_policy", "cost_table", "described", "failed_cells", "figure_table",
    "known", "listed", "ordered", "picture", "rate", "share", "success_rows", "table",
    "uncertainty", "write_page",
]  # fmt: skip

PHASE = "the same, informed of the time and learning from episodes on a common clock"
#: What each policy is, in the order of the report.
DESCRIPTIONS = {
    "tpgmm": "task-parameterised Gaussian mixture: the hands' poses seen from the objects, "
    "and the joints",
    OPEN_LOOP: "the same, played by the clock with what is seen at the start, as in 0.1.0",
    EVEN_CLOCK: "the same, watching the scene, but by the clock, wherever the robot is",
    "tpgmm-places": "the same, learned and played with all objects as places: where they were "
    "at the beginning, whoever holds them later",
    "tpgmm-position-only": "the same without the orientation of the hands",
    "tpgmm-no-joints": "the same without the joints as a subspace: the hands' poses alone",
    "tpgmm-auto": "the same with the subspaces chosen by itself, operators='auto'",
    "key-poses": "inverse kinematics to the hands' key poses, each seen from where "
    "demonstrations differ least, along minimum-jerk paths with the mean timing",
    "key-poses-posture": "the same with the mean demonstrated posture in the null space",
    "act": "LeRobot's Action Chunking Transformer on joints and object poses",
    "act-phase": PHASE,
    "act-large": "it again, with LeRobot's own sizes: forty million weights",
    "act-large-phase": PHASE,
    "diffusion": "LeRobot's Diffusion Policy on joints and object poses",
    "diffusion-phase": PHASE,
    "nearest": "replays the demonstration whose objects stood nearest: the naive floor",
    "mean": "replays the mean of the aligned demonstrations, wherever the objects are",
}


def ordered(policies: Iterable[str]) -> list[str]:
    """Each policy once, in the order of the report, variants behind what they vary."""
    names = [*DESCRIPTIONS, *(name for name in POLICIES if name not in DESCRIPTIONS)]

    def place(policy: str) -> tuple[int, str]:
        if policy in names:
            return names.index(policy), ""
        return names.index(Variant.parse(policy).base), policy

    return sorted(set(policies), key=place)


def described(policy: str) -> str:
    """Description of a policy, in a line."""
    if policy in DESCRIPTIONS:
        return DESCRIPTIONS[policy]
    variant = Variant.parse(policy)
    if not variant.overrides:
        return f"`{policy}`"
    return f"{variant.base} with {', '.join(f'`{item}`' for item in variant.overrides)}"


def by_policy(rows: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """The rows of each policy, in the order of the report."""
    for policy in ordered(rows.policy):
        yield policy, rows[rows.policy == policy]


def write_page(path: Path, paragraphs: Iterable[str]) -> Path:
    """Write paragraphs of Markdown in one step; return the path."""
    text = "\n\n".join(paragraphs)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        file.write_text(text + "\n", encoding="utf-8")
    return path


def picture(folder: Path, name: str) -> Path:
    """Where a picture of a page goes, without suffix."""
    (folder / "figures").mkdir(exist_ok=True)
    return folder / "figures" / name


def block(lines: Iterable[str]) -> str:
    """Lines as they are."""
    return "\n".join(("```", *lines, "```"))


def bullets(lines: Iterable[str]) -> str:
    """A list."""
    return "\n".join(f"- {line}" for line in lines)


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table."""
    lines = (head, ["---"] * len(head), *rows)
    return "\n".join(f"| {' | '.join(map(str, cells))} |" for cells in lines)


def failed_cells(heading: str, failures: Mapping[Cell, str]) -> Iterator[str]:
    """The cells without a result, with the reason."""
    if failures:
        yield f"## {heading}"
        yield bullets(f"`{cell.key}`: {reason}" for cell, reason in failures.items())


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


def listed(values: Iterable[int]) -> str:
    """Numbers in their order."""
    return ", ".join(map(str, sorted(values)))


def uncertainty(trials: int) -> str:
    """How well a rate is known after a number of episodes."""
    low, high = wilson(trials // 2, trials)
    return (
        f"With {trials} episodes a rate around one half is known to "
        f"{50 * (high - low):.0f} percentage points, either way."
    )


def success_rows(episodes: pd.DataFrame, counts: Iterable[int]) -> list[list[str]]:
    """Policies down, their successes with each number of demonstrations across."""
    return [
        [policy, *(rate(rows[rows.demonstrations == count]) for count in counts)]
        for policy, rows in by_policy(episodes)
    ]


def known(figures: Mapping[str, Figure], episodes: pd.DataFrame) -> dict[str, Figure]:
    """The figures that episodes have."""
    return {name: figure for name, figure in figures.items() if name in episodes}


def figure_table(
    head: Sequence[str],
    groups: Iterable[tuple[Sequence[object], pd.DataFrame]],
    figures: Mapping[str, Figure],
) -> str:
    """Median and 95th percentile of figures, in a row for each group of episodes.

    Parameters
    ----------
    head : sequence of str
        Over what stands before the figures.
    groups : iterable of (sequence, DataFrame)
        What stands before the figures, and the episodes.
    figures : mapping of str to Figure
        The columns.
    """
    rows = [
        [*first, *(_spread(episodes[key], figure.digits) for key, figure in figures.items())]
        for first, episodes in groups
    ]
    return table([*head, *(figure.heading for figure in figures.values())], rows)


def _spread(values: pd.Series[Any], digits: int) -> str:
    """Median and 95th percentile."""
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


def cost_table(cells: pd.DataFrame) -> Iterator[str]:
    """Costs of training and acting, as :func:`~.tables.cell_table` holds it."""
    yield "## What it costs"
    yield (
        "Medians over the cells with the most demonstrations of each task; in brackets the "
        "smallest and the largest. An action is everything from the raw observation to the "
        "joint references for one robot, on one thread, median and 99th percentile; policies "
        "that predict chunks compute one for several actions, and take these from memory."
    )
    most = cells.groupby(["env", "policy"]).demonstrations.transform("max")
    cells = cells[cells.demonstrations == most]
    cells = cells.assign(
        per_episode=cells.evaluation_cpu_seconds / cells.episodes, megabytes=cells.bytes / 1e6
    )
    rows = [
        [policy, *(_range(part[key], digits) for key, digits in COSTS.values())]
        for policy, part in by_policy(cells)
    ]
    yield table(["policy", *COSTS], rows)


def _range(values: pd.Series[Any], digits: int) -> str:
    values = values.dropna()
    if values.empty:
        return "-"
    middle, low, high = (
        f"{value:,.{digits}f}".replace(",", " ")
        for value in (values.median(), values.min(), values.max())
    )
    return middle if low == high else f"{middle} ({low} to {high})"
