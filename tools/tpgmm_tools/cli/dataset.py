"""``tpgmm dataset``: look at LeRobot data sets, and write them."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from itertools import chain, repeat, zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from tpgmm_tools.arguments import options

if TYPE_CHECKING:
    from tpgmm_datasets.description import ColumnInfo, DatasetInfo
    from tpgmm_datasets.lerobot.layout import Episode
    from tpgmm_datasets.reader import Recording
    from tpgmm_torch.data.demonstrations import Demonstration


app = typer.Typer(
    help="Look at LeRobot data sets, or write one: generated, or converted.",
    add_completion=False,
)

CONVERT = "tpgmm dataset convert recordings/arm out/arm --units deg --rate 30"


@options.command(app, "tpgmm dataset info out/demo/dataset")
def info(
    path: str,
) -> None:
    """Print what a data set holds: features, names, units and ranges, episodes, problems.

    Parameters
    ----------
    path : str
        A LeRobot data set: its folder, or hf://datasets/OWNER/NAME.
    """
    from tpgmm_datasets.description import describe_lerobot
    from tpgmm_datasets.errors import list_problems
    from tpgmm_torch.checks.report import in_columns

    description = describe_lerobot(path)
    for name, value in _summary(description).items():
        typer.echo(f"{name:<10} {value}")
    head = ("column", "type", "value", "unit", "from", "to")
    rows = [row for column in description.columns for row in _rows(column)]
    typer.echo(f"\n{in_columns([head, *rows])}")
    for problem in list_problems(description.problems):
        typer.echo(f"problem: {problem}")


@options.command(app, "tpgmm dataset check arm --robot arm.urdf && tpgmm fit ...")
def check(
    path: str,
    *,
    described: options.RobotOptions,
    data: options.DataOptions,
    strict: bool = False,
) -> None:
    """List all problems of a data set, and what is implausible in it.

    The exit code is 1 if there are problems or something cannot be: values beyond any limit of
    the robot, for example. What is unlikely is listed; with --strict it fails too.

    Parameters
    ----------
    path : str
        A LeRobot data set: its folder, or hf://datasets/OWNER/NAME.
    strict : bool
        Fail for what is only unlikely, too.
    """
    from tpgmm_datasets.description import describe_lerobot
    from tpgmm_datasets.errors import CHECKS, list_problems

    description = describe_lerobot(path)
    problems = [problem for problem in description.problems if problem.check != "joints"]
    for problem in list_problems(problems):
        typer.echo(problem)
    if problems:
        raise typer.Exit(1)
    # all problems in one go, not the first
    recording = data.open(path, described.read(), relax=CHECKS)
    typer.echo(
        f"no problems in {len(description.lengths)} episodes, {sum(description.lengths)} rows"
    )
    if description.tracked:
        typer.echo(f"tracked: {_sum_up_tracking(description)}")
    findings = _check_plausibility(recording, strict)
    for kind, finding in findings:
        typer.echo(f"{kind}: {finding}")
    if any(strict or kind == "error" for kind, _ in findings):
        raise typer.Exit(1)


def _check_plausibility(recording: Recording, strict: bool) -> list[tuple[str, object]]:
    """Return errors, and what is unlikely; exit where units are not known."""
    from tpgmm_datasets.errors import DatasetError, DatasetWarning, UnknownUnitsError

    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", DatasetWarning)
            report = recording.check()
    except UnknownUnitsError as error:  # no fault of the set
        typer.echo(f"cannot say whether it is plausible: {error}")
        raise typer.Exit(1 if strict else 0) from error
    except DatasetError as error:
        return [("error", error)]
    bad = [one.message for one in caught if issubclass(one.category, DatasetWarning)]
    found = [("error" if one.impossible else "unlikely", one) for one in report]
    return [*(("error", message) for message in bad), *found]


@options.command(app, "tpgmm dataset plot out/demo/dataset --out out/dataset.png")
def plot(
    path: str,
    *,
    out: Path,
    data: options.DataOptions,
) -> None:
    """Draw the joints and the positions of the frames over time, a line per episode.

    Parameters
    ----------
    path : str
        A LeRobot data set: its folder, or hf://datasets/OWNER/NAME.
    out : ``FILE.png``
        Where the picture goes.
    """
    import torch

    from tpgmm_tools.plotting import figure, save

    demonstrations = data.read(path)
    first = demonstrations[0]
    panels = list(first.joint_names or (f"joint {i}" for i in range(first.n_joints)))
    panels += [f"{name}.{axis}" for name in first.frames for axis in "xyz"]
    drawing = figure(len(panels), f"{path}: {len(demonstrations)} episodes", height=0.9)
    for one in demonstrations:
        frames = [frame.expand(one.time.shape).position for frame in one.frames.values()]
        values = torch.cat([one.joints, *frames], dim=1)
        for axes, column in zip(drawing.axes, values.T, strict=True):
            axes.plot(one.time, column, linewidth=0.8, alpha=0.7)
    for axes, name in zip(drawing.axes, panels, strict=True):
        axes.set_ylabel(name, fontsize="x-small", rotation=0, ha="right")
        axes.tick_params(labelsize="x-small")
    out.parent.mkdir(parents=True, exist_ok=True)
    typer.echo(save(drawing, out))


@options.command(app, "tpgmm dataset generate out/shake --n-demonstrations 20")
def generate(
    path: Path,
    *,
    n_demonstrations: int = 10,
    random_state: int = 0,
    rate: int = 100,
    steady_rhythm: bool = False,
    append: bool = False,
) -> None:
    """Write generated demonstrations of shaking a bottle with two hands, as in 'tpgmm demo'.

    Parameters
    ----------
    path : Path
        Folder of the set to write.
    n_demonstrations : int >= 1
        How many episodes.
    random_state : int >= 0
        Seed; appended episodes differ if it does.
    rate : int >= 1
        Time steps per second.
    steady_rhythm : bool
        Shake equally fast in all, as the environment 'bottle_shaking' asks.
    append : bool
        Add the episodes to the set in PATH, if there is one.
    """
    from tpgmm_datasets.bottle.skill import TASK, BottleShaking
    from tpgmm_datasets.errors import DatasetError

    if path.exists() and not append:  # the writer would say so too, ten seconds later
        raise DatasetError(f"{path} exists; remove it, or add episodes to it with --append")
    skill = BottleShaking(rate=rate, steady_rhythm=steady_rhythm)
    shown = skill.demonstrations(n_demonstrations, random_state)
    _save(shown, path, append, fps=rate, task=TASK, robot_type="upper_body")


@options.command(app, CONVERT)
def convert(
    source: str,
    path: Path,
    *,
    described: options.RobotOptions,
    data: options.DataOptions,
    append: bool = False,
    task: str | None = None,
) -> None:
    """Write a converted data set: layout v3.0, joints in radians, some episodes or joints.

    Reads any set that the other commands read, v2.1 too. Joints, frames, events and actions are
    kept, as float32, actions that are no postures become the next joints; pictures stay behind.

    Parameters
    ----------
    source : str
        A LeRobot data set: its folder, or hf://datasets/OWNER/NAME.
    path : Path
        Folder of the set to write.
    append : bool
        Add the episodes to the set in PATH, if there is one.
    task : str
        What is done, for all. Default: each episode's own.
    """
    recording = data.open(source, described.read())
    demonstrations = list(recording.demonstrations())
    layout, columns = recording.assembly.layout, recording.assembly.joints
    kept = demonstrations[0].joint_names or ()
    stored = {"m": "m", "mm": "m", "raw": "raw"}  # what is no angle once it is read
    units = {
        name: stored[unit]
        for name, unit in zip(columns.names or (), columns.units, strict=False)
        if name in kept and unit in stored
    }
    tasks = [task] * len(demonstrations) if task else _tasks(recording.episodes)
    about = {"task": tasks, "robot_type": layout.robot_type, "units": units}
    _save(demonstrations, path, append, fps=data.rate or layout.fps, **about)


@options.command(
    app, "tpgmm dataset add-frames recordings/arm --frame cup=poses.csv --out out/arm"
)
def add_frames(path: str, *, frame: list[str], out: Path) -> None:
    """Write a copy of a data set (v3.0) with measured poses of objects.

    They are put into observation.environment_state, where lerobot-train sees them too; 'tpgmm
    fit' takes the table itself. Videos are linked or copied.

    Parameters
    ----------
    path : str
        A LeRobot data set: its folder.
    frame : ``NAME=POSES.csv``
        An object and its poses, repeatable: a table (.csv or .parquet) with columns episode,
        x, y, z in metres, and yaw in radians or qw, qx, qy, qz if it is turned; and time in
        seconds, if it moves.
    out : ``DIR``
        Folder of the copy.
    """
    from tpgmm_datasets.text import parse_frames
    from tpgmm_datasets.writer import add_frames

    frames = parse_frames(frame) or {}
    add_frames(path, out, frames)
    typer.echo(f"{', '.join(frames)} added to the copy {out}")


@options.command(
    app, "tpgmm dataset track arm tracked --cell cell.json --robot so101 --units lerobot"
)
def track(
    path: str,
    out: Path,
    *,
    cell: Path,
    described: options.RobotOptions,
    units: list[str] | None = None,
    joint_name: list[str] | None = None,
) -> None:
    """Write a copy of a data set (v3.0) with the objects that its own pictures show.

    Their poses are put into observation.environment_state, where lerobot-train and 'tpgmm fit'
    find them; tracking.seen and tracking.known say where they were measured, and where they
    were measured or inferred. Videos are linked or copied; report.html in the copy shows what
    was found. With a robot, what a hand carries is known while it is covered.

    Parameters
    ----------
    path : str
        A LeRobot data set: its folder.
    out : ``DIR``
        Folder of the copy.
    cell : ``CELL.json``
        Cameras, objects and joint offsets, as 'tpgmm calibrate' writes them.
    units : ``[JOINT=]UNIT``
        Unit of the stored joints, as of 'tpgmm fit', repeatable.
    joint_name : ``STORED=JOINT``
        The robot's name of a stored joint, as of 'tpgmm fit', repeatable.
    """
    from tpgmm_datasets.text import parse_joint_names, parse_units
    from tpgmm_torch.checks.report import in_columns
    from tpgmm_torch.exceptions import PlausibilityWarning
    from tpgmm_vision.episodes.report import table
    from tpgmm_vision.episodes.tracking import track_lerobot

    robot = described.read()
    reading = {**parse_units(units or ()), "joint_names": parse_joint_names(joint_name or ())}
    with options.show_progress("tracking") as progress:
        reports = track_lerobot(path, out, cell, robot, **reading, progress=progress)
    typer.echo(in_columns(table(reports)))
    known = {str(one.index): [t.known.mean() for t in one.tracks.values()] for one in reports}
    if unknown := [index for index, shares in known.items() if min(shares) < 0.95]:
        carried = "" if robot else "With --robot, what hands carry is known. "
        text = (
            f"objects are unknown for a while in episodes {','.join(unknown)}, and their last "
            f"poses are repeated. {carried}Leave such episodes out of 'tpgmm fit' (--episodes)"
        )
        warnings.warn(text, PlausibilityWarning, stacklevel=1)
    typer.echo(f"{len(reports)} episodes tracked in the copy {out}; look at {out}/report.html")


def _tasks(episodes: Sequence[Episode]) -> list[str]:
    """Return the task of each episode, which must have one."""
    for episode in episodes:
        if len(episode.tasks) != 1:
            raise options.refuse(
                f"episode {episode.index} has {len(episode.tasks)} tasks, not one: give --task"
            )
    return [episode.tasks[0] for episode in episodes]


def _save(
    demonstrations: Sequence[Demonstration], path: Path, append: bool, **described: Any
) -> None:
    from tpgmm_datasets.writer import save_lerobot

    save_lerobot(demonstrations, path, append=append, **described)
    rows = sum(map(len, demonstrations))
    typer.echo(f"{len(demonstrations)} episodes, {rows} rows written to {path}")


def _summary(description: DatasetInfo) -> dict[str, object]:
    lengths, cameras = description.lengths, ", ".join(description.cameras)
    longest = f", {min(lengths)} to {max(lengths)} rows each" if lengths else ""
    return {
        "path": description.path,
        "layout": description.version,
        "robot": description.robot_type or "not given",
        "rate": f"{description.fps:g} rows per second",
        "episodes": f"{len(lengths)}, {description.duration:.1f} s in all{longest}",
        "tasks": ", ".join(description.tasks) or "none",
        "cameras": f"{cameras} (not read)" if cameras else "none",
        "joints": description.joints or "not found",
        "frames": ", ".join(description.frames) or "none found",
        "events": ", ".join(description.events) or "none found",
        "tracked": _sum_up_tracking(description),
        "problems": len(description.problems) or "none",
    }


def _sum_up_tracking(description: DatasetInfo) -> str:
    """Say how often objects were seen in the pictures."""
    shares = description.tracked.items()
    found = [f"{name} seen in {a:.0%}, known in {b:.0%} of all rows" for name, (a, b) in shares]
    return ", ".join(found) or "none"


def _rows(column: ColumnInfo) -> Iterator[tuple[str, ...]]:
    """Make a row for each value; the key stands in the first."""
    width = len(column.low or column.names or column.units or (0,))
    names = column.names or map(str, range(width))
    low, high = ([f"{x:.4g}" for x in ends or ()] for ends in (column.low, column.high))
    keys = chain([(column.key, column.dtype)], repeat(("", "")))
    rows = zip_longest(names, column.units or (), low, high, fillvalue="")
    yield from ((*key, *values) for key, values in zip(keys, rows, strict=False))
