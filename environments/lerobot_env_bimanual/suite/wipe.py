"""Wipe: the right palm wipes a tilted board in a zigzag, the left hand steadies its edge.

The way is one in the board's plane, at an even pace, and pressing is part of it: the reference
of the palm is a little below the board, and a soft sponge makes a force of that. Poses at a few
instants say neither; nor is the force anywhere in the observation.
"""

from __future__ import annotations

import math
from typing import ClassVar

import mujoco
import numpy as np
import torch
from torch import Tensor

from lerobot_env_bimanual.bottle.measures import Figure
from lerobot_env_bimanual.eyes.carriers import flat_at
from lerobot_env_bimanual.robot_scene import BOX, PALM, Hold, RobotScene, add_geom, add_thing
from lerobot_env_bimanual.suite.task import (
    Box,
    Frames,
    Judge,
    Leg,
    Legs,
    Pose,
    Style,
    SuiteTask,
    shift_pose,
    vector,
)
from tpgmm_datasets.bottle.skill import HANDS, place_hand
from tpgmm_torch import Frame, quaternions

#: How high the middle of the board is above the table, and half its sides and thickness [m].
#: Its frame is in the middle of its upper side.
FOOT = 0.06
BOARD = (0.075, 0.085, 0.01)
#: Where boards are: the box of that middle [m], and how far they are turned about the vertical
#: and tilted to either side [deg].
AREA, TILT = Box((0.27, -0.04, 0.08), (0.32, 0.0, 0.11), 20.0), 15.0
#: Half the sides of the sponge on the right palm, in the hand's frame, and its stiffness at
#: each corner [1/s^2] and damping [1/s], as MuJoCo takes them.
SPONGE = (0.025, 0.01, 0.025)
STIFFNESS, DAMPING = 450.0, 40.0
#: What is wiped: half its sides, and those of a cell of it [m].
FIELD, CELL = (0.05, 0.06), 0.01
#: The zigzag: half its sides [m], how many strokes, and how deep the reference presses [m].
WAY, STROKES, PRESS = (0.034, 0.044), 4, 0.005
#: Where the right palm waits: above where it begins and ends; before, behind the board, in
#: whose frame that is [m].
HOVER, BEHIND = 0.05, (-0.13, -0.13, 0.06)
#: How the right hand is turned on the board, about its normal [rad]: the wrist asks for that.
TURN = math.radians(35.0)
#: Where the left palm touches the edge, and where it waits, in the board's frame [m].
EDGE, WAIT = (-0.02, BOARD[1] + 0.01, -0.01), (-0.07, BOARD[1] + 0.07, -0.01)
#: How far the left hand is pitched there, its palm along the edge [rad]; its wrist asks for it.
PITCH = math.radians(12.0)
#: Which forces wipe [N].
FORCES = (2.0, 40.0)
STEADY = Hold("l_hand", "board", "edge")


class Wipe(SuiteTask):
    """Wipe a board with one hand, and steady it with the other."""

    name = "wipe"
    description = "steady the board with the left hand, wipe it with the right"
    foot = FOOT
    phases: ClassVar = {
        "reach": 2.0, "close": 1.5, "press": 1.2, "wipe": 6.0, "lift": 1.0, "away": 1.5,
        "rest": 0.4,
    }  # fmt: skip
    carriers: ClassVar = {"board": flat_at(10, BOARD[0] + 0.04, 0.0, upright=False)}
    grasp, box = "close", AREA
    #: Nobody carries a board that stands fast.
    holds = ()
    pairs = tuple((hand, "board") for hand in HANDS)
    figures: ClassVar = {
        "coverage": Figure("wiped", 2, low=0.9),
        "force": Figure("mean force [N]", 1, 4.0, 20.0),
        "off_s": Figure("without contact [s]", 2, high=0.3),
        "edge_mm": Figure("left palm from the edge [mm]", 1, high=10.0),
    }

    def furnish(self, spec: mujoco.MjSpec) -> None:
        """Add a board on a foot, its edge, and a sponge on the right palm."""
        board = add_thing(spec, "board", free=False)
        long, wide, thick = BOARD
        shapes = {
            "board": ((long, wide, thick), (0.0, 0.0, -thick), PALM, (0.9, 0.9, 0.85, 1)),
            "edge": ((long, 1e-3, thick), (0.0, wide - 1e-3, -thick), 0, (0.3, 0.3, 0.3, 1)),
        }
        for name, (size, place, collides, colour) in shapes.items():
            look = {"name": name, "pos": place, "rgba": colour}
            add_geom(board, BOX, size, conaffinity=collides, **look)
        place = (0.0, 0.01 + SPONGE[1], 0.0)
        look = {"name": "sponge", "pos": place, "rgba": (0.95, 0.85, 0.3, 1)}
        # it slides: with a pyramid of friction, normal forces grow with the speed
        soft = {"contype": PALM, "priority": 1, "condim": 1, "solref": (-STIFFNESS, -DAMPING)}
        impedance = (0.5, 0.5, 0.001, 0.5, 2.0)
        add_geom(spec.body("r_hand"), BOX, SPONGE, mass=0.02, solimp=impedance, **look, **soft)

    def draw(self, rng: np.random.Generator) -> dict[str, Pose]:
        """Draw a board before the robot, turned and tilted."""
        position = rng.uniform(AREA.lowest, AREA.highest)
        largest = np.radians((TILT, TILT, AREA.yaw))
        roll, pitch, yaw = rng.uniform(-largest, largest)
        turn, tilt = (
            quaternions.exp(vector(angles)) for angles in ((0.0, 0.0, yaw), (roll, pitch, 0.0))
        )
        return {"board": np.concatenate((position, quaternions.product(turn, tilt).numpy()))}

    def usual(self, pose: Pose) -> bool:
        """Check whether the board may have been drawn, but for rounding."""
        orientation = torch.from_numpy(np.asarray(pose[3:], dtype=np.float64))
        yaw = 2 * math.atan2(float(orientation[3]), float(orientation[0]))
        turn = quaternions.exp(vector((0.0, 0.0, yaw)))
        tilt = quaternions.log(quaternions.product(quaternions.conjugate(turn), orientation))
        turned = abs((math.degrees(yaw) + 180) % 360 - 180) <= AREA.yaw + 1e-6
        level = math.degrees(float(tilt.abs().max())) <= TILT + 1e-6
        return AREA.surrounds(pose) and turned and level

    def legs(self, starts: Frames, poses: Frames, style: Style) -> Legs:
        """Left to the edge and back; right to the board, over it in a zigzag, and back."""
        board = poses["board"]
        left, right = style.aim.unbind(1)
        n = len(board.position)

        def zigzag(done: Tensor) -> Frame:
            return _on(board, _zigzag(done), -PRESS)

        first, last = (torch.full((n,), share, dtype=torch.float64) for share in (0.0, 1.0))
        behind = shift_pose(_on(board, vector(BEHIND[:2]).expand(n, 2), BEHIND[2]), right)
        return {
            "l_hand": [
                Leg("reach", shift_pose(_beside(board, WAIT), left), free=True),
                Leg("close", _beside(board, EDGE)),
                Leg("away", shift_pose(_beside(board, WAIT), left), free=True),
            ],
            "r_hand": [
                Leg("reach", behind, free=True),
                Leg("close", shift_pose(_on(board, _zigzag(first), HOVER), right), free=True),
                Leg("press", zigzag(first)),
                Leg("wipe", zigzag),
                Leg("lift", shift_pose(_on(board, _zigzag(last), HOVER), right)),
                Leg("away", behind, free=True),
            ],
        }

    def judge(self) -> Judge:
        """Looks where the sponge presses on the board, and at the left palm meanwhile."""
        return _Judge()


