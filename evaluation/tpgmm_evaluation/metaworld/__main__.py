"""All tasks of Meta-World from few demonstrations: ``make metaworld``.

What is done is kept, one file for each cell: a run that is broken off goes on where it was, and
one with more episodes adds those that are new.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any

import torch
import typer

from lerobot_env_bimanual.metaworld.state import MetaworldStateEnv
from lerobot_env_bimanual.metaworld.tasks import TASKS, check_task
from tpgmm_evaluation.cells import Cell, Job, Results, parse_numbers, run_cells
from tpgmm_evaluation.metaworld.learners import LEARNERS, Actor, Learner, settings_of
from tpgmm_evaluation.metaworld.networks import Network
from tpgmm_evaluation.metaworld.recordings import (
    evaluation_seeds,
    record_expert,
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
from tpgmm_evaluation.metaworld.trials import try_out
from tpgmm_evaluation.report.pages import write_page
from tpgmm_evaluation.report.tables import episode_table, write_table
from tpgmm_tools.arguments import options
from tpgmm_torch.exceptions import UnknownNameError

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
    workers: int = 1,
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
    workers : int >= 1
        Processes, of one thread each.
    out : ``DIR``
        Where results are.
    """
    names = TASKS if tasks == "all" else [check_task(name) for name in tasks.split(",")]
    learners = _choose_learners(policies.split(","), 60 * budget)
    results = Results(out / ("tuning" if tuning else "cells"))
    situations = evaluation_seeds(episodes, tuning=tuning)
    counts = parse_numbers(demonstrations, "--demonstrations")
    grid = list(product(parse_numbers(seeds, "--seeds"), counts, learners))
    jobs = []
    for task in names:
        cells = [
            cell
            for cell in (Cell(task, policy, n, seed) for seed, n, policy in grid)
            if len(_read_episodes(results, cell, learners[cell.policy], situations)) < episodes
        ]
        if cells:
            arguments = cells, learners, results, situations, record
            jobs.append(Job(cells, results, arguments))
    failures = run_cells(measure_cells, jobs, workers, typer.echo)
    report(results, out)
    if failures:
        typer.echo(f"{len(failures)} cells failed", err=True)
        raise typer.Exit(1)


def _choose_learners(names: Sequence[str], budget: float) -> dict[str, Learner]:
    """Select learners by their names, networks with a budget [s]."""
    learners: dict[str, Learner] = {}
    for name in names:
        if name not in LEARNERS:
            raise UnknownNameError("policy", name, "the benchmark", LEARNERS)
        learner = LEARNERS[name]
        if isinstance(learner, Network):
            learner = replace(learner, budget=budget)
        learners[name] = learner
    return learners


def _read_episodes(
    results: Results, cell: Cell, learner: Learner, situations: Sequence[int]
) -> list[dict[str, Any]]:
    """Read episodes of a cell in the first of these situations, of the same settings."""
    found = results.read(cell)
    if found is None or found["settings"] != settings_of(learner):
        return []
    seeds = [episode["seed"] for episode in found["episodes"]]
    same = seeds[: len(situations)] == [*situations][: len(seeds)]
    return list(found["episodes"]) if same else []


def measure_cells(
    cells: Sequence[Cell],
    learners: dict[str, Learner],
    results: Results,
    situations: Sequence[int],
    record: int,
) -> None:
    """Learn a task, and try what was learned in the situations that are missing.

    Parameters
    ----------
    cells : sequence of Cell
        Of one task.
    learners : dict
        By the names of policies.
    results : Results
        Beside whose folder demonstrations are kept.
    situations : sequence of int
        Seeds of the episodes.
    record : int
        Episodes of the expert at least.
    """
    torch.set_num_threads(1)
    env, folder = MetaworldStateEnv(cells[0].env), results.folder.parent / "demonstrations"
    for cell in cells:
        learner = learners[cell.policy]
        done = _read_episodes(results, cell, learner, situations)
        shown = record_expert(folder, cell.env, cell.seed, cell.demonstrations, record)
        chosen = successes(shown, cell.demonstrations, cell.env)
        held_out = validation(folder, cell.env) if isinstance(learner, Network) else []
        began = time.process_time()
        actor: Actor = learner.fit(chosen, cell.seed, held_out)
        trained = time.process_time()
        episodes = [*done, *try_out(env, actor, situations[len(done) :])]
        results.write(
            cell,
            {
                "episodes": episodes,
                "settings": settings_of(learner),
                "expert": {"episodes": len(shown), "successes": sum(e.success for e in shown)},
                "demonstration_seeds": [episode.seed for episode in chosen],
                "validation_seeds": [episode.seed for episode in held_out],
                "training_seconds": trained - began,  # of the processor
                "training_outcome": actor.outcome,
                "evaluation_seconds": time.process_time() - trained,
                "versions": {name: version(name) for name in PACKAGES},
            },
        )
    env.close()


def report(results: Results, out: Path) -> None:
    """Write ``results.md``, its picture and ``episodes.parquet`` of all finished cells."""
    found = results.read_all(typer.echo)
    if not found:
        return
    experts = {(cell["cell"]["env"], cell["cell"]["seed"]): cell["expert"] for cell in found}
    asked, solved = (
        sum(expert[key] for expert in experts.values()) for key in ("episodes", "successes")
    )
    for cell in found:  # its demonstrations are those of the training seed
        cell["settings"]["demonstration_seed"] = cell["cell"]["seed"]
    episodes = episode_table(found)
    successes_by_group = summary(episodes)
    paragraphs = (
        "# Meta-World: successes in per cent",
        f"The scripted experts solved {solved} of {asked} situations.",
        successes_by_group,
        "![Success over demonstrations, a panel for each group of tasks](success.webp)",
        comparison_table(episodes),
        task_table(episodes),
        cost_table(found),
    )
    draw_groups(episodes, out / "success")
    write_table(episodes, out / "episodes")
    write_page(out / "results.md", "\n\n".join(filter(None, paragraphs)))
    typer.echo(successes_by_group)


if __name__ == "__main__":
    app()
