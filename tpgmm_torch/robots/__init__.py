"""Robots and other sources of link poses and Jacobians."""

from typing import TYPE_CHECKING

from tpgmm_torch.late import load_late

# readers of descriptions are loaded where a robot is made of one (PEP 562)
if TYPE_CHECKING:
    from tpgmm_torch.robots.kinematics import JointSpace, Kinematics, RobotState
    from tpgmm_torch.robots.robot import Robot
    from tpgmm_torch.robots.tracked_poses import Poses

__all__ = ["JointSpace", "Kinematics", "Poses", "Robot", "RobotState"]

__getattr__, __dir__ = load_late(
    globals(),
    {
        ".kinematics": ("JointSpace", "Kinematics", "RobotState"),
        ".robot": ("Robot",),
        ".tracked_poses": ("Poses",),
    },
)
