"""Lid: the left hand steadies a box, the right one opens its hinged lid and closes it again.

Both hands hold one mechanism that moves about one axis: the way is a circle about the hinge,
along which the hand turns with the lid. Key poses at its ends do not say so, and whoever takes
the chord between them pulls the box away, or loses the grip.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import ClassVar

import mujoco
import numpy as np
import torch
from torch import Tensor

from lerobot_env_bimanual.bottle.measures import Closing
from lerobot_env_bimanual.suite.names import SUITE
from lerobot_env_bimanual.suite.scene import TABLE, Hold, SuiteScene, add_thing
from lerobot_env_bimanual.suite.task import (
    Judge,
    Leg,
    Pose,
    Style,
    SuiteTask,
    stands_in,
    upright_pose,
)
from tpgmm_datasets.bottle.skill import attached
from tpgmm_torch import (
    Canonical,
    Frame,
    RelativeOrientation,
    RelativePosition,
    Stack,
    quaternions,
)
from tpgmm_torch.motion.minimum_jerk import minimum_jerk
from tpgmm_torch.operators import Operator

__all__ = ["Lid"]

#: Half of the box along x, y and z [m]; its origin is in its middle.
HALF = (0.05, 0.06, 0.04)
#: The hinge is the upper right edge, the lid's origin; the knob stands on the lid, where the
#: left hand does not come in its way [m].
HINGE = (0.0, -HALF[1], HALF[2])
KNOB, KNOB_HALF = (0.0, 0.08, 0.015), (0.02, 0.008, 0.015)
BOX = Hold("l_hand", "box", "box")
LID = Hold("r_hand", "lid", "knob")
#: Where boxes are: the box of their origins, and how they are turned [m, deg].
LOWEST, HIGHEST, YAW = (0.25, -0.055, 0.065), (0.30, -0.03, 0.09), 12.0
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
    objects = SUITE["lid"]
    foot = HALF[2]
    phases: ClassVar[Mapping[str, float]] = MappingProxyType(
        {
            "reach": 2.0,
            "close": 1.0,
            "hold": 0.6,
            "open": 2.5,
            "keep": 2.0,
            "shut": 2.5,
            "release": 0.8,
            "away": 1.2,
            "rest": 0.4,
        }
    )
    grasp = "close"
    holds = (BOX, LID)
    limits: ClassVar[Mapping[str, tuple[float, float]]] = MappingProxyType(
        {
            "opened_deg": (OPEN, math.inf),
            "kept_s": (KEPT, math.inf),
            "box_mm": (0.0, 5.0),
            "shut_deg": (0.0, SHUT),
            "grips": (1.0, 1.0),
        }
    )
    headings: ClassVar[Mapping[str, tuple[str, int]]] = MappingProxyType(
        {
            "opened_deg": ("opened [deg]", 1),
            "kept_s": ("kept open [s]", 1),
            "box_mm": ("box moved [mm]", 1),
            "shut_deg": ("shut to [deg]", 1),
            "grips": ("grips kept", 0),
            "pull_n": ("pull [N]", 0),
        }
    )

    def furnish(self, spec: mujoco.MjSpec) -> None:
        """A box, and on it a lid with a knob, which turns about the upper right edge."""
        visible = {"contype": 0, "conaffinity": 0}
        wide, deep, _ = HALF
        box = add_thing(spec, "box")
        box.add_geom(
            name="box",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=HALF,
            mass=0.4,
            friction=(0.4, 0.005, 0.0001),
            contype=0,
            conaffinity=TABLE,
            rgba=(0.75, 0.6, 0.4, 1),
        )
        lid = box.add_body(name="lid", pos=HINGE)
        lid.add_joint(
            name="lid",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=(1, 0, 0),
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
            range=(0.0, math.radians(110.0)),
            damping=0.01,
            frictionloss=0.02,
        )
        lid.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=(wide, deep, 0.003),
            pos=(0, deep, 0.003),
            mass=0.08,
            rgba=(0.6, 0.45, 0.3, 1),
            **visible,
        )
        lid.add_geom(
            name="knob",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=KNOB_HALF,
            pos=KNOB,
            mass=0.02,
            rgba=(0.3, 0.3, 0.35, 1),
            **visible,
        )

    def draw(self, rng: np.random.Generator) -> dict[str, Pose]:
        """The box a little to the right of the middle."""
        return {"box": upright_pose(rng, LOWEST, HIGHEST, YAW)}

    def usual(self, pose: Pose) -> bool:
        """Whether it stands in its box."""
        return stands_in(pose, LOWEST, HIGHEST, YAW)

    def legs(
        self, starts: Mapping[str, Frame], poses: Mapping[str, Frame], style: Style
    ) -> Mapping[str, Sequence[Leg]]:
        """Left to the box's side and back; right to the knob, about the hinge and back."""
        box = poses["box"]
        opened = torch.deg2rad(OPENED + SPREAD * style.free[:, 0])
        rolled = torch.full_like(opened, math.radians(ROLL))
        hinge, point = (torch.tensor(at, dtype=torch.float64) for at in (HINGE, GRIP))

        def lid(share: Tensor) -> Frame:
            """Where the right hand holds the lid, opened by a share of the angle."""
            plate = _turned(Frame(box.transform(hinge), box.orientation), opened * share)
            palm = _turned(Frame(plate.transform(point), plate.orientation), rolled)
            return attached(palm, ORIGIN)

        shut = lid(torch.zeros_like(opened))
        beside, above = (
            Frame(attached(box, point).position + aside, orientation)
            for point, aside, orientation in zip(
                WAIT.values(),
                style.aim.unbind(1),
                (attached(box, SIDE).orientation, shut.orientation),
                strict=True,
            )
        )
        left = [
            Leg("reach", beside, free=True),
            Leg("close", attached(box, SIDE)),
            Leg("away", beside),
        ]
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

    def operators(self, orientation: bool = True, held: bool = True) -> list[Operator]:
        """The hands seen from the box, and from each other, which is the closed chain."""
        kinds = (RelativePosition, RelativeOrientation)[: 1 + orientation]

        def seen(what: str, frame: str) -> Stack:
            return Stack(*(kind(what, frame) for kind in kinds))

        pairs = (("l_hand", "box"), ("r_hand", "box"), ("r_hand", "l_hand"))
        return [*(seen(*pair) for pair in pairs), Canonical()]


