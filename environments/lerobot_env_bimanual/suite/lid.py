"""Lid: the left hand steadies a box, the right one opens its hinged lid and closes it again.

Both hands hold one mechanism that moves about one axis: the way is a circle about the hinge,
along which the hand turns with the lid. Key poses at its ends do not say so, and whoever takes
the chord between them pulls the box away, or loses the grip.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import mujoco
import numpy as np
import torch
from torch import Tensor

from lerobot_env_bimanual.bottle.measures import Closing, Figure
from lerobot_env_bimanual.eyes.carriers import CUBE_ROOM, cube_at
from lerobot_env_bimanual.robot_scene import BOX as CUBOID
from lerobot_env_bimanual.robot_scene import TABLE, Hold, RobotScene, add_geom, add_thing
from lerobot_env_bimanual.suite.task import (
    Box,
    Frames,
    Judge,
    Leg,
    Legs,
    Pose,
    Style,
    SuiteTask,
    vector,
)
from tpgmm_datasets.bottle.skill import place_hand
from tpgmm_torch import Frame, quaternions
from tpgmm_torch.motion.minimum_jerk import minimum_jerk

#: Half of the box along x, y and z [m]; its origin is in its middle.
HALF = (0.05, 0.06, 0.04)
#: The hinge is the upper right edge, the lid's origin; the knob stands on the lid, where the
#: left hand does not come in its way [m].
HINGE = (0.0, -HALF[1], HALF[2])
KNOB, KNOB_HALF = (0.0, 0.08, 0.015), (0.02, 0.008, 0.015)
HELD = Hold("l_hand", "box", "box")
LID = Hold("r_hand", "lid", "knob")
#: Where boxes are: the box of their origins, and how they are turned [m, deg].
AREA = Box((0.25, -0.055, 0.065), (0.30, -0.03, 0.09), 12.0)
#: Half of a palm's thickness [m].
PALM = 0.01
#: Where the palms touch: the left one in the box's frame, the right one in the lid's [m].
SIDE = (-0.02, HALF[1] + PALM, 0.02)
GRIP = (0.0, KNOB[1] - KNOB_HALF[1] - PALM, KNOB[2])
#: How the right hand is rolled where the lid is shut: as far one way as it will be the other
#: when it is open [deg].
ROLL = -35.0
ORIGIN = (0.0, 0.0, 0.0)
#: Where they wait, in the box's frame [m].
WAIT = {"l_hand": (-0.06, 0.11, 0.02), "r_hand": (-0.06, -0.04, 0.08)}
#: How far people open the lid, and by how much that differs [deg].
OPENED, SPREAD = 90.0, 3.0
#: From where on it counts as open, and up to where as shut [deg]; for how long it stays open
#: at least [s].
OPEN, SHUT, KEPT = 80.0, 5.0, 2.0


class Lid(SuiteTask):
    """Hold a box with the left hand, open its lid with the right one, and close it."""

    name = "lid"
    description = "hold the box with the left hand, open its lid with the right, close it"
    foot = HALF[2]
    phases: ClassVar = {
        "reach": 2.0, "close": 1.0, "hold": 0.6, "open": 2.5, "keep": 2.0, "shut": 2.5,
        "release": 0.8, "away": 1.2, "rest": 0.4,
    }  # fmt: skip
    carriers: ClassVar = {"box": cube_at(10, HALF[0] + CUBE_ROOM)}
    grasp, box = "close", AREA
    holds = (HELD, LID)
    # the hands from each other: the closed chain
    pairs = (("l_hand", "box"), ("r_hand", "box"), ("r_hand", "l_hand"))
    figures: ClassVar = {
        "opened_deg": Figure("opened [deg]", 1, low=OPEN),
        "kept_s": Figure("kept open [s]", 1, low=KEPT),
        "box_mm": Figure("box moved [mm]", 1, high=5.0),
        "shut_deg": Figure("shut to [deg]", 1, high=SHUT),
        "grips": Figure("grips kept", 0, 1.0, 1.0),
        "pull_n": Figure("pull [N]"),
    }

    def furnish(self, spec: mujoco.MjSpec) -> None:
        """Add a box, and on it a lid with a knob, which turns about the upper right edge."""
        wide, deep, _ = HALF
        box = add_thing(spec, "box")
        look = {"name": "box", "rgba": (0.75, 0.6, 0.4, 1)}
        rough = {"friction": (0.4, 0.005, 0.0001), "conaffinity": TABLE}
        add_geom(box, CUBOID, HALF, mass=0.4, **look, **rough)
        lid = box.add_body(name="lid", pos=HINGE)
        lid.add_joint(
            name="lid", type=mujoco.mjtJoint.mjJNT_HINGE, axis=(1, 0, 0),
            limited=mujoco.mjtLimited.mjLIMITED_TRUE, range=(0.0, math.radians(110.0)),
            damping=0.01, frictionloss=0.02,
        )  # fmt: skip
        look = {"pos": (0, deep, 0.003), "rgba": (0.6, 0.45, 0.3, 1)}
        add_geom(lid, CUBOID, (wide, deep, 0.003), mass=0.08, **look)
        look = {"name": "knob", "pos": KNOB, "rgba": (0.3, 0.3, 0.35, 1)}
        add_geom(lid, CUBOID, KNOB_HALF, mass=0.02, **look)

    def draw(self, rng: np.random.Generator) -> dict[str, Pose]:
        """Draw the box a little to the right of the middle."""
        return {"box": AREA.draw(rng)}

    def legs(self, starts: Frames, poses: Frames, style: Style) -> Legs:
        """Left to the box's side and back; right to the knob, about the hinge and back."""
        box = poses["box"]
        opened = torch.deg2rad(OPENED + SPREAD * style.free[:, 0])
        rolled = torch.full_like(opened, math.radians(ROLL))
        hinge, point = map(vector, (HINGE, GRIP))

        def lid(share: Tensor) -> Frame:
            """Return the right hand's pose at the lid, opened by a share of the angle."""
            plate = _turn_about_x(Frame(box.transform(hinge), box.orientation), opened * share)
            palm = _turn_about_x(Frame(plate.transform(point), plate.orientation), rolled)
            return place_hand(palm, ORIGIN)

        shut = lid(torch.zeros_like(opened))
        beside, above = (
            Frame(place_hand(box, point).position + aside, orientation)
            for point, aside, orientation in zip(
                WAIT.values(),
                style.aim.unbind(1),
                (place_hand(box, SIDE).orientation, shut.orientation),
                strict=True,
            )
        )
        close = Leg("close", place_hand(box, SIDE))
        left = [Leg("reach", beside, free=True), close, Leg("away", beside)]
        right = [
            Leg("reach", above, free=True),
            Leg("close", shut),
            Leg("open", lambda done: lid(minimum_jerk(done))),
            Leg("shut", lambda done: lid(1 - minimum_jerk(done))),
            Leg("away", above),
        ]
        return {"l_hand": left, "r_hand": right}

    def judge(self) -> Judge:
        """Opens both hands when the lid was open for long enough, and is shut again."""
        return _Judge()


