"""``tpgmm correct``: merge what a person corrected into a model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tpgmm_tools.cli import options
from tpgmm_tools.cli.plugins import OWN, model_format

__all__ = ["app"]

app = typer.Typer()

EXAMPLE = (
    "Example: tpgmm correct out/model --dataset out/corrections --policy out/policy, after "
    "tpgmm fit ... --keep-demonstrations --out out/model and lerobot-rollout "
    "--strategy.type=dagger ..."
)


@app.command(epilog=EXAMPLE)
def correct(
    model: options.Model,
    dataset: Annotated[
        str, typer.Option(help="A LeRobot data set of corrections, one in each episode.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Where the corrected model goes; default: in place."),
    ] = None,
    policy: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Also write a policy that lerobot-rollout takes, if lerobot_policy_tpgmm is "
            "installed.",
        ),
    ] = None,
    forget: Annotated[
        int, typer.Option(help="So many of the oldest demonstrations count no longer.", min=0)
    ] = 0,
    placed: Annotated[
        bool,
        typer.Option(
            "--place/--placed",
            help="Find where in the skill each correction belongs; with --placed their times "
            "are those of the skill.",
        ),
    ] = True,
    frame: options.Frames = None,
    event: options.Events = None,
    episodes: options.Episodes = None,
    units: options.Units = None,
    joints: options.Joints = None,
    joint_name: options.JointNames = None,
    rate: options.Rate = None,
    plausibility: options.Plausibility = "warn",
) -> None:
    """Merge corrections into a model, and go on.

    The corrections are those that lerobot-rollout records with --strategy.type=dagger, or any
    recordings of the skill or of a segment of it. The model must have been saved with its
    demonstrations (tpgmm fit --keep-demonstrations).
    """
    from tpgmm_torch.corrections import in_skill_time
    from tpgmm_torch.estimator import TaskParameterizedGMM

    write = model_format("lerobot") if policy is not None else model_format(OWN)
    fitted = TaskParameterizedGMM.load(model, device="cpu")
    robot = fitted.robot
    recordings = options.recordings(
        dataset, robot, frame, event, episodes, units, joints, joint_name, rate, plausibility
    )
    shown = recordings.corrections()
    if placed:
        shown = in_skill_time(fitted, shown)
    fitted.partial_fit(shown, forget=forget)
    fitted.save(out or model, demonstrations=True)
    for number, one in enumerate(shown):
        typer.echo(f"{number:>4}  {float(one.time[0]):.2f} to {float(one.time[-1]):.2f} s")
    weights = fitted.demonstration_weights_
    assert weights is not None
    typer.echo(f"learned from {int(weights.sum())} demonstrations, saved {out or model}")
    if write is not None and policy is not None:
        write(fitted, policy, recordings.signals())
        typer.echo(f"policy {policy}")
