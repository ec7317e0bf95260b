"""Handover: the left hand brings a baton, the right hand takes it and puts it on a stand.

Where the hands meet is free. What matters there is where one hand is seen from what the other
holds; afterwards the thing moves with another hand.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import mujoco
import numpy as np

from lerobot_env_bimanual.bottle.measures import Closing, Figure
from lerobot_env_bimanual.eyes.carriers import CUBE_ROOM, cube_at, flat_at
from lerobot_env_bimanual.robot_scene import (
    CYLINDER,
    TABLE,
    Hold,
    RobotScene,
    add_geom,
    add_thing,
)
from lerobot_env_bimanual.suite.task import (
    Box,
    Frames,
    Judge,
    Leg,
    Legs,
    Pose,
    Style,
    SuiteTask,
    raise_pose,
    seen,
    vector,
)
from tpgmm_torch import Canonical, Frame
from tpgmm_torch.operators import Operator

RADIUS, FOOT = 0.02, 0.08
LEFT = Hold("l_hand", "baton", "baton")
RIGHT = Hold("r_hand", "baton", "baton")
#: Where batons and stands are: the box of the baton's centre, and the same on the other side.
BOX = Box((0.24, 0.06, 0.10), (0.32, 0.13, 0.15), 20.0)
#: Where the palms touch the baton, and where they wait, in its frame [m].
GRIP = {"l_hand": (0.0, RADIUS + 0.01, -0.035), "r_hand": (0.0, -RADIUS - 0.01, 0.035)}
WAIT = {"l_hand": (-0.05, 0.1, -0.035), "r_hand": (-0.05, -0.1, 0.035)}
#: Where it changes hands [m], and by how much that differs.
MEETING, MEETING_SPREAD = (0.27, 0.0, 0.17), (0.02, 0.03, 0.015)
#: How high it is lifted before it is carried and lowered, and how near to its place the hand
#: opens [m].
LIFT, PUT = 0.05, 0.01
LIFTED = 0.02


class Handover(SuiteTask):
    """Pass a baton from one hand to the other, and put it on a stand."""

    name = "handover"
    description = "take the baton with the left hand, pass it to the right, put it on the stand"
    foot = FOOT
    phases: ClassVar = {
        "reach": 2.0, "close": 1.0, "hold": 0.6, "raise": 0.8, "bring": 2.0, "meet": 1.2,
        "pass": 0.8, "leave": 1.0, "carry": 2.0, "lower": 1.2, "open": 0.8, "away": 1.0,
        "rest": 0.4,
    }  # fmt: skip
    carriers: ClassVar = {
        "baton": cube_at(10, z=FOOT + CUBE_ROOM),
        "stand": flat_at(20, 0.09, 0.001),
    }
    grasp, box, grip, wait = "close", BOX, GRIP, WAIT
    holds: ClassVar[tuple[Hold, ...]] = (LEFT, RIGHT)
    figures: ClassVar = {
        "place_mm": Figure("on the stand [mm]", 1, high=8.0),
        "lean_deg": Figure("lean [deg]", 1, high=5.0),
        "passed": Figure("passed", 0, 1.0, 1.0),
        "put": Figure("put down", 0, 1.0, 1.0),
    }

    def furnish(self, spec: mujoco.MjSpec) -> None:
        """Add a baton, and a flat stand that nothing collides with."""
        look = {"name": "baton", "rgba": (0.85, 0.3, 0.3, 1)}
        baton, size = add_thing(spec, "baton"), (RADIUS, FOOT, 0)
        add_geom(baton, CYLINDER, size, **look, mass=0.3, conaffinity=TABLE)
        stand = add_thing(spec, "stand", free=False)
        add_geom(stand, CYLINDER, (0.05, 0.001, 0), rgba=(0.2, 0.6, 0.3, 1))

    def draw(self, rng: np.random.Generator) -> dict[str, Pose]:
        """Draw the baton on the left, the stand on the right of the table."""
        baton = BOX.draw(rng)
        return {"baton": baton, "stand": BOX.across(baton[2] - FOOT).draw(rng)}

    def legs(self, starts: Frames, poses: Frames, style: Style) -> Legs:
        """Left to the baton, to the meeting, and back; right to the meeting and the stand."""
        baton, stand = poses["baton"], poses["stand"]
        meeting = Frame(vector(MEETING) + style.free * vector(MEETING_SPREAD))
        place = Frame(stand.transform(vector((0.0, 0.0, FOOT))), stand.orientation)

        left = [
            Leg("reach", self.near(baton, "l_hand", style), free=True),
            Leg("close", self.at_grip(baton, "l_hand")),
            Leg("raise", self.at_grip(raise_pose(baton, LIFT), "l_hand")),
            Leg("bring", self.at_grip(meeting, "l_hand"), free=True),
            Leg("leave", self.near(meeting, "l_hand", style)),
            Leg("carry", starts["l_hand"], free=True),
        ]
        right = [
            Leg("bring", self.near(meeting, "r_hand", style), free=True),
            Leg("meet", self.at_grip(meeting, "r_hand")),
            Leg("carry", self.at_grip(raise_pose(place, LIFT), "r_hand"), free=True),
            Leg("lower", self.at_grip(place, "r_hand")),
            Leg("away", self.near(place, "r_hand", style)),
        ]
        return {"l_hand": left, "r_hand": right}

    def judge(self) -> Judge:
        """Opens the left hand when the right one holds, and that when the baton is down."""
        return _Judge()

    def operators(self, orientation: bool = True, held: bool = True) -> list[Operator]:
        """List the left hand seen from the baton's place, the hands from each other, joints.

        With what is held, the baton from the stand; otherwise the right hand.
        """
        pairs = (("l_hand", "baton"), ("r_hand", "l_hand"))
        last = ("baton" if held else "r_hand", "stand")
        return [*(seen(*pair, orientation) for pair in (*pairs, last)), Canonical()]


class PutDown(Judge):
    """Opens the hand that has lifted the baton when that is down again."""

    hold: ClassVar[Hold]

    def __init__(self) -> None:
        self.time = 0.0
        self.lifted = self.put = False
        self.opening = Closing(reach=PUT)

    def note(self, scene: RobotScene, seconds: float) -> None:
        """Note whether the hand has lifted the baton."""
        self.time += seconds
        self.lifted = self.hold in scene.held and (self.lifted or height(scene) > LIFTED)

    def lets_go(self, scene: RobotScene) -> Sequence[Hold]:
        """Open it when the baton comes no nearer to the table."""
        if self.lifted and self.opening.update(self.time, max(height(scene), 0.0)):
            self.put = True
            return (self.hold,)
        return ()


class _Judge(PutDown):
    hold = RIGHT

    def lets_go(self, scene: RobotScene) -> Sequence[Hold]:
        both = LEFT in scene.held and RIGHT in scene.held
        return (LEFT,) if both else super().lets_go(scene)

    def figures(self, scene: RobotScene) -> dict[str, float]:
        return {
            **on_stand(scene),
            "passed": float(LEFT in scene.taken and RIGHT in scene.taken),
            "put": float(self.put),
        }


def on_stand(scene: RobotScene) -> dict[str, float]:
    """Measure how far the baton is from its place [mm], and how it leans [deg]."""
    baton, stand = scene.pose("baton"), scene.pose("stand")
    away = baton[:3] - stand[:3] - (0.0, 0.0, FOOT)
    return {
        "place_mm": 1e3 * float(np.linalg.norm(away)),
        "lean_deg": math.degrees(2 * math.asin(min(1.0, math.hypot(*baton[4:6])))),
    }


def height(scene: RobotScene) -> float:
    """Return the height of the baton's foot above the table [m]."""
    return float(scene.pose("baton")[2] - FOOT - scene.table)