def _turn_about_x(pose: Frame, angle: Tensor) -> Frame:
    """Turn a pose about its x axis by angles (...) [rad]."""
    half, zero = angle / 2, torch.zeros_like(angle)
    turn = torch.stack((half.cos(), half.sin(), zero, zero), dim=-1)
    turned = quaternions.product(pose.orientation, turn)
    return Frame(pose.position.expand(*turned.shape[:-1], 3), turned)


class _Judge(Judge):
    def __init__(self) -> None:
        self.time = self.opened = self.kept = self.now = self.moved = self.pull = 0.0
        self.lost = self.released = False
        self.box: Pose | None = None
        self.shutting = Closing(reach=math.radians(SHUT))

    def note(self, scene: RobotScene, seconds: float) -> None:
        self.time += seconds
        angle, place = self._angle(scene), scene.pose("box")[:3]
        if self.box is None or not scene.taken:
            self.box = place
        self.moved = max(self.moved, float(np.linalg.norm(place - self.box)))
        self.opened = max(self.opened, angle)
        self.now = self.now + seconds if angle >= OPEN else 0.0
        self.kept = max(self.kept, self.now)
        self.pull = max([self.pull, *map(scene.pull, scene.held)])
        self.lost |= not self.released and scene.held != scene.taken

    def lets_go(self, scene: RobotScene) -> Sequence[Hold]:
        if self.released or self.kept < KEPT:
            return ()
        gap = math.radians(max(self._angle(scene), 0.0))
        self.released = self.shutting.update(self.time, gap)
        return tuple(scene.held) if self.released else ()

    def figures(self, scene: RobotScene) -> dict[str, float]:
        return {
            "opened_deg": self.opened,
            "kept_s": self.kept,
            "box_mm": 1e3 * self.moved,
            "shut_deg": max(self._angle(scene), 0.0),
            "grips": float({HELD, LID} <= scene.taken and not self.lost),
            "pull_n": self.pull,
        }

    def _angle(self, scene: RobotScene) -> float:
        """By how much the lid is open [deg]."""
        return math.degrees(float(scene.data.joint("lid").qpos[0]))
