"""What is measured: each section yields cells, which are measured once and kept in a file each.

A cell holds arrays, named ``KIND:NAME``. The kind says how two of them are compared: ``same``
to rounding; ``success`` (0 or 1), ``score`` (more is better) and ``error`` (less is better) in
pairs, the same episode, fold or situation in both; ``seconds`` by their ratio.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import types
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from tpgmm_evaluation.regressions.goldens import GOLDENS, Measured

from lerobot_policy_tpgmm.environments.disturbances import NOMINAL
from lerobot_policy_tpgmm.evaluation.benchmarks import BENCHMARKS, OTHER_ROBOTS
from lerobot_policy_tpgmm.evaluation.cells import Results
from lerobot_policy_tpgmm.evaluation.compare import compare
from lerobot_policy_tpgmm.evaluation.settings import Settings
from tpgmm_datasets.bottle.experiment import BottleExperiment
from tpgmm_datasets.bottle.skill import BottleShaking
from tpgmm_torch.atomic import replacing
from tpgmm_torch.exceptions import TPGMMError

__all__ = ["SECTIONS", "Plan", "measure", "timed"]

#: Real recordings beside the checkout, and what ``examples/leave_one_out.py`` calls them.
RECORDINGS = {"g1_bottle": "g1", "honeytea_bimanual": "honeytea", "so101_record": "so101"}
ALOHA = ("aloha_state", "aloha_insertion")
SUITE = tuple(set(BENCHMARKS) - set(ALOHA) - {n for t in OTHER_ROBOTS.values() for n in t})
#: Disturbances of the small form: one of the robot, one of the object, one of the sensor.
FEW = ("stopped-3", "moved", "pose-noise")

Work = Callable[[], Measured]
Say = Callable[[str], None]


@dataclass(frozen=True)
class Plan:
    """What to measure, and where.

    Parameters
    ----------
    out : Path
        Where cells are kept, as ``SECTION/NAME.npz``.
    small : bool, default=False
        Whether a few situations of each do, in minutes; the whole takes hours.
    root : Path
        The checkout, whose examples, tests and benchmarks are used.
    data : Path
        The folder of the recordings; they are left out where there is none.
    workers : int, default=1
        Processes for the rollouts.
    tasks : sequence of str
        Of the suite.
    """

    out: Path
    small: bool = False
    root: Path = Path()
    data: Path = Path("../shared/data")
    workers: int = 1
    tasks: Sequence[str] = SUITE

    def loaded(self, module: str) -> Any:
        """A module of the checkout's examples or tests, which are in no package."""
        parent = module.partition(".")[0]
        if parent not in sys.modules or not hasattr(sys.modules[parent], "__path__"):
            sys.modules[parent] = types.ModuleType(parent)
        sys.modules[parent].__path__ = [str(self.root / parent)]
        return import_module(module)


def measure(plan: Plan, sections: Sequence[str], say: Say = print) -> list[str]:
    """Measure what is not yet in the folder.

    Parameters
    ----------
    plan : Plan
    sections : sequence of str
        Keys of ``SECTIONS``.
    say : callable
        Takes a line of progress.

    Returns
    -------
    list of str
        What failed, and why.
    """
    failures = []
    for section in sections:
        try:
            for name, work in SECTIONS[section](plan):
                path = plan.out / section / f"{name}.npz"
                if not path.exists():
                    say(f"{section}/{name} ...")
                    with warnings.catch_warnings(action="ignore"):
                        cell = work()
                    with replacing(path) as new, new.open("wb") as file:
                        np.savez_compressed(file, **cell)
        except Exception as error:  # one that fails is no reason to lose the others
            failures.append(f"{section}: {type(error).__name__}: {error}")
            say(f"FAILED {failures[-1]}")
    return failures


def goldens(plan: Plan) -> Iterator[tuple[str, Work]]:
    """Three skills, ten situations each."""
    for name, golden in GOLDENS.items():
        yield name, partial(golden, plan.small)


def demo(plan: Plan) -> Iterator[tuple[str, Work]]:
    """The figures that ``make demo`` prints."""

    def work() -> Measured:
        skill = BottleShaking(rate=20 if plan.small else 100)
        with tempfile.TemporaryDirectory() as folder:
            run = BottleExperiment(Path(folder), n_situations=10 if plan.small else 50)
            run.skill = skill
            metrics = run.run()
        return {
            f"error:{row}, {measure}, {part}": np.array([value], dtype=np.float64)
            for row, measures in metrics["rows"].items()
            for measure, spread in measures.items()
            for part, value in (
                spread if isinstance(spread, Mapping) else {"worst": spread}
            ).items()
        }

    yield "figures", work


def _rollouts(
    plan: Plan, tasks: Sequence[str], policies: Sequence[str], conditions: Sequence[str] = ()
) -> Iterator[tuple[str, Work]]:
    """Cells of ``tpgmm compare``, which goes on where it was: successes and errors."""
    episodes, seeds = (6, (0,)) if plan.small else (34, (0, 1, 2))
    counts = (10,) if conditions else (3, 10)
    settings, out = [Settings(task, episodes=episodes) for task in tasks], plan.out / "rollouts"
    done = compare(
        settings, out, policies, counts, seeds, conditions or (NOMINAL,), plan.workers,
        command="make baseline",
    )  # fmt: skip
    if done.failures:
        raise TPGMMError(f"{len(done.failures)} cells failed: see {out}/TASK/failures")
    for task in settings:
        limits = task.benchmark().criteria
        errors = [name for name, (low, high) in limits.items() if low == 0 < high < np.inf]
        for result in Results(out / task.env / "cells").read_all(print):
            cell, rows = result["cell"], result["episodes"]
            if cell["policy"] in policies and (cell["condition"] != NOMINAL) == bool(
                conditions
            ):
                found = {"success:success": np.array([row["success"] for row in rows], float)}
                for key in errors:
                    found[f"error:{key}"] = np.array([row[key] for row in rows], float)
                group = f"{cell['policy']}-n{cell['demonstrations']}"
                name = f"{cell['env']}-s{cell['seed']}-{cell['condition']}"
                yield f"{group}/{name}", lambda found=found: found


