"""Pictures of a comparison."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, PercentFormatter

from lerobot_policy_tpgmm.evaluation.report.tables import wilson

__all__ = ["draw_curves", "draw_errors", "draw_success"]

#: Colour and marker of each policy; the phase-informed variant of a baseline is filled.
LOOKS = {
    "tpgmm": ("tab:red", "o", True),
    "tpgmm-open-loop": ("tab:red", "o", False),
    "tpgmm-places": ("tab:brown", "v", False),
    "tpgmm-position-only": ("tab:orange", "s", True),
    "act": ("tab:blue", "^", False),
    "act-phase": ("tab:blue", "^", True),
    "diffusion": ("tab:green", "D", False),
    "diffusion-phase": ("tab:green", "D", True),
    "nearest": ("0.4", "X", True),
}


def _look(policy: str) -> dict[str, Any]:
    colour, marker, filled = LOOKS.get(policy, ("tab:purple", "P", True))
    return {
        "color": colour,
        "marker": marker,
        "markerfacecolor": colour if filled else "white",
        "linestyle": "-" if filled else "--",
        "markersize": 6,
        "label": policy,
    }


def _policies(table: pd.DataFrame) -> list[str]:
    """Those of a table, in the order of the report."""
    names = set(table.policy)
    return [*(name for name in LOOKS if name in names), *sorted(names - set(LOOKS))]


def _spread(counts: Sequence[int], index: int, total: int) -> np.ndarray[Any, Any]:
    """Numbers of demonstrations, moved a little so that policies do not hide one another."""
    return np.asarray(counts) * 1.04 ** (index - (total - 1) / 2)


def _over_demonstrations(axes: Axes, table: pd.DataFrame) -> None:
    counts = sorted(set(table.demonstrations))
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(FixedLocator(counts))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xticklabels([str(count) for count in counts])
    axes.set_xlim(counts[0] / 1.3, counts[-1] * 1.3)
    axes.set_xlabel("demonstrations")
    axes.grid(alpha=0.3)


def draw_success(episodes: pd.DataFrame, path: Path) -> None:
    """Success rate with its 95 % interval over the number of demonstrations.

    All episodes are of one condition; those of several training seeds are pooled.
    """
    figure = Figure(figsize=(7.5, 4.2), layout="constrained")
    axes = figure.subplots()
    policies = _policies(episodes)
    for index, policy in enumerate(policies):
        groups = episodes[episodes.policy == policy].groupby("demonstrations").success
        rates = groups.mean()
        bounds = np.array([wilson(int(group.sum()), len(group)) for _, group in groups]).T
        spread = np.abs(bounds - rates.to_numpy())
        x = _spread(list(rates.index), index, len(policies))
        axes.errorbar(x, rates, yerr=spread, capsize=2, elinewidth=1, **_look(policy))
    _over_demonstrations(axes, episodes)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_ylim(-0.03, 1.03)
    axes.set_ylabel("success")
    figure.legend(loc="outside right center", fontsize="small")
    figure.savefig(path, dpi=120)


def draw_errors(
    episodes: pd.DataFrame,
    figures: Mapping[str, tuple[str, int]],
    criteria: Mapping[str, tuple[float, float]],
    path: Path,
) -> None:
    """Median and quartiles of each figure over the number of demonstrations.

    All episodes are of one condition; ``figures`` and ``criteria`` as in :class:`Benchmark`.
    """
    shown = [key for key in figures if key in episodes]
    figure = Figure(figsize=(3.2 * len(shown) + 1.5, 3.4), layout="constrained")
    policies = _policies(episodes)
    for axes, key in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown, strict=True):
        for index, policy in enumerate(policies):
            groups = episodes[episodes.policy == policy].groupby("demonstrations")[key]
            low, middle, high = (
                groups.quantile(share, interpolation="nearest") for share in (0.25, 0.5, 0.75)
            )
            x = _spread(list(middle.index), index, len(policies))
            spread = np.array((middle - low, high - middle))
            look = _look(policy) | {"markersize": 5}
            axes.errorbar(x, middle, yerr=spread, capsize=2, elinewidth=1, **look)
        for bound in criteria.get(key, ()):
            if 0 < bound < np.inf:
                axes.axhline(bound, color="0.3", linestyle=":", linewidth=1)
        _over_demonstrations(axes, episodes)
        axes.set_title(figures[key][0], fontsize="medium")
        positive = episodes[key][episodes[key] > 0]
        if len(positive) and positive.max() > 30 * positive.median():
            axes.set_yscale("log")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", fontsize="small")
    figure.savefig(path, dpi=120)


def draw_curves(trainings: Iterable[Mapping[str, Any]], path: Path) -> None:
    """Learning curves: losses over steps, and the error of the actions over time.

    Parameters
    ----------
    trainings : iterable of mapping
        ``policy``, ``demonstrations``, ``seed`` and ``curve``.
    """
    trainings = list(trainings)
    policies = list(dict.fromkeys(item["policy"] for item in trainings))
    counts = sorted({item["demonstrations"] for item in trainings})
    figure = Figure(figsize=(3.2 * len(policies) + 1.2, 5.6), layout="constrained")
    grid = figure.subplots(2, len(policies), squeeze=False, sharey="row")
    for item in trainings:
        column = policies.index(item["policy"])
        colour = f"C{counts.index(item['demonstrations'])}"
        curve = pd.DataFrame(item["curve"])
        upper, lower = grid[0, column], grid[1, column]
        upper.plot(curve.step, curve.train_loss, ":", color=colour)
        upper.plot(curve.step, curve.validation_loss, "-", color=colour)
        errors = 1e3 * curve.validation_error
        lower.plot(curve.seconds / 60, errors, color=colour)
        best = errors.idxmin()
        lower.plot(curve.seconds[best] / 60, errors[best], "o", color=colour, markersize=5)
    for column, policy in enumerate(policies):
        grid[0, column].set_title(policy, fontsize="medium")
        grid[0, column].set_xlabel("training steps")
        grid[1, column].set_xlabel("minutes of one processor")
        grid[0, column].set_yscale("log")
        grid[1, column].set_ylim(bottom=0)
        for axes in grid[:, column]:
            axes.grid(alpha=0.3)
    grid[0, 0].set_ylabel("loss (dotted: training,\nsolid: held-out episodes)")
    grid[1, 0].set_ylabel("error of the actions,\nheld-out episodes [mrad]")
    for index, count in enumerate(counts):
        grid[0, 0].plot([], [], color=f"C{index}", label=f"{count} demonstrations")
    figure.legend(loc="outside upper center", ncols=len(counts), fontsize="small")
    figure.savefig(path, dpi=120)
