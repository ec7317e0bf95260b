"""All tasks of Meta-World from few demonstrations: ``make metaworld``.

What is done is kept, one file for each cell: a run that is broken off goes on where it was, and
one with more episodes adds those that are new.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
import typer

from lerobot_env_bimanual.metaworld.state import MetaworldStateEnv
from lerobot_env_bimanual.metaworld.tasks import TASKS, check_task
from tpgmm_evaluation.cells import Cell, Results
from tpgmm_evaluation.metaworld.learners import LEARNERS, Actor, Learner
from tpgmm_evaluation.metaworld.networks import Network
from tpgmm_evaluation.metaworld.recordings import (
    evaluation_seeds,
    recorded,
    successes,
    validation,
)
from tpgmm_evaluation.metaworld.summary import (
    comparison_table,
    cost_table,
    draw_groups,
    summary,
    task_table,
)
from tpgmm_evaluation.metaworld.trials import trials
from tpgmm_evaluation.report.pages import write_page
from tpgmm_evaluation.report.tables import episode_table, write_table
from tpgmm_tools.arguments import options
from tpgmm_torch.exceptions import DataError, UnknownNameError

__all__ = ["app"]

app = typer.Typer(add_completion=False)

#: Whose versions are written down with each cell.
PACKAGES = ("metaworld", "mujoco", "numpy", "torch", "scikit-learn", "lerobot", "diffusers")


@options.command(app, "python -m tpgmm_evaluation.metaworld --tasks reach-v3 --seeds 0,1")
def run(
    *,
    tasks: str = "all",
    demonstrations: str = "1,3,5,10",
    seeds: str = "0",
    episodes: int = 50,
    policies: str = ",".join(LEARNERS),
    record: int = 12,
    budget: float = Network.budget / 60,
    tuning: bool = False,
    out: Path = Path("out/metaworld"),
) -> None:
    """Record experts, learn from them, and try what was learned in unseen situations.

    Parameters
    ----------
    tasks : ``NAME,...``
        Tasks, or all.
    demonstrations : ``N,...``
        Numbers of demonstrations.
    seeds : ``N,...``
        Each has demonstrations of its own.
    episodes : int >= 1
        In each cell.
    policies : ``NAME,...``
        Among tpgmm, perceptron, act and diffusion.
    record : int >= 1
        Episodes of the expert at least; more where it fails.
    budget : float >= 0
        Minutes of the processor for each network at most.
    tuning : bool
        Try in other situations than those that are reported.
    out : ``DIR``
        Where results are.
    """
    torch.set_num_threads(1)
    names = TASKS if tasks == "all" else [check_task(name) for name in tasks.split(",")]
    chosen = policies.split(",")
    for name in chosen:
        if name not in LEARNERS:
            raise UnknownNameError("policy", name, "the benchmark", LEARNERS)
    learners = {name: _limited(LEARNERS[name], 60 * budget) for name in chosen}
    results = Results(out / ("tuning" if tuning else "cells"))
    situations = evaluation_seeds(episodes, tuning=tuning)
    for task in names:
        cells = [
            Cell(task, policy, n, seed)
            for seed in _integers("seeds", seeds)
            for n in _integers("demonstrations", demonstrations)
            for policy in chosen
        ]
        kept = {
            cell: _kept(results, cell, settings_of(learners[cell.policy]), situations)
            for cell in cells
        }
        missing = [cell for cell in cells if len(kept[cell]) < episodes]
        if not missing:
            continue
        env = MetaworldStateEnv(task)
        for cell in missing:
            learner, folder = learners[cell.policy], out / "demonstrations"
            result = _measure(env, cell, learner, folder, record, situations, kept[cell])
            results.write(cell, result)
            solved = sum(episode["success"] for episode in result["episodes"])
            typer.echo(f"{cell.key}: {solved} of {episodes}")
        env.close()
    report(results, out)


def _integers(option: str, text: str) -> list[int]:
    try:
        return [int(number) for number in text.split(",")]
    except ValueError:
        raise DataError(f"--{option} is integers joined by commas, got {text!r}") from None


def _limited(learner: Learner, budget: float) -> Learner:
    return replace(learner, budget=budget) if isinstance(learner, Network) else learner


def settings_of(learner: Learner) -> dict[str, Any]:
    """All settings of a learner, as JSON holds them."""
    text = json.dumps(asdict(learner), default=lambda kind: kind.__name__)
    return dict(json.loads(text))


def _kept(
    results: Results, cell: Cell, settings: dict[str, Any], situations: Sequence[int]
) -> list[dict[str, Any]]:
    """Episodes of a cell in the first of these situations, if settings are as they were."""
    found = results.read(cell)
    if found is None or found["settings"] != settings:
        return []
    seeds = [episode["seed"] for episode in found["episodes"]]
    same = seeds[: len(situations)] == [*situations][: len(seeds)]
    return list(found["episodes"]) if same else []


def _measure(
    env: MetaworldStateEnv,
    cell: Cell,
    learner: Learner,
    folder: Path,
    record: int,
    situations: Sequence[int],
    kept: list[dict[str, Any]],
) -> dict[str, Any]:
    shown = recorded(folder, cell.env, cell.seed, cell.demonstrations, record)
    chosen = successes(shown, cell.demonstrations, cell.env)
    held_out = validation(folder, cell.env) if isinstance(learner, Network) else []
    began = time.process_time()
    actor: Actor = (
        learner.fit(chosen, cell.seed, held_out)
        if isinstance(learner, Network)
        else learner.fit(chosen, cell.seed)
    )
    trained = time.process_time()
    episodes = [*kept, *trials(env, actor, situations[len(kept) :])]
    return {
        "episodes": episodes,
        "settings": settings_of(learner),
        "expert": {"episodes": len(shown), "successes": sum(one.success for one in shown)},
        "demonstration_seeds": [one.seed for one in chosen],
        "validation_seeds": [one.seed for one in held_out],
        "training_seconds": trained - began,  # of the processor
        "training_outcome": actor.outcome,
        "evaluation_seconds": time.process_time() - trained,
        "versions": {name: version(name) for name in PACKAGES},
    }


def report(results: Results, out: Path) -> None:
    """Write ``results.md``, its picture and ``episodes.parquet`` of all finished cells."""
    found = results.read_all(typer.echo)
    if not found:
        return
    experts = {(one["cell"]["env"], one["cell"]["seed"]): one["expert"] for one in found}
    asked, solved = (
        sum(expert[key] for expert in experts.values()) for key in ("episodes", "successes")
    )
    # its demonstrations are those of the training seed
    shown = [{"demonstration_seed": one["cell"]["seed"], **one["settings"]} for one in found]
    rows = [{**one, "settings": settings} for one, settings in zip(found, shown, strict=True)]
    episodes = episode_table(rows)
    successes_by_group = summary(found)
    paragraphs = (
        "# Meta-World: successes in per cent",
        f"The scripted experts solved {solved} of {asked} situations.",
        successes_by_group,
        "![Success over demonstrations, a panel for each group of tasks](success.webp)",
        comparison_table(episodes),
        task_table(found),
        cost_table(found),
    )
    draw_groups(episodes, out / "success")
    write_table(episodes, out / "episodes")
    write_page(out / "results.md", filter(None, paragraphs))
    typer.echo(successes_by_group)


if __name__ == "__main__":
    app()
