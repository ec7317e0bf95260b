"""Two SO-101 arms, a cup with a stem, and a saucer in the left gripper, in MuJoCo."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from lerobot_env_bimanual.base import Array
from lerobot_env_bimanual.eyes.carriers import cube_at
from lerobot_env_bimanual.robot_scene import (
    BOX,
    CYLINDER,
    OBJECT,
    PALM,
    TABLE,
    Hold,
    RobotScene,
    add_geom,
    add_table,
    add_thing,
    add_view,
)
from lerobot_env_bimanual.so101 import TASKS
from lerobot_env_bimanual.so101.robot import PLAY, hand_of, so101_spec

OBJECTS = TASKS["cup_on_saucer"]
LEFT = Hold(hand_of("left"), "saucer", "saucer")
RIGHT = Hold(hand_of("right"), "cup", "stem")
#: Radius of the cup and half its height, radius of its stem, and the middle of the stem above
#: the cup's foot [m].
CUP, CUP_HALF, STEM_RADIUS, STEM = 0.025, 0.025, 0.008, 0.060
#: Edge of the tags on cubes, half an edge of a cube of them, and of the block inside [m].
TAG = 0.03
CUBE = TAG * 10 / 16
BLOCK = CUBE - 0.001
#: The middle of the cup's cube above its foot [m].
CUBE_MIDDLE = 0.118
#: Radius of the saucer and its top above its middle [m].
SAUCER, SAUCER_TOP = 0.055, 0.003
#: Half the thickness of what the cup collides with [m].
DEPTH = 0.015
#: The middle of its cube, at the end of its x axis [m].
SAUCER_CUBE = (SAUCER + CUBE, 0.0, CUBE - SAUCER_TOP)
CARRIERS = {
    "cup": cube_at(10, z=CUBE_MIDDLE, size=TAG),
    "saucer": cube_at(20, *SAUCER_CUBE, size=TAG),
}
#: Where the stem is in the right gripper, seen from the link between its jaws: beside the fixed
#: jaw, and not at the very ends; how far ahead of the left one the saucer's middle is [m].
GRIP, HELD_AHEAD = (-0.006, 0.0, -0.012), 0.045
#: How the hands then point: down by so much [rad]; and which axis of each is then vertical,
#: upwards.
RIGHT_TILT, LEFT_TILT = math.radians(40.0), math.radians(30.0)
RIGHT_UP = (0.0, -math.cos(RIGHT_TILT), -math.sin(RIGHT_TILT))
LEFT_UP = (-math.cos(LEFT_TILT), 0.0, -math.sin(LEFT_TILT))
#: By how much the saucer's x axis, at whose end its cube stands, is turned from the left hand's
#: forward [rad]: the cube then faces a camera before the robot.
CUBE_TURN = math.radians(40.0)
#: A jaw holds from this force on [N], what is within this distance of the other jaw [m].
PRESSED, REACH = 0.3, 0.01
#: How long the arms sag and come to rest before an episode [ms].
SETTLING = 1500


class BiSo101Scene(RobotScene):
    """The state of the simulated world.

    A gripper takes hold of what it may hold, as it then lies in it, when its moving jaw presses
    it and the fixed one is within 10 mm; it lets go when the moving jaw has left it.
    """

    def __init__(self) -> None:
        spec = so101_spec()
        add_view(spec)
        add_table(spec, 0.8)
        _add_cup(spec)
        _add_saucer(spec)
        # the fixed jaw lies askew under the saucer that it holds
        spec.add_exclude(bodyname1=LEFT.hand, bodyname2="saucer")
        super().__init__(spec, OBJECTS, (LEFT, RIGHT))
        joints = [self.model.joint(i) for i in self.model.actuator_trnid[:, 0]]
        plays = [self.model.joint(joint.name + PLAY).qposadr[0] for joint in joints]
        self._plays = np.array(plays)

    @property
    def angles(self) -> Array:
        """Angles of the links, behind the play of the joints, shape (12,) [rad]."""
        return np.asarray(self.data.qpos[self._places] + self.data.qpos[self._plays])

    def reset(
        self,
        poses: Mapping[str, Array],
        joints: Array,
        table: float = 0.0,
    ) -> None:
        """Let the arms come to rest where their servos are commanded.

        Parameters
        ----------
        poses : mapping of str to ndarray of shape (7,)
            Of the cup in the base frame, and of the saucer in the left hand.
        joints : ndarray of shape (12,)
            References [rad].
        table : float, default=0
            Its height [m].
        """
        super().reset({"cup": poses["cup"]}, joints, table)
        hand = self.data.body(LEFT.hand)
        position, turn = np.zeros(3), np.zeros(4)
        held = np.asarray(poses["saucer"])
        mujoco.mju_mulPose(position, turn, hand.xpos, hand.xquat, held[:3], held[3:])
        self.put("saucer", np.concatenate((position, turn)))
        self.hold(LEFT)
        for _ in range(SETTLING):
            self._step(joints)
        mujoco.mj_kinematics(self.model, self.data)

    def _controls(self, references: Array, speeds: Array) -> Array:
        """Those of servos, which know no speeds."""
        return references

    def rest(self) -> None:
        """Go on as it is: the servos keep their references."""

    def grip(self) -> None:
        """Take hold of what the jaws press, and let go of what they have left."""
        for hold in self._welds:
            pressed = self.touch(f"{hold.hand[0]}_jaw", hold.grip)
            if hold in self.held:
                if pressed == 0.0:
                    self.let_go(hold)
            elif pressed > PRESSED and self.gap(hold) < REACH:
                self.hold(hold)


def _add_cup(spec: Any) -> None:
    """Add a cup that stands on four feet, with a stem and a cube on it."""
    cup, white = add_thing(spec, "cup"), {"rgba": (0.9, 0.9, 0.95, 1)}
    add_geom(cup, CYLINDER, (CUP, CUP_HALF, 0), pos=(0, 0, CUP_HALF), mass=0.06, **white)
    foot = {"conaffinity": TABLE | OBJECT, "contype": OBJECT, "mass": 0.005, **white}
    radius, aside = 0.004, 0.02
    for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        place = (aside * x, aside * y, radius)
        add_geom(cup, mujoco.mjtGeom.mjGEOM_SPHERE, (radius, 0, 0), pos=place, **foot)
    half = (CUBE_MIDDLE - 2 * CUP_HALF) / 2
    stem = {"name": "stem", "pos": (0, 0, 2 * CUP_HALF + half), "conaffinity": PALM}
    add_geom(cup, CYLINDER, (STEM_RADIUS, half, 0), mass=0.01, **stem, **white)
    add_geom(cup, BOX, (BLOCK,) * 3, pos=(0, 0, CUBE_MIDDLE), mass=0.02, **white)


def _add_saucer(spec: Any) -> None:
    """Add a saucer whose cube stands at the end of its x axis."""
    saucer, look = add_thing(spec, "saucer"), {"rgba": (0.35, 0.5, 0.75, 1)}
    size = (SAUCER, SAUCER_TOP, 0)
    add_geom(saucer, CYLINDER, size, name="saucer", mass=0.05, conaffinity=PALM, **look)
    # what stands on it is pushed up, however deep a hand has pressed it in
    top, below = (0.7 * SAUCER, 0.7 * SAUCER, DEPTH), (0.0, 0.0, SAUCER_TOP - DEPTH)
    stop = {"contype": OBJECT, "conaffinity": OBJECT | TABLE, "group": 3}
    add_geom(saucer, BOX, top, pos=below, mass=0, **stop)
    add_geom(saucer, BOX, (BLOCK,) * 3, pos=SAUCER_CUBE, mass=0.02, **look)


def in_left_hand(aside: float = 0.0, turn: float = 0.0) -> Array:
    """Return the saucer's pose (7,) in the left gripper: level where that points down.

    Parameters
    ----------
    aside : float
        By how much it is farther between the jaws [m].
    turn : float
        By how much it is turned about its own axis [rad].
    """
    up = np.array(LEFT_UP)
    ahead = np.cross((0.0, 1.0, 0.0), up)  # y points to the left
    angle = CUBE_TURN + turn
    x = math.cos(angle) * ahead + math.sin(angle) * np.array((0.0, 1.0, 0.0))
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.stack((x, np.cross(up, x), up), axis=1).ravel())
    return np.concatenate(((HELD_AHEAD - aside) * ahead, quaternion))
