"""``tpgmm view``: a motion in three dimensions."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from tpgmm_tools.cli import options

__all__ = ["app"]

app = typer.Typer()

SUFFIXES = {"html": ".html", "rerun": ".rrd"}
serving = options.in_panel("Live")
EXAMPLE = (
    "tpgmm view out/demo --object bottle=cylinder:0.04,0.2 --situation 0 --situation 1"
    "\n\n"
    "Example: tpgmm view out/model --dataset out/demo/dataset --episodes 0:5 --live"
)


@options.command(app, EXAMPLE)
def view(
    data: options.DataOptions,
    model: Annotated[
        Path,
        typer.Argument(
            metavar="DIR",
            help="A model that 'tpgmm fit' saved, or what 'tpgmm demo' wrote: a folder with "
            "model/ and dataset/.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Where it goes; default DIR.html or DIR.rrd."),
    ] = None,
    form: Annotated[
        Literal["html", "rerun"],
        typer.Option("--format", help="A page, or a Rerun recording (.rrd) of the same."),
    ] = "html",
    dataset: Annotated[
        str | None,
        typer.Option(help="A LeRobot data set: demonstrated paths, and their situations."),
    ] = None,
    situations: options.Situations = None,
    situation: Annotated[
        list[int],
        typer.Option(
            min=0,
            help="Which of the situations is shown, counted from 0; several side by side.",
        ),
    ] = [0],  # noqa: B006
    shapes: Annotated[
        list[str] | None,
        typer.Option(
            "--object",
            metavar="FRAME=SHAPE",
            help="What an object looks like: box:X,Y,Z, cylinder:RADIUS,LENGTH or "
            "sphere:RADIUS in metres, at the origin of its frame; else a small box.",
        ),
    ] = None,
    meshes: Annotated[
        Path | None,
        options.of_robot(
            "The robot's mesh files; without them, sticks stand for meshes.",
            metavar="FOLDER",
            exists=True,
            file_okay=False,
        ),
    ] = None,
    fps: Annotated[float, typer.Option(min=1, max=200, help="Pictures per second.")] = 25.0,
    live: Annotated[
        bool,
        serving(
            "Serve the page instead: objects can be moved by hand, and the skill is "
            "reproduced for where they are.",
            "--live",
        ),
    ] = False,
    host: Annotated[str, serving("Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, serving("First port to try.", min=0, max=65535)] = 8080,
) -> None:
    """Look at a motion in three dimensions.

    Writes one HTML file that needs nothing else: the robot from its URDF, objects, demonstrated
    and reproduced paths, ellipsoids of two standard deviations along the path, a time line,
    curves of stiffness, of each operator's share and of what is held. With --format rerun,
    the same as a recording for Rerun's viewer.
    """
    import torch

    from tpgmm_tools.viewing import LiveView, parse_shape, write_motion, write_rerun
    from tpgmm_torch.estimator import TaskParameterizedGMM
    from tpgmm_torch.exceptions import DataError

    # the matrices are small: a second thread on a busy machine only spins
    torch.set_num_threads(1)
    suffix = SUFFIXES[form]
    where, place = model, out or Path(f"{model}{suffix}")
    if place.suffix != suffix:
        raise DataError(f"--out ends in {suffix}, got {str(place)!r}")
    if form == "rerun" and (live or len(situation) > 1):
        raise DataError("--format rerun records one situation, and nothing is served")
    if (model / "model").is_dir() and (model / "dataset").is_dir():
        where, dataset = model / "model", dataset or str(model / "dataset")
    if situations is None and dataset is None:
        raise DataError("give --dataset DATASET or --situations FILE.json: what to show")
    fitted = TaskParameterizedGMM.load(where, device="cpu")
    wanted, demonstrations = options.wanted(situations, dataset, data, fitted.kinematics_)
    if (last := max(situation)) >= len(wanted):
        raise DataError(
            f"there are {len(wanted)} situations, counted from 0; got --situation {last}"
        )
    pairs = [text.partition("=") for text in shapes or ()]
    objects = {name: parse_shape(shape) for name, _, shape in pairs}
    how: dict[str, Any] = {"objects": objects, "meshes": meshes, "fps": fps}
    if live:
        at = {"host": host, "port": port, "first": situation[0], **how}
        with (
            LiveView(fitted, wanted, demonstrations, **at) as shown,
            suppress(KeyboardInterrupt),
        ):
            typer.echo(f"open {shown.url} in a browser; stop with Ctrl-C")
            shown.run()
        return
    chosen = [wanted[number] for number in situation]
    how["title"] = f"{model.resolve().name}, situation {', '.join(map(str, situation))}"
    if form == "rerun":
        trajectory = write_rerun(place, fitted, chosen[0], demonstrations, **how)
    else:
        trajectory = write_motion(place, fitted, chosen, demonstrations, **how)
    seconds = float(trajectory.time[-1] - trajectory.time[0])
    typer.echo(f"{seconds:.1f} s of motion, {place.stat().st_size / 1e6:.1f} MB, in {place}")
