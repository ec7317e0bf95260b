"""Results as tidy tables: one row for each cell, and one for each episode."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from tpgmm_torch.atomic import replacing
from tpgmm_torch.exceptions import DataError

#: What identifies a cell, in the order of the columns.
KEYS = ("env", "policy", "demonstrations", "seed", "condition")


def wilson(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Compute the score interval of a proportion (Wilson, JASA 22, 1927).

    Unlike the normal approximation it stays within [0, 1] and is not empty where all trials
    succeed or none.

    Raises
    ------
    DataError
        If there are no trials, or more successes than trials.
    """
    if not 0 <= successes <= trials or trials == 0:
        raise DataError(f"{successes} successes of {trials} trials are no proportion")
    interval = binomtest(successes, trials).proportion_ci(confidence, "wilson")
    return float(interval.low), float(interval.high)


def cell_table(results: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Tabulate cells in a row each, from what :class:`Results` holds.

    It has what identifies the cell; ``success`` with its 95 % interval of Wilson; median and
    95th percentile of each figure of the environment; latency, training, size, options,
    seeds, versions and machine.
    """
    return pd.DataFrame([_row(result) for result in results])


def _row(result: Mapping[str, Any]) -> dict[str, Any]:
    episodes, training = pd.DataFrame(result["episodes"]), result["training"]
    successes = int(episodes.success.sum())
    low, high = wilson(successes, len(episodes))
    spreads = {}
    for key, values in episodes.drop(columns=["seed", "success"]).items():
        spreads[f"{key}_median"] = float(np.median(values))
        # not interpolated: a figure may be infinite
        spreads[f"{key}_p95"] = float(np.percentile(values, 95, method="higher"))
    return {
        **{key: result["cell"][key] for key in KEYS},
        "episodes": len(episodes),
        "successes": successes,
        "success": successes / len(episodes),
        "success_low": low,
        "success_high": high,
        **spreads,
        **result["latency"],
        "training_seconds": training["seconds"],
        "training_outcome": training["outcome"],
        **{key: training[key] for key in ("fps", "parameters", "bytes")},
        "evaluation_seconds": result["evaluation_seconds"],
        # 0.1.0 did not take it
        "evaluation_cpu_seconds": result.get("evaluation_cpu_seconds", float("nan")),
        "first_evaluation_seed": result["episodes"][0]["seed"],
        "options": json.dumps(result["settings"]["options"]),
        "demonstration_seed": result["settings"]["demonstration_seed"],
        **{key: json.dumps(result[key]) for key in ("versions", "machine")},
    }


def episode_table(results: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Tabulate evaluation episodes in a row each, from what :class:`Results` holds.

    It has what identifies the cell (the seed of its training as ``training_seed``), the seed of
    its demonstrations, the seed of the episode (``evaluation_seed``), what the episode gave,
    and the versions of the packages as JSON. Environments have figures of their own; those of
    the others are NaN.
    """
    parts = []
    for result in results:
        cell = {key: result["cell"][key] for key in KEYS if key != "seed"}
        cell["training_seed"] = result["cell"]["seed"]
        cell["demonstration_seed"] = result["settings"]["demonstration_seed"]
        episodes = pd.DataFrame(result["episodes"]).rename(columns={"seed": "evaluation_seed"})
        parts.append(episodes.assign(versions=json.dumps(result["versions"]), **cell))
    if not parts:
        return pd.DataFrame()
    table = pd.concat(parts, ignore_index=True)
    last = ["versions"]  # figures that came later stand before them all the same
    first = [*cell, "evaluation_seed"]
    return table[[*first, *table.columns.difference([*first, *last], sort=False), *last]]


def count_demonstrations(folder: Path) -> pd.DataFrame:
    """Count attempts at demonstrations that succeed by the environment's own criteria.

    Parameters
    ----------
    folder : Path
        Of the environment.

    Returns
    -------
    DataFrame
        ``seed`` of the demonstrations, how many were ``tried``, how many ``succeed``.
    """
    rows = []
    for summary in (folder / "episodes").glob("s*/summary.json"):
        successes = json.loads(summary.read_text(encoding="utf-8"))["successes"]
        seed = int(summary.parent.name.removeprefix("s"))
        rows.append({"seed": seed, "tried": len(successes), "succeed": sum(successes)})
    table = pd.DataFrame(rows, columns=["seed", "tried", "succeed"])
    return table.sort_values("seed", ignore_index=True)


def write_table(table: pd.DataFrame, path: Path) -> None:
    """Write a table as ``PATH.parquet`` and ``PATH.csv``, each in one step."""
    for suffix, write in ((".parquet", table.to_parquet), (".csv", table.to_csv)):
        with replacing(path.with_name(path.name + suffix)) as file:
            write(file, index=False)
