"""Pick, place, return: three skills that are learned separately, and a grasp that may fail.

The left hand takes a baton, puts it on a stand, and goes back to where it began. Nothing here
is hard; the conditions ``slips`` and ``knocked`` spoil the first grasp.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import mujoco
import numpy as np

from lerobot_env_bimanual.bottle.measures import Figure
from lerobot_env_bimanual.robot_scene import Hold, RobotScene
from lerobot_env_bimanual.suite.handover import (
    BOX,
    FOOT,
    LEFT,
    Handover,
    PutDown,
    on_stand,
)
from lerobot_env_bimanual.suite.task import (
    Box,
    Frames,
    Judge,
    Leg,
    Legs,
    Pose,
    Style,
    raise_pose,
    seen,
    vector,
)
from tpgmm_torch import Canonical, Frame
from tpgmm_torch.operators import Operator

#: The shelf of the task ``shelf``, for the environment and for ``--policy.obstacles``.
SHELF = Path(__file__).with_name("shelf.xml")
#: Where stands are, in the reach of the left hand [m].
STANDS = (0.25, -0.04), (0.32, 0.0)
#: How high the baton is lifted [m].
LIFT = 0.07


class PickPlace(Handover):
    """Take a baton, put it on a stand, and go back, with one hand."""

    name = "pick_place"
    description = "take the baton with the left hand, put it on the stand, go back"
    phases: ClassVar = {
        "reach": 2.0, "close": 1.0, "hold": 0.8, "lift": 1.0, "carry": 2.0, "lower": 1.2,
        "open": 0.8, "away": 1.0, "home": 1.6, "rest": 0.4,
    }  # fmt: skip
    holds: ClassVar[tuple[Hold, ...]] = (LEFT,)
    figures: ClassVar = {
        **{name: Handover.figures[name] for name in ("place_mm", "lean_deg", "put")},
        "home_mm": Figure("hand from its start [mm]", 1, high=50.0),
    }

    def draw(self, rng: np.random.Generator) -> dict[str, Pose]:
        """Draw the baton on the left, the stand in the middle of the table."""
        baton = BOX.draw(rng)
        low, high = ((*corner, baton[2] - FOOT) for corner in STANDS)
        return {"baton": baton, "stand": Box(low, high, BOX.yaw).draw(rng)}

    def legs(self, starts: Frames, poses: Frames, style: Style) -> Legs:
        """Left to the baton, up, to the stand, and back; right nowhere."""
        baton, stand, hand = poses["baton"], poses["stand"], "l_hand"
        place = Frame(stand.transform(vector((0.0, 0.0, FOOT))), stand.orientation)
        left = [
            Leg("reach", self.near(baton, hand, style), free=True),
            Leg("close", self.at_grip(baton, hand)),
            Leg("lift", self.at_grip(raise_pose(baton, LIFT), hand)),
            Leg("carry", self.at_grip(raise_pose(place, LIFT), hand), free=True),
            Leg("lower", self.at_grip(place, hand)),
            Leg("away", self.near(place, hand, style)),
            Leg("home", starts[hand], free=True),
        ]
        return {hand: left, "r_hand": []}

    def judge(self) -> Judge:
        """Opens the hand when the baton is down again."""
        return _Judge()

    def operators(self, orientation: bool = True, held: bool = True) -> list[Operator]:
        """List the hand seen from baton and stand, what it holds, and the joints."""
        own = [seen("baton", "stand", orientation, held)] if held else []
        hand = [seen("l_hand", frame, orientation) for frame in ("baton", "stand")]
        return [*hand, *own, Canonical()]


class _Judge(PutDown):
    hold = LEFT

    def __init__(self) -> None:
        super().__init__()
        self.first: Pose | None = None

    def note(self, scene: RobotScene, seconds: float) -> None:
        self.first = scene.pose("l_hand") if self.first is None else self.first
        super().note(scene, seconds)

    def figures(self, scene: RobotScene) -> dict[str, float]:
        hand = scene.pose("l_hand")
        home = hand - (hand if self.first is None else self.first)
        placed = {**on_stand(scene), "put": float(self.put)}
        return {**placed, "home_mm": 1e3 * float(np.linalg.norm(home[:3]))}


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
        return _Clear()


class _Clear(_Judge):
    def __init__(self) -> None:
        super().__init__()
        self.inside = 0.0

    def note(self, scene: RobotScene, seconds: float) -> None:
        super().note(scene, seconds)
        self.inside = max(self.inside, scene.depth("a shelf"))

    def figures(self, scene: RobotScene) -> dict[str, float]:
        return {**super().figures(scene), "inside_mm": 1e3 * self.inside}
