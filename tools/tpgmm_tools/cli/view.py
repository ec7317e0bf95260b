"""``tpgmm view``: a motion in three dimensions."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import typer

from tpgmm_tools.arguments import options

app = typer.Typer()

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
    format_: str = "html",
    dataset: str | None = None,
    situations: Path | None = None,
    situation: int = 0,
    fps: float = 25.0,
    around: options.SceneOptions,
    live: bool = False,
    host: str = "127.0.0.1",
    port: int = 8080,
) -> None:
    """Look at a motion in three dimensions.

    Writes one HTML file that needs nothing else: the robot from its URDF, objects, demonstrated
    and reproduced paths, ellipsoids of two standard deviations along the path, a time line,
    curves of stiffness, of each operator's share and of what is held.

    Parameters
    ----------
    model : ``DIR``
        A model that 'tpgmm fit' saved, or what 'tpgmm demo' wrote: a folder with model/ and
        dataset/.
    out : ``FILE.html``
        Where it goes; default DIR.html.
    format_ : ``html``
        The only one that is left.
    dataset : str
        A LeRobot data set: demonstrated paths, and their situations.
    situations : ``FILE.json``
        Situations, as 'tpgmm reproduce' takes them, instead of the data set's.
    situation : int >= 0
        Which of the situations is shown, counted from 0.
    fps : float >= 1
        Pictures per second.
    live : bool
        Serve the page instead: objects can be moved by hand, and the skill is reproduced for
        where they are.
    host : str
        Address to listen on, with --live.
    port : int
        First port to try, with --live.
    """
    from tpgmm_tools.viewing import LiveView, write_motion

    if format_ != "html":
        raise options.refuse(
            f"a motion is written as one HTML file, not as {format_!r}: leave --format out"
        )
    folder, place = model, out or Path(f"{model}.html")
    if place.suffix != ".html":
        raise options.refuse(f"--out ends in .html, got {str(place)!r}")
    if (folder / "model").is_dir() and (folder / "dataset").is_dir():
        model, dataset = folder / "model", dataset or str(folder / "dataset")
    if not (dataset or situations):
        raise options.refuse("give --dataset DATASET or --situations FILE.json: what to show")
    fitted = options.load_one_thread(model)
    known, shown = options.read_situations(situations, dataset, data, fitted.kinematics_)
    options.check_situation(situation, len(known))
    how = around.read(fitted.skill, shown) | {"fps": fps}
    if live:
        served = LiveView(fitted, known, shown, host=host, port=port, first=situation, **how)
        with served, suppress(KeyboardInterrupt):
            typer.echo(f"open {served.url} in a browser; stop with Ctrl-C")
            served.run()
        return
    title = f"{folder.resolve().name}, situation {situation}"
    time = write_motion(place, fitted, known[situation], shown, title=title, **how).time
    size = place.stat().st_size / 1e6
    typer.echo(f"{float(time[-1] - time[0]):.1f} s of motion, {size:.1f} MB, in {place}")
