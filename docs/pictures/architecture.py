"""Picture of the page "Architecture": the rooms of the core, from the test of the layers."""

from __future__ import annotations

import ast
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

__all__ = ["draw", "floors"]

TABLE = Path(__file__).parents[2] / "tests" / "project" / "test_layers.py"
WIDTH, HEIGHT, GAP = 6.6, 0.46, 0.12


def floors() -> tuple[tuple[str, ...], ...]:
    """The core's ``ROOMS``: a room may import from those of the floors before its own."""
    for node in ast.parse(TABLE.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.AnnAssign) and ast.unparse(node.target) == "ROOMS":
            assert node.value is not None
            table: dict[str, tuple[tuple[str, ...], ...]] = ast.literal_eval(node.value)
            return table["tpgmm_torch"]
    raise LookupError(f"{TABLE} has no ROOMS")


def draw(out: Path) -> None:
    """Write ``rooms.svg``, the last floor on top: imports point downwards."""
    table = floors()
    total = len(table) * (HEIGHT + GAP)
    drawing = Figure(figsize=(6.8, total + 0.2))
    axes = drawing.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(-0.1, WIDTH + 0.1), ylim=(-0.1, total + 0.1))
    axes.axis("off")
    for number, rooms in enumerate(table):
        _draw_floor(axes, number * (HEIGHT + GAP), rooms)
    drawing.savefig(out / "rooms.svg")


def _draw_floor(axes: Axes, bottom: float, rooms: tuple[str, ...]) -> None:
    """Boxes side by side."""
    width = WIDTH / len(rooms)
    for column, room in enumerate(rooms):
        box = FancyBboxPatch(
            (column * width + 0.06, bottom + 0.03),
            width - 0.12,
            HEIGHT - 0.06,
            boxstyle="round,pad=0,rounding_size=0.08",
            facecolor="#eaf1f8",
            edgecolor="#4878a8",
        )
        axes.add_patch(box)
        middle = (column + 0.5) * width, bottom + HEIGHT / 2
        axes.text(*middle, room, ha="center", va="center", fontsize="small", family="monospace")
