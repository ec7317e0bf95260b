"""Draws the pictures of the pages with the project's own code, before the build.

Each module in ``docs/pictures`` that has ``draw(out)`` writes into ``docs/_pictures``; again
only if a source of the pictures or of the packages is newer.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from sphinx.application import Sphinx
from sphinx.util import logging

from tpgmm_tools.plotting import STYLE

__all__ = ["draw_all", "setup"]

ROOT = Path(__file__).parents[2]
SOURCES = (
    "docs/pictures",
    "tpgmm_torch",
    "datasets/tpgmm_datasets",
    "evaluation/RESULTS.md",
    "tests/project/test_layers.py",
)


def draw_all(out: Path) -> list[str]:
    """Draw what is older than its sources; the names of the modules that drew."""
    paths = [ROOT / source for source in SOURCES]
    files = [f for path in paths for f in ([path] if path.is_file() else path.rglob("*.py"))]
    newest = max(file.stat().st_mtime for file in files)
    drawn = []
    out.mkdir(exist_ok=True)
    for path in sorted((ROOT / "docs" / "pictures").glob("*.py")):
        module = importlib.import_module(path.stem)
        stamp = out / f".{path.stem}"
        if not hasattr(module, "draw"):
            continue
        if not stamp.exists() or stamp.stat().st_mtime < newest:
            with rc_context(STYLE):
                module.draw(out)
            stamp.touch()
            drawn.append(path.stem)
    return drawn


def _draw(app: Sphinx) -> None:
    drawn = draw_all(Path(app.srcdir) / "_pictures")
    logging.getLogger(__name__).info("pictures drawn: %s", ", ".join(drawn) or "none")


def setup(app: Sphinx) -> dict[str, Any]:
    """What Sphinx calls."""
    app.connect("builder-inited", _draw)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
