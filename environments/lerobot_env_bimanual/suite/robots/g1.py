"""A Unitree G1 at the table of the suite: waist and arms, with palms in its rubber hands.

Links, joints, ranges, masses and shapes are those of the URDF in the package
``example-robot-data``, read when they are asked for, so that nothing of it is copied. Legs are
left out, the pelvis stands still, and joints are under position control as the upper body's.
"""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import mujoco
import torch
from torch import Tensor

from lerobot_env_bimanual.robot_scene import PALM_SIZE, add_position_control
from tpgmm_datasets.bottle.skill import HANDS
from tpgmm_torch import Robot
from tpgmm_torch.exceptions import DependencyError

PACKAGE = "example-robot-data"
FOLDER = "cmeel.prefix/share/example-robot-data/robots/g1_description"
URDF, MESHES = f"{FOLDER}/urdf/g1_29dof_rev_1_0.urdf", f"{FOLDER}/meshes"
#: Where the pelvis stands, seen from the origin of the tasks [m]. Of twelve places it was the
#: one where, in all that experts ask for, joints stay furthest from their ends.
BASE = (-0.08, 0.0, 0.0)
#: How far before the last joint of a wrist the middle of the palm is [m].
AHEAD = 0.09
#: A hand comes to things along its own -z, which is where the wrist's x is: turns about x, y, z
#: [rad].
TURN = "0 -1.5707963267948966 0"
SIDES = ("left", "right")
#: What the names of the legs' links and joints have in them.
LEGS = ("hip", "knee", "ankle")
WAIST = ("waist_yaw_joint", "waist_roll_joint", "waist_pitch_joint")
ARM = (
    *("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow"),
    *("wrist_roll", "wrist_pitch", "wrist_yaw"),
)
#: How much stiffer its joints are than the upper body's: with equal gains its hands yield more,
#: and press hardly hard enough to wipe.
GAIN = 2.0
#: Of the left arm: hands wait as those of the upper body do [rad].
POSTURE = (0.209, 0.337, -0.135, -0.066, 0.17, 0.323, -0.372)
#: Which joints turn the other way in a mirror.
MIRRORED = (1.0, -1.0, -1.0, 1.0, -1.0, 1.0, -1.0)


def g1_posture() -> Tensor:
    """Return the posture in which it waits, hands before it, shape (17,) [rad]."""
    left, mirror = (torch.tensor(row, dtype=torch.float64) for row in (POSTURE, MIRRORED))
    return torch.cat((torch.zeros(len(WAIST), dtype=torch.float64), left, mirror * left))


def g1_robot() -> Robot:
    """Build the kinematics of waist and arms.

    Returns
    -------
    Robot
        The joints of the waist, of the left arm, then of the right one, by their names in the
        URDF; links ``l_hand`` and ``r_hand``.

    Raises
    ------
    DependencyError
        Without example-robot-data.
    """
    robot = _description()
    # models are saved with their robot: no paths of this machine's meshes
    for link in robot.iter("link"):
        for shape in link.findall("visual"):
            link.remove(shape)
    arms = [f"{side}_{joint}_joint" for side in SIDES for joint in ARM]
    text = ElementTree.tostring(robot, encoding="unicode")
    return Robot.from_urdf(text, HANDS, joints=[*WAIST, *arms])


def g1_spec() -> mujoco.MjSpec:
    """Waist, arms, trunk and head alone, simulated under position control.

    Returns
    -------
    mujoco.MjSpec
        As :func:`~lerobot_env_bimanual.robot_scene.add_position_control` gives it.

    Raises
    ------
    DependencyError
        Without example-robot-data.
    """
    robot = _description()
    # MuJoCo drops what is only seen, and joins what does not move
    keep = {"discardvisual": "false", "fusestatic": "false", "strippath": "false"}
    SubElement(SubElement(robot, "mujoco"), "compiler", keep)
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(robot, encoding="unicode"))
    for hand in HANDS:
        spec.body(hand).add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=PALM_SIZE, mass=0)
    return add_position_control(spec, GAIN)


def _description() -> Element:
    """Read the URDF from the pelvis up, with hands, seen from the origin of the tasks."""
    robot = ElementTree.parse(_locate_file(URDF)).getroot()
    meshes = _locate_file(MESHES)
    for link in robot.iter("link"):
        for shape in link.findall("collision"):
            link.remove(shape)
        for mesh in link.iter("mesh"):
            mesh.set("filename", str(meshes / Path(mesh.get("filename", "")).name))
    for part in [*robot]:
        if any(leg in part.get("name", "") for leg in LEGS):
            robot.remove(part)
    _fix(robot, "origin", "pelvis", "{} {} {}".format(*BASE), "0 0 0")
    SubElement(robot, "link", name="origin")
    for side, hand in zip(SIDES, HANDS, strict=True):
        SubElement(robot, "link", name=hand)
        _fix(robot, f"{side}_wrist_yaw_link", hand, f"{AHEAD} 0 0", TURN)
    return robot


def _locate_file(path: str) -> Path:
    """Locate a file or folder of the package."""
    try:
        place = Path(str(distribution(PACKAGE).locate_file(path)))
    except PackageNotFoundError as error:
        raise DependencyError(
            f"the robot g1 needs {PACKAGE}: pip install 'lerobot_env_bimanual[g1]'"
        ) from error
    if not place.exists():
        raise DependencyError(
            f"the robot g1 is not in this version of {PACKAGE}, {path} is missing: "
            "pip install --upgrade 'lerobot_env_bimanual[g1]'"
        )
    return place


def _fix(robot: Element, parent: str, child: str, place: str, turn: str) -> None:
    """Mount a link on another."""
    joint = SubElement(robot, "joint", name=f"{child}_mount", type="fixed")
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)
    SubElement(joint, "origin", xyz=place, rpy=turn)
