"""``tpgmm reproduce``: what a model does in new situations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tpgmm_torch.cli import options
from tpgmm_torch.cli.plugins import TABLES, required

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
    episodes: options.Episodes = None,
    units: options.Units = None,
    joints: options.Joints = None,
    rate: options.Rate = None,
) -> None:
    """Reproduce a skill in new situations.

    Writes joint references over time: a table with one row per time step (.parquet as
    tpgmm_datasets.demonstrations_to_frame makes it, .csv with plain column names), or arrays
    (.npz). Prints a line per situation.
    """
    from tpgmm_torch.data.demonstrations import Situation
    from tpgmm_torch.data.situation_files import read_situations
    from tpgmm_torch.estimator import TaskParameterizedGMM
    from tpgmm_torch.exceptions import DataError

    if out.suffix not in FORMATS:
        raise DataError(f"--out ends in one of {list(FORMATS)}, got {str(out)!r}")
    if (situations is None) == (dataset is None):
        raise DataError("give either --situations FILE.json or --dataset DATASET")
    fitted = TaskParameterizedGMM.load(model, device="cpu")
    kinematics = fitted.kinematics_
    if dataset is not None:
        wanted = [
            Situation.of(demonstration)
            for demonstration in options.recordings(
                dataset, kinematics, frame, episodes, units, joints, rate
            ).demonstrations()
        ]
    elif situations is not None:
        wanted = read_situations(situations, kinematics.joint_names)
    trajectories = fitted.predict(wanted, candidates=False)
    _write(trajectories, wanted, out)
    for number, trajectory in enumerate(trajectories):
        typer.echo(f"{number:>4}  {_describe(trajectory, kinematics)}")
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
    )


def _write(
    trajectories: Sequence[Trajectory], situations: Sequence[Situation], out: Path
) -> None:
    import numpy as np

    from tpgmm_torch.atomic import replacing
    from tpgmm_torch.data.demonstrations import Demonstration

    table = required(TABLES, "pandas")(
        [
            Demonstration(t.time, t.joints, s.frames_at(t.time), t.joint_names)
            for t, s in zip(trajectories, situations, strict=True)
        ]
    )
    with replacing(out) as new:
        if out.suffix == ".parquet":
            table.to_parquet(new)
        elif out.suffix == ".csv":
            table.set_axis(table.columns.get_level_values("name"), axis=1).to_csv(new)
        else:
            np.savez(
                new,
                episode=table.index.get_level_values("episode").to_numpy(),
                time=table.index.get_level_values("time").to_numpy(),
                joints=table["joint"].to_numpy(),
                joint_names=np.array(trajectories[0].joint_names),
            )
