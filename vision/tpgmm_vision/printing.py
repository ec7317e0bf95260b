"""Printed targets as PDF in true size: tags, nets of cubes, ChArUco boards."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib import style
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from tpgmm_torch.atomic import replacing
from tpgmm_torch.exceptions import DataError
from tpgmm_vision.poses import Array
from tpgmm_vision.targets import DEFAULT_FAMILY, Board, dictionary_of, modules_of, target_from

__all__ = ["print_targets"]

#: Width and height of pages [mm].
PAGES = {"a4": (210.0, 297.0), "letter": (215.9, 279.4)}
#: What printers leave white at each edge of a page, at most; height of the ruler and the words
#: below; white between tags; width of a flap for glue; length of the ruler: [mm].
MARGIN, FOOTER, GAP, FLAP, RULER = 7.0, 26.0, 4.0, 8.0, 100
#: Modules of this size are a few dots of any printer [mm].
SMALLEST_MODULE = 0.5
MM_PER_INCH, POINTS_PER_MM = 25.4, 72 / 25.4
#: The faces of :func:`tpgmm_vision.targets.cube`, and their column and row in the net, in which
#: all tags are upright.
NET = {"+x": (1, 1), "-x": (3, 1), "+y": (2, 1), "-y": (0, 1), "+z": (1, 2), "-z": (1, 0)}
#: The outline of a square: edges 0 to 3 are below, right, above and left.
RING = np.array([(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)])
ADVICE = (
    "Print at 100 % (actual size). Measure the ruler, and squares in both directions. If the "
    f"ruler has L mm: print at {100 * RULER} / L %, or multiply sizes by L / {RULER}."
)
FOLD = "Cut along full lines, fold along dashed ones, print outside, glue the flaps: a cube of"
GLUE = "Glue the board onto something stiff and flat, such as glass."
CELL = 'In the cell file: "target": '
UNITS = "sizes are in mm in the command, in m in Python"


def print_targets(
    path: str | Path,
    tags: Sequence[int] = (),
    cubes: Sequence[Sequence[int]] = (),
    board: Board | None = None,
    *,
    size: float = 0.04,
    family: str = DEFAULT_FAMILY,
    page: str = "a4",
) -> list[dict[str, Any]]:
    """Write targets as a PDF in true size, with a ruler on each page to check the print.

    A cube is a net to cut out, fold and glue; it has the geometry of
    :func:`tpgmm_vision.targets.cube`.

    Parameters
    ----------
    path : str or Path
        The PDF.
    tags : sequence of int
        Numbers of single tags.
    cubes : sequence of sequences of int
        Numbers on the faces +x, -x, +y, -y, +z and -z of each cube; five leave the last one
        free.
    board : Board, optional
        For the calibration of cameras.
    size : float, default=0.04
        Edge of the black squares of tags and cubes [m].
    family : str, default="apriltag_36h11"
        Of the tags and cubes, one of :data:`tpgmm_vision.targets.FAMILIES`.
    page : {"a4", "letter"}

    Returns
    -------
    list of dict
        What a cell file says of each tag and cube, its ``"target"``.

    Raises
    ------
    DataError
        If there is nothing to print, a number occurs twice, the family is not known, or
        something is too large for the page or too small to be printed.
    """
    single, nets = _describe_targets(tags, cubes, size, family)
    if not (single or nets or board) or page not in PAGES:
        raise DataError(
            "there are tags, cubes and a board to print (--tag, --cube, --board) on pages "
            f"{list(PAGES)}, got {tags=}, {cubes=}, {board=}, {page=}"
        )
    with (
        style.context(["default", {"pdf.fonttype": 42}]),
        replacing(path) as new,
        PdfPages(new, metadata={"Title": "Targets in true size"}) as pdf,
    ):
        figures = [*_tags(single, page), *(_cube(entry, page) for entry in nets)]
        for figure in [*figures, _board(board, page)] if board else figures:
            pdf.savefig(figure)
    return single + nets


def _describe_targets(
    tags: Sequence[int], cubes: Sequence[Sequence[int]], size: float, family: str
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Describe tags and cubes as a cell file does, and refuse numbers that do not fit."""
    numbers = [*tags, *chain(*cubes)]
    if twice := sorted({number for number in numbers if numbers.count(number) > 1}):
        raise DataError(f"tags {twice} are asked for twice; one number belongs to one place")
    usual = {"size": size} | ({} if family == DEFAULT_FAMILY else {"family": family})
    single: list[dict[str, Any]] = [{"tag": int(number)} | usual for number in tags]
    nets: list[dict[str, Any]] = [{"cube": list(map(int, faces))} | usual for faces in cubes]
    for entry in single + nets:
        target_from(entry | {"size": 1.0}, json.dumps(entry))  # sizes are checked by the page
    return single, nets


