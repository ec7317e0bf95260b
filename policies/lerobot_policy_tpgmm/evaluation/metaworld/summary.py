"""Tables of what was measured: groups of tasks, and numbers of demonstrations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from lerobot_policy_tpgmm.environments.metaworld.tasks import (
    DIFFICULTIES,
    TASKS,
    TUNED,
    difficulty,
)
from lerobot_policy_tpgmm.evaluation.report.tables import wilson

__all__ = ["GROUPS", "cost_table", "summary", "task_table"]

#: Rows of the summary, and the tasks that they are about.
GROUPS: dict[str, tuple[str, ...]] = {
    "all": TASKS,
    **DIFFICULTIES,
    "tuned half": TUNED,
    "held half": tuple(sorted({*TASKS} - {*TUNED})),
}
Result = Mapping[str, Any]


def summary(results: Iterable[Result]) -> str:
    """Successes in per cent, with 95 % intervals of Wilson over episodes, as Markdown.

    Where there are several training seeds, the interval is followed by each seed's figure.
    An interval is that of more episodes of these tasks, not of other tasks.

    Parameters
    ----------
    results : iterable of mapping
        Finished cells, as :class:`~lerobot_policy_tpgmm.evaluation.cells.Results` reads them.
    """
    results = list(results)
    columns = _columns(results)
    lines = [_line(["tasks", *(f"{policy}, {n}" for policy, n in columns)])]
    lines.append(_line(["---"] * (1 + len(columns))))
    for group, tasks in GROUPS.items():
        cells = [
            _entry([r for r in results if _place(r) == place and r["cell"]["env"] in tasks])
            for place in columns
        ]
        if any(cells):
            lines.append(_line([f"{group} ({len(tasks)})", *cells]))
    return "\n".join(lines) + "\n"


def task_table(results: Iterable[Result]) -> str:
    """Successes of episodes in finished cells, ``results``, task by task, as Markdown."""
    results = list(results)
    columns = _columns(results)
    lines = [_line(["task", "", *(f"{policy}, {n}" for policy, n in columns)])]
    lines.append(_line(["---"] * (2 + len(columns))))
    for task in TASKS:
        here = [r for r in results if r["cell"]["env"] == task]
        if not here:
            continue
        entries = [_counts([r for r in here if _place(r) == place]) for place in columns]
        half = "tuned" if task in TUNED else "held"
        lines.append(_line([task, f"{difficulty(task)}, {half}", *entries]))
    return "\n".join(lines) + "\n"


def cost_table(results: Iterable[Result]) -> str:
    """What training and acting take, and why trainings ended, as Markdown.

    Medians over the finished cells, ``results``, in seconds of the processor for a training and
    in milliseconds for an action.
    """
    results = list(results)
    lines = [_line(["", "trainings", "training [s]", "action [ms]", "why trainings ended"])]
    lines.append(_line(["---"] * 5))
    for policy, n in _columns(results):
        here = [r for r in results if _place(r) == (policy, n)]
        ends = Counter(result["training_outcome"] for result in here)
        lines.append(
            _line(
                [
                    f"{policy}, {n}",
                    str(len(here)),
                    f"{np.median([result['training_seconds'] for result in here]):.3g}",
                    f"{1e3 * np.median([_action_seconds(result) for result in here]):.3g}",
                    "; ".join(f"{outcome}: {count}" for outcome, count in ends.most_common()),
                ]
            )
        )
    return "\n".join(lines) + "\n"


def _action_seconds(result: Result) -> float:
    episodes = result["episodes"]
    acting = sum(episode["acting_seconds"] for episode in episodes)
    return float(acting / sum(episode["steps"] for episode in episodes))


def _place(result: Result) -> tuple[str, int]:
    return result["cell"]["policy"], result["cell"]["demonstrations"]


def _columns(results: Sequence[Result]) -> list[tuple[str, int]]:
    return sorted({_place(result) for result in results}, key=lambda p: (p[0] != "tpgmm", *p))


def _episodes(results: Sequence[Result]) -> list[bool]:
    return [episode["success"] for result in results for episode in result["episodes"]]


def _entry(results: Sequence[Result]) -> str:
    successes = _episodes(results)
    if not successes:
        return ""
    low, high = wilson(sum(successes), len(successes))
    # each task counts alike, however many of its episodes there are
    by_task: dict[str, list[bool]] = {}
    for result in results:
        by_task.setdefault(result["cell"]["env"], []).extend(_episodes([result]))
    mean = np.mean([np.mean(values) for values in by_task.values()])
    text = f"{100 * mean:.1f} ({100 * low:.0f} to {100 * high:.0f})"
    seeds = sorted({result["cell"]["seed"] for result in results})
    if len(seeds) > 1:
        of_seed = [_episodes([r for r in results if r["cell"]["seed"] == s]) for s in seeds]
        text += " [" + ", ".join(f"{100 * np.mean(values):.0f}" for values in of_seed) + "]"
    return text


def _counts(results: Sequence[Result]) -> str:
    successes = _episodes(results)
    return f"{sum(successes)}/{len(successes)}" if successes else ""


def _line(entries: Iterable[str]) -> str:
    return "| " + " | ".join(entries) + " |"
