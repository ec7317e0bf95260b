"""The bimanual ViperX of gym-aloha as a :class:`tpgmm_torch.Robot`.

Its description is written as URDF from gym-aloha's own MuJoCo model, compiled at run time, so
that nothing of that package is copied and the two cannot differ.
"""

from __future__ import annotations

from functools import cache
from typing import Any
from xml.etree import ElementTree

from tpgmm_torch import Canonical, Frame, RelativeOrientation, RelativePosition, Robot, Stack
from tpgmm_torch.exceptions import DependencyError, UnknownNameError
from tpgmm_torch.operators import Operator
from tpgmm_torch.robots.mjcf import mjcf_to_urdf

SIDES = ("left", "right")
ARM_JOINTS = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
#: What the error says where gym-aloha is missing.
HOW_TO_INSTALL = (
    "pip install 'lerobot_env_bimanual[aloha]' (on Python 3.12: one of its "
    "dependencies has no wheel for later ones)"
)
#: gym-aloha's order: the joints of an arm [rad], then its gripper (0 closed, 1 open).
JOINTS = tuple(f"{side}_arm_{joint}" for side in SIDES for joint in (*ARM_JOINTS, "gripper"))
#: The objects of each task, in the order of ``environment_state``.
OBJECTS = {"transfer_cube": ("cube",), "insertion": ("peg", "socket")}
GRIPPERS = tuple(name for name in JOINTS if name.endswith("_gripper"))
#: Where the fingers hold things, 14 mm behind their tips, in gym-aloha's ``gripper_link`` [m].
PINCH_POINT = (0.14, 0.0, 0.0)


def aloha_operators(task: str, orientation: bool = True) -> list[Operator]:
    """List the subspaces of a task: each gripper seen from an object, and the joints.

    Where peg and socket meet, also one gripper seen from the other.

    Parameters
    ----------
    task : {"transfer_cube", "insertion"}
    orientation : bool, default=True
        False leaves the grippers' orientations out.

    Notes
    -----
    The grippers have a subspace each. Stacked into one they would be correlated, and among a
    few demonstrations every correlation seems certain: with the two objects of the insertion
    6 of 50 unseen situations were then solved after 5 demonstrations, with a subspace each
    41 were.
    """
    if task not in OBJECTS:
        raise UnknownNameError("task", task, "aloha_state", OBJECTS)
    pairs = {
        "transfer_cube": (("left_gripper", "cube"), ("right_gripper", "cube")),
        "insertion": (
            ("left_gripper", "socket"),
            ("right_gripper", "peg"),
            ("right_gripper", "left_gripper"),
        ),
    }[task]
    if not orientation:
        return [*(RelativePosition(*pair) for pair in pairs), Canonical()]
    poses = (Stack(RelativePosition(*pair), RelativeOrientation(*pair)) for pair in pairs)
    return [*poses, Canonical()]


def aloha_robot(**options: Any) -> Robot:
    """Build the two arms, with the points between the fingers as links.

    Parameters
    ----------
    **options
        Passed to :meth:`tpgmm_torch.Robot.from_urdf`, for example ``dtype``.

    Returns
    -------
    Robot
        With the joints of gym-aloha in its order, 6 + gripper of the left arm, then of the
        right. The grippers are coordinates without kinematics, in gym-aloha's normalised
        scale: 0 is closed, 1 open. The links ``left_gripper`` and ``right_gripper`` sit
        between the fingertips, x ahead, y from the right finger to the left one.

    Raises
    ------
    DependencyError
        Without gym-aloha.
    """
    tools = {
        f"{side}_gripper": (f"vx300s_{side}/gripper_link", Frame(PINCH_POINT)) for side in SIDES
    }
    return Robot.from_urdf(
        aloha_urdf(),
        links=tuple(tools),
        joints=JOINTS,
        coordinates=GRIPPERS,
        tools=tools,
        **options,
    )


@cache
def aloha_urdf() -> str:
    """gym-aloha's scene as URDF text, with the arms' joints named as its actions name them.

    Links have the names of gym-aloha's bodies (``vx300s_left/gripper_link``), joints those
    that its actions have (``left_arm_waist``); the origin is the world's.

    Raises
    ------
    DependencyError
        Without gym-aloha.
    """
    try:
        from gym_aloha.constants import ASSETS_DIR
    except ImportError as error:
        raise DependencyError(
            f"the robot of aloha_state needs gym-aloha: {HOW_TO_INSTALL}"
        ) from error
    robot = ElementTree.fromstring(
        mjcf_to_urdf(ASSETS_DIR / "bimanual_viperx_transfer_cube.xml")
    )
    for joint in robot.findall("joint"):
        # the actions of gym-aloha call vx300s_left/waist left_arm_waist
        name = joint.get("name", "")
        if name.startswith("vx300s_") and not name.endswith("_mount"):
            joint.set("name", name.removeprefix("vx300s_").replace("/", "_arm_"))
    return ElementTree.tostring(robot, encoding="unicode")