def _zigzag(done: Tensor) -> Tensor:
    """Places (..., 2) in the board's plane, when a share of the wiping is done [m]."""
    long, wide = WAY
    # at rest at the beginning and the end, and at each turn along the board
    along = done - torch.sin(2 * math.pi * STROKES * done) / (2 * math.pi * STROKES)
    across = torch.cos(math.pi * STROKES * done)
    return torch.stack((long * (1 - 2 * along), -wide * across), dim=-1)


def _beside(board: Frame, point: tuple[float, ...]) -> Frame:
    """Return the left hand (n,) with its palm to the edge, at a point of the board's frame."""
    return _turn_hand(board, vector(point), (0.0, PITCH, 0.0))


def _on(board: Frame, place: Tensor, height: float) -> Frame:
    """Return the right hand (...) with its palm to the board, the sponge so high above it."""
    above = torch.full_like(place[..., :1], height + 0.01 + 2 * SPONGE[1])
    point = torch.cat((place, above), dim=-1)
    return _turn_hand(board, point, (0.0, 0.0, TURN), (-math.pi / 2, 0.0, 0.0))


def _turn_hand(board: Frame, point: Tensor, *turns: tuple[float, ...]) -> Frame:
    """Turn a hand in the board's frame by rotation vectors, one after the other."""
    orientation = board.orientation
    for turn in turns:
        orientation = quaternions.product(orientation, quaternions.exp(vector(turn)))
    place = board.transform(point)
    return place_hand(Frame(place, orientation.expand(*place.shape[:-1], 4)), (0.0, 0.0, 0.0))


class _Judge(Judge):
    def __init__(self) -> None:
        shape = [round(2 * half / CELL) for half in FIELD]
        self.wiped = np.zeros(shape, dtype=bool)
        self.pressed = self.impulse = self.edge = self.off = self.pause = 0.0

    def note(self, scene: RobotScene, seconds: float) -> None:
        force = scene.touch("sponge", "board")
        low, high = FORCES
        if force < low:
            # what comes after the last contact is no pause
            self.pause += seconds if self.pressed else 0.0
            return
        self.off, self.pause = self.off + self.pause, 0.0
        self.pressed += seconds
        self.impulse += force * seconds
        self.edge = max(self.edge, scene.gap(STEADY))
        if force <= high:
            self._wipe(scene)

    def _wipe(self, scene: RobotScene) -> None:
        """Mark the cells that are in the sponge, which gives way to the board."""
        rows, columns = (
            (np.arange(n) + 0.5) * CELL - half
            for n, half in zip(self.wiped.shape, FIELD, strict=True)
        )
        grid = np.stack(np.broadcast_arrays(rows[:, None], columns, 0.0), axis=-1)
        board, sponge = scene.data.body("board"), scene.data.geom("sponge")
        cells = board.xpos + grid @ board.xmat.reshape(3, 3).T
        inside = np.abs((cells - sponge.xpos) @ sponge.xmat.reshape(3, 3)) <= SPONGE
        self.wiped |= inside.all(-1)

    def figures(self, scene: RobotScene) -> dict[str, float]:
        return {
            "coverage": float(self.wiped.mean()),
            "force": self.impulse / self.pressed if self.pressed else 0.0,
            "off_s": self.off,
            "edge_mm": 1e3 * self.edge,
        }
