"""gym-aloha's two ViperX arms at the table of the suite, with palms in place of fingers.

Bodies, joints, ranges, masses and shapes are taken from gym-aloha's own MuJoCo model when they
are asked for, so that nothing of that package is copied. Its table, fingers, servos and dry
friction are left out: joints are under the same position control as the upper body's.
"""

from __future__ import annotations

import math
from xml.etree import ElementTree

import mujoco
import torch
from torch import Tensor

from lerobot_env_bimanual.aloha.robot import ARM_JOINTS, HOW_TO_INSTALL, SIDES
from lerobot_env_bimanual.robot_scene import PALM_SIZE, add_position_control
from tpgmm_datasets.bottle.skill import HANDS
from tpgmm_torch import Robot, quaternions
from tpgmm_torch.exceptions import DependencyError
from tpgmm_torch.robots.mjcf import mjcf_to_urdf

#: Where the left arm stands [m]; the right one is its mirror image. This, and how hands are
#: mounted, comes from a search: how far six joints stay, in all that the experts ask for, from
#: their ends and speeds, from stretched elbows and straight wrists.
BASE = (0.03, 0.4, -0.19)
#: How the left hand is mounted: so far ahead of ``gripper_link`` [m], and that is turned to the
#: left and down by so much where the hand is level and straight [rad].
AHEAD, OUTWARDS, DOWN = 0.08, math.radians(6.0), math.radians(27.0)
#: Of a hand [kg].
MASS = 0.1
#: Of all joints, as in the manufacturer's description [rad/s].
SPEED = math.pi
#: Of the left arm: hands wait where those of the upper body do, level [rad].
POSTURE = (-1.67, -0.24, 0.82, 1.07, 1.48, -2.17)
#: Which joints turn the other way in a mirror.
MIRRORED = (-1.0, 1.0, 1.0, -1.0, 1.0, -1.0)


def viperx_posture() -> Tensor:
    """Return the posture in which both arms wait, shape (12,) [rad]."""
    left, mirror = (torch.tensor(row, dtype=torch.float64) for row in (POSTURE, MIRRORED))
    return torch.cat((left, mirror * left))


def viperx_robot() -> Robot:
    """Build the kinematics of both arms: the six joints of the left one, then the right one's.

    Returns
    -------
    Robot
        Joints are named as gym-aloha's actions are, links ``l_hand`` and ``r_hand``.

    Raises
    ------
    DependencyError
        Without gym-aloha.
    """
    spec = _arms()
    # models are saved with their robot: no paths of this machine's meshes
    for shape in (*spec.geoms, *spec.meshes):
        spec.delete(shape)
    spec.compile()
    description = ElementTree.fromstring(mjcf_to_urdf(spec.to_xml()))
    for limit in description.iter("limit"):
        limit.set("velocity", str(SPEED))
    text = ElementTree.tostring(description, encoding="unicode")
    joints = [f"{side}_arm_{joint}" for side in SIDES for joint in ARM_JOINTS]
    return Robot.from_urdf(text, HANDS, joints=joints)


def viperx_spec() -> mujoco.MjSpec:
    """Both arms alone, simulated under position control.

    Returns
    -------
    mujoco.MjSpec
        As :func:`~lerobot_env_bimanual.robot_scene.add_position_control` gives it.

    Raises
    ------
    DependencyError
        Without gym-aloha.
    """
    return add_position_control(_arms())


def _arms() -> mujoco.MjSpec:
    """Both arms, without collisions and friction."""
    try:
        from gym_aloha.constants import ASSETS_DIR
    except ImportError as error:
        raise DependencyError(f"the robot viperx needs gym-aloha: {HOW_TO_INSTALL}") from error
    spec = mujoco.MjSpec.from_file(str(ASSETS_DIR / "bimanual_viperx_transfer_cube.xml"))
    spec.compiler.inertiagrouprange = (0, 5)  # else what is added weighs nothing
    for part in (*spec.cameras, *spec.lights, *spec.actuators, *spec.keys, *spec.sites):
        spec.delete(part)
    for name in ("table", "midair", "box"):
        spec.delete(spec.body(name))
    x, y, z = BASE
    for side, hand, sign in zip(SIDES, HANDS, (1, -1), strict=True):
        arm = f"vx300s_{side}"
        base, gripper = spec.body(arm), spec.body(f"{arm}/gripper_link")
        base.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        base.pos, base.quat = (x, sign * y, z), (1, 0, 0, 0)
        for name in ("left_finger_link", "right_finger_link", "gripper_prop_link"):
            spec.delete(spec.body(f"{arm}/{name}"))
        for name in ARM_JOINTS:
            joint = spec.joint(f"{arm}/{name}")
            joint.name, joint.frictionloss = f"{side}_arm_{name}", 0.0
        palm = gripper.add_body(
            name=hand, pos=(AHEAD, 0, 0), quat=_hand_orientation(sign).numpy()
        )
        palm.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=PALM_SIZE, mass=MASS)
    return spec


def _hand_orientation(sign: int) -> Tensor:
    """Compute how a hand is turned in ``gripper_link``, a unit quaternion."""
    turns = (
        (0.0, -DOWN, 0.0),
        (0.0, 0.0, -sign * OUTWARDS),
        (0.0, -math.pi / 2, 0.0),  # a hand comes along its own -z
    )
    orientation = torch.tensor((1.0, 0.0, 0.0, 0.0), dtype=torch.float64)
    for turn in turns:
        by = quaternions.exp(torch.tensor(turn, dtype=torch.float64))
        orientation = quaternions.product(orientation, by)
    return orientation
