"""``tpgmm reproduce``: what a model does in new situations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tpgmm_tools.cli import options

if TYPE_CHECKING:
    from tpgmm_torch.data.demonstrations import Situation
    from tpgmm_torch.data.trajectories import Trajectory
    from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["app"]

app = typer.Typer()

FORMATS = (".parquet", ".csv", ".npz")
EXAMPLE = (
    "Example: tpgmm reproduce out/model --dataset out/demo/dataset --episodes 0:3 "
    "--out out/reproductions.csv"
    "\n\n"
    'A file of situations: [{"joints": {"elbow": 0.3, ...}, "frames": {"bottle": '
    '{"position": [0.3, 0, 0.1], "orientation": [1, 0, 0, 0]}}}, ...]; joints may also be a '
    "list in the model's order."
).replace("[", "\\[")


@app.command(epilog=EXAMPLE)
def reproduce(
    model: options.Model,
    out: Annotated[
        Path, typer.Option(metavar="FILE", help="Where they go: .parquet, .csv or .npz.")
    ],
    situations: Annotated[
        Path | None,
        typer.Option(metavar="FILE.json", help="Situations: start postures and frames."),
    ] = None,
    dataset: Annotated[
        str | None,
        typer.Option(help="Or a LeRobot data set: the situations of its episodes."),
    ] = None,
    frame: options.Frames = None,
    event: options.Events = None,
    episodes: options.Episodes = None,
    units: options.Units = None,
    joints: options.Joints = None,
    joint_name: options.JointNames = None,
    rate: options.Rate = None,
    via: Annotated[
        list[str] | None,
        typer.Option(
            help="A via-point, repeatable: TIME:OPERATOR=NUMBERS~TOLERANCE, as in "
            "3.2:position:l_hand@bottle=0,0,0.1 or 3.2:canonical=l_elbow:0.4; in place of "
            "those that were saved with the model.",
            metavar="VIA",
        ),
    ] = None,
    fade: Annotated[
        float,
        typer.Option(help="Seconds before and after a via-point that it changes.", min=1e-3),
    ] = 1.0,
) -> None:
    """Reproduce a skill in new situations.

    Writes joint references over time and their covariance: a table with one row per time step
    (.parquet, .csv), as tpgmm_torch.data.tables.trajectories_from_frame reads it back, or
    arrays (.npz). Prints a line per situation.
    """
    from tpgmm_torch.data.demonstrations import Situation
    from tpgmm_torch.data.situation_files import read_situations
    from tpgmm_torch.estimator import TaskParameterizedGMM
    from tpgmm_torch.exceptions import DataError, UnknownNameError
    from tpgmm_torch.multimodal import ModeChoice, MultimodalTaskParameterizedGMM
    from tpgmm_torch.persistence import MODES

    if out.suffix not in FORMATS:
        raise DataError(f"--out ends in one of {list(FORMATS)}, got {str(out)!r}")
    if (situations is None) == (dataset is None):
        raise DataError("give either --situations FILE.json or --dataset DATASET")
    fitted: TaskParameterizedGMM | MultimodalTaskParameterizedGMM
    if (model / MODES).is_dir():
        if via:
            raise DataError(f"--via is for one way, as {model / 'mode_0'}")
        fitted = ways = MultimodalTaskParameterizedGMM.load(model, device="cpu")
        kinematics = ways.models_[0].kinematics_
    else:
        fitted = one = TaskParameterizedGMM.load(model, device="cpu")
        kinematics = one.kinematics_
    if dataset is not None:
        recordings = options.recordings(
            dataset, kinematics, frame, event, episodes, units, joints, joint_name, rate
        )
        wanted = [Situation.of(shown) for shown in recordings.demonstrations()]
    elif situations is not None:
        wanted = read_situations(situations, kinematics.joint_names)
    if via:
        fitted = one.with_via_points(via, fade)
    choices: list[ModeChoice] = []
    try:
        if isinstance(fitted, MultimodalTaskParameterizedGMM):
            choices = fitted.choose(wanted)
            trajectories = fitted.predict(wanted, candidates=False, choices=choices)
        else:
            trajectories = fitted.predict(wanted, candidates=False)
    except UnknownNameError as error:
        if error.kind != "frame" or dataset is None:
            raise
        raise DataError(
            f"{error}. Say where it is in the data set, as to 'tpgmm fit': --frame "
            f"{error.name}=FEATURE or --frame {error.name}=LINK@EVENT"
        ) from error
    _write(trajectories, wanted, out)
    for number, trajectory in enumerate(trajectories):
        typer.echo(f"{number:>4}  {_describe(trajectory, kinematics)}")
    for number, choice in enumerate(choices):
        typer.echo(f"{number:>4}  {choice}")
    typer.echo(f"written to {out}")


def _describe(trajectory: Trajectory, kinematics: Kinematics) -> str:
    import torch

    from tpgmm_torch.metrics import largest_acceleration, largest_velocity

    joints, names = trajectory.joints, trajectory.joint_names
    speed = (joints.diff(dim=0) / trajectory.time.diff()[:, None]).abs().amax(0)
    beyond = torch.maximum(kinematics.lower - joints, joints - kinematics.upper).amax(0)
    tolerance = 1e-6
    problems = [
        f"{name} beyond its limit by {float(by):.3g} rad"
        for name, by in zip(names, beyond, strict=True)
        if by > tolerance
    ] + [
        f"{name} faster than its limit"
        for name, value, limit in zip(names, speed, kinematics.velocity, strict=True)
        if value > limit * (1 + tolerance)
    ]
    return (
        f"{float(trajectory.time[-1] - trajectory.time[0]):6.2f} s  "
        f"speed <= {largest_velocity(trajectory):.3g} rad/s  "
        f"acceleration <= {largest_acceleration(trajectory):.3g} rad/s^2  "
        f"{', '.join(problems) or 'within limits'}"
        f"{'' if trajectory.novelty is None else f'  novelty {trajectory.novelty:.2g}'}"
    )


def _write(
    trajectories: Sequence[Trajectory], situations: Sequence[Situation], out: Path
) -> None:
    import numpy as np

    from tpgmm_torch.atomic import replacing
    from tpgmm_torch.data.arrays import as_array
    from tpgmm_torch.data.tables import trajectories_to_frame, write_table

    if out.suffix != ".npz":
        frames = [
            s.frames_at(t.time.cpu()) for t, s in zip(trajectories, situations, strict=True)
        ]
        write_table(trajectories_to_frame(trajectories, frames), out)
        return
    with replacing(out) as new:
        np.savez(
            new,
            episode=np.repeat(np.arange(len(trajectories)), list(map(len, trajectories))),
            time=np.concatenate([as_array(one.time) for one in trajectories]),
            joints=np.concatenate([as_array(one.joints) for one in trajectories]),
            covariance=np.concatenate([as_array(one.covariance) for one in trajectories]),
            joint_names=np.array(trajectories[0].joint_names),
        )
