"""Results as tidy tables: one row for each cell, and one for each episode."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from tpgmm_torch.atomic import replacing
from tpgmm_torch.exceptions import DataError

__all__ = ["cell_table", "demonstration_table", "episode_table", "wilson", "write_table"]

#: What identifies a cell, in the order of the columns.
KEYS = ("env", "policy", "demonstrations", "seed", "condition")


def wilson(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Score interval of a proportion (Wilson, JASA 22, 1927).

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
    """One row for each cell, from what :class:`Results` holds.

    It has what identifies the cell; ``success`` with its 95 % interval of Wilson; median and
    95th percentile of each figure of the environment; latency, training, size, options,
    seeds, versions and machine.
    """
    return pd.DataFrame([_row(result) for result in results])


def _row(result: Mapping[str, Any]) -> dict[str, Any]:
    episodes, training = result["episodes"], result["training"]
    successes = sum(episode["success"] for episode in episodes)
    low, high = wilson(successes, len(episodes))
    row = {key: result["cell"][key] for key in KEYS}
    row |= {
        "episodes": len(episodes),
        "successes": successes,
        "success": successes / len(episodes),
        "success_low": low,
        "success_high": high,
    }
    for key in (name for name in episodes[0] if name not in ("seed", "success")):
        values = [episode[key] for episode in episodes]
        row[f"{key}_median"] = float(np.median(values))
        # not interpolated: a figure may be infinite
        row[f"{key}_p95"] = float(np.percentile(values, 95, method="higher"))
    row |= result["latency"]
    row |= {f"training_{key}": training[key] for key in ("seconds", "outcome")}
    row |= {key: training[key] for key in ("fps", "parameters", "bytes")}
    row["evaluation_seconds"] = result["evaluation_seconds"]
    # 0.1.0 did not take it
    row["evaluation_cpu_seconds"] = result.get("evaluation_cpu_seconds", float("nan"))
    row["first_evaluation_seed"] = episodes[0]["seed"]
    for key in ("options", "demonstration_seed"):
        row[key] = _text(result["settings"][key])
    return row | {key: _text(result[key]) for key in ("versions", "machine")}


def _text(value: Any) -> Any:
    return json.dumps(value) if isinstance(value, Mapping | Sequence) else value


def episode_table(results: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """One row for each evaluation episode, from what :class:`Results` holds.

    It has what identifies the cell (the seed of its training as ``training_seed``), the seed of
    its demonstrations, the seed of the episode (``evaluation_seed``), what the episode gave,
    and the versions of the packages as JSON. Environments have figures of their own; those of
    the others are NaN.
    """
    rows = []
    for result in results:
        cell = {key: result["cell"][key] for key in KEYS}
        cell["training_seed"] = cell.pop("seed")
        cell["demonstration_seed"] = result["settings"]["demonstration_seed"]
        versions = _text(result["versions"])
        for episode in result["episodes"]:
            given = {key: value for key, value in episode.items() if key != "seed"}
            row = {**cell, "evaluation_seed": episode["seed"], **given}
            rows.append({**row, "versions": versions})
    table = pd.DataFrame(rows)
    # figures that came later stand before the versions all the same
    return table[[key for key in table if key != "versions"] + ["versions"] * bool(rows)]


def demonstration_table(folder: Path) -> pd.DataFrame:
    """How many attempts at demonstrations succeed by the environment's own criteria.

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
