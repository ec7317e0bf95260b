"""Pictures of a comparison."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, PercentFormatter

from lerobot_policy_tpgmm.evaluation.jobs import POLICIES
from lerobot_policy_tpgmm.evaluation.report.significance import REFERENCE
from lerobot_policy_tpgmm.evaluation.report.tables import wilson
from tpgmm_torch.plotting import BLUE, GREEN, ORANGE, PURPLE, SKY, STYLE, VERMILION, save

__all__ = ["draw_conditions", "draw_curves", "draw_errors", "draw_success"]

#: What is written of each figure: vectors for print, and something small for pages.
FORMATS = (".pdf", ".webp")
#: Colours of the families of policies beside TP-GMM: Okabe and Ito's, black and grey.
COLOURS = (BLUE, GREEN, PURPLE, SKY, ORANGE, "0.1", "0.55")
#: Markers and lines differ too, for readers without colours.
MARKERS = "s^DvPX<>ph*d"
LINES = ("--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1, 1, 1)))
#: Panels side by side.
COLUMNS = 4
#: Width of an entry of the legend [inch].
ENTRY = 1.9
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
        return _line(policy, VERMILION, "o", "-") | {"linewidth": 2.0, "zorder": 4}
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
    look = _line(policy, colour, MARKERS[index % len(MARKERS)], line)
    return look if policy == family else look | {"markerfacecolor": "white"}


def _line(label: str, colour: str, marker: str, line: Any) -> dict[str, Any]:
    return {
        "color": colour,
        "marker": marker,
        "markersize": 4.5,
        "linestyle": line,
        "linewidth": 1.2,
        "label": label,
    }


def _policies(table: pd.DataFrame) -> list[str]:
    """Those of a table, in the order of the registry."""
    names = set(table.policy)
    known = [name for name in POLICIES if name in names]
    return [*known, *sorted(names - set(known))]


def _save(figure: Figure, path: Path) -> None:
    for suffix in FORMATS:
        save(figure, path.with_name(path.name + suffix))


def _legend(figure: Figure, panels: Iterable[Axes]) -> None:
    """Each policy once, below the panels, in the order of the registry."""
    shown: dict[str, Any] = {}
    for axes in panels:
        handles, labels = axes.get_legend_handles_labels()
        shown |= dict(zip(labels, handles, strict=True))
    order = _policies(pd.DataFrame({"policy": list(shown)}))
    figure.legend([shown[label] for label in order], order, loc="outside lower center", ncols=4)


def _spread(counts: Sequence[int], index: int, total: int) -> np.ndarray[Any, Any]:
    """Numbers of demonstrations, moved a little so that policies do not hide one another."""
    width = min(0.04, 0.3 / total)
    return np.asarray(counts) * (1 + width) ** (index - (total - 1) / 2)


def _over_demonstrations(axes: Axes, table: pd.DataFrame) -> None:
    counts = sorted(set(table.demonstrations))
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(FixedLocator(counts))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xticklabels([str(count) for count in counts])
    axes.set_xlim(counts[0] / 1.3, counts[-1] * 1.3)
    axes.set_xlabel("demonstrations")
    axes.grid(alpha=0.3)


@rc_context(STYLE)
def draw_success(episodes: pd.DataFrame, path: Path) -> None:
    """Success over the number of demonstrations: a panel for each environment.

    Lines join the shares of all episodes with their 95 % intervals (Wilson), small dots are the
    shares of each training seed, where there are several.

    Parameters
    ----------
    episodes : DataFrame
        Of one condition.
    path : Path
        Without suffix; ``.pdf`` and ``.webp`` are written.
    """
    tasks = list(dict.fromkeys(episodes.env))
    columns = min(COLUMNS, len(tasks))
    rows = math.ceil(len(tasks) / columns)
    size = (max(4.2, 1.9 * columns + 0.6), 2.1 * rows + 0.8)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
    policies = _policies(episodes)
    for axes, task in zip(grid, tasks, strict=False):
        part = episodes[episodes.env == task]
        for index, policy in enumerate(policies):
            chosen = part[part.policy == policy]
            if len(chosen):
                _success_line(axes, chosen, policy, index, len(policies))
        _over_demonstrations(axes, part)
        axes.set_title(task, fontsize="medium")
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        axes.set_ylim(-0.05, 1.05)
    for axes in grid[len(tasks) :]:
        axes.remove()
    for axes in grid[::columns]:
        axes.set_ylabel("success")
    _legend(figure, grid[: len(tasks)])
    _save(figure, path)


def _success_line(
    axes: Axes, episodes: pd.DataFrame, policy: str, index: int, total: int
) -> None:
    groups = episodes.groupby("demonstrations").success
    rates = groups.mean()
    bounds = np.array([wilson(int(group.sum()), len(group)) for _, group in groups]).T
    look, x = _look(policy), _spread(list(rates.index), index, total)
    gaps = np.abs(bounds - rates.to_numpy())
    axes.errorbar(x, rates, yerr=gaps, capsize=1.5, elinewidth=0.8, **look)
    places = dict(zip(rates.index, x, strict=True))
    seeds = episodes.groupby(["demonstrations", "training_seed"]).success.mean()
    if len(seeds) > len(rates):
        at = [places[count] for count, _ in seeds.index]
        axes.plot(at, seeds, ".", color=look["color"], markersize=3, alpha=0.6)


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
    _save(figure, path)


@rc_context(STYLE)
def draw_errors(
    episodes: pd.DataFrame,
    figures: Mapping[str, tuple[str, int]],
    criteria: Mapping[str, tuple[float, float]],
    path: Path,
) -> None:
    """Median and quartiles of each figure over the number of demonstrations.

    All episodes are of one condition; ``figures`` and ``criteria`` as in :class:`Benchmark`.
    ``path`` has no suffix.
    """
    shown = [key for key in figures if key in episodes]
    columns = min(COLUMNS, len(shown))
    rows = math.ceil(len(shown) / columns)
    figure = Figure(figsize=(1.9 * columns + 0.6, 2.1 * rows + 0.8), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    policies = _policies(episodes)
    for axes, key in zip(grid, shown, strict=False):
        for index, policy in enumerate(policies):
            groups = episodes[episodes.policy == policy].groupby("demonstrations")[key]
            low, middle, high = (
                groups.quantile(share, interpolation="nearest") for share in (0.25, 0.5, 0.75)
            )
            x = _spread(list(middle.index), index, len(policies))
            # no bar where a quartile is infinite
            gaps = np.array((middle - low, high - middle))
            axes.errorbar(x, middle, yerr=gaps, capsize=1.5, elinewidth=0.8, **_look(policy))
        for bound in criteria.get(key, ()):
            if 0 < bound < np.inf:
                axes.axhline(bound, color="0.3", linestyle=":", linewidth=1)
        _over_demonstrations(axes, episodes)
        axes.set_title(figures[key][0], fontsize="medium")
        positive = episodes[key][episodes[key] > 0]
        if len(positive) and positive.max() > 30 * positive.median():
            axes.set_yscale("log")
    for axes in grid[len(shown) :]:
        axes.remove()
    _legend(figure, grid[: len(shown)])
    _save(figure, path)


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
    figure = Figure(figsize=(2.2 * len(policies) + 1.2, 4.4), layout="constrained")
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
    _save(figure, path)
