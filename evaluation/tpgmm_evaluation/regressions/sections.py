"""Sections of what is measured: each has cells, one file each."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

from lerobot_env_bimanual.disturbances import NOMINAL
from tpgmm_datasets.bottle.skill import BottleShaking
from tpgmm_evaluation.benchmarks import ALOHA, GROUPS
from tpgmm_evaluation.cells import Cell, Results
from tpgmm_evaluation.compare import compare
from tpgmm_evaluation.regressions.goldens import GOLDENS
from tpgmm_evaluation.regressions.plan import Measured, Plan, import_paths
from tpgmm_evaluation.settings import Settings
from tpgmm_tools.paper.experiment import BottleExperiment
from tpgmm_torch.atomic import replacing
from tpgmm_torch.exceptions import TPGMMError

#: Real recordings beside the checkout, and what ``examples/leave_one_out.py`` calls them.
RECORDINGS = {"g1_bottle": "g1", "honeytea_bimanual": "honeytea", "so101_record": "so101"}
#: Disturbances of the small form: one of the robot, one of the object, one of the sensor.
FEW = ("stopped-3", "moved", "pose-noise")

Work = Callable[[], Measured]


def measure(plan: Plan, sections: Sequence[str]) -> list[str]:
    """Measure what is not yet in the folder.

    Parameters
    ----------
    plan : Plan
        Where and how much.
    sections : sequence of str
        Keys of ``SECTIONS``.

    Returns
    -------
    list of str
        What failed, and why.
    """
    failures = []
    for section in sections:
        try:
            for name, work in SECTIONS[section](plan):
                _keep(plan.out / section / f"{name}.npz", work, f"{section}/{name} ...")
        except Exception as error:  # one that fails is no reason to lose the others
            failures.append(f"{section}: {type(error).__name__}: {error}")
            print(f"FAILED {failures[-1]}")
    return failures


def _keep(path: Path, work: Work, title: str) -> None:
    """Measure a cell, unless its file is there."""
    if path.exists():
        return
    print(title)
    with warnings.catch_warnings(action="ignore"):
        cell = work()
    with replacing(path) as new, new.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **cell)


def demo(plan: Plan) -> Iterator[tuple[str, Work]]:
    """Measure the figures that ``make demo`` prints."""

    def work() -> Measured:
        n, rate = (10, 20) if plan.small else (50, 100)
        with tempfile.TemporaryDirectory() as folder:
            experiment = BottleExperiment(Path(folder), n_situations=n)
            experiment.skill = BottleShaking(rate=rate)
            rows = experiment.run()["rows"]
        found = {}
        for row, measures in rows.items():
            for name, values in measures.items():
                parts = values if isinstance(values, dict) else {"worst": values}
                for part, value in parts.items():
                    found[f"error:{row}, {name}, {part}"] = np.array([value], float)
        return found

    yield "figures", work


def _grid(disturbed: bool, small: bool) -> tuple[Sequence[str], Sequence[int], Sequence[int]]:
    """Return the conditions, numbers of demonstrations and seeds of rollouts."""
    if disturbed:
        return FEW if small else ("all",), (10,), (0,)
    return (NOMINAL,), (3, 10), (0,) if small else (0, 1, 2)


def rollouts(
    tasks: Sequence[str], policies: Sequence[str], disturbed: bool, plan: Plan
) -> Iterator[tuple[str, Work]]:
    """Roll out cells of ``tpgmm compare``, which resumes by itself."""
    if plan.small:
        policies = policies[:1]
    conditions, counts, seeds = _grid(disturbed, plan.small)
    settings = [Settings(task, episodes=6 if plan.small else 34) for task in tasks]
    out = plan.out / "rollouts"
    done = compare(settings, out, policies, counts, seeds, conditions, plan.workers)
    if done.failures:
        raise TPGMMError(f"{len(done.failures)} cells failed: see {out}/TASK/failures")
    for task in settings:
        for result in Results(out / task.env / "cells").read_all(print):
            cell = Cell(**result["cell"])
            if cell.policy in policies and disturbed == (cell.condition != NOMINAL):
                name = f"{cell.env}-s{cell.seed}-{cell.condition}"
                group = f"{cell.policy}-n{cell.demonstrations}"
                yield f"{group}/{name}", partial(episode_figures, task, result)


def episode_figures(task: Settings, result: Mapping[str, Any]) -> Measured:
    """Collect successes and errors of the episodes of a cell."""
    errors = [key for key, figure in task.benchmark().criteria.items() if figure.low == 0]
    names = {"success:success": "success", **{f"error:{key}": key for key in errors}}
    rows = result["episodes"]
    return {n: np.array([row[key] for row in rows], float) for n, key in names.items()}


def reach(plan: Plan) -> Iterator[tuple[str, Work]]:
    """Measure robots before bottles out of reach: calm, and far from the nearest posture."""
    example = plan.load_module("examples.out_of_reach")

    def work() -> Measured:
        bottles, starts = (20, 10) if plan.small else (200, 60)
        model = example.learned()
        there = example.outside(bottles, 0, 0.5)
        ticks = round((example.GRASP + 4.0) / example.DT)
        paths = example.played(model, there, ticks, True)
        found = {f"error:{k}": [v] for k, v in example.calm(model, paths).items()}
        here, least = example.distances(model, there, paths[-1], starts, 50)
        far = least > example.REACHED
        excess = (here / least - 1)[far]
        found["error:excess distance"] = excess.tolist()
        return {name: np.array(values, dtype=float) for name, values in found.items()}

    yield "bottles", work


def recordings(plan: Plan) -> Iterator[tuple[str, Work]]:
    """Leave real recordings out: errors at the event and along the path, likelihood."""
    example = plan.load_module("examples.leave_one_out")

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
    """Make mistakes with recordings and situations, and count those noticed."""
    table = plan.load_module("tests.support.mistakes").MISTAKES

    def is_noticed(mistake: Any) -> bool:
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
        # by name, so that the sample stays the same whatever is added to the table
        chosen = [x for x in table if not plan.small or crc32(str(x).encode()) % 8 == 0]
        return {f"success:{m}": np.array([float(is_noticed(m))]) for m in chosen}

    yield "table", work


def measure_times(root: Path, small: bool) -> Measured:
    """Let the checkout at ``root`` measure the seconds of its main work."""
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, "-m", "benchmarks", "--only", "main", "--out", out]
        command += ["--repeat", "1"] if small else []
        env = os.environ | {"PYTHONPATH": import_paths(root)}
        subprocess.run(command, cwd=root, env=env, check=True, stdout=subprocess.DEVNULL)
        rows = json.loads((Path(out) / "main.json").read_text(encoding="utf-8"))["rows"]
    return {f"seconds:{row['work']}": np.array([row["ours"]]) for row in rows}


#: In the order in which they are measured: the quick ones first.
SECTIONS: Mapping[str, Callable[[Plan], Iterator[tuple[str, Work]]]] = {
    "goldens": lambda plan: ((name, partial(work, plan)) for name, work in GOLDENS.items()),
    "mistakes": mistakes,
    "demo": demo,
    "times": lambda plan: iter([("main", partial(measure_times, plan.root, plan.small))]),
    "recordings": recordings,
    "reach": reach,
    "suite": partial(rollouts, GROUPS["suite"], ("tpgmm", "tpgmm-auto"), False),
    "aloha": partial(rollouts, ALOHA, ("tpgmm",), False),
    "disturbed": partial(rollouts, GROUPS["suite"], ("tpgmm",), True),
}
