"""Pictures of a comparison."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator, PercentFormatter

from tpgmm_evaluation.jobs import POLICIES
from tpgmm_evaluation.report.significance import REFERENCE
from tpgmm_evaluation.report.tables import wilson
from tpgmm_tools.plotting import BLUE, GREEN, ORANGE, PURPLE, SKY, STYLE, VERMILION, save

#: What is written of each figure: vectors for print, and something small for pages.
FORMATS = (".pdf", ".webp")
#: Panels side by side.
COLUMNS = 4
#: Colours of the families of policies: Okabe and Ito's; others are black.
COLOURS = {
    "tpgmm": VERMILION,
    "key": BLUE,
    "act": GREEN,
    "diffusion": PURPLE,
    "nearest": SKY,
    "mean": ORANGE,
}
#: Markers and lines differ too, for readers without colours.
MARKERS = "s^DvPX<>ph*d"
LINES = ("--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1, 1, 1)))
#: Share above which the colours of a heat map are bright.
BRIGHT = 0.6


def _look(policy: str) -> dict[str, Any]:
    """Choose colour by family, marker and line by policy; the same in all figures."""
    if policy == REFERENCE:
        return line_of(policy, VERMILION, "o") | {"linewidth": 2.0, "zorder": 4}
    names = [name for name in POLICIES if name != REFERENCE]
    index = names.index(policy) if policy in names else len(names) + len(policy)
    family = policy.split()[0].partition("-")[0]
    marker, line = MARKERS[index % len(MARKERS)], LINES[index % len(LINES)]
    look = line_of(policy, COLOURS.get(family, "0.1"), marker, line)
    return look if policy in (family, "key-poses") else look | {"markerfacecolor": "white"}


def _looks(table: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """Return the looks of a table's policies, in the order of the registry."""
    names = set(table.policy)
    known = [name for name in POLICIES if name in names]
    return {name: _look(name) for name in (*known, *sorted(names - set(known)))}


def draw_success(episodes: pd.DataFrame, path: Path) -> None:
    """Draw success over the number of demonstrations: a panel for each environment.

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
    """Draw success under disturbances: a heat map for each policy.

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
    figure = Figure(figsize=size, layout="constrained")
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


def line_of(label: str, colour: str, marker: str, line: Any = "-") -> dict[str, Any]:
    """Return the style of all lines of a policy."""
    return {
        "color": colour,
        "marker": marker,
        "markersize": 4.5,
        "linestyle": line,
        "linewidth": 1.2,
        "label": label,
    }


@rc_context(STYLE)
def success_panels(episodes: pd.DataFrame, looks: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Draw success over the number of demonstrations in panels, one an environment.

    Lines join the shares of all episodes with their 95 % intervals (Wilson), small dots are the
    shares of each training seed, where there are several.

    Parameters
    ----------
    episodes : DataFrame
        Of one condition, as of
        :func:`~tpgmm_evaluation.report.tables.episode_table`.
    looks : mapping of str to mapping
        The policies in their order, each with what :func:`line_of` gives.

    Returns
    -------
    Figure
    """
    tasks = list(dict.fromkeys(episodes.env))
    columns = min(COLUMNS, len(tasks))
    rows = math.ceil(len(tasks) / columns)
    size = (max(4.2, 1.9 * columns + 0.6), 2.1 * rows + 0.8)
    figure = Figure(figsize=size, layout="constrained")
    grid = list(figure.subplots(rows, columns, squeeze=False, sharey=True).flat)
    for axes in grid[len(tasks) :]:
        axes.remove()
    grid = grid[: len(tasks)]
    shown: dict[str, Any] = {}
    for axes, task in zip(grid, tasks, strict=True):
        part = episodes[episodes.env == task]
        for index, (policy, look) in enumerate(looks.items()):
            chosen = part[part.policy == policy]
            if len(chosen):
                # a little aside, so that policies do not hide others
                aside = (1 + min(0.04, 0.3 / len(looks))) ** (index - (len(looks) - 1) / 2)
                shown[look["label"]] = _success_line(axes, chosen, aside, look)
        counts = sorted(set(part.demonstrations))
        axes.set(xscale="log", xlabel="demonstrations", ylim=(-0.05, 1.05))
        axes.set_xticks(counts, map(str, counts))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_xlim(counts[0] / 1.3, counts[-1] * 1.3)
        axes.grid(alpha=0.3)
        axes.set_title(task, fontsize="medium")
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    for axes in grid[::COLUMNS]:
        axes.set_ylabel("success")
    order = [look["label"] for look in looks.values() if look["label"] in shown]
    figure.legend([shown[label] for label in order], order, loc="outside lower center", ncols=4)
    return figure


def _success_line(
    axes: Axes, episodes: pd.DataFrame, aside: float, look: Mapping[str, Any]
) -> Any:
    """Draw the line of a policy in a panel, and the dots of its seeds; return the line."""
    groups = episodes.groupby("demonstrations").success
    rates = groups.mean()
    bounds = np.array([wilson(int(group.sum()), len(group)) for _, group in groups]).T
    gaps = np.abs(bounds - rates.to_numpy())
    line = axes.errorbar(
        rates.index * aside, rates, yerr=gaps, capsize=1.5, elinewidth=0.8, **look
    )
    seeds = episodes.groupby(["demonstrations", "training_seed"]).success.mean()
    if len(seeds) > len(rates):
        at = seeds.index.get_level_values("demonstrations") * aside
        axes.plot(at, seeds, ".", color=look["color"], markersize=3, alpha=0.6)
    return line


def write(figure: Figure, path: Path) -> None:
    """Write a figure in all formats; ``path`` has no suffix."""
    for suffix in FORMATS:
        save(figure, path.with_name(path.name + suffix))