# Sizes are in mm from here on, and the origin of a page is its upper left corner in the margin.


def _tags(entries: Sequence[Mapping[str, Any]], page: str) -> Iterator[Any]:
    """Pages of single tags, with lines to cut along."""
    if not entries:
        return
    size, _, side = _sizes(entries[0])
    words = f"{CELL}{json.dumps(entries[0])}, each with its number."
    axes, free = _axes(page, words, "a tag", size, side, (1, 0), (1, 0))
    columns, rows = (int((most + GAP) // (side + GAP)) for most in free)
    for place, entry in enumerate(entries[: columns * rows]):
        corner = np.array([place % columns, -(place // columns)]) * (side + GAP) - (0, side)
        _line(axes, corner + side * RING)
        _face(axes, entry, entry["tag"], corner, f"{size:g} mm")
    yield axes.figure
    yield from _tags(entries[columns * rows :], page)


def _cube(entry: Mapping[str, Any], page: str) -> Any:
    """Draw the net of a cube."""
    size, _, side = _sizes(entry)
    words = f"{FOLD} {side:g} mm.\n{CELL}{json.dumps(entry)}."
    axes, _ = _axes(page, words, "a cube with tags", size, side, (4, FLAP), (3, 2 * FLAP))
    numbers = dict(zip(NET, entry["cube"], strict=False))
    for face, cell in NET.items():
        corner = side * np.array(cell) - (0, FLAP + 3 * side)
        _face(axes, entry, numbers.get(face), corner, face)
        for edge, (start, end) in enumerate(pairwise(corner + side * RING)):
            along = (end - start) / side
            out = np.array([along[1], -along[0]])
            joined = tuple((out + cell).round().astype(int)) in NET.values()
            flap = not joined and (face[1] == "z" or (face, edge) == ("-x", 1))
            if not joined or edge in (1, 2):  # an edge of two faces only once
                _line(axes, [start, end], **({"dashes": (8, 6)} if joined or flap else {}))
            if flap:
                wide = min(FLAP, side / 4)
                tip = start + wide * (out + along), end + wide * (out - along)
                _line(axes, [start, *tip, end])
    return axes.figure


def _board(board: Board, page: str) -> Any:
    """Draw a board."""
    square, marker, drawn = board.square * 1e3, board.marker * 1e3, board.drawn
    columns, rows = drawn.getChessboardSize()
    words = f"{columns} x {rows} squares of {square:g} mm, {board.family} of {marker:g} mm."
    sizes = square, square, (columns, 0), (rows, 0)
    axes, free = _axes(page, f"{words} {GLUE}", "a board with squares", *sizes)
    corner = np.array([(free[0] - columns * square) / 2, 0])
    markers = np.array(drawn.getObjPoints())[:, :, :2] * (1e3, -1e3)  # whose y is down
    for number, one in zip(drawn.getIds().ravel(), markers, strict=True):
        _tag(axes, board.family, int(number), corner + one[3], marker)
    black = np.argwhere(np.indices((columns, rows)).sum(axis=0) % 2 == 0)
    _fill(axes, corner + square * (black * (1, -1) - (0, 1)), square)
    return axes.figure


def _sizes(entry: Mapping[str, Any]) -> tuple[float, float, float]:
    """Edges of the black square, of a module, and of the tag with a module of white around it.

    Raises
    ------
    DataError
        If it is too small to be printed.
    """
    modules, size = modules_of(entry.get("family", DEFAULT_FAMILY)), entry["size"] * 1e3
    if not (least := modules * SMALLEST_MODULE) <= size < np.inf:
        raise DataError(f"a tag to print has at least {least:g} mm, got {size:g} mm: {UNITS}")
    return size, size / modules, size + 2 * size / modules


def _axes(
    page: str, words: str, what: str, size: float, edge: float, *extent: tuple[float, float]
) -> tuple[Any, tuple[float, float]]:
    """Axes of a page with the ruler and words below, and the free width and height.

    The page is upright, or else turned, so that something fits: ``extent`` says how many edges,
    and how much more, this needs in width and height.

    Raises
    ------
    DataError
        If it fits on neither; the message says which size would.
    """
    sheets = PAGES[page], PAGES[page][::-1]
    frees = [(width - 2 * MARGIN, height - 2 * MARGIN - FOOTER) for width, height in sheets]
    (columns, across), (rows, along) = extent
    fits = [min((width - across) / columns, (height - along) / rows) for width, height in frees]
    if edge > max(fits):
        most = f"{np.floor(max(fits) * size / edge):g} mm would: {UNITS}"
        raise DataError(f"{what} of {size:g} mm does not fit on a page {page!r}, {most}")
    turned = edge > fits[0]
    (width, height), free = sheets[turned], frees[turned]
    axes = Figure(figsize=(width / MM_PER_INCH, height / MM_PER_INCH)).add_axes((0, 0, 1, 1))
    axes.axis((-MARGIN, width - MARGIN, MARGIN - height, MARGIN))
    axes.axis("off")
    y = -free[1] - 10
    _line(axes, [(0, y), (RULER, y)], color="0")
    for step in range(0, RULER + 1, 10):
        _line(axes, [(step, y), (step, y + (2 if step % 50 else 4))], color="0")
    axes.text(RULER + 2, y, f"{RULER} mm", fontsize=8)
    axes.text(0, y - 2, f"{ADVICE}\n{words}", fontsize=6.5, va="top", linespacing=1.3)
    return axes, free


def _line(axes: Any, points: Any, **style: Any) -> None:
    """Draw a thin line through points."""
    axes.plot(*np.array(points).T, **{"color": "0.5", "linewidth": 0.4} | style)


def _fill(axes: Any, squares: Array, size: float) -> None:
    """Fill squares, given by their lower left corners (n, 2), as one path.

    In one path, viewers and printers see no seams between neighbours.
    """
    path = Outline.make_compound_path_from_polys(squares[:, None] + RING[:4] * size)
    axes.add_patch(PathPatch(path, facecolor="0", edgecolor="none"))


def _tag(axes: Any, family: str, number: int, corner: Array, size: float) -> None:
    """Draw a tag's black modules; ``corner`` is the lower left one of its black square."""
    count = modules_of(family)
    picture = cv2.aruco.generateImageMarker(dictionary_of(family), number, count)
    _fill(axes, corner + np.argwhere(picture[::-1] == 0)[:, ::-1] * size / count, size / count)


def _face(axes: Any, entry: Any, number: int | None, corner: Array, words: str) -> None:
    """Draw a tag, if any, and the white around it, at the outer edge of which words stand."""
    size, module, _ = _sizes(entry)
    if number is not None:
        family = entry.get("family", DEFAULT_FAMILY)
        _tag(axes, family, number, corner + module, size)
        words = f"{number}   {words}"
    points = min(7.0, 0.4 * module * POINTS_PER_MM)
    axes.text(*(corner + 0.1 * module), words, fontsize=points, color="0.5")
