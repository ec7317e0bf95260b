"""Peg in hole: the right hand takes a peg, the left one a block, and they fit in the air.

Where the hands meet is free, and so is how the round peg is turned about its axis. What matters
is where the peg is seen from the hole, which the other hand carries: to a millimetre, and along
a line. Key poses say where the peg is in the end, not that its way in is straight. Beside the
hole it jams: both arms give way, as stiff as their position control, and the force is judged.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import mujoco
import numpy as np
import torch
from torch import Tensor

from lerobot_env_bimanual.bottle.measures import Figure
from lerobot_env_bimanual.eyes.carriers import CUBE_ROOM, cube_at
from lerobot_env_bimanual.robot_scene import BOX as CUBOID
from lerobot_env_bimanual.robot_scene import (
    CYLINDER,
    OBJECT,
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
    shift_pose,
    vector,
)
from tpgmm_torch import Frame, quaternions

#: The peg's radius, half its length, and its head's radius and half length [m].
RADIUS, LENGTH, HEAD = 0.012, 0.045, (0.022, 0.015)
#: The block, half as wide, and half as high [m].
WIDTH, HEIGHT = 0.04, 0.03
#: Between peg and hole all round, how much wider the hole's mouth is, and the hole's depth [m].
CLEARANCE, CHAMFER, DEPTH = 0.001, 0.002, 0.05
#: Wood on wood, smoothed; and how stiff a contact is: its time constant [s], its damping.
SOLID = {
    "contype": OBJECT, "conaffinity": TABLE | OBJECT,
    "friction": (0.3, 0.005, 0.0001), "solref": (0.004, 1.0),
}  # fmt: skip
PEG = Hold("r_hand", "peg", "peg")
BLOCK = Hold("l_hand", "block", "block")
#: Where pegs are: the box of the peg's centre; blocks are on the other side of the table.
AREA = Box((0.24, -0.13, 0.075), (0.32, -0.07, 0.1), 20.0)
#: Where the palms touch peg and block, and where they wait, in their frames [m].
GRIP = {"r_hand": (0.0, -HEAD[0] - 0.01, 0.03), "l_hand": (0.0, WIDTH + 0.01, 0.015)}
WAIT = {"r_hand": (-0.05, -0.09, 0.03), "l_hand": (-0.05, 0.11, 0.015)}
#: How far both are lifted off the table [m].
LIFT = 0.03
#: Where the block is brought [m], and by how much that differs.
MEETING, MEETING_SPREAD = (0.26, -0.01, 0.1), (0.02, 0.02, 0.008)
#: Where the peg waits, from the hole's mouth; how far above it the way in begins; how deep it
#: leads [m].
BESIDE, ABOVE, IN = (0.0, -0.07, 0.0), 0.012, 0.04
#: What counts as inserted [m].
DEEP = 0.03


class PegInHole(SuiteTask):
    """Take a peg and a block with a hole, and put one into the other in the air."""

    name = "peg_in_hole"
    description = "take the peg and the block with a hole, and insert the peg in the air"
    foot = LENGTH
    phases: ClassVar = {
        "reach": 2.0, "close": 1.0, "hold": 0.6, "lift": 0.8, "bring": 2.0, "align": 1.2,
        "insert": 2.0, "keep": 1.2,
    }  # fmt: skip
    carriers: ClassVar = {
        "peg": cube_at(10, z=LENGTH + CUBE_ROOM),
        "block": cube_at(20, WIDTH + CUBE_ROOM),
    }
    grasp, box, grip, wait = "close", AREA, GRIP, WAIT
    holds = (PEG, BLOCK)
    pairs = (("r_hand", "peg"), ("l_hand", "block"))
    together = ("peg", "block"), ("r_hand", "l_hand")
    figures: ClassVar = {
        "depth_mm": Figure("depth [mm]", 1, low=1e3 * DEEP),
        "inserted_s": Figure("inserted for [s]", 1, low=0.5),
        "force_n": Figure("pressed by [N]", 1, high=30.0),
        "held": Figure("both held", 0, 1.0, 1.0),
    }

    def furnish(self, spec: mujoco.MjSpec) -> None:
        """Add a round peg with a head, and a block of boxes around a square hole."""
        peg = add_thing(spec, "peg")
        radius, tall = HEAD
        for name, size, height in (
            ("peg", (radius, tall, 0), LENGTH - tall),
            ("pin", (RADIUS, LENGTH - tall, 0), -tall),
        ):
            look = {"name": name, "pos": (0.0, 0.0, height), "rgba": (0.85, 0.3, 0.3, 1)}
            add_geom(peg, CYLINDER, size, mass=0.05, **look, **SOLID)
        block = add_thing(spec, "block")
        # the hand closes on the whole, and it has the mass of it
        add_geom(block, CUBOID, (WIDTH, WIDTH, HEIGHT), name="block", mass=0.25, group=3)
        for position, half, orientation in _block():
            look = {"pos": position, "quat": orientation, "rgba": (0.3, 0.45, 0.7, 1)}
            add_geom(block, CUBOID, half, mass=0, **look, **SOLID)

    def draw(self, rng: np.random.Generator) -> dict[str, Pose]:
        """Draw the peg on the right, the block on the left of the table."""
        peg = AREA.draw(rng)
        return {"peg": peg, "block": AREA.across(peg[2] - LENGTH + HEIGHT).draw(rng)}

    def legs(self, starts: Frames, poses: Frames, style: Style) -> Legs:
        """Left to the block and the meeting; right to the peg, beside, above, and in."""
        peg, block = poses["peg"], poses["block"]
        # nobody turns them on the way
        place = vector(MEETING) + style.free * vector(MEETING_SPREAD)
        meeting = Frame(place, block.orientation)

        def over(height: float) -> Frame:
            """Return the peg so high above where the hole begins."""
            up = vector((0.0, 0.0, HEIGHT + LENGTH + height))
            return Frame(meeting.position + up, _straighter(peg))

        begun = over(ABOVE)
        beside = shift_pose(begun, vector(BESIDE) + style.aim[:, 1] * torch.tensor((1, 1, 0)))
        left = [
            Leg("reach", self.near(block, "l_hand", style), free=True),
            Leg("close", self.at_grip(block, "l_hand")),
            Leg("lift", self.at_grip(raise_pose(block, LIFT), "l_hand")),
            Leg("bring", self.at_grip(meeting, "l_hand"), free=True),
        ]
        right = [
            Leg("reach", self.near(peg, "r_hand", style), free=True),
            Leg("close", self.at_grip(peg, "r_hand")),
            Leg("lift", self.at_grip(raise_pose(peg, LIFT), "r_hand")),
            Leg("bring", self.at_grip(beside, "r_hand"), free=True),
            Leg("align", self.at_grip(begun, "r_hand")),
            Leg("insert", self.at_grip(over(-IN), "r_hand")),
        ]
        return {"l_hand": left, "r_hand": right}

    def judge(self) -> Judge:
        """Measures how deep the peg is, for how long, and how hard they press on each other."""
        return _Judge()


class _Judge(Judge):
    def __init__(self) -> None:
        self.force = self.inserted = 0.0

    def note(self, scene: RobotScene, seconds: float) -> None:
        pressed = np.linalg.norm(scene.force("block", "peg"))
        self.force = max(self.force, float(pressed))
        deep = _depth(scene) >= DEEP and {PEG, BLOCK} <= scene.held
        self.inserted = self.inserted + seconds if deep else 0.0

    def figures(self, scene: RobotScene) -> dict[str, float]:
        return {
            "depth_mm": 1e3 * _depth(scene),
            "inserted_s": self.inserted,
            "force_n": self.force,
            "held": float({PEG, BLOCK} <= scene.held),
        }


def _depth(scene: RobotScene) -> float:
    """Measure how deep the middle of the peg's end is in the hole, 0 beside it [m]."""
    peg, block = (scene.data.body(name) for name in ("peg", "block"))
    tip = peg.xpos - LENGTH * peg.xmat.reshape(3, 3)[:, 2]
    x, y, z = block.xmat.reshape(3, 3).T @ (tip - block.xpos)
    inside = max(abs(x), abs(y)) < RADIUS + CLEARANCE
    return max(0.0, HEIGHT - float(z)) if inside else 0.0


