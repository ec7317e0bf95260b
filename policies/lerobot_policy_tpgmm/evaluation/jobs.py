"""Train a policy and evaluate it: the work behind the cells, one process at a time."""

from __future__ import annotations

import json
import os
import platform
import shutil
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from lerobot.envs.factory import make_env_config
from lerobot.processor import make_default_pre_post_processors
from lerobot.utils.constants import OBS_ENV_STATE

from lerobot_policy_tpgmm.evaluation.cells import Cell, Results, write_json
from lerobot_policy_tpgmm.evaluation.policies.baselines import RECIPES, Training, train
from lerobot_policy_tpgmm.evaluation.policies.episodes import Episodes
from lerobot_policy_tpgmm.evaluation.policies.replay import NearestPolicy
from lerobot_policy_tpgmm.evaluation.rollouts import Runner, evaluate, latency
from lerobot_policy_tpgmm.evaluation.settings import Settings
from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from lerobot_policy_tpgmm.processor_tpgmm import make_tpgmm_pre_post_processors
from tpgmm_datasets import describe_lerobot, load_lerobot
from tpgmm_torch import Demonstration, TaskParameterizedGMM
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.atomic import replacing

__all__ = ["POLICIES", "record", "run"]

#: In the order of the report.
POLICIES = ("tpgmm", "tpgmm-places", "tpgmm-position-only", *RECIPES, "nearest")
RECORD = "training.json"
PACKAGES = ("tpgmm-torch", "lerobot", "torch", "numpy", "gymnasium", "mujoco", "diffusers")


def record(folder: Path, settings: Settings, n: int, seed: int = 0) -> None:
    """Record what trainings with a seed learn from, unless ``n`` episodes are there."""
    place = settings.episodes_in(folder, seed)
    summary = place / "summary.json"
    if summary.exists():
        recorded = json.loads(summary.read_text(encoding="utf-8"))["successes"]
        if len(recorded) >= n:
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
        options = settings.disturbed(cell.condition)
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
    """What results may depend on of the machine, without its name."""
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
    train_it = {"nearest": _nearest} | dict.fromkeys(RECIPES, _baseline)
    episodes = settings.episodes_in(folder, cell.seed)
    trained = train_it.get(cell.variant.base, _tpgmm)(episodes, settings, cell)
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


def _baseline(episodes: Path, settings: Settings, cell: Cell) -> Training:
    training = Episodes.read(episodes / "training").first(cell.demonstrations)
    validation = Episodes.read(episodes / "validation")
    recipe = RECIPES[cell.variant.base]
    if recipe.phase and not settings.benchmark().synchronous:
        training, validation = training.on_common_clock(validation)
    return train(recipe, training, validation, seed=cell.seed, budget=settings.budget)


def _nearest(episodes: Path, settings: Settings, cell: Cell) -> Training:
    kept = Episodes.read(episodes / "training").first(cell.demonstrations)
    policy = NearestPolicy.fit(kept)
    processors = make_default_pre_post_processors(policy.config)
    return Training(policy, processors, kept.fps, outcome="kept as they are")


def _tpgmm(episodes: Path, settings: Settings, cell: Cell) -> Training:
    """Align the first episodes and learn their references."""
    benchmark = settings.benchmark()
    demonstrations = load_lerobot(
        episodes / "training",
        robot=benchmark.robot,
        joints="action",
        episodes=range(cell.demonstrations),
    )
    base = cell.variant.base
    if base == "tpgmm-places":
        demonstrations = [_at_first(demonstration) for demonstration in demonstrations]
    if not benchmark.synchronous:
        warping = DynamicTimeWarping(robot=benchmark.robot)
        demonstrations = warping.fit_transform(demonstrations)
    model = TaskParameterizedGMM(
        settings.n_components or benchmark.n_components,
        benchmark.operators(
            orientation=base != "tpgmm-position-only", held=base != "tpgmm-places"
        ),
        benchmark.robot,
        random_state=cell.seed,
    )
    policy = TPGMMPolicy.from_estimator(
        model.fit(demonstrations),
        fps=benchmark.rate,
        environment_names=_environment_names(episodes / "training"),
    )
    recipe = {"n_components": policy.config.n_components, "operators": policy.config.operators}
    processors = make_tpgmm_pre_post_processors(policy.config)
    outcome = "learned by expectation-maximisation"
    return Training(policy, processors, benchmark.rate, recipe, outcome=outcome)


def _environment_names(path: Path) -> list[str]:
    """Which entry of the observation is what: operators may name objects in another order."""
    columns = {column.key: column.names for column in describe_lerobot(path).columns}
    return list(columns[OBS_ENV_STATE] or ())


def _at_first(demonstration: Demonstration) -> Demonstration:
    """With all objects where they were at the beginning."""
    frames = {
        name: frame[0] if frame.batch_shape else frame
        for name, frame in demonstration.frames.items()
    }
    return replace(demonstration, frames=frames)
