"""Which episodes fail, by which criterion, and how to see them again."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import pandas as pd

from tpgmm_evaluation.benchmarks import Benchmark
from tpgmm_evaluation.settings import Settings

#: What identifies a failed episode.
COLUMNS = ["env", "policy", "demonstrations", "training_seed", "condition", "evaluation_seed"]


def criterion(benchmark: Benchmark, key: str) -> str:
    """Format a figure and the bounds between which it lies in a success."""
    heading, _, low, high = benchmark.figures[key]
    if low == high:
        return f"{heading} = {low:g}"
    if not math.isfinite(high):
        return f"{heading} ≥ {low:g}"
    return f"{heading} ≤ {high:g}" if low <= 0 else f"{heading} {low:g} to {high:g}"


def missed_criteria(episode: Mapping[str, Any], benchmark: Benchmark) -> list[str]:
    """Return the criteria that an episode does not meet.

    Parameters
    ----------
    episode : mapping
        Its figures by name; one that is missing or NaN does not meet its criterion.
    """
    return [
        key
        for key, figure in benchmark.criteria.items()
        if not figure.low <= episode.get(key, math.nan) <= figure.high
    ]


def list_failures(episodes: pd.DataFrame, benchmarks: Mapping[str, Benchmark]) -> pd.DataFrame:
    """Tabulate episodes without success, and what was missed in them.

    Parameters
    ----------
    episodes : DataFrame
        As :func:`~tpgmm_evaluation.report.tables.episode_table` makes it.
    benchmarks : mapping
        By the name of the environment.

    Returns
    -------
    DataFrame
        What identifies the episode, and ``missed``: criteria joined by a semicolon, each with
        the value in brackets. Without criteria, or if all of them are met, it says so.
    """
    rows = []
    for row in episodes[~episodes.success.astype(bool)].to_dict("records"):
        benchmark = benchmarks[row["env"]]
        texts = [
            f"{criterion(benchmark, key)} ({row.get(key, math.nan):.3g})"
            for key in missed_criteria(row, benchmark)
        ]
        if not benchmark.criteria:
            texts = [
                f"{figure.heading}: {row[key]:.3g}"
                for key, figure in benchmark.figures.items()
                if key in row
            ]
        text = "; ".join(texts) or "all of them are met, but not in time"
        rows.append({key: row[key] for key in COLUMNS} | {"missed": text})
    return pd.DataFrame(rows, columns=[*COLUMNS, "missed"])


def evaluation_command(
    settings: Settings, condition: str, policy: str, rate: object, seed: object, trials: object
) -> str:
    """Return the call of LeRobot's evaluation that repeats episodes.

    Parameters
    ----------
    policy : str
        A pretrained directory.
    rate : object
        Of the policy [Hz], or a word in its place.
    seed, trials : object
        Of the first episode, and how many there are.
    """
    options = settings.disturb(condition)
    given = " ".join(f"--env.{key}={_plain(value)}" for key, value in options.items())
    return (
        f"lerobot-eval --policy.path={policy} --policy.device=cpu "
        f"--env.type={settings.benchmark().env} --env.fps={rate} {given}{' ' * bool(given)}"
        f"--eval.n_episodes={trials} --eval.batch_size={trials} --eval.use_async_envs=false "
        f"--seed={seed}"
    )


def _plain(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
