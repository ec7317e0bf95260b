"""Pour: the left hand tilts a jug over a cup that the right hand holds, and moves meanwhile.

Nothing in the room says where it is poured: what matters is where the jug's mouth is seen from
the cup, at each instant, and how far the jug is tilted there, since with the tilt grows the
stream. Where the cup is held, how it sways, and from which side the jug comes about the
vertical is free: the mouth's place and the jug's turn only go together.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import ClassVar

import mujoco
import numpy as np
import torch
from torch import Tensor

from lerobot_env_bimanual.base import Array
from lerobot_env_bimanual.bottle.measures import Figure
from lerobot_env_bimanual.eyes.carriers import CUBE_ROOM, cube_at
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
    vector,
)
from tpgmm_datasets.bottle.skill import between
from tpgmm_torch import Frame, quaternions
from tpgmm_torch.motion.minimum_jerk import minimum_jerk

#: Of the cup and the jug, whose frames are in their middle: radius, and half the height [m].
CUP, CUP_HALF = 0.03, 0.03
JUG, JUG_HALF = 0.025, 0.06
LEFT = Hold("l_hand", "jug", "jug")
RIGHT = Hold("r_hand", "cup", "cup")
#: Where cups and jugs stand: the box of the cup's centre, and the jug's on the other side.
BOX = Box((0.25, -0.13, 0.055), (0.32, -0.06, 0.085), 20.0)
#: Where the palms touch them, and where they wait, in their frames [m].
GRIP = {"l_hand": (0.0, JUG + 0.01, 0.01), "r_hand": (0.0, -CUP - 0.01, 0.0)}
WAIT = {"l_hand": (-0.05, 0.1, 0.01), "r_hand": (-0.05, -0.1, 0.0)}
#: The jug's tags are at its lower end, which is away from the cup's when it is tilted [m].
LOW = -0.03
#: How high the jug is lifted before it is carried [m].
LIFT = 0.05
#: Where the cup is held [m], and by how much it sways from there while it is poured into.
MEETING, SWAY = (0.27, -0.02, 0.16), (0.02, 0.02, 0.0)
#: From which side the jug comes, about the vertical, and by how much that differs [rad].
SIDE, SIDE_SPREAD = math.radians(-35.0), math.radians(15.0)
#: How far the jug is tilted [rad]; where its mouth is above the cup's rim, and how far beside
#: the cup while it is upright [m].
TILT, ABOVE, BESIDE = math.radians(98.0), 0.03, 0.06
#: From this tilt on it flows; before, the mouth should be above the cup [deg].
BRIM, OVER = 60.0, 55.0
#: What flows in a second for each degree beyond, as a share of what is in the jug.
FLOW = 1 / 45
#: A cup that leans more takes nothing [deg].
UPRIGHT = 15.0
#: Where the jug is in the end [m].
ASIDE = (0.26, 0.1, 0.16)
GRAVITY = 9.81


class Pour(SuiteTask):
    """Pour from a jug into a cup, one in each hand."""

    name = "pour"
    description = "take the cup with the right hand, the jug with the left, pour into the cup"
    foot = CUP_HALF
    phases: ClassVar = {
        "reach": 2.0, "close": 1.0, "hold": 0.6, "lift": 1.6, "grip": 0.6, "raise": 0.8,
        "bring": 2.0, "tilt": 1.6, "pour": 1.6, "back": 1.6, "leave": 1.6, "rest": 0.4,
    }  # fmt: skip
    carriers: ClassVar = {
        "cup": cube_at(10, CUP + CUBE_ROOM),
        "jug": cube_at(20, JUG + CUBE_ROOM, z=LOW),
    }
    grasp, box, grip, wait = "close", BOX, GRIP, WAIT
    holds = (LEFT, RIGHT)
    pairs = (("r_hand", "cup"), ("l_hand", "jug"))
    together = ("jug", "cup"), ("l_hand", "r_hand")
    figures: ClassVar = {
        "poured": Figure("poured", 2, low=0.9),
        "spilled": Figure("spilled", 2, high=0.1),
        "cup_deg": Figure("cup's lean [deg]", 1, high=10.0),
        "jug_deg": Figure("jug's lean in the end [deg]", 1, high=10.0),
        "held": Figure("both held", 0, 1.0, 1.0),
    }

    def furnish(self, spec: mujoco.MjSpec) -> None:
        """Add a cup and a jug, which collide with the table alone."""
        shapes = {
            "cup": (CUP, CUP_HALF, 0.15, (0.3, 0.5, 0.85, 1)),
            "jug": (JUG, JUG_HALF, 0.3, (0.9, 0.75, 0.3, 1)),
        }
        for name, (radius, half, mass, colour) in shapes.items():
            look, body = {"name": name, "rgba": colour}, add_thing(spec, name)
            add_geom(body, CYLINDER, (radius, half, 0), mass=mass, conaffinity=TABLE, **look)

    def draw(self, rng: np.random.Generator) -> dict[str, Pose]:
        """Draw the cup on the right, the jug on the left of the table."""
        cup = BOX.draw(rng)
        return {"cup": cup, "jug": BOX.across(cup[2] - CUP_HALF + JUG_HALF).draw(rng)}

    def legs(self, starts: Frames, poses: Frames, style: Style) -> Legs:
        """Right to the cup, and lifts it; left to the jug, over the cup, and back."""
        cup, jug = poses["cup"], poses["jug"]
        aside = dict(zip(GRIP, style.aim.unbind(1), strict=True))
        sway, meeting = style.free * vector(SWAY), vector(MEETING) + aside["r_hand"]
        # where the cup is at the ends of the phases in which it is poured into
        turns = [Frame(meeting + share * sway) for share in (0.0, 1.0, -1.0, 0.0)]
        cups = dict(zip(("tilt", "pour", "back"), pairwise(turns), strict=True))
        side = _turn(SIDE + SIDE_SPREAD * style.free[:, 2], (0.0, 0.0, 1.0))

        def pouring(phase: str, tilted: Callable[[Tensor], Tensor]) -> Leg:
            def way(done: Tensor) -> Frame:
                below = between(*cups[phase], done)
                return self.at_grip(_over(below, side, TILT * tilted(done)), "l_hand")

            return Leg(phase, way)

        ready = _over(turns[0], side, torch.zeros_like(side[:, 0]))
        away = Frame(vector(ASIDE) + aside["l_hand"])
        left = [
            Leg("reach", self.near(jug, "l_hand", style), free=True),
            Leg("lift", self.at_grip(jug, "l_hand")),
            Leg("raise", self.at_grip(raise_pose(jug, LIFT), "l_hand")),
            Leg("bring", self.at_grip(ready, "l_hand"), free=True),
            pouring("tilt", minimum_jerk),
            pouring("pour", torch.ones_like),
            pouring("back", lambda done: 1 - minimum_jerk(done)),
            Leg("leave", self.at_grip(away, "l_hand"), free=True),
        ]
        right = [
            Leg("reach", self.near(cup, "r_hand", style), free=True),
            Leg("close", self.at_grip(cup, "r_hand")),
            Leg("lift", self.at_grip(turns[0], "r_hand"), free=True),
            *(Leg(phase, self.at_grip(end, "r_hand")) for phase, (_, end) in cups.items()),
        ]
        return {"l_hand": left, "r_hand": right}

    def judge(self) -> Judge:
        """Follows what flows; hands do not open."""
        return _Judge()


def _turn(angle: Tensor, axis: tuple[float, ...]) -> Tensor:
    """Unit quaternions (..., 4) about an axis, for angles (...) [rad]."""
    return quaternions.exp(angle[..., None] * angle.new_tensor(axis))


def _over(cup: Frame, side: Tensor, tilt: Tensor) -> Frame:
    """Return the jug (n,), tilted so far, its mouth where it should then be for a cup.

    While it is upright that is beside the cup, and it goes above it as it is tilted.
    """
    orientation = quaternions.product(side, _turn(tilt, (1.0, 0.0, 0.0)))
    beside = torch.zeros(*tilt.shape, 3, dtype=torch.float64)
    beside[..., 1] = BESIDE * (1 - minimum_jerk((tilt / math.radians(OVER)).clamp(max=1)))
    beside[..., 2] = CUP_HALF + ABOVE
    mouth = cup.position + quaternions.rotate(side, beside)
    lip = quaternions.rotate(orientation, vector((0.0, -JUG, JUG_HALF)))
    return Frame(mouth - lip, orientation)


class _Judge(Judge):
    """Judge of pouring: drops leave the jug's rim where it is lowest, with its velocity."""

    def __init__(self) -> None:
        self.full = 1.0
        self.poured = self.spilled = self.lean = 0.0
        self.mouth: Array | None = None
        # what falls: how much of it, where, how fast
        self.amounts: Array = np.zeros(0)
        self.places: Array = np.zeros((0, 3))
        self.speeds: Array = np.zeros((0, 3))

    def note(self, scene: RobotScene, seconds: float) -> None:
        before = _seen(scene, self.places)
        self.places = self.places + self.speeds * seconds
        self.places[:, 2] -= GRAVITY * seconds**2 / 2
        self.speeds[:, 2] -= GRAVITY * seconds
        if self.amounts.size:
            self.lean = max(self.lean, _lean(scene, "cup"))
        self._arrive(before, _seen(scene, self.places), _lean(scene, "cup") <= UPRIGHT)
        self._flow(scene, seconds)

    def _arrive(self, before: Array, after: Array, upright: bool) -> None:
        """Count what came down to the cup's rim between two instants, seen from the cup."""
        down = after[:, 2] <= CUP_HALF
        before, after = before[down], after[down]
        fallen = before[:, 2] - after[:, 2]
        share = (before[:, 2] - CUP_HALF) / np.where(fallen > 0, fallen, 1.0)
        through = before + np.clip(share, 0.0, 1.0)[:, None] * (after - before)
        inside = (np.linalg.norm(through[:, :2], axis=1) <= CUP) & upright
        self.poured += float(self.amounts[down][inside].sum())
        self.spilled += float(self.amounts[down][~inside].sum())
        self.amounts, self.places = self.amounts[~down], self.places[~down]
        self.speeds = self.speeds[~down]

    def _flow(self, scene: RobotScene, seconds: float) -> None:
        """Let more leave the jug, where its rim is lowest."""
        axis = scene.data.body("jug").xmat.reshape(3, 3)[:, 2]
        down = axis[2] * axis - (0.0, 0.0, 1.0)
        lowest = JUG * down / max(float(np.linalg.norm(down)), 1e-9)
        mouth = scene.pose("jug")[:3] + JUG_HALF * axis + lowest
        amount = min(FLOW * (_lean(scene, "jug") - BRIM) * seconds, self.full)
        if amount > 0 and self.mouth is not None:
            speed = (mouth - self.mouth) / seconds
            self.full -= amount
            self.amounts = np.append(self.amounts, amount)
            self.places = np.concatenate((self.places, mouth[None]))
            self.speeds = np.concatenate((self.speeds, speed[None]))
        self.mouth = mouth

    def figures(self, scene: RobotScene) -> dict[str, float]:
        return {
            "poured": self.poured,
            "spilled": self.spilled,
            "cup_deg": self.lean,
            "jug_deg": _lean(scene, "jug"),
            "held": float(scene.held == {LEFT, RIGHT}),
        }


def _seen(scene: RobotScene, places: Array) -> Array:
    """Places (n, 3) as seen from the cup [m]."""
    cup = scene.data.body("cup")
    return np.asarray((places - cup.xpos) @ cup.xmat.reshape(3, 3))


def _lean(scene: RobotScene, name: str) -> float:
    """Return the angle of an object's axis with the vertical [deg]."""
    cosine = float(scene.data.body(name).xmat[8])
    return math.degrees(math.acos(min(1.0, max(-1.0, cosine))))
