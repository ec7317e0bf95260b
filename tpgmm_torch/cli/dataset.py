"""``tpgmm dataset``: what is in a LeRobot data set, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tpgmm_torch.cli import options

if TYPE_CHECKING:
    from tpgmm_datasets import DatasetInfo
    from tpgmm_datasets.description import ColumnInfo

__all__ = ["app"]

app = typer.Typer(help="Look at a LeRobot data set: what is in it, and what is wrong.")


@app.command(epilog="Example: tpgmm dataset info out/demo/dataset")
def info(path: options.Dataset) -> None:
    """Print what a data set holds: features, names, units and ranges, episodes, problems."""
    from tpgmm_datasets import describe_lerobot

    found = describe_lerobot(path)
    for name, value in _summary(found).items():
        typer.echo(f"{name:<10} {value}")
    rows = [("column", "type", "value", "unit", "from", "to")]
    rows += [row for column in found.columns for row in _rows(column)]
    widths = [max(map(len, cells)) for cells in zip(*rows, strict=True)]
    typer.echo()
    for row in rows:
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
        typer.echo("  ".join(cells).rstrip())
    for problem in found.problems:
        typer.echo(f"problem: {problem}")


@app.command(epilog="Example: tpgmm dataset check out/demo/dataset && tpgmm fit ...")
def check(path: options.Dataset) -> None:
    """List all problems of a data set; the exit code is 1 if there are any."""
    from tpgmm_datasets import describe_lerobot

    found = describe_lerobot(path)
    for problem in found.problems:
        typer.echo(problem)
    if found.problems:
        raise typer.Exit(1)
    typer.echo(f"no problems in {len(found.lengths)} episodes, {sum(found.lengths)} rows")


@app.command(epilog="Example: tpgmm dataset plot out/demo/dataset --out out/dataset.png")
def plot(
    path: options.Dataset,
    out: Annotated[Path, typer.Option(metavar="FILE.png", help="Where the picture goes.")],
    frame: options.Frames = None,
    episodes: options.Episodes = None,
    units: options.Units = None,
    joints: options.Joints = None,
    rate: options.Rate = None,
) -> None:
    """Draw the joints and the positions of the frames over time, a line per episode."""
    import numpy as np

    from tpgmm_torch.plotting import figure

    demonstrations = options.read_demonstrations(
        path, None, frame, episodes, units, joints, rate
    )
    first = demonstrations[0]
    panels = list(first.joint_names or (f"joint {i}" for i in range(first.n_joints)))
    panels += [f"{name}.{axis}" for name in first.frames for axis in "xyz"]
    drawing = figure(len(panels), f"{path}: {len(demonstrations)} episodes", height=0.9)
    for demonstration in demonstrations:
        time = demonstration.time.numpy()
        poses = [
            np.broadcast_to(pose.position.numpy(), (len(time), 3))
            for pose in demonstration.frames.values()
        ]
        values = np.concatenate([demonstration.joints.numpy(), *poses], axis=1)
        for axes, column in zip(drawing.axes, values.T, strict=True):
            axes.plot(time, column, linewidth=0.8, alpha=0.7)
    for axes, name in zip(drawing.axes, panels, strict=True):
        axes.set_ylabel(name, fontsize="x-small", rotation=0, ha="right")
        axes.tick_params(labelsize="x-small")
    out.parent.mkdir(parents=True, exist_ok=True)
    drawing.savefig(out, dpi=110)
    typer.echo(out)


def _summary(found: DatasetInfo) -> dict[str, object]:
    lengths = found.lengths
    longest = f", {min(lengths)} to {max(lengths)} rows each" if lengths else ""
    return {
        "path": found.path,
        "layout": found.version,
        "robot": found.robot_type or "not told",
        "rate": f"{found.fps:g} rows per second",
        "episodes": f"{len(lengths)}, {found.duration:.1f} s in all{longest}",
        "tasks": ", ".join(found.tasks) or "none",
        "cameras": f"{', '.join(found.cameras)} (not read)" if found.cameras else "none",
        "joints": found.joints or "not found",
        "frames": ", ".join(found.frames) or "none found",
        "events": ", ".join(found.events) or "none found",
        "problems": len(found.problems) or "none",
    }


def _rows(column: ColumnInfo) -> Iterator[tuple[str, str, str, str, str, str]]:
    """A row per value; the key stands in the first."""
    width = len(column.low or column.names or column.units or (0,))
    for i in range(width):
        yield (
            column.key if i == 0 else "",
            column.dtype if i == 0 else "",
            column.names[i] if column.names else str(i),
            column.units[i] if column.units else "",
            f"{column.low[i]:.4g}" if column.low else "",
            f"{column.high[i]:.4g}" if column.high else "",
        )
