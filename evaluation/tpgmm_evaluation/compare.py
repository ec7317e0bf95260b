"""The comparison from end to end: what ``tpgmm compare`` runs."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from lerobot_env_bimanual.disturbances import NOMINAL
from tpgmm_evaluation.baselines import RECIPES
from tpgmm_evaluation.benchmarks import BENCHMARKS
from tpgmm_evaluation.cells import Cell, Results
from tpgmm_evaluation.jobs import POLICIES, record, run
from tpgmm_evaluation.processes import run_jobs
from tpgmm_evaluation.report.summary import Task, write_summary
from tpgmm_evaluation.settings import Settings
from tpgmm_evaluation.variants import NAMED, Variant
from tpgmm_torch.exceptions import DataError, UnknownNameError

__all__ = ["ALL_CONDITIONS", "Comparison", "compare", "rewrite_report"]

#: Stands for every condition that an environment has.
ALL_CONDITIONS = "all"


@dataclass(frozen=True)
class Comparison:
    """Result of a comparison.

    Parameters
    ----------
    finished : int
        Cells of the grid that have a result.
    failures : dict
        The others, with the reason.
    """

    finished: int
    failures: dict[Cell, str]


def compare(
    settings: Settings | Sequence[Settings],
    out: Path,
    policies: Sequence[str] = POLICIES,
    demonstrations: Sequence[int] = (5, 10),
    seeds: Sequence[int] = (0,),
    conditions: Sequence[str] = (NOMINAL,),
    workers: int = 1,
    say: Callable[[str], None] = print,
    command: str = "",
) -> Comparison:
    """Train policies on the same episodes, evaluate them on the same seeds, write a report.

    Cells that are finished are not run again; the report shows all that stand in the folder.

    Parameters
    ----------
    settings : Settings or sequence of Settings
        Of each environment.
    out : Path
        The folder: ``report.md`` with tables and figures, and for each environment a folder of
        its name with ``episodes/`` (two LeRobot data sets for each seed), ``policies/``
        (pretrained directories) and ``cells/`` (one JSON file each).
    policies : sequence of str
        Names, or ``"tpgmm --policy.FIELD=VALUE ..."``: trained as ``"tpgmm"`` and used with
        other settings.
    demonstrations : sequence of int
        Numbers of demonstrations.
    seeds : sequence of int
        Of the training and, unless the settings say otherwise, of the demonstrations.
    conditions : sequence of str
        ``"nominal"``, or disturbances of the environment joined by ``+``; ``"all"`` stands for
        those that an environment has. An environment is tried in those that it knows.
    workers : int, default=1
        Processes, of one thread each.
    say : callable
        Takes a line of progress.
    command : str
        For the report.

    Raises
    ------
    UnknownNameError
        If a policy does not exist, or a condition in none of the environments.
    DataError
        If the folder holds results of other settings.
    """
    tasks = (settings,) if isinstance(settings, Settings) else tuple(settings)
    grids = _grids(tasks, policies, demonstrations, seeds, conditions, say)
    for task in tasks:
        task.keep(out / task.env / "settings.json")
    left = [
        [cell for cell in cells if not _finished(Results(out / task.env / "cells"), cell, say)]
        for task, cells in zip(tasks, grids, strict=True)
    ]
    total = sum(map(len, grids))
    say(f"{total} cells, {total - sum(map(len, left))} of them finished before")
    groups = []
    for task, cells, pending in zip(tasks, grids, left, strict=True):
        for seed in sorted({cell.seed for cell in pending}):
            say(f"{task.env}: episodes of seed {task.drawn(seed)} ...")
            record(out / task.env, task, max(cell.demonstrations for cell in cells), seed)
        pending.sort(key=lambda cell: cell.training)  # stable
        groups += [
            (out / task.env, task, list(same))
            for _, same in groupby(pending, key=lambda cell: cell.training)
        ]
    failures = _run(groups, workers, say)
    path = _report(out, failures, command, say)
    say(f"report and tables: {path}")
    return Comparison(total - len(failures), failures)


def rewrite_report(out: Path, say: Callable[[str], None] = print) -> Path:
    """Write the report of a folder again, from the cells that are in it.

    Parameters
    ----------
    out : Path
        As for :func:`compare`.
    say : callable
        Told of damaged files, which are left out.

    Returns
    -------
    Path
        The report.

    Raises
    ------
    DataError
        If no comparison is there.
    """
    if not _kept(out):
        raise DataError(
            f"{out} holds no comparison: there is no ENVIRONMENT/settings.json in it. Give the "
            "folder that `tpgmm compare --out` wrote"
        )
    return _report(out, {}, "", say)


def _kept(out: Path) -> list[Path]:
    """The settings of all environments in a folder, in the order of the registry."""
    names = [*BENCHMARKS, *sorted(path.name for path in out.glob("*") if path.is_dir())]
    paths = [out / name / "settings.json" for name in dict.fromkeys(names)]
    return [path for path in paths if path.exists()]


def _report(
    out: Path, failures: Mapping[Cell, str], command: str, say: Callable[[str], None]
) -> Path:
    tasks = [
        Task(path.parent, Settings.read(path), Results(path.parent / "cells").read_all(say))
        for path in _kept(out)
    ]
    return write_summary(out, tasks, failures, command)


def _grids(
    tasks: Sequence[Settings],
    policies: Sequence[str],
    demonstrations: Sequence[int],
    seeds: Sequence[int],
    conditions: Sequence[str],
    say: Callable[[str], None],
) -> list[list[Cell]]:
    """The cells of each environment."""
    for policy in policies:
        if Variant.parse(policy).base not in POLICIES:
            known = (*POLICIES, *NAMED)
            raise UnknownNameError("policy", policy, "the comparison", known)
    if not tasks or not policies or not seeds or not demonstrations or min(demonstrations) < 1:
        raise DataError(
            "a comparison needs environments, policies, seeds and numbers of demonstrations "
            f"> 0, got {[task.env for task in tasks]}, {list(policies)}, {list(seeds)}, "
            f"{list(demonstrations)}"
        )
    tried = _tried(tasks, conditions, say)
    return [
        [
            Cell(task.env, policy, n, seed, condition)
            for n in dict.fromkeys(demonstrations)
            for policy in dict.fromkeys(policies)
            for seed in dict.fromkeys(seeds)
            for condition in known
        ]
        for task, known in zip(tasks, tried, strict=True)
    ]


def _tried(
    tasks: Sequence[Settings], conditions: Sequence[str], say: Callable[[str], None]
) -> list[list[str]]:
    """Which conditions each environment is tried in: of those asked for, the ones it knows."""
    known = [task.benchmark().all_conditions for task in tasks]  # an unknown task ends here
    tried: list[dict[str, Any]] = [{} for _ in tasks]
    for condition in conditions:
        unknown: dict[str, UnknownNameError] = {}
        for task, names, every in zip(tasks, tried, known, strict=True):
            if condition == ALL_CONDITIONS:
                names |= dict.fromkeys(every)
                continue
            try:
                task.disturb(condition)
            except UnknownNameError as error:
                unknown[task.env] = error
            else:
                names[condition] = None
        if len(unknown) == len(tasks):
            raise next(iter(unknown.values()))
        if unknown:
            say(f"{', '.join(unknown)}: not tried in {condition!r}, which is unknown there")
    return [list(names) for names in tried]


def _finished(results: Results, cell: Cell, say: Callable[[str], None]) -> bool:
    try:
        return results.read(cell) is not None
    except DataError as error:
        say(f"{error}; the cell is run again")
        results.path(cell).unlink()
        return False


def _run(
    groups: Sequence[tuple[Path, Settings, list[Cell]]],
    workers: int,
    say: Callable[[str], None],
) -> dict[Cell, str]:
    """Run the cells, those of one training one after the other; return what failed."""
    # networks first, which take long, so that no worker is idle at the end
    groups = sorted(groups, key=lambda group: group[2][0].variant.base not in RECIPES)
    logs = [folder / "failures" / f"{cells[0].training}.txt" for folder, _, cells in groups]
    pending = sum(len(cells) for *_, cells in groups)
    began, finished, failures = time.monotonic(), 0, {}
    for number, problem in run_jobs(run, groups, workers, logs):
        folder, _, cells = groups[number]
        results = Results(folder / "cells")
        finished += len(cells)
        for cell in cells:
            result = results.read(cell)
            if result is None:
                failures[cell] = problem or "it left no result"
                text = f"FAILED, {failures[cell]} (all of it in {logs[number]})"
            else:
                successes = sum(row["success"] for row in result["episodes"])
                text = f"{successes} of {len(result['episodes'])} succeed"
            say(f"{cell.key}: {text}")
        say(f"[{finished}/{pending}] after {(time.monotonic() - began) / 60:.1f} min")
    return failures
