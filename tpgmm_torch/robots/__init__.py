"""Robots and other sources of link poses and Jacobians."""

from importlib import import_module
from typing import TYPE_CHECKING

# readers of descriptions are loaded where a robot is made of one (PEP 562)
if TYPE_CHECKING:
    from tpgmm_torch.robots.kinematics import JointSpace, Kinematics, RobotState
    from tpgmm_torch.robots.robot import Robot
    from tpgmm_torch.robots.tracked_poses import Poses

__all__ = ["JointSpace", "Kinematics", "Poses", "Robot", "RobotState"]

_HOME = {
    "JointSpace": "kinematics",
    "Kinematics": "kinematics",
    "Poses": "tracked_poses",
    "Robot": "robot",
    "RobotState": "kinematics",
}


def __getattr__(name: str) -> object:
    """Load a public name when it is first asked for."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return globals().setdefault(name, getattr(import_module(f"{__name__}.{_HOME[name]}"), name))
