"""Tables and a picture of results: groups of tasks, numbers of demonstrations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from lerobot_env_bimanual.metaworld.tasks import DIFFICULTIES, TASKS, TUNED, difficulty
from tpgmm_evaluation.report.figures import line_of, success_panels, write
from tpgmm_evaluation.report.pages import table
from tpgmm_evaluation.report.significance import REFERENCE, compare_over_tasks
from tpgmm_evaluation.report.tables import wilson
from tpgmm_tools.plotting import BLUE, GREEN, PURPLE, VERMILION

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
#: What the columns of a table are about.
COLUMN = ["policy", "demonstrations"]


def summary(episodes: pd.DataFrame) -> str:
    """Tabulate successes in per cent, with 95 % intervals of Wilson over episodes.

    Where there are several training seeds, the interval is followed by the figure of each that
    was tried in all these tasks, and where not all tasks of a group were tried, by how many
    were. An interval is that of more episodes of these tasks, not of other tasks.

    Parameters
    ----------
    episodes : DataFrame
        As :func:`~tpgmm_evaluation.report.tables.episode_table` makes it.
    """
    texts = {}
    for group, tasks in GROUPS.items():
        here = episodes[episodes.env.isin(tasks)]
        for place, part in here.groupby(COLUMN):
            texts[(f"{group} ({len(tasks)})", *place)] = _share(part, len(tasks))
    return _tabulate(["tasks"], texts)


def _share(episodes: pd.DataFrame, n_tasks: int) -> str:
    # each task counts alike, however many of its episodes there are
    by_task = episodes.groupby("env").success.mean()
    mean, n = float(by_task.mean()), len(episodes)
    low, high = wilson(round(mean * n), n)
    text = f"{100 * mean:.1f} ({100 * low:.0f} to {100 * high:.0f})"
    # figures of fewer tasks are no figures of the same
    seeds = episodes.groupby("training_seed").agg({"env": "nunique", "success": "mean"})
    whole = seeds.success[seeds.env == len(by_task)]
    if len(whole) > 1:
        text += " [" + ", ".join(f"{100 * share:.0f}" for share in whole) + "]"
    return text if len(by_task) == n_tasks else f"{text}, in {len(by_task)} of {n_tasks}"


def task_table(episodes: pd.DataFrame) -> str:
    """Tabulate successes task by task; ``episodes`` as for :func:`summary`."""
    texts = {}
    for task in TASKS:
        kind = f"{difficulty(task)}, {'tuned' if task in TUNED else 'held'}"
        for place, part in episodes[episodes.env == task].groupby(COLUMN):
            texts[(task, kind, *place)] = f"{part.success.sum()}/{len(part)}"
    return _tabulate(["task", ""], texts)


def _tabulate(head: Sequence[str], texts: Mapping[tuple[Any, ...], str]) -> str:
    """Tabulate texts by row, policy and number of demonstrations, with a column for these."""
    columns = sorted({key[-2:] for key in texts}, key=_order)
    rows = [
        [*row, *(texts.get((*row, *place), "") for place in columns)]
        for row in dict.fromkeys(key[:-2] for key in texts)
    ]
    return table([*head, *(f"{policy}, {n}" for policy, n in columns)], rows)


def _order(place: tuple[Any, ...]) -> tuple[Any, ...]:
    """Put TP-GMM first."""
    return (place[0] != REFERENCE, *place)


def cost_table(results: Iterable[Mapping[str, Any]]) -> str:
    """Tabulate costs of training and acting, and why trainings ended.

    Medians over the finished cells, ``results``, in seconds of the processor for a training and
    in milliseconds for an action.
    """
    cells = pd.DataFrame(
        {
            **result["cell"],
            "training": result["training_seconds"],
            "outcome": result["training_outcome"],
            "action": 1e3
            * sum(episode["acting_seconds"] for episode in result["episodes"])
            / sum(episode["steps"] for episode in result["episodes"]),
        }
        for result in results
    )
    rows = []
    for (policy, n), here in sorted(cells.groupby(COLUMN), key=lambda group: _order(group[0])):
        ends = here.outcome.value_counts(sort=True)
        reasons = "; ".join(f"{outcome}: {count}" for outcome, count in ends.items())
        medians = (f"{here[key].median():.3g}" for key in ("training", "action"))
        rows.append([f"{policy}, {n}", len(here), *medians, reasons])
    head = ["", "trainings", "training [s]", "action [ms]", "why trainings ended"]
    return table(head, rows)


def comparison_table(episodes: pd.DataFrame) -> str:
    """Compare TP-GMM with each other policy, over the tasks that both were tried in.

    Parameters
    ----------
    episodes : DataFrame
        As for :func:`summary`.
    """
    head = ["beside", "tasks", "TP-GMM", "other", "difference", "better", "worse", "p"]
    rows = []
    for row in compare_over_tasks(episodes).itertuples():
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


def panels(episodes: pd.DataFrame) -> pd.DataFrame:
    """Select the episodes of the picture: ``env`` is the group of tasks of their panel.

    A training seed of a policy is in a panel where it was tried in as many of its tasks as any
    other: shares of some tasks are no rivals of shares of all.

    Parameters
    ----------
    episodes : DataFrame
        As for :func:`summary`.
    """
    parts = []
    for group, tasks in GROUPS.items():
        part = episodes[episodes.env.isin(tasks)]
        tried = part.groupby([*COLUMN, "training_seed"]).env.transform("nunique")
        parts.append(part[tried == tried.max()].assign(env=group))
    return pd.concat(parts)


def draw_groups(episodes: pd.DataFrame, path: Path) -> None:
    """Draw success over the number of demonstrations, a panel for each group of tasks.

    Parameters
    ----------
    episodes : DataFrame
        As for :func:`summary`.
    path : Path
        Without suffix; ``.pdf`` and ``.webp`` are written.
    """
    write(success_panels(panels(episodes), LOOKS), path)
