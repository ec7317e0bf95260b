"""One pass through the tree, whichever way it goes, and pytorch-kinematics as an oracle."""

import pytest
import pytorch_kinematics
import torch

from tests.support.robot_zoo import HANDS, g1, random_joints, upper_body, zoo
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_torch import quaternions
from tpgmm_torch.robots.forward_kinematics import MANY
from tpgmm_torch.robots.robot import Robot

ROBOTS = {"upper body": upper_body, "zoo": zoo, "zoo from its tip": lambda: zoo(base="tip")}
ROBOTS["g1"] = g1


@pytest.mark.parametrize("make", ROBOTS.values(), ids=list(ROBOTS))
@pytest.mark.parametrize("count", [2, MANY - 1, MANY, 3 * MANY])
def test_many_robots_are_each_one_alone(make, count):
    robot = make()
    joints = random_joints(robot, count)
    together = robot.state(joints)
    for index in (0, count - 1):
        alone = robot.state(joints[index])
        for name in ("positions", "orientations", "jacobians"):
            torch.testing.assert_close(
                getattr(together, name)[index], getattr(alone, name), rtol=0, atol=1e-14
            )


def test_one_robot_has_any_shape():
    robot = zoo()
    joints = random_joints(robot, 3)[1]
    alone = robot.state(joints)
    for batch in ((1,), (1, 1)):
        state = robot.state(joints.expand(*batch, -1))
        for name in ("positions", "orientations", "jacobians"):
            part, whole = getattr(alone, name), getattr(state, name)
            assert torch.equal(whole, part.expand(*batch, *part.shape))


def test_no_robot_at_all_is_a_batch_too():
    state = upper_body().state(torch.zeros(0, 17))
    assert state.positions.shape == (0, 2, 3)
    assert state.jacobians.shape == (0, 2, 6, 17)


def test_a_link_that_nothing_moves_has_a_jacobian_of_zeros():
    state = Robot.from_urdf(upper_body_urdf(), ["base"]).state(torch.zeros(17))
    assert torch.equal(state.positions, torch.zeros(1, 3, dtype=torch.float64))
    assert not state.jacobians.any()


def test_upper_body_agrees_with_pytorch_kinematics():
    robot = upper_body()
    chain = pytorch_kinematics.build_chain_from_urdf(upper_body_urdf().encode())
    assert tuple(chain.get_joint_parameter_names()) == robot.joint_names
    joints = random_joints(robot, 20)
    state = robot.state(joints)
    poses = chain.to(dtype=torch.float64).forward_kinematics(joints)
    for hand in HANDS:
        matrix = poses[hand].get_matrix()
        # it keeps the origins of the joints in float32
        torch.testing.assert_close(state.position(hand), matrix[:, :3, 3], rtol=0, atol=1e-6)
        rotation = quaternions.to_matrix(state.orientation(hand))
        torch.testing.assert_close(rotation, matrix[:, :3, :3], rtol=0, atol=1e-6)


def test_second_derivatives_are_those_of_finite_differences():
    robot = zoo()
    joints = random_joints(robot, 1).requires_grad_()

    def position(q):
        return robot.state(q).positions

    assert torch.autograd.gradgradcheck(position, joints, fast_mode=True)
