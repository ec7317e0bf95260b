"""Tables and a picture of results: groups of tasks, numbers of demonstrations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lerobot_env_bimanual.metaworld.tasks import DIFFICULTIES, TASKS, TUNED, difficulty
from tpgmm_evaluation.report.figures import line_of, success_panels, write
from tpgmm_evaluation.report.pages import table
from tpgmm_evaluation.report.significance import REFERENCE, over_tasks
from tpgmm_evaluation.report.tables import wilson
from tpgmm_tools.plotting import BLUE, GREEN, PURPLE, VERMILION

__all__ = [
    "GROUPS", "LOOKS", "comparison_table", "cost_table", "draw_groups", "summary", "task_table",
]  # fmt: skip

#: Rows of the summary, and the tasks that they are about.
GROUPS: dict[str, tuple[str, ...]] = {
    "all": TASKS,
    **DIFFICULTIES,
    "tuned half": TUNED,
    "held half": tuple(sorted({*TASKS} - {*TUNED})),
}
#: The learners in their order, and what their lines look like.
LOOKS = {
    REFERENCE: line_of("TP-GMM", VERMILION, "o"),
    "perceptron": line_of("perceptron", PURPLE, "s", "--"),
    "act": line_of("ACT", BLUE, "^", "-."),
    "diffusion": line_of("Diffusion Policy", GREEN, "D", ":"),
}
#: So many tasks are named in which TP-GMM loses most.
NAMED = 6
Result = Mapping[str, Any]


def summary(results: Iterable[Result]) -> str:
    """Successes in per cent, with 95 % intervals of Wilson over episodes, as Markdown.

    Where there are several training seeds, the interval is followed by the figure of each that
    was tried in all these tasks, and where not all tasks of a group were tried, by how many
    were. An interval is that of more episodes of these tasks, not of other tasks.

    Parameters
    ----------
    results : iterable of mapping
        Finished cells, as :class:`~tpgmm_evaluation.cells.Results` reads them.
    """
    results = list(results)
    columns, rows = _columns(results), []
    for group, tasks in GROUPS.items():
        here = [result for result in results if result["cell"]["env"] in tasks]
        cells = [
            _entry([result for result in here if _place(result) == place], len(tasks))
            for place in columns
        ]
        if any(cells):
            rows.append([f"{group} ({len(tasks)})", *cells])
    return table(["tasks", *(f"{policy}, {n}" for policy, n in columns)], rows)


def task_table(results: Iterable[Result]) -> str:
    """Successes of episodes in finished cells, ``results``, task by task, as Markdown."""
    results = list(results)
    columns, rows = _columns(results), []
    for task in TASKS:
        here = [r for r in results if r["cell"]["env"] == task]
        if here:
            entries = [_counts([r for r in here if _place(r) == place]) for place in columns]
            half = "tuned" if task in TUNED else "held"
            rows.append([task, f"{difficulty(task)}, {half}", *entries])
    return table(["task", "", *(f"{policy}, {n}" for policy, n in columns)], rows)


def cost_table(results: Iterable[Result]) -> str:
    """Costs of training and acting, and why trainings ended, as Markdown.

    Medians over the finished cells, ``results``, in seconds of the processor for a training and
    in milliseconds for an action.
    """
    results = list(results)
    rows: list[list[object]] = []
    for policy, n in _columns(results):
        here = [r for r in results if _place(r) == (policy, n)]
        training = np.median([result["training_seconds"] for result in here])
        action = np.median([_action_seconds(result) for result in here])
        ends = Counter(result["training_outcome"] for result in here)
        reasons = "; ".join(f"{outcome}: {count}" for outcome, count in ends.most_common())
        rows.append(
            [f"{policy}, {n}", len(here), f"{training:.3g}", f"{1e3 * action:.3g}", reasons]
        )
    head = ["", "trainings", "training [s]", "action [ms]", "why trainings ended"]
    return table(head, rows)


def comparison_table(episodes: pd.DataFrame) -> str:
    """TP-GMM beside each other policy, over the tasks that both were tried in, as Markdown.

    Parameters
    ----------
    episodes : DataFrame
        As :func:`~tpgmm_evaluation.report.tables.episode_table` makes it.
    """
    head = ["beside", "tasks", "TP-GMM", "other", "difference", "better", "worse", "p"]
    rows = []
    for row in over_tasks(episodes).itertuples():
        lost = row.differences[row.differences < 0].sort_values()
        rows.append(
            [
                f"{row.policy}, {row.demonstrations}",
                len(row.differences),
                f"{100 * row.success:.1f}",
                f"{100 * row.other_success:.1f}",
                f"{100 * row.difference:.1f} ({100 * row.low:.0f} to {100 * row.high:.0f})",
                int((row.differences > 0).sum()),
                len(lost),
                f"{row.p:.2g}",
                ", ".join(f"{task} {100 * by:.0f}" for task, by in lost.head(NAMED).items()),
            ]
        )
    return table([*head, "loses most"], rows) if rows else ""


def draw_groups(episodes: pd.DataFrame, path: Path) -> None:
    """Success over the number of demonstrations, a panel for each group of tasks.

    A training seed of a policy is in a panel where it was tried in as many of its tasks as any
    other: shares of some tasks are no rivals of shares of all.

    Parameters
    ----------
    episodes : DataFrame
        As of :func:`comparison_table`.
    path : Path
        Without suffix; ``.pdf`` and ``.webp`` are written.
    """
    panels, place = [], ["policy", "demonstrations", "training_seed"]
    for group, tasks in GROUPS.items():
        part = episodes[episodes.env.isin(tasks)]
        tried = part.groupby(place).env.transform("nunique")
        panels.append(part[tried == tried.max()].assign(env=group))
    write(success_panels(pd.concat(panels), LOOKS), path)


def _action_seconds(result: Result) -> float:
    episodes = result["episodes"]
    acting = sum(episode["acting_seconds"] for episode in episodes)
    return float(acting / sum(episode["steps"] for episode in episodes))


def _place(result: Result) -> tuple[str, int]:
    return result["cell"]["policy"], result["cell"]["demonstrations"]


def _columns(results: Sequence[Result]) -> list[tuple[str, int]]:
    return sorted({_place(result) for result in results}, key=lambda p: (p[0] != REFERENCE, *p))


def _episodes(results: Sequence[Result]) -> list[bool]:
    return [episode["success"] for result in results for episode in result["episodes"]]


def _entry(results: Sequence[Result], tasks: int) -> str:
    successes = _episodes(results)
    if not successes:
        return ""
    # each task counts alike, however many of its episodes there are
    by_task, of_seed = (_grouped(results, key) for key in ("env", "seed"))
    mean = float(np.mean([np.mean(_episodes(here)) for here in by_task.values()]))
    low, high = wilson(round(mean * len(successes)), len(successes))
    text = f"{100 * mean:.1f} ({100 * low:.0f} to {100 * high:.0f})"
    # figures of fewer tasks are no figures of the same
    whole = [of_seed[seed] for seed in sorted(of_seed) if len(of_seed[seed]) == len(by_task)]
    if len(whole) > 1:
        shares = [100 * np.mean(_episodes(one)) for one in whole]
        text += " [" + ", ".join(f"{share:.0f}" for share in shares) + "]"
    return text if len(by_task) == tasks else f"{text}, in {len(by_task)} of {tasks}"


def _grouped(results: Sequence[Result], key: str) -> dict[Any, list[Result]]:
    """By what their cells have at a key."""
    groups: dict[Any, list[Result]] = {}
    for result in results:
        groups.setdefault(result["cell"][key], []).append(result)
    return groups


def _counts(results: Sequence[Result]) -> str:
    successes = _episodes(results)
    return f"{sum(successes)}/{len(successes)}" if successes else ""
