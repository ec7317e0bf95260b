"""``tpgmm compare``: what a number of demonstrations buys with each policy."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from tpgmm_torch.exceptions import DataError

__all__ = ["app"]

app = typer.Typer(add_completion=False)

EXAMPLES = """Examples:

tpgmm compare --demonstrations 5,10 --workers 2 --out out/compare (the reduced grid, as
'make compare')

tpgmm compare --demonstrations 5,10,25,50 --seeds 0,1,2 --episodes 100 --budget 30
--workers 8 --out out/full (the full grid)

tpgmm compare --demonstrations 10 --policies tpgmm --conditions all --out out/conditions
(every condition, beside the open loop of 0.1.0, as 'make conditions')

tpgmm compare --policies "tpgmm,tpgmm --policy.feedback=observation"
--conditions pushes,stopped-3,moved+pose-noise --out out/disturbed

tpgmm compare --env aloha_state --demonstrations 25 --out out/aloha
"""


@app.command(epilog=EXAMPLES)
def compare(
    env: Annotated[
        str,
        typer.Option(
            help="bottle_shaking, carry_and_put, aloha_state (cube transfer) or "
            "aloha_insertion."
        ),
    ] = "bottle_shaking",
    policies: Annotated[
        str,
        typer.Option(
            metavar="NAME,...",
            help="Among tpgmm, tpgmm-open-loop (by the clock, as in 0.1.0), tpgmm-places "
            "(objects are where they were at first), tpgmm-position-only, act, act-phase, "
            "diffusion, diffusion-phase, nearest; or all but the second and third. A tpgmm may "
            "have settings: 'tpgmm --policy.FIELD=VALUE'. Beside disturbances the open loop is "
            "always there.",
        ),
    ] = "all",
    demonstrations: Annotated[
        str, typer.Option(metavar="N,...", help="Numbers of demonstrations to learn from.")
    ] = "5,10",
    seeds: Annotated[str, typer.Option(metavar="N,...", help="Of the training.")] = "0",
    conditions: Annotated[
        str,
        typer.Option(
            metavar="NAME,...",
            help="Of the evaluation: nominal, or disturbances of the environment joined by +: "
            "pushes, noise, and what --env.condition takes (stopped-3, pushed-back, moved, "
            "pose-lost, ...); or all.",
        ),
    ] = "nominal",
    episodes: Annotated[
        int, typer.Option(min=1, help="Evaluation episodes, the same for all.")
    ] = 50,
    budget: Annotated[
        float,
        typer.Option(
            min=0,
            help="Minutes of one processor after which the training of a baseline ends even "
            "if its validation error still falls.",
        ),
    ] = 6.0,
    workers: Annotated[int, typer.Option(min=1, help="Processes, of one thread each.")] = 1,
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Where everything goes, and is found again.")
    ] = Path("out/compare"),
) -> None:
    """Compare TP-GMM with ACT, Diffusion Policy and a naive floor in simulation.

    Every policy learns from the same episodes and is rolled out on the same seeds through
    LeRobot's own rollout. ACT and Diffusion are LeRobot's, plain and informed of the time
    ('-phase'), and trained until their error on held-out episodes has stopped falling.

    The folder gets the episodes (LeRobot data sets), the trained policies (for lerobot-eval
    --policy.path), tables, figures and report.md. What is finished there is not run again, so a
    run that was stopped goes on, and a grid can grow.
    """
    from lerobot_policy_tpgmm.environments.disturbances import NOMINAL
    from lerobot_policy_tpgmm.evaluation.compare import compare as run
    from lerobot_policy_tpgmm.evaluation.jobs import POLICIES
    from lerobot_policy_tpgmm.evaluation.settings import Settings
    from lerobot_policy_tpgmm.evaluation.variants import OPEN_LOOP

    settings = Settings(env, episodes=episodes, budget=60 * budget)
    usual = [policy for policy in POLICIES if policy != "tpgmm-places"]
    chosen = usual if policies == "all" else policies.split(",")
    every = settings.benchmark().all_conditions
    tried = list(every) if conditions == "all" else conditions.split(",")
    if "tpgmm" in chosen and OPEN_LOOP not in chosen and tried != [NOMINAL]:
        chosen.insert(chosen.index("tpgmm") + 1, OPEN_LOOP)
    result = run(
        settings,
        out,
        chosen,
        _numbers(demonstrations, "--demonstrations"),
        _numbers(seeds, "--seeds"),
        tried,
        workers,
        typer.echo,
        shlex.join(["tpgmm", *sys.argv[1:]]),
    )
    if result.failures:
        typer.echo(f"{len(result.failures)} cells failed", err=True)
        raise typer.Exit(1)


def _numbers(text: str, option: str) -> list[int]:
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise DataError(f"{option} takes numbers like 5,10,25, got {text!r}") from None
