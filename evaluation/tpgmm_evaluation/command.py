"""``tpgmm compare``: what a number of demonstrations buys with each policy."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import typer

from tpgmm_tools.arguments import options

app = typer.Typer(add_completion=False)

EXAMPLES = """tpgmm compare --env suite --demonstrations 3,10 --policies quick --episodes 10
--workers 2 --out out/compare (a quick look, as 'make compare')

tpgmm compare --env all --demonstrations 3,10 --seeds 0,1,2 --episodes 100 --conditions all
--budget 30 --workers 8 --out out/evidence (everything)

tpgmm compare --demonstrations 10 --policies tpgmm --conditions all --out out/conditions
(every condition, beside the open loop of 0.1.0, as 'make conditions')

tpgmm compare --policies "tpgmm,tpgmm --policy.control.feedback=observation"
--conditions pushes,stopped-3,moved+pose-noise --out out/disturbed

tpgmm compare --env aloha_state,carry_and_put --demonstrations 25 --out out/two

tpgmm compare --report-only --out out/two
"""


@options.command(app, EXAMPLES)
def compare(
    *,
    env: str = "bottle_shaking",
    policies: str = "all",
    demonstrations: str = "5,10",
    seeds: str = "0",
    demonstration_seed: int | None = None,
    conditions: str = "nominal",
    episodes: int = 50,
    budget: float = 6.0,
    workers: int = 1,
    out: Path = Path("out/compare"),
    report_only: bool = False,
) -> None:
    """Compare TP-GMM with ACT, Diffusion Policy and a naive floor in simulation.

    Every policy learns from the same episodes and is rolled out on the same seeds through
    LeRobot's own rollout. ACT and Diffusion are LeRobot's, plain and informed of the time
    ('-phase'), and trained until their error on held-out episodes has stopped falling.

    The folder gets report.md, which begins with where TP-GMM loses, figures, results.parquet
    with a row for each episode, and for each environment a folder with its episodes (LeRobot
    data sets), its cells and trained policies (for lerobot-eval --policy.path). What
    is finished there is not run again, so a run that was stopped goes on, and a grid can grow.

    Parameters
    ----------
    env : ``NAME,...``
        Tasks: bottle_shaking, carry_and_put, aloha_state (cube transfer), aloha_insertion, ...
        (a wrong name lists them); suite: all of the upper body; suite-viperx: its tasks on
        gym-aloha's arms (lid-viperx, ...), suite-g1: on a Unitree G1; all.
    policies : ``NAME,...``
        Among tpgmm; it without one of its parts, tpgmm-open-loop (by the clock, as in 0.1.0),
        tpgmm-even-clock, tpgmm-places (objects are where they were at first),
        tpgmm-position-only, tpgmm-no-joints, tpgmm-auto; key-poses, key-poses-posture; act,
        act-large (LeRobot's sizes), diffusion, each also with the time, -phase; nearest,
        mean; all, of tpgmm with all parts and without orientation, of act the
        small one; or quick: of these, all that no gradient trains. A tpgmm may have settings:
        'tpgmm --policy.FIELD=VALUE'. Beside disturbances the open loop is always there.
    demonstrations : ``N,...``
        Numbers of demonstrations to learn from.
    seeds : ``N,...``
        Of the training and of the demonstrations it learns from.
    demonstration_seed : int >= 0
        The same demonstrations for all seeds; the intervals then do not tell how much others
        would change.
    conditions : ``NAME,...``
        Of the evaluation: nominal, or disturbances of the environment joined by +: pushes,
        noise, and what --env.condition takes (stopped-3, pushed-back, moved, pose-lost, ...);
        or all.
    episodes : int >= 1
        Evaluation episodes, the same for all.
    budget : float >= 0
        Minutes of one processor after which the training of a baseline ends even if its
        validation error still falls.
    workers : int >= 1
        Processes, of one thread each.
    out : ``DIR``
        Where everything goes, and is found again.
    report_only : bool
        Write the report again from what is in --out; run nothing.
    """
    from lerobot_env_bimanual.disturbances import NOMINAL
    from tpgmm_evaluation import compare as module
    from tpgmm_evaluation.benchmarks import GROUPS
    from tpgmm_evaluation.cells import parse_numbers
    from tpgmm_evaluation.settings import Settings
    from tpgmm_evaluation.variants import OPEN_LOOP

    if report_only:
        typer.echo(module.rewrite_report(out, typer.echo))
        return
    settings = [
        Settings(
            name, episodes=episodes, budget=60 * budget, demonstration_seed=demonstration_seed
        )
        for name in _expand(env, GROUPS)
    ]
    chosen = _policies(policies)
    tried = conditions.split(",")
    if "tpgmm" in chosen and OPEN_LOOP not in chosen and tried != [NOMINAL]:
        chosen.insert(chosen.index("tpgmm") + 1, OPEN_LOOP)
    result = module.compare(
        settings,
        out,
        chosen,
        parse_numbers(demonstrations, "--demonstrations"),
        parse_numbers(seeds, "--seeds"),
        tried,
        workers,
        typer.echo,
        shlex.join(["tpgmm", *sys.argv[1:]]),
    )
    if result.failures:
        typer.echo(f"{len(result.failures)} cells failed", err=True)
        raise typer.Exit(1)


def _policies(text: str) -> list[str]:
    """Return the policies that are meant, each once."""
    from tpgmm_evaluation.baselines import RECIPES
    from tpgmm_evaluation.jobs import POLICIES
    from tpgmm_evaluation.trainings import ABLATIONS

    rare = {*ABLATIONS, "act-large", "act-large-phase"} - {"tpgmm-position-only"}
    usual = [name for name in POLICIES if name not in rare]
    groups = {"all": usual, "quick": [name for name in usual if name not in RECIPES]}
    return _expand(text, groups)


def _expand(text: str, groups: Mapping[str, Sequence[str]]) -> list[str]:
    parts = (groups.get(part, [part]) for part in text.split(","))
    return list(dict.fromkeys(name for names in parts for name in names))
