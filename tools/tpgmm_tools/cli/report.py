"""``tpgmm report``: what is to be known of a model, on one page."""

from __future__ import annotations

from pathlib import Path

import typer

from tpgmm_tools.arguments import options

app = typer.Typer()

EXAMPLE = "tpgmm report out/demo/model --dataset out/demo/dataset --out out/report.html"


@options.command(app, EXAMPLE)
def report(
    model: Path,
    *,
    dataset: str,
    data: options.DataOptions,
    out: Path | None = None,
    alignment: options.Alignments = "dtw",
    situation: int = 0,
    most: int = 10,
    around: options.SceneOptions,
) -> None:
    """Write one HTML page about a model, for yourself and for those who have to trust it.

    How exactly it reproduces demonstrations that are left out, at events in mm and degrees;
    which operator decides when; speeds and positions against the robot's limits; how new each
    demonstration is to the others; what touches obstacles; the motion in three dimensions.

    Parameters
    ----------
    model : ``DIR``
        A model that 'tpgmm fit' saved.
    dataset : str
        The LeRobot data set that it was learned from.
    out : ``FILE.html``
        Where the page goes; default DIR.html.
    alignment : str
        How episodes are brought onto one clock, as for 'tpgmm fit'.
    situation : int >= 0
        The episode whose situation is shown, counted from 0.
    most : int >= 3
        Of more episodes, only this number is left out, one after the other.
    """
    from tpgmm_tools.report import write_report
    from tpgmm_torch.structure.choices import prepare_demonstrations

    fitted = options.load_one_thread(model)
    robot = fitted.kinematics_
    shown = options.align(data.read(dataset, robot), alignment, robot)
    shown = prepare_demonstrations(shown, fitted.operators_, robot, holds=fitted.holds_ or None)
    options.check_situation(situation, len(shown))
    how = around.read(fitted.skill, shown) | {"situation": situation, "most": most}
    place = out or Path(f"{model}.html")
    folder = model.resolve()
    title = folder.parent.name if folder.name == "model" else folder.name
    with options.show_progress("leaving one out") as progress:
        write_report(place, fitted, shown, title=title, progress=progress, **how)
    typer.echo(f"{place.stat().st_size / 1e6:.1f} MB in {place}")
