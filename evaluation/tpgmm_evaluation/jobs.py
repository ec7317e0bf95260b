"""Train a policy and evaluate it: the work behind the cells, one process at a time."""

from __future__ import annotations

import json
import os
import platform
import shutil
import time
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from lerobot.envs.factory import make_env_config

from tpgmm_evaluation.cells import Cell, Results, write_json
from tpgmm_evaluation.rollouts import Runner, evaluate, latency
from tpgmm_evaluation.settings import Settings
from tpgmm_evaluation.trainings import TRAININGS
from tpgmm_torch.atomic import replacing

#: In the order of the report.
POLICIES = tuple(TRAININGS)
RECORD = "training.json"
PACKAGES = (
    *("tpgmm-torch", "lerobot", "torch", "numpy", "scikit-learn", "gymnasium", "mujoco"),
    *("diffusers", "mink"),
)


def record(folder: Path, settings: Settings, n: int, seed: int = 0) -> None:
    """Record what trainings with a seed learn from, unless ``n`` episodes are there."""
    place = settings.episodes_in(folder, seed)
    summary = place / "summary.json"
    if summary.exists():
        tried = json.loads(summary.read_text(encoding="utf-8"))["successes"]
        if sum(tried) >= n:
            return
    shutil.rmtree(place, ignore_errors=True)
    benchmark = settings.benchmark()
    successes = benchmark.record(place, n, settings.validation, settings.drawn(seed))
    write_json(summary, {"successes": successes})


def run(folder: Path, settings: Settings, cells: Sequence[Cell]) -> None:
    """Train a policy, unless that is done, and evaluate it: all cells of one training."""
    torch.set_num_threads(1)  # the networks are small: a second thread only spins
    directory = folder / "policies" / cells[0].training
    if not (directory / RECORD).exists():
        _train(folder, settings, cells[0], directory)
    training = json.loads((directory / RECORD).read_text(encoding="utf-8"))
    results = Results(folder / "cells")
    for cell in cells:
        runner = Runner.load(directory, cell.variant.arguments)
        options = settings.disturb(cell.condition)
        config = make_env_config(settings.benchmark().env, fps=training["fps"], **options)
        began, used = time.perf_counter(), time.process_time()
        rows = evaluate(runner, config, settings.seeds)
        seconds, used = time.perf_counter() - began, time.process_time() - used
        drawn = {"options": options, "demonstration_seed": settings.drawn(cell.seed)}
        results.write(
            cell,
            {
                "settings": {**asdict(settings), **drawn},
                "training": training,
                "evaluation_seconds": seconds,
                "evaluation_cpu_seconds": used,
                "latency": latency(runner, config),
                "episodes": rows,
                "versions": {name: version(name) for name in PACKAGES},
                "machine": machine(),
            },
        )


def machine() -> dict[str, Any]:
    """Describe what results may depend on of the machine, without its name."""
    return {
        "architecture": platform.machine(),
        "system": platform.system(),
        "processors": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
    }


def _train(folder: Path, settings: Settings, cell: Cell, directory: Path) -> None:
    """Write the pretrained directory in one step."""
    began = time.process_time()
    episodes = settings.episodes_in(folder, cell.seed)
    trained = TRAININGS[cell.variant.base](episodes, settings, cell)
    seconds = time.process_time() - began
    with replacing(directory) as new:
        for part in (trained.policy, *trained.processors):
            part.save_pretrained(new)
        description = {
            "fps": trained.fps,
            "seconds": seconds,
            "parameters": sum(p.numel() for p in trained.policy.parameters()),
            "bytes": sum(path.stat().st_size for path in new.iterdir()),
            "outcome": trained.outcome,
            "recipe": trained.recipe,
            "curve": trained.curve,
        }
        write_json(new / RECORD, description)
