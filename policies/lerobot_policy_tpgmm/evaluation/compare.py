"""The comparison from end to end: what ``tpgmm compare`` runs."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from lerobot_policy_tpgmm.environments.disturbances import NOMINAL
from lerobot_policy_tpgmm.evaluation.cells import Cell, Results
from lerobot_policy_tpgmm.evaluation.jobs import POLICIES, record, run
from lerobot_policy_tpgmm.evaluation.processes import run_jobs
from lerobot_policy_tpgmm.evaluation.report.report import write_report
from lerobot_policy_tpgmm.evaluation.settings import Settings
from lerobot_policy_tpgmm.evaluation.variants import OPEN_LOOP, Variant
from tpgmm_torch.exceptions import DataError, UnknownNameError

__all__ = ["Comparison", "compare"]

#: Minutes that a cell takes, to begin with, to judge what remains.
EXPECTED = {"tpgmm": 1.5, "tpgmm-position-only": 1.5, "nearest": 1.0}


@dataclass(frozen=True)
class Comparison:
    """What became of a comparison.

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
    settings: Settings,
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
    out : Path
        The folder: ``episodes/`` (two LeRobot data sets), ``policies/`` (pretrained
        directories), ``cells/`` (one JSON file each), tables, figures and ``report.md``.
    policies : sequence of str
        Names, or ``"tpgmm --policy.FIELD=VALUE ..."``: trained as ``"tpgmm"`` and used with
        other settings.
    demonstrations : sequence of int
        Numbers of demonstrations.
    seeds : sequence of int
        Of the training.
    conditions : sequence of str
        ``"nominal"``, or disturbances of the environment joined by ``+``.
    workers : int, default=1
        Processes, of one thread each.
    say : callable
        Takes a line of progress.
    command : str
        For the report.

    Raises
    ------
    UnknownNameError
        If a policy or condition does not exist.
    DataError
        If the folder holds results of other settings.
    """
    grid = _grid(settings, policies, demonstrations, seeds, conditions)
    settings.keep(out / "settings.json")
    results = Results(out / "cells")
    pending = [cell for cell in grid if not _finished(results, cell, say)]
    say(f"{len(grid)} cells, {len(grid) - len(pending)} of them finished before")
    failures = {}
    if pending:
        say("episodes ...")
        record(out, settings, max(cell.demonstrations for cell in grid))
        failures = _run(out, settings, pending, workers, say)
    path = write_report(out, settings, results.read_all(say), failures, command)
    say(f"report and tables: {path}")
    return Comparison(len(grid) - len(failures), failures)


def _grid(
    settings: Settings,
    policies: Sequence[str],
    demonstrations: Sequence[int],
    seeds: Sequence[int],
    conditions: Sequence[str],
) -> list[Cell]:
    for policy in policies:
        if Variant.parse(policy).base not in POLICIES:
            known = (*POLICIES, OPEN_LOOP)
            raise UnknownNameError("policy", policy, "the comparison", known)
    for condition in conditions:
        settings.disturbed(condition)
    if not policies or not seeds or not demonstrations or min(demonstrations) < 1:
        raise DataError(
            "a comparison needs policies, seeds and numbers of demonstrations > 0, got "
            f"{list(policies)}, {list(seeds)}, {list(demonstrations)}"
        )
    return [
        Cell(settings.env, policy, n, seed, condition)
        for n in dict.fromkeys(demonstrations)
        for policy in dict.fromkeys(policies)
        for seed in dict.fromkeys(seeds)
        for condition in dict.fromkeys(conditions)
    ]


def _finished(results: Results, cell: Cell, say: Callable[[str], None]) -> bool:
    try:
        return results.read(cell) is not None
    except DataError as error:
        say(f"{error}; the cell is run again")
        results.path(cell).unlink()
        return False


def _run(
    out: Path,
    settings: Settings,
    pending: Sequence[Cell],
    workers: int,
    say: Callable[[str], None],
) -> dict[Cell, str]:
    """Run the cells, those of one training one after the other; return what failed."""
    pending = sorted(pending, key=lambda cell: cell.training)  # stable
    groups = [list(cells) for _, cells in groupby(pending, key=lambda cell: cell.training)]
    # the long ones first, so that no worker is idle at the end
    groups.sort(key=lambda cells: -_expected(cells, settings))
    logs = [out / "failures" / f"{cells[0].training}.txt" for cells in groups]
    results = Results(out / "cells")
    began, done, total = time.monotonic(), 0.0, sum(_expected(g, settings) for g in groups)
    finished, failures = 0, {}
    jobs = [(out, settings, cells) for cells in groups]
    for number, problem in run_jobs(run, jobs, workers, logs):
        cells = groups[number]
        done += _expected(cells, settings)
        finished += len(cells)
        elapsed = (time.monotonic() - began) / 60
        left = (total - done) * elapsed / done
        for cell in cells:
            result = results.read(cell)
            if result is None:
                failures[cell] = problem or "it left no result"
                text = f"FAILED, {failures[cell]} (all of it in {logs[number]})"
            else:
                successes = sum(row["success"] for row in result["episodes"])
                text = f"{successes} of {len(result['episodes'])} succeed"
            say(f"{cell.key}: {text}")
        say(f"[{finished}/{len(pending)}] {elapsed:.1f} min gone, about {left:.0f} min to go")
    return failures


def _expected(cells: Sequence[Cell], settings: Settings) -> float:
    """Minutes, roughly, in proportion to one another."""
    training = EXPECTED.get(cells[0].variant.base, settings.budget / 60)
    return training + len(cells) * settings.episodes / 50
