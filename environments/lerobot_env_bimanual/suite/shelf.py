"""Shelf: pick_place with a low shelf between the arms, which nobody has shown.

Demonstrations are those of ``pick_place``; what is learned from them leads the left forearm
through the shelf. Nothing collides with it, so that it can be measured how deep.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import mujoco

from lerobot_env_bimanual.bottle.measures import Figure
from lerobot_env_bimanual.suite.pick_place import PickPlace, Placing
from lerobot_env_bimanual.suite.scene import SuiteScene
from lerobot_env_bimanual.suite.task import Judge

__all__ = ["SHELF", "Shelf"]

#: The shelf, for the environment and for ``--policy.obstacles``.
SHELF = Path(__file__).with_name("shelf.xml")


class Shelf(PickPlace):
    """Take a baton and put it on a stand, clear of a shelf."""

    name = "shelf"
    description = f"{PickPlace.description}, clear of the shelf"
    figures: ClassVar = {
        **PickPlace.figures,
        "inside_mm": Figure("inside the shelf [mm]", 1, high=0.0),
    }

    def furnish(self, spec: mujoco.MjSpec) -> None:
        """Baton, stand and shelf, with which nothing collides."""
        super().furnish(spec)
        shelf = mujoco.MjSpec.from_file(str(SHELF))
        for geom in shelf.geoms:
            geom.contype = geom.conaffinity = 0
        spec.attach(shelf, prefix="a ", frame=spec.worldbody.add_frame())

    def judge(self) -> Judge:
        """As of ``pick_place``; it keeps how deep anything was in the shelf."""
        return _Judge()


class _Judge(Placing):
    def __init__(self) -> None:
        super().__init__()
        self.inside = 0.0

    def note(self, scene: SuiteScene, seconds: float) -> None:
        super().note(scene, seconds)
        self.inside = max(self.inside, scene.depth("a shelf"))

    def figures(self, scene: SuiteScene) -> dict[str, float]:
        return {**super().figures(scene), "inside_mm": 1e3 * self.inside}
