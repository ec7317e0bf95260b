"""Pictures of a comparison."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import rc_context
from matplotlib.figure import Figure as Sheet
from matplotlib.ticker import PercentFormatter

from lerobot_env_bimanual.bottle.measures import Figure
from tpgmm_evaluation.jobs import POLICIES
from tpgmm_evaluation.report.panels import (
    add_legend,
    line_of,
    over_demonstrations,
    panels_for,
    spread,
    success_panels,
    write,
)
from tpgmm_evaluation.report.significance import REFERENCE
from tpgmm_tools.plotting import BLUE, GREEN, ORANGE, PURPLE, SKY, STYLE, VERMILION

__all__ = ["draw_conditions", "draw_curves", "draw_errors", "draw_success"]

#: Colours of the families of policies beside TP-GMM: Okabe and Ito's, black and grey.
COLOURS = (BLUE, GREEN, PURPLE, SKY, ORANGE, "0.1", "0.55")
#: Markers and lines differ too, for readers without colours.
MARKERS = "s^DvPX<>ph*d"
LINES = ("--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1, 1, 1)))
#: Share above which the colours of a heat map are bright.
BRIGHT = 0.6


def _family(policy: str) -> str:
    """What a policy is a variant of: the shortest name that its own begins with."""
    first = policy.split()[0]
    names = (name for name in POLICIES if first == name or first.startswith(f"{name}-"))
    return min(names, key=len, default=first)


@cache
def _look(policy: str) -> dict[str, Any]:
    """Colour by family, marker and line by policy; the same in all figures."""
    family = _family(policy)
    if policy == REFERENCE:
        return line_of(policy, VERMILION, "o") | {"linewidth": 2.0, "zorder": 4}
    names = [name for name in POLICIES if name != REFERENCE]
    index = names.index(policy) if policy in names else len(names) + len(policy)
    families = list(dict.fromkeys(map(_family, POLICIES)))
    if family == _family(REFERENCE):
        colour = VERMILION
    else:
        families.remove(_family(REFERENCE))
        at = families.index(family) if family in families else len(families)
        colour = COLOURS[at % len(COLOURS)]
    line = LINES[index % len(LINES)]
    look = line_of(policy, colour, MARKERS[index % len(MARKERS)], line)
    return look if policy == family else look | {"markerfacecolor": "white"}


def _looks(table: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """Those of a table's policies, in the order of the registry."""
    names = set(table.policy)
    known = [name for name in POLICIES if name in names]
    return {name: _look(name) for name in (*known, *sorted(names - set(known)))}


def draw_success(episodes: pd.DataFrame, path: Path) -> None:
    """Success over the number of demonstrations: a panel for each environment.

    Parameters
    ----------
    episodes : DataFrame
        Of one condition.
    path : Path
        Without suffix; ``.pdf`` and ``.webp`` are written.
    """
    write(success_panels(episodes, _looks(episodes)), path)


@rc_context(STYLE)
def draw_conditions(rates: Mapping[str, pd.DataFrame], path: Path) -> None:
    """Success under disturbances: a heat map for each policy.

    Parameters
    ----------
    rates : mapping of str to DataFrame
        For each policy the shares, environments down and conditions across; NaN where
        nothing was tried. All have the same conditions.
    path : Path
        Without suffix; ``.pdf`` and ``.webp`` are written.
    """
    heights = [len(table) for table in rates.values()]
    conditions = list(next(iter(rates.values())).columns)
    size = (max(4.0, 0.36 * len(conditions) + 2.2), 0.3 * sum(heights) + 0.4 * len(rates) + 1.2)
    figure = Sheet(figsize=size, layout="constrained")
    panels = figure.subplots(
        len(rates), 1, squeeze=False, sharex=True, height_ratios=[h + 0.5 for h in heights]
    )[:, 0]
    for axes, (policy, table) in zip(panels, rates.items(), strict=True):
        image = axes.imshow(table, vmin=0, vmax=1, cmap="cividis", aspect="auto")
        for (row, column), value in np.ndenumerate(table.to_numpy()):
            if np.isfinite(value):
                colour = "black" if value > BRIGHT else "white"
                text = f"{100 * value:.0f}"
                style = {"ha": "center", "va": "center", "fontsize": "x-small"}
                axes.text(column, row, text, color=colour, **style)
        axes.set_yticks(range(len(table)), list(table.index))
        axes.set_title(policy, fontsize="medium", loc="left")
    panels[-1].set_xticks(range(len(conditions)), conditions, rotation=60, ha="right")
    bar = figure.colorbar(image, ax=list(panels), format=PercentFormatter(1.0), pad=0.01)
    bar.set_label("success")
    write(figure, path)


@rc_context(STYLE)
def draw_errors(
    episodes: pd.DataFrame,
    figures: Mapping[str, Figure],
    path: Path,
) -> None:
    """Median and quartiles of each figure over the number of demonstrations.

    All episodes are of one condition; ``path`` has no suffix.
    """
    shown = [key for key in figures if key in episodes]
    figure, grid = panels_for(len(shown))
    looks = _looks(episodes)
    for axes, key in zip(grid, shown, strict=True):
        for index, (policy, look) in enumerate(looks.items()):
            groups = episodes[episodes.policy == policy].groupby("demonstrations")[key]
            low, middle, high = (
                groups.quantile(share, interpolation="nearest") for share in (0.25, 0.5, 0.75)
            )
            x = spread(list(middle.index), index, len(looks))
            # no bar where a quartile is infinite
            gaps = np.array((middle - low, high - middle))
            axes.errorbar(x, middle, yerr=gaps, capsize=1.5, elinewidth=0.8, **look)
        for bound in figures[key][2:]:
            if 0 < bound < np.inf:
                axes.axhline(bound, color="0.3", linestyle=":", linewidth=1)
        over_demonstrations(axes, episodes)
        axes.set_title(figures[key].heading, fontsize="medium")
        positive = episodes[key][episodes[key] > 0]
        if len(positive) and positive.max() > 30 * positive.median():
            axes.set_yscale("log")
    add_legend(figure, grid, looks)
    write(figure, path)


@rc_context(STYLE)
def draw_curves(trainings: Iterable[Mapping[str, Any]], path: Path) -> None:
    """Learning curves: losses over steps, and the error of the actions over time.

    Parameters
    ----------
    trainings : iterable of mapping
        ``policy``, ``demonstrations``, ``seed`` and ``curve``.
    path : Path
        Without suffix.
    """
    trainings = list(trainings)
    policies = list(dict.fromkeys(item["policy"] for item in trainings))
    counts = sorted({item["demonstrations"] for item in trainings})
    figure = Sheet(figsize=(2.2 * len(policies) + 1.2, 4.4), layout="constrained")
    grid = figure.subplots(2, len(policies), squeeze=False, sharey="row")
    for item in trainings:
        column = policies.index(item["policy"])
        colour = COLOURS[counts.index(item["demonstrations"]) % len(COLOURS)]
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
        colour = COLOURS[index % len(COLOURS)]
        grid[0, 0].plot([], [], color=colour, label=f"{count} demonstrations")
    figure.legend(loc="outside upper center", ncols=len(counts))
    write(figure, path)
