"""Two SO-101 arms, a cup with a stem, and a saucer in the left gripper, in MuJoCo."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_env_bimanual.robot_scene import (
    BOX,
    CAMERA,
    CYLINDER,
    PALM,
    TABLE,
    add_geom,
    add_table,
)
from lerobot_env_bimanual.so101.robot import PLAY, hand_of, so101_spec
from lerobot_env_bimanual.suite.scene import OBJECT, Hold, SuiteScene, add_thing

__all__ = [
    "CUP", "GRIP", "LEFT", "OBJECTS", "RIGHT", "SAUCER_TOP", "STEM", "BiSo101Scene",
    "in_left_hand",
]  # fmt: skip

OBJECTS = ("cup", "saucer")
LEFT = Hold(hand_of("left"), "saucer", "saucer")
RIGHT = Hold(hand_of("right"), "cup", "stem")
#: Radius of the cup and half its height, radius of its stem, and the middle of the stem above
#: the cup's foot [m].
CUP, CUP_HALF, STEM_RADIUS, STEM = 0.025, 0.025, 0.008, 0.065
#: Edge of the cube on the stem, whose middle is so high above the cup's foot [m].
CUBE, CUBE_MIDDLE = 0.0375, 0.099
#: Radius of the saucer and its top above its middle [m].
SAUCER, SAUCER_TOP = 0.055, 0.003
#: Where the stem is in the right gripper, seen from the link between its jaws: beside the fixed
#: jaw, and not at the very ends; where the middle of the saucer is in the left one [m].
GRIP, HELD = (-0.006, 0.0, -0.012), (0.0, 0.0, 0.045)
#: By how much the saucer's x axis, at whose end its cube stands, is turned from the left hand's
#: forward [rad]: the cube then faces a camera before the robot.
CUBE_TURN = math.radians(40.0)
#: A jaw holds from this force on [N], what is within this distance of the other jaw [m].
PRESSED, REACH = 0.3, 0.01
#: How long the arms sag and come to rest before an episode [ms].
SETTLING = 1500


class BiSo101Scene(SuiteScene):
    """The state of the simulated world.

    A gripper takes hold of what it may hold, as it then lies in it, when its moving jaw presses
    it and the fixed one is within 10 mm; it lets go when the moving jaw has left it.
    """

    def __init__(self) -> None:
        spec = so101_spec()
        spec.visual.quality.shadowsize, spec.visual.quality.offsamples = 0, 0
        _add_view(spec)
        add_table(spec, 0.8)
        _add_cup(spec)
        _add_saucer(spec)
        super().__init__(spec, OBJECTS, (LEFT, RIGHT))
        joints = [self.model.joint(i) for i in self.model.actuator_trnid[:, 0]]
        plays = [self.model.joint(joint.name + PLAY).qposadr[0] for joint in joints]
        self._plays = np.array(plays)

    @property
    def angles(self) -> NDArray[np.float64]:
        """Where the links are, behind the play of the joints, shape (12,) [rad]."""
        return np.asarray(self.data.qpos[self._places] + self.data.qpos[self._plays])

    def reset(
        self,
        poses: Mapping[str, NDArray[np.float64]],
        joints: NDArray[np.float64],
        table: float = 0.0,
    ) -> None:
        """Let the arms come to rest where their servos are told to be.

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

    def _controls(
        self, references: NDArray[np.float64], speeds: NDArray[np.float64]
    ) -> NDArray[np.float64]:
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


def _add_view(spec: Any) -> None:
    """A camera before the robot, and light."""
    eye, middle = np.array((0.80, -0.03, 0.52)), np.array((0.24, -0.03, 0.08))
    back = (eye - middle) / np.linalg.norm(eye - middle)
    right = np.cross((0.0, 0.0, 1.0), back)
    right /= np.linalg.norm(right)
    spec.worldbody.add_camera(
        name=CAMERA, pos=eye, xyaxes=(*right, *np.cross(back, right)), fovy=45
    )
    spec.worldbody.add_light(pos=(0.6, 0.3, 1.4), dir=(-0.3, -0.2, -1), diffuse=(0.8,) * 3)


def _add_cup(spec: Any) -> None:
    """A cup that stands on four feet, with a stem and a cube on it."""
    cup, white = add_thing(spec, "cup"), {"rgba": (0.9, 0.9, 0.95, 1)}
    add_geom(cup, CYLINDER, (CUP, CUP_HALF, 0), pos=(0, 0, CUP_HALF), mass=0.06, **white)
    foot = {"conaffinity": TABLE | OBJECT, "contype": OBJECT, "mass": 0.005, **white}
    radius, aside = 0.004, 0.02
    for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        place = (aside * x, aside * y, radius)
        add_geom(cup, mujoco.mjtGeom.mjGEOM_SPHERE, (radius, 0, 0), pos=place, **foot)
    half = CUBE_MIDDLE / 2 - CUP_HALF
    stem = {"name": "stem", "pos": (0, 0, 2 * CUP_HALF + half), "conaffinity": PALM}
    add_geom(cup, CYLINDER, (STEM_RADIUS, half, 0), mass=0.01, **stem, **white)
    add_geom(cup, BOX, (CUBE / 2,) * 3, pos=(0, 0, CUBE_MIDDLE), mass=0.02, **white)


def _add_saucer(spec: Any) -> None:
    """A saucer whose cube stands at the end of its x axis."""
    saucer, look = add_thing(spec, "saucer"), {"rgba": (0.35, 0.5, 0.75, 1)}
    size = (SAUCER, SAUCER_TOP, 0)
    add_geom(saucer, CYLINDER, size, name="saucer", mass=0.05, conaffinity=PALM, **look)
    top = (0.8 * SAUCER, 0.8 * SAUCER, SAUCER_TOP)
    add_geom(saucer, BOX, top, mass=0, contype=OBJECT, conaffinity=OBJECT, **look)
    place = (SAUCER + CUBE / 2, 0, CUBE / 2 - SAUCER_TOP)
    add_geom(saucer, BOX, (CUBE / 2,) * 3, pos=place, mass=0.02, **look)


def in_left_hand(aside: float = 0.0, turn: float = 0.0) -> NDArray[np.float64]:
    """The saucer in the left gripper, shape (7,): level where that is.

    Parameters
    ----------
    aside : float
        How far it was pushed in too far [m].
    turn : float
        How far it is turned about its own axis [rad].
    """
    axes = np.zeros((3, 3))
    axes[:, 2] = (-1.0, 0.0, 0.0)  # up, where the hand is level: its x axis points down
    angle = CUBE_TURN + turn
    axes[:, 0] = (0.0, math.sin(angle), math.cos(angle))
    axes[:, 1] = np.cross(axes[:, 2], axes[:, 0])
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, axes.ravel())
    return np.concatenate((np.array(HELD) - (0.0, 0.0, aside), quaternion))
