"""``tpgmm camera``: what cameras look at."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

import typer

from tpgmm_tools.arguments import options

app = typer.Typer(help="Print tags and boards for cameras.", add_completion=False)
app.callback()(lambda: None)  # a group, though of one command


@options.command(app, "tpgmm camera print --cube 10,11,12,13,14 --size 40 --out cube.pdf")
def print(
    *,
    tag: list[int] | None = None,
    cube: list[str] | None = None,
    board: bool = False,
    size: float = 40.0,
    family: str = "apriltag_36h11",
    page: Literal["a4", "letter"] = "a4",
    out: Path = Path("targets.pdf"),
) -> None:
    """Write tags, nets of cubes, or a ChArUco board as a PDF in true size.

    Each page has a ruler to check the print, and says what a cell file calls the target.

    Parameters
    ----------
    tag : ``NUMBER``
        A single tag, repeatable.
    cube : ``NUMBER,...``
        A cube to cut out, fold and glue, repeatable: the numbers on its faces +x, -x, +y, -y,
        +z and -z; with five the last one stays free.
    board : bool
        A board to calibrate cameras with.
    size : ``MM``
        Edge of the black squares of tags and cubes, in millimetres.
    family : ``NAME``
        Of tags and cubes: apriltag_36h11, apriltag_25h9, apriltag_16h5, aruco_4x4, aruco_5x5,
        aruco_6x6 or aruco_original.
    page : ``a4 | letter``
        Size of the paper.
    out : ``FILE.pdf``
        Where it goes.
    """
    from tpgmm_vision.printing import print_targets
    from tpgmm_vision.targets import Board

    try:
        cubes = [[int(number) for number in one.split(",")] for one in cube or ()]
    except ValueError as error:
        raise options.refuse(f"--cube has numbers, as 10,11,12,13,14, got {cube}") from error
    style, drawn = {"family": family, "page": page}, Board() if board else None
    entries = print_targets(out, tag or (), cubes, drawn, size=size / 1e3, **style)
    typer.echo(f"{out}: print it at 100 %, and measure the ruler")
    for entry in entries:
        typer.echo(f'"target": {json.dumps(entry)}')