def _turned(pose: Frame, angle: Tensor) -> Frame:
    """The same place, turned about its x axis by angles (n,) [rad]."""
    half, zero = angle / 2, torch.zeros_like(angle)
    turn = torch.stack((half.cos(), half.sin(), zero, zero), dim=-1)
    return Frame(pose.position, quaternions.product(pose.orientation, turn))


class _Judge(Judge):
    def __init__(self) -> None:
        self.time = self.opened = self.kept = self.now = self.moved = self.pull = 0.0
        self.lost = self.released = False
        self.box: Pose | None = None
        self.shutting = Closing(reach=math.radians(SHUT))

    def note(self, scene: SuiteScene, seconds: float) -> None:
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

    def lets_go(self, scene: SuiteScene) -> Sequence[Hold]:
        if self.released or self.kept < KEPT:
            return ()
        gap = math.radians(max(self._angle(scene), 0.0))
        self.released = self.shutting.update(self.time, gap)
        return tuple(scene.held) if self.released else ()

    def figures(self, scene: SuiteScene) -> dict[str, float]:
        return {
            "opened_deg": self.opened,
            "kept_s": self.kept,
            "box_mm": 1e3 * self.moved,
            "shut_deg": max(self._angle(scene), 0.0),
            "grips": float({BOX, LID} <= scene.taken and not self.lost),
            "pull_n": self.pull,
        }

    def _angle(self, scene: SuiteScene) -> float:
        """By how much the lid is open [deg]."""
        return math.degrees(float(scene.data.joint("lid").qpos[0]))