def _straighter(pose: Frame) -> Tensor:
    """Half as far turned: how arms turn by themselves what they bring before the chest."""
    straight = torch.zeros_like(pose.orientation)
    straight[..., 0] = 1.0
    half = torch.full(pose.batch_shape, 0.5, dtype=torch.float64)
    return quaternions.slerp(straight, pose.orientation, half)


def _block() -> list[tuple[Sequence[float], Sequence[float], Sequence[float]]]:
    """Positions, half sizes and orientations of the boxes of which the block is made."""
    hole = RADIUS + CLEARANCE
    top, bottom = HEIGHT - CHAMFER, HEIGHT - DEPTH
    none = (1.0, 0.0, 0.0, 0.0)
    floor = ((0.0, 0.0, (bottom - HEIGHT) / 2), (WIDTH, WIDTH, (bottom + HEIGHT) / 2), none)
    boxes: list[tuple[Sequence[float], Sequence[float], Sequence[float]]] = [floor]
    for inner, low, high in ((hole, bottom, top), (hole + CHAMFER, top, HEIGHT)):
        middle, thick = (inner + WIDTH) / 2, (WIDTH - inner) / 2
        z, tall = (low + high) / 2, (high - low) / 2
        for sign in (-1, 1):
            boxes.append(((sign * middle, 0.0, z), (thick, WIDTH, tall), none))
            boxes.append(((0.0, sign * middle, z), (inner, thick, tall), none))
    # a chamfer is the side of a box that is turned by 45 degrees about an edge of the mouth
    face, back, long = CHAMFER / math.sqrt(2), 0.002, hole + CHAMFER
    out = hole + CHAMFER / 2 + back / math.sqrt(2)
    z = HEIGHT - CHAMFER / 2 - back / math.sqrt(2)
    w = math.cos(math.pi / 8)
    for sign in (-1, 1):
        turn = sign * math.sin(math.pi / 8)
        boxes.append(((sign * out, 0.0, z), (back, long, face), (w, 0.0, turn, 0.0)))
        boxes.append(((0.0, sign * out, z), (long, back, face), (w, -turn, 0.0, 0.0)))
    return boxes
