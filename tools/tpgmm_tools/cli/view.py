"""``tpgmm view``: a motion in three dimensions."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Literal

import typer

from tpgmm_tools.arguments import options

__all__ = ["app"]

app = typer.Typer()

SUFFIXES = {"html": ".html", "rerun": ".rrd"}
EXAMPLE = (
    "tpgmm view out/demo --object bottle=cylinder:0.04,0.2 --situation 1"
    "\n\n"
    "Example: tpgmm view out/model --dataset out/demo/dataset --episodes 0:5 --live"
)


@options.command(app, EXAMPLE)
def view(
    model: Path,
    *,
    data: options.DataOptions,
    out: Path | None = None,
    format_: Literal["html", "rerun"] = "html",
    dataset: str | None = None,
    situations: Path | None = None,
    situation: int = 0,
    object_: list[str] | None = None,
    meshes: Path | None = None,
    fps: float = 25.0,
    obstacles: Path | None = None,
    visuals: bool = False,
    live: bool = False,
    host: str = "127.0.0.1",
    port: int = 8080,
) -> None:
    """Look at a motion in three dimensions.

    Writes one HTML file that needs nothing else: the robot from its URDF, objects, demonstrated
    and reproduced paths, ellipsoids of two standard deviations along the path, a time line,
    curves of stiffness, of each operator's share and of what is held. With --format rerun,
    the same as a recording for Rerun's viewer.

    Parameters
    ----------
    model : ``DIR``
        A model that 'tpgmm fit' saved, or what 'tpgmm demo' wrote: a folder with model/ and
        dataset/.
    out : ``FILE``
        Where it goes; default DIR.html or DIR.rrd.
    format_ : str
        A page, or a Rerun recording (.rrd) of the same.
    dataset : str
        A LeRobot data set: demonstrated paths, and their situations.
    situations : ``FILE.json``
        Situations, as 'tpgmm reproduce' takes them, instead of the data set's.
    situation : int >= 0
        Which of the situations is shown, counted from 0.
    object_ : ``FRAME=SHAPE``
        What an object looks like, repeatable: box:X,Y,Z, cylinder:RADIUS,LENGTH or
        sphere:RADIUS in metres, at the origin of its frame; else a small box.
    meshes : ``FOLDER``
        The robot's mesh files; without them, sticks stand for meshes.
    fps : float >= 1
        Pictures per second.
    obstacles : ``FILE.xml``
        An MJCF with what stands around, as for 'tpgmm reproduce': it is drawn, and with --live
        the controller keeps clear of it.
    visuals : bool
        With --obstacles, take the robot's visual geometry where it has no collision geometry.
    live : bool
        Serve the page instead: objects can be moved by hand, and the skill is reproduced for
        where they are.
    host : str
        Address to listen on, with --live.
    port : int
        First port to try, with --live.
    """
    import torch

    from tpgmm_tools.viewing import LiveView, write_motion, write_rerun
    from tpgmm_torch.exceptions import DataError
    from tpgmm_torch.persistence import load_model

    # the matrices are small: a second thread on a busy machine only spins
    torch.set_num_threads(1)
    suffix = SUFFIXES[format_]
    where, place = model, out or Path(f"{model}{suffix}")
    if place.suffix != suffix:
        raise DataError(f"--out ends in {suffix}, got {str(place)!r}")
    if format_ == "rerun" and live:
        raise DataError("--live serves a page, --format rerun writes a file: give one of them")
    if (model / "model").is_dir() and (model / "dataset").is_dir():
        where, dataset = model / "model", dataset or str(model / "dataset")
    if situations is None and dataset is None:
        raise DataError("give --dataset DATASET or --situations FILE.json: what to show")
    fitted = load_model(where, device="cpu")
    wanted, demonstrations = options.wanted(situations, dataset, data, fitted.kinematics_)
    options.check_situation(situation, len(wanted))
    how = options.look(object_, meshes, obstacles, visuals, fitted.skill, demonstrations)
    how["fps"] = fps
    if live:
        at = {"host": host, "port": port, "first": situation, **how}
        with (
            LiveView(fitted, wanted, demonstrations, **at) as shown,
            suppress(KeyboardInterrupt),
        ):
            typer.echo(f"open {shown.url} in a browser; stop with Ctrl-C")
            shown.run()
        return
    how["title"] = f"{model.resolve().name}, situation {situation}"
    write = write_rerun if format_ == "rerun" else write_motion
    trajectory = write(place, fitted, wanted[situation], demonstrations, **how)
    seconds = float(trajectory.time[-1] - trajectory.time[0])
    typer.echo(f"{seconds:.1f} s of motion, {place.stat().st_size / 1e6:.1f} MB, in {place}")