def suite(plan: Plan) -> Iterator[tuple[str, Work]]:
    """Seven tasks of two hands, with operators as named, and found."""
    policies = ("tpgmm",) if plan.small else ("tpgmm", "tpgmm-auto")
    return _rollouts(plan, plan.tasks, policies)


def disturbed(plan: Plan) -> Iterator[tuple[str, Work]]:
    """The same where something goes wrong, from ten demonstrations."""
    return _rollouts(plan, plan.tasks, ("tpgmm",), FEW if plan.small else ("all",))


def aloha(plan: Plan) -> Iterator[tuple[str, Work]]:
    """Both tasks of gym-aloha."""
    return _rollouts(plan, ALOHA[: 1 if plan.small else None], ("tpgmm",))


def reach(plan: Plan) -> Iterator[tuple[str, Work]]:
    """Bottles out of reach: how calm robots are, and how far from the nearest posture."""
    example = plan.loaded("examples.out_of_reach")

    def work() -> Measured:
        bottles, starts = (20, 10) if plan.small else (200, 60)
        model = example.learned()
        there = example.outside(bottles, 0, 0.5)
        ticks = round((example.GRASP + 4.0) / example.DT)
        paths = example.played(model, there, example.UpTo(), ticks)
        found = {f"error:{k}": [v] for k, v in example.calm(model, paths).items()}
        here, least = example.distances(model, there, paths[-1], starts, 25)
        far = least > example.REACHED
        excess = (here / least - 1)[far]
        found["error:excess distance"] = excess.tolist()
        return {name: np.array(values, dtype=float) for name, values in found.items()}

    yield "bottles", work


def recordings(plan: Plan) -> Iterator[tuple[str, Work]]:
    """Real recordings, one left out: errors at the event and along the path, likelihood."""
    example = plan.loaded("examples.leave_one_out")

    def work(folder: Path, likely: bool) -> Measured:
        recording = example.RECORDINGS[RECORDINGS[folder.name]](folder)
        last = len(recording.demonstrations) - 1
        folds = np.linspace(0, last, 4).astype(int).tolist() if plan.small else None
        if likely:
            scores = example.likelihoods(recording, folds=folds)
            return {
                f"score:shrinkage {name}, K = {n}": column
                for name, rows in scores.items()
                for n, column in zip(example.NUMBERS, rows.T, strict=True)
            }
        found = example.leave_one_out(recording, folds=folds)
        return {
            f"error:{name}, {heading}": column
            for name in recording.models
            for heading, column in zip(example.COLUMNS, found[name].T, strict=True)
            if not np.isnan(column).any()
        }

    for name in RECORDINGS:
        folder = plan.data / name
        if folder.is_dir():
            yield f"{name}/likelihood", partial(work, folder, True)
            if name != "so101_record":  # joints alone: no link to look at
                yield f"{name}/left out", partial(work, folder, False)


def mistakes(plan: Plan) -> Iterator[tuple[str, Work]]:
    """Mistakes with recordings and situations: which of them are noticed."""
    table = plan.loaded("tests.support.mistakes").MISTAKES

    def noticed(mistake: Any) -> bool:
        messages = []
        with (
            warnings.catch_warnings(record=True) as caught,
            tempfile.TemporaryDirectory() as at,
        ):
            warnings.simplefilter("always")
            try:
                mistake.make(Path(at))
            except TPGMMError as error:
                messages.append(str(error))
        messages += [str(w.message) for w in caught]
        return any(re.search(mistake.told, message) for message in messages)

    def work() -> Measured:
        chosen = table[::8] if plan.small else table
        return {f"success:{one}": np.array([float(noticed(one))]) for one in chosen}

    yield "table", work


def timed(root: Path, small: bool) -> Measured:
    """Seconds of the main work, measured by the checkout at ``root`` with its own code."""
    containers = ("", "datasets", "policies", "environments", "evaluation", "tools")
    paths = os.pathsep.join(str(root.resolve() / each) for each in containers)
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, "-m", "benchmarks", "--only", "main", "--out", out]
        command += ["--sizes", "tiny"] if small else []
        env = os.environ | {"PYTHONPATH": paths}
        subprocess.run(command, cwd=root, env=env, check=True, stdout=subprocess.DEVNULL)
        rows = json.loads((Path(out) / "main.json").read_text(encoding="utf-8"))["rows"]
    return {f"seconds:{row['work']}": np.array([row["ours"]]) for row in rows}


def times(plan: Plan) -> Iterator[tuple[str, Work]]:
    """``make bench``'s main figures."""
    yield "main", partial(timed, plan.root, plan.small)


#: In the order in which they are measured: the quick ones first.
SECTIONS: Mapping[str, Callable[[Plan], Iterator[tuple[str, Work]]]] = {
    each.__name__: each
    for each in (
        goldens, mistakes, demo, times, recordings, reach, suite, aloha, disturbed,
    )
}  # fmt: skip
