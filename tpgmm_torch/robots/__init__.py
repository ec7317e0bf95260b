"""Robots and other sources of link poses and Jacobians."""

from tpgmm_torch.robots.joint_space import JointSpace
from tpgmm_torch.robots.kinematics import Kinematics, RobotState
from tpgmm_torch.robots.robot import Robot
from tpgmm_torch.robots.tracked_poses import Poses

__all__ = ["JointSpace", "Kinematics", "Poses", "Robot", "RobotState"]
