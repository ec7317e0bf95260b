"""Joints that close around things."""

import torch
from torch import Tensor

from tpgmm_torch.data.pose_names import is_gripper
from tpgmm_torch.robots.kinematics import Kinematics


def gripping_joints(kinematics: Kinematics) -> Tensor | None:
    """Find joints that close around things: named as grippers, and moving no link.

    One that holds something does not come to its reference: where it stands says nothing of
    whether the robot follows.

    Parameters
    ----------
    kinematics : Kinematics
        Of the robot.

    Returns
    -------
    Tensor of bool, shape (n_joints,)
        None if there is no such joint, or no other one.
    """
    named = torch.tensor([is_gripper(name) for name in kinematics.joint_names])
    if not named.any() or named.all():
        return None
    lower, upper = kinematics.lower, kinematics.upper
    moved = kinematics.state(torch.zeros_like(lower).clamp(lower, upper)).jacobians.abs() > 0
    links = bool(kinematics.links)
    free = ~moved.flatten(end_dim=-2).any(0) if links else torch.ones_like(named)
    found = named.to(free.device) & free
    return found if bool(found.any()) else None
