"""All tasks of Meta-World from few demonstrations: ``make metaworld``.

What is done is kept, one file for each cell: a run that is broken off goes on where it was, and
one with more episodes adds those that are new.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import typer

from lerobot_env_bimanual.metaworld.tasks import TASKS, check_task
from tpgmm_evaluation.cells import Cell, Job, Results, parse_numbers, run_cells
from tpgmm_evaluation.metaworld.learners import LEARNERS, Learner
from tpgmm_evaluation.metaworld.networks import Network
from tpgmm_evaluation.metaworld.recordings import evaluation_seeds
from tpgmm_evaluation.metaworld.summary import (
    comparison_table,
    cost_table,
    draw_groups,
    summary,
    task_table,
)
from tpgmm_evaluation.metaworld.trials import measure_cells, read_episodes
from tpgmm_evaluation.report.pages import write_page
from tpgmm_evaluation.report.tables import episode_table, write_table
from tpgmm_tools.arguments import options
from tpgmm_torch.exceptions import UnknownNameError

app = typer.Typer(add_completion=False)


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
            if len(read_episodes(results, cell, learners[cell.policy], situations)) < episodes
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
