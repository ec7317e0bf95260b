"""The robots that do the tasks of the suite: what a task and its simulation need of each."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
from torch import Tensor

from lerobot_env_bimanual.bottle.conditions import skill
from lerobot_env_bimanual.robot_scene import robot_spec
from lerobot_env_bimanual.suite.names import UPPER_BODY
from lerobot_env_bimanual.suite.robots.g1 import g1_posture, g1_robot, g1_spec
from lerobot_env_bimanual.suite.robots.viperx import viperx_posture, viperx_robot, viperx_spec
from tpgmm_torch import Robot
from tpgmm_torch.exceptions import UnknownNameError

__all__ = ["Embodiment"]


@dataclass(frozen=True)
class Embodiment:
    """A robot with two hands before a table.

    Its base frame is that of the tasks: x ahead, y to the left, z up; the things are 0.2 to
    0.4 m ahead. A hand has its palm on the side of its y axis that is turned to the other one,
    and comes to things along its own -z.

    Parameters
    ----------
    robot : Robot
        With the links ``l_hand`` and ``r_hand``.
    posture : Tensor of shape (n_joints,)
        Around which episodes start, and which the expert's null space seeks, if there is one
        [rad].
    spec : callable
        Makes the simulated robot, as
        :func:`~lerobot_env_bimanual.robot_scene.add_position_control` gives it, its joints
        in the order of ``robot``.
    """

    robot: Robot
    posture: Tensor
    spec: Callable[[], mujoco.MjSpec]


EMBODIMENTS: dict[str, Callable[[], Embodiment]] = {
    UPPER_BODY: lambda: Embodiment(skill().robot, skill().neutral_posture(), robot_spec),
    "viperx": lambda: Embodiment(viperx_robot(), viperx_posture(), viperx_spec),
    "g1": lambda: Embodiment(g1_robot(), g1_posture(), g1_spec),
}


@functools.cache
def embodiment(name: str) -> Embodiment:
    """Make a robot of the suite once: building its kinematics takes a while.

    Raises
    ------
    UnknownNameError
        If it does not exist.
    DependencyError
        If its description is in a package that is not installed.
    """
    if name not in EMBODIMENTS:
        raise UnknownNameError("robot", name, "the suite", EMBODIMENTS)
    return EMBODIMENTS[name]()
