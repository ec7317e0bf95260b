"""Pick, place, return: three skills that are learned separately, and a grasp that may fail.

The left hand takes a can, puts it on a mat, and goes back to where it began. Nothing here is
hard; the condition ``slips`` or ``knocked`` spoils the first grasp.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import ClassVar

import mujoco
import numpy as np

from lerobot_env_bimanual.bottle.measures import Closing, Figure
from lerobot_env_bimanual.eyes.carriers import CUBE_ROOM, cube_at, flat_at
from lerobot_env_bimanual.robot_scene import CYLINDER, TABLE, add_geom
from lerobot_env_bimanual.suite.names import MORE
from lerobot_env_bimanual.suite.scene import Hold, SuiteScene, add_thing
from lerobot_env_bimanual.suite.task import (
    Box,
    Judge,
    Leg,
    Pose,
    Style,
    SuiteTask,
    raised,
    seen,
    vector,
)
from tpgmm_torch import Canonical, Demonstration, Frame
from tpgmm_torch.operators import Operator

__all__ = ["PickPlace"]

#: The can's radius and half its height [m].
RADIUS, FOOT = 0.025, 0.06
CAN = Hold("l_hand", "can", "can")
#: Where cans are, and mats beside them.
BOX = Box((0.25, 0.09, 0.08), (0.32, 0.15, 0.13), 20.0)
MATS = (0.25, -0.03), (0.32, 0.01)
#: Where the palm touches the can, and where it waits, in its frame [m].
GRIP = {"l_hand": (0.0, RADIUS + 0.01, 0.0)}
WAIT = {"l_hand": (-0.05, 0.1, 0.0)}
#: How high the can is lifted, from when on it counts as lifted, and how near to the table the
#: hand opens [m].
LIFT, LIFTED, PUT = 0.07, 0.03, 0.01
#: The last phase of each skill.
SKILLS = {"pick": "lift", "place": "away", "home": "rest"}


class PickPlace(SuiteTask):
    """Take a can, put it on a mat, and go back."""

    name = "pick_place"
    description = "take the can with the left hand, put it on the mat, go back"
    objects = MORE["pick_place"]
    foot = FOOT
    phases: ClassVar = {
        "reach": 2.0, "close": 1.0, "hold": 0.8, "lift": 1.0, "carry": 2.0, "lower": 1.2,
        "open": 0.8, "away": 1.0, "home": 1.6, "rest": 0.4,
    }  # fmt: skip
    carriers: ClassVar = {"can": cube_at(10, z=FOOT + CUBE_ROOM), "mat": flat_at(20, 0.09, 0.001)}
    grasp, box, grip, wait = "close", BOX, GRIP, WAIT
    holds = (CAN,)
    figures: ClassVar = {
        "place_mm": Figure("on the mat [mm]", 1, high=15.0),
        "lean_deg": Figure("lean [deg]", 1, high=5.0),
        "put": Figure("put down", 0, 1.0, 1.0),
        "home_mm": Figure("hand from its start [mm]", 1, high=50.0),
    }

    def furnish(self, spec: mujoco.MjSpec) -> None:
        """A can, and a mat that nothing collides with."""
        can, mat = add_thing(spec, "can"), add_thing(spec, "mat", free=False)
        look = {"name": "can", "rgba": (0.85, 0.3, 0.3, 1)}
        add_geom(can, CYLINDER, (RADIUS, FOOT, 0), **look, mass=0.3, conaffinity=TABLE)
        add_geom(mat, CYLINDER, (0.05, 0.001, 0), rgba=(0.2, 0.6, 0.3, 1))

    def draw(self, rng: np.random.Generator) -> dict[str, Pose]:
        """The can on the left, the mat in the middle of the table."""
        can = BOX.draw(rng)
        low, high = ((*corner, can[2] - FOOT) for corner in MATS)
        return {"can": can, "mat": Box(low, high, BOX.yaw).draw(rng)}

    def legs(
        self, starts: Mapping[str, Frame], poses: Mapping[str, Frame], style: Style
    ) -> Mapping[str, Sequence[Leg]]:
        """Left to the can, up, to the mat, and back; right nowhere."""
        can, mat, hand = poses["can"], poses["mat"], "l_hand"
        place = Frame(mat.transform(vector((0.0, 0.0, FOOT))), mat.orientation)
        left = [
            Leg("reach", self.near(can, hand, style), free=True),
            Leg("close", self.at_grip(can, hand)),
            Leg("lift", self.at_grip(raised(can, LIFT), hand)),
            Leg("carry", self.at_grip(raised(place, LIFT), hand), free=True),
            Leg("lower", self.at_grip(place, hand)),
            Leg("away", self.near(place, hand, style)),
            Leg("home", starts[hand], free=True),
        ]
        return {hand: left, "r_hand": []}

    def judge(self) -> Judge:
        """Opens the hand when the can is down again."""
        return _Judge()

    def operators(self, orientation: bool = True, held: bool = True) -> list[Operator]:
        """The hand seen from where the can was and from the mat; what it holds; the joints."""
        pairs = (("l_hand", "can"), ("l_hand", "mat"))
        own = [seen("can", "mat", orientation, held)] if held else []
        return [*(seen(*pair, orientation) for pair in pairs), *own, Canonical()]

    def operators_of(self, skill: str, orientation: bool = True) -> list[Operator]:
        """The subspaces of one skill, learned by itself."""
        pairs = {
            "pick": [seen("l_hand", "can", orientation)],
            "place": [
                seen("can", "mat", orientation, True), seen("l_hand", "mat", orientation),
            ],
        }  # fmt: skip
        return [*pairs.get(skill, []), Canonical()]

    @staticmethod
    def parts(recorded: Demonstration) -> dict[str, Demonstration]:
        """What is recorded of each skill, each on a clock that begins at 0."""
        ends = [-math.inf, *(recorded.events[last] for last in SKILLS.values())]
        found = {}
        for name, (begin, end) in zip(SKILLS, pairwise(ends), strict=True):
            part = recorded.at_steps((recorded.time > begin) & (recorded.time <= end))
            time = part.time - part.time[0]
            found[name] = Demonstration(time, part.joints, part.frames, part.joint_names)
        return found


class _Judge(Judge):
    def __init__(self) -> None:
        self.time = 0.0
        self.lifted = self.put = False
        self.first: Pose | None = None
        self.opening = Closing(reach=PUT)

    def note(self, scene: SuiteScene, seconds: float) -> None:
        if self.first is None:
            self.first = scene.pose("l_hand")
        self.time += seconds
        self.lifted = CAN in scene.held and (self.lifted or self._height(scene) > LIFTED)

    def lets_go(self, scene: SuiteScene) -> Sequence[Hold]:
        if self.lifted and self.opening.update(self.time, max(self._height(scene), 0.0)):
            self.put = True
            return (CAN,)
        return ()

    def figures(self, scene: SuiteScene) -> dict[str, float]:
        can, mat, hand = (scene.pose(name) for name in ("can", "mat", "l_hand"))
        first = hand if self.first is None else self.first
        away = can[:3] - mat[:3] - (0.0, 0.0, FOOT)
        return {
            "place_mm": 1e3 * float(np.linalg.norm(away)),
            "lean_deg": math.degrees(2 * math.asin(min(1.0, math.hypot(*can[4:6])))),
            "put": float(self.put),
            "home_mm": 1e3 * float(np.linalg.norm(hand[:3] - first[:3])),
        }

    def _height(self, scene: SuiteScene) -> float:
        """Of the can's foot above the table [m]."""
        return float(scene.pose("can")[2] - FOOT - scene.table)
