"""Joints that grip."""

import pytest

from tests.support.robot_zoo import upper_body
from tpgmm_control.sensing.gripping import gripping_joints
from tpgmm_datasets.robots import so101_urdf
from tpgmm_torch.robots.kinematics import JointSpace
from tpgmm_torch.robots.robot import Robot


@pytest.mark.parametrize(
    ("robot", "expected"),
    [
        (upper_body(), None),
        (upper_body(coordinates=["l_grip", "r_grip", "lamp"]), ["l_grip", "r_grip"]),
        (Robot.from_urdf(so101_urdf(), ["gripper_frame_link"], joints="*"), ["gripper"]),
        (JointSpace(["elbow", "left_gripper"]), ["left_gripper"]),
        (JointSpace(["left_gripper", "right_gripper"]), None),
    ],
)
def test_joints_that_grip_are_named_so_and_move_no_link(robot, expected):
    found = gripping_joints(robot)
    if expected is None:
        assert found is None
    else:
        assert [robot.joint_names[i] for i in found.nonzero()] == expected
