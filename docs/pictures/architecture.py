"""Picture of the page "Architecture": the table of layers in tests/project/test_layers.py."""

from __future__ import annotations

import ast
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

__all__ = ["draw", "layers"]

TABLE = Path(__file__).parents[2] / "tests" / "project/test_layers.py"
#: What a layer is about, in the order of the table.
TITLES = (
    "errors and storage",
    "algebra",
    "what goes in and out",
    "robots",
    "operators and alignment",
    "mixture: pieces",
    "mixture: EM",
    "reproduction",
    "files",
    "estimator",
    "around it",
    "command line",
)
WIDTH, HEIGHT, GAP = 6.6, 0.46, 0.12
#: Modules side by side; the names of more would run into each other.
MOST = 5


def layers() -> tuple[tuple[str, ...], ...]:
    """``LAYERS``: a module may import those of its own layer and of layers before it."""
    for node in ast.parse(TABLE.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "LAYERS":
            table: tuple[tuple[str, ...], ...] = ast.literal_eval(node.value)
            return table
    raise LookupError(f"{TABLE} has no LAYERS")


def draw(out: Path) -> None:
    """Write ``layers.svg``, the last layer on top: imports point downwards."""
    table = layers()
    lines = [-(-len(modules) // MOST) for modules in table]
    total = sum(lines) * HEIGHT + len(lines) * GAP
    drawing = Figure(figsize=(8.4, total + 0.2))
    axes = drawing.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(-2.1, WIDTH), ylim=(-0.1, total + 0.1))
    axes.axis("off")
    bottom = 0.0
    for title, modules, count in zip(TITLES, table, lines, strict=True):
        middle = bottom + count * HEIGHT / 2
        axes.text(-0.1, middle, title, ha="right", va="center", color="0.35")
        per_line = -(-len(modules) // count)
        for begin in range(0, len(modules), per_line):
            _draw_line(axes, bottom, modules[begin : begin + per_line])
            bottom += HEIGHT
        bottom += GAP
    drawing.savefig(out / "layers.svg")


def _draw_line(axes: Axes, bottom: float, modules: tuple[str, ...]) -> None:
    """Boxes side by side."""
    width = WIDTH / len(modules)
    for column, module in enumerate(modules):
        box = FancyBboxPatch(
            (column * width + 0.06, bottom + 0.03),
            width - 0.12,
            HEIGHT - 0.06,
            boxstyle="round,pad=0,rounding_size=0.08",
            facecolor="#eaf1f8",
            edgecolor="#4878a8",
        )
        axes.add_patch(box)
        axes.text(
            (column + 0.5) * width,
            bottom + HEIGHT / 2,
            module.replace("_", "_\n") if len(module) > 14 and len(modules) > 3 else module,
            ha="center",
            va="center",
            fontsize="small" if len(modules) < 5 else "x-small",
            family="monospace",
            linespacing=0.95,
        )
