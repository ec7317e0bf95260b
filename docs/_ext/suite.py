"""Directive ``suite``: what the tasks of the suite say of themselves, one section each."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from lerobot_env_bimanual.suite.names import SUITE
from lerobot_env_bimanual.suite.tasks import suite_task

__all__ = ["Suite", "section", "setup"]

IMAGES = Path(__file__).parents[1] / "images" / "suite"
COMMANDS = """```bash
tpgmm compare --env {name} --demonstrations 3,10 --policies tpgmm,nearest --out out/{name}
lerobot-eval --policy.path=POLICY --env.type=bimanual --env.task={name} --eval.n_episodes=50
```"""


def section(name: str) -> str:
    """What there is to say of a task, in Markdown."""
    return "\n\n".join(_parts(name))


def _parts(name: str) -> Iterator[str]:
    task = suite_task(name)
    text = (sys.modules[type(task).__module__].__doc__ or "").strip()
    title, _, rest = text.partition(": ")
    yield f"### {title}"
    yield rest[:1].upper() + rest[1:]
    if (IMAGES / f"{name}.webp").is_file():
        yield f"![{title}: three moments of an expert's episode](../images/suite/{name}.webp)"
    objects = ", ".join(f"`{thing}`" for thing in task.objects)
    phases = ", ".join(f"{phase} {seconds:g} s" for phase, seconds in task.phases.items())
    yield f'`{name}`: "{task.description}". Observed: {objects}. Phases: {phases}.'
    rows = [
        f"| `{name}` | {figure.heading} | {_bounds(figure.low, figure.high)} |"
        for name, figure in task.figures.items()
        if figure.has_limit
    ]
    yield "\n".join(("| figure | | in a success |", "|---|---|---|", *rows))
    yield COMMANDS.format(name=name)


def _bounds(low: float, high: float) -> str:
    if low == high:
        return f"{low:g}"
    return f"at least {low:g}" if math.isinf(high) else f"{low:g} to {high:g}"


class Suite(SphinxDirective):
    """A section for each task."""

    def run(self) -> list[nodes.Node]:
        """Ask the tasks."""
        text = "\n\n".join(map(section, SUITE))
        return self.parse_text_to_nodes(text, allow_section_headings=True)


def setup(app: Sphinx) -> dict[str, Any]:
    """What Sphinx calls."""
    app.add_directive("suite", Suite)
    return {"parallel_read_safe": True}
