"""Picture of the page "When to use which policy": success under each disturbance."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from tpgmm_evaluation.report.tables import wilson
from tpgmm_tools.plotting import BLUE, ORANGE, VERMILION

__all__ = ["draw", "successes"]

RESULTS = Path(__file__).parents[2] / "evaluation" / "RESULTS.md"
COLORS = {"TP-GMM": BLUE, "key poses": ORANGE, "TP-GMM, played without looking": VERMILION}


def successes() -> tuple[list[str], int, dict[str, list[int]]]:
    """Conditions, episodes of each, and successes by policy, read from the results in full."""
    head, *rows = re.findall(
        rf"^\| (of \d+, all tasks|{'|'.join(COLORS)}) \|(.+)\|$",
        RESULTS.read_text(encoding="utf-8"),
        re.MULTILINE,
    )
    conditions = [name.strip(" `") for name in head[1].split("|")[:-1]]
    counts = {name: [int(n) for n in cells.split("|")[:-1]] for name, cells in rows}
    return conditions, int(head[0].split()[1].strip(",")), counts


def draw(out: Path) -> None:
    """Write ``disturbances.svg``: bars for each condition, with Wilson's intervals."""
    conditions, episodes, counts = successes()
    drawing = Figure(figsize=(8.4, 2.8), layout="constrained")
    axes = drawing.subplots()
    for number, (name, color) in enumerate(COLORS.items()):
        place = np.arange(len(conditions)) + 0.27 * (number - 1)
        share = np.array(counts[name]) / episodes
        ends = np.array([wilson(n, episodes) for n in counts[name]]).T
        axes.bar(place, 100 * share, 0.25, color=color, label=name)
        axes.errorbar(place, 100 * share, 100 * abs(ends - share), fmt="none", ecolor="0.2")
    axes.set_xticks(np.arange(len(conditions)), conditions)
    axes.set_ylabel("success [%]")
    drawing.legend(loc="outside lower center", ncols=len(COLORS))
    drawing.savefig(out / "disturbances.svg")
