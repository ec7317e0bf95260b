"""The comparison from end to end: what ``tpgmm compare`` runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, groupby, product
from pathlib import Path

from lerobot_env_bimanual.disturbances import NOMINAL
from tpgmm_evaluation.baselines import RECIPES
from tpgmm_evaluation.benchmarks import BENCHMARKS
from tpgmm_evaluation.cells import Cell, Job, Results, run_cells
from tpgmm_evaluation.jobs import POLICIES, record, run
from tpgmm_evaluation.report.summary import Task, write_summary
from tpgmm_evaluation.settings import Settings
from tpgmm_evaluation.variants import NAMED, Variant
from tpgmm_torch.exceptions import DataError, UnknownNameError

__all__ = ["compare"]

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
    _check(tasks, policies, demonstrations, seeds)
    known = choose_conditions(tasks, conditions, say)
    for task in tasks:
        task.keep(out / task.env / "settings.json")
    pending, total = [], 0
    for task, names in zip(tasks, known, strict=True):
        cells = dict.fromkeys(
            Cell(task.env, policy, n, seed, name)
            for n, policy, seed, name in product(demonstrations, policies, seeds, names)
        )
        results, total = Results(out / task.env / "cells"), total + len(cells)
        pending.append([cell for cell in cells if not results.has(cell, say)])
    say(f"{total} cells, {total - sum(map(len, pending))} of them finished before")
    jobs = []
    for task, left in zip(tasks, pending, strict=True):
        folder = out / task.env
        for seed in sorted({cell.seed for cell in left}):
            say(f"{task.env}: episodes of seed {task.drawn(seed)} ...")
            record(folder, task, max(demonstrations), seed)
        jobs += _by_training(folder, task, left)
    # networks first, which take long, so that no worker is idle at the end
    jobs.sort(key=lambda job: job.cells[0].variant.base not in RECIPES)
    failures = run_cells(run, jobs, workers, say)
    path = _report(out, failures, command, say)
    say(f"report and tables: {path}")
    return Comparison(total - len(failures), failures)


def _by_training(folder: Path, task: Settings, cells: Sequence[Cell]) -> list[Job]:
    """Group cells by their training, whose cells run one after the other."""
    ordered = sorted(cells, key=lambda cell: cell.training)  # stable
    groups = [list(same) for _, same in groupby(ordered, key=lambda cell: cell.training)]
    return [Job(same, Results(folder / "cells"), (folder, task, same)) for same in groups]


def _check(
    tasks: Sequence[Settings],
    policies: Sequence[str],
    demonstrations: Sequence[int],
    seeds: Sequence[int],
) -> None:
    """Check that there is something to compare, and that its policies exist."""
    for policy in policies:
        if Variant.parse(policy).base not in POLICIES:
            known = (*POLICIES, *NAMED)
            raise UnknownNameError("policy", policy, "the comparison", known)
    if not all((tasks, policies, seeds, demonstrations)) or min(demonstrations) < 1:
        raise DataError(
            "a comparison needs environments, policies, seeds and numbers of demonstrations "
            f"> 0, got {[task.env for task in tasks]}, {list(policies)}, {list(seeds)}, "
            f"{list(demonstrations)}"
        )


def choose_conditions(
    tasks: Sequence[Settings], conditions: Sequence[str], say: Callable[[str], None]
) -> list[list[str]]:
    """Choose for each environment those of the conditions that it knows.

    Parameters
    ----------
    tasks : sequence of Settings
        Of each environment.
    conditions : sequence of str
        As for :func:`compare`.
    say : callable
        Told of a condition that some of the environments do not know.

    Raises
    ------
    UnknownNameError
        If none of them knows one.
    """
    chosen = [_known_conditions(task, conditions) for task in tasks]
    for name in dict.fromkeys(name for name in conditions if name != ALL_CONDITIONS):
        unknown = [t.env for t, names in zip(tasks, chosen, strict=True) if name not in names]
        if len(unknown) == len(tasks):
            tasks[0].disturb(name)  # says what it knows
        if unknown:
            say(f"{', '.join(unknown)}: not tried in {name!r}, which is unknown there")
    return chosen


def _known_conditions(task: Settings, conditions: Sequence[str]) -> list[str]:
    """List the conditions that an environment knows, each once."""
    every = task.benchmark().all_conditions  # an unknown task ends here
    names = chain.from_iterable(every if n == ALL_CONDITIONS else [n] for n in conditions)
    return [name for name in dict.fromkeys(names) if task.knows(name)]


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
    if not _settings_files(out):
        raise DataError(
            f"{out} holds no comparison: there is no ENVIRONMENT/settings.json in it. Give the "
            "folder that `tpgmm compare --out` wrote"
        )
    return _report(out, {}, "", say)


def _settings_files(out: Path) -> list[Path]:
    """Find the settings of all environments in a folder, in the order of the registry."""
    names = [*BENCHMARKS, *sorted(path.name for path in out.glob("*") if path.is_dir())]
    paths = [out / name / "settings.json" for name in dict.fromkeys(names)]
    return [path for path in paths if path.exists()]


def _report(
    out: Path, failures: Mapping[Cell, str], command: str, say: Callable[[str], None]
) -> Path:
    tasks = [
        Task(path.parent, Settings.read(path), Results(path.parent / "cells").read_all(say))
        for path in _settings_files(out)
    ]
    return write_summary(out, tasks, failures, command)
