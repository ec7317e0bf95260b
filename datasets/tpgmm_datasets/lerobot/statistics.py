"""Statistics of the columns, as LeRobot keeps them per episode and for the whole set."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tpgmm_torch.data.arrays import Array

#: By column, by name of the statistic: one value per value of the column.
Statistics = dict[str, dict[str, Array]]

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def episode_statistics(columns: Mapping[str, Array]) -> Statistics:
    """Compute minimum, maximum, mean, deviation, count and quantiles of one episode.

    Parameters
    ----------
    columns : mapping of str to ndarray of shape (T, width)
        The values by column.
    """
    return {key: _column_statistics(values) for key, values in columns.items()}


def _column_statistics(values: Array) -> dict[str, Array]:
    values = values.astype(np.float64)
    quantiles = np.quantile(values, list(QUANTILES.values()), axis=0)
    return {
        "min": values.min(axis=0),
        "max": values.max(axis=0),
        "mean": values.mean(axis=0),
        "std": values.std(axis=0),
        "count": np.array([len(values)]),
        **dict(zip(QUANTILES, quantiles, strict=True)),
    }


def merge_statistics(a: Statistics, b: Statistics) -> Statistics:
    """Merge the statistics of two parts.

    Everything is exact but the quantiles, which are averages weighted by the number of rows:
    so does LeRobot, and only so can a set grow without being read again.
    """
    return {key: _merge_column(a[key], b[key]) for key in a}


def _merge_column(a: dict[str, Array], b: dict[str, Array]) -> dict[str, Array]:
    count = a["count"] + b["count"]
    share = b["count"] / count
    shift = b["mean"] - a["mean"]
    variance = (1 - share) * a["std"] ** 2 + share * b["std"] ** 2
    return {
        "min": np.minimum(a["min"], b["min"]),
        "max": np.maximum(a["max"], b["max"]),
        "mean": a["mean"] + share * shift,
        "std": np.sqrt(variance + share * (1 - share) * shift**2),
        "count": count,
        **{name: (1 - share) * a[name] + share * b[name] for name in QUANTILES},
    }


def stated_range(root: Path, key: str, width: int) -> Array | None:
    """Read smallest and largest values of a column over all episodes, from the metadata.

    Parameters
    ----------
    root : Path
        Folder of the data set, in either layout.
    key : str
        Name of the column.
    width : int
        How many values it has.

    Returns
    -------
    ndarray of shape (2, width), or None
        None where the metadata do not say: statistics are no part of what a set must have.
    """
    try:
        whole = root / "meta/stats.json"
        if whole.is_file():
            stated = [json.loads(whole.read_bytes())]
        else:
            lines = (root / "meta/episodes_stats.jsonl").read_text().splitlines()
            stated = [json.loads(line)["stats"] for line in lines]
        low, high = ([_numbers(s[key][end], width) for s in stated] for end in ("min", "max"))
        found: Array = np.stack((np.min(low, axis=0), np.max(high, axis=0)))
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return found if np.isfinite(found).all() else None


def _numbers(values: Any, width: int) -> Array:
    return np.asarray(values, dtype=np.float64).reshape(width)
