"""Products along the tree, for one robot and for many, against products written out."""

import numpy as np
import pytest
import pytorch_kinematics
import torch

from tests.support.robot_zoo import (
    HANDS,
    g1,
    random_joints,
    upper_body,
    written_out,
    zoo,
)
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_torch import quaternions

ROBOTS = {
    "upper body": upper_body,
    "zoo": zoo,
    "zoo from its tip": lambda: zoo(base="tip"),
    "zoo that does not move": lambda: zoo(("flange", "arm"), base="arm"),
    "zoo of a slide": lambda: zoo(("column",), joints=["lift"], coordinates=["free"]),
    "zoo of fingers": lambda: zoo(("l_finger", "r_finger"), joints=["wag", "grip", "elbow"]),
    "g1": g1,
}
COUNTS = [1, 2, 7, 40, 300]


@pytest.mark.parametrize("make", ROBOTS.values(), ids=list(ROBOTS))
@pytest.mark.parametrize("count", COUNTS)
def test_every_robot_of_a_batch_is_the_products_along_its_tree(make, count):
    robot = make()
    joints = random_joints(robot, count, seed=count)
    positions, orientations, jacobians = robot.forward_kinematics(joints)
    assert positions.shape == (count, len(robot.links), 3)
    assert orientations.shape == (count, len(robot.links), 4)
    assert jacobians.shape == (count, len(robot.links), 6, robot.n_joints)
    assert bool((orientations[..., 0] >= 0).all())
    rotations = quaternions.to_matrix(orientations)
    for index in range(0, count, 1 + count // 20):
        poses, expected = written_out(robot.tree, joints[index].numpy())
        links = slice(len(poses) - len(robot.links), None)
        poses, expected = poses[links], expected[links]
        np.testing.assert_allclose(positions[index], poses[:, :3, 3], rtol=0, atol=1e-13)
        np.testing.assert_allclose(rotations[index], poses[:, :3, :3], rtol=0, atol=1e-13)
        np.testing.assert_allclose(jacobians[index], expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("count", [1, 3])
def test_the_type_is_the_one_asked_for(count):
    robot = zoo()
    joints = random_joints(robot, count)
    single = robot.to(torch.float32).forward_kinematics(joints.float())
    for rounded, exact in zip(single, robot.forward_kinematics(joints), strict=True):
        assert rounded.dtype == torch.float32
        torch.testing.assert_close(rounded.double(), exact, rtol=0, atol=2e-6)


def test_a_turn_beyond_a_half_comes_back_with_a_real_part_that_is_not_negative():
    robot = zoo(("turret",), joints=["swivel"])
    for angle in (2.0, 3.5, 6.0, -3.5):
        for joints in ([[angle]], [[angle], [0.0]]):
            turn = robot.state(joints).orientation("turret")[0]
            assert turn[0] >= 0
            at_rest = robot.state([0.0]).orientation("turret")
            turned = quaternions.product(turn, quaternions.conjugate(at_rest))
            angle_seen = float(quaternions.log(turned).norm())
            assert angle_seen == pytest.approx(abs((angle + np.pi) % (2 * np.pi) - np.pi))


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


@pytest.mark.parametrize("repeats", [1, 10])
def test_upper_body_agrees_with_pytorch_kinematics(repeats):
    robot = upper_body()
    chain = pytorch_kinematics.build_chain_from_urdf(upper_body_urdf().encode())
    assert tuple(chain.get_joint_parameter_names()) == robot.joint_names
    joints = random_joints(robot, 20).repeat(repeats, 1)
    state = robot.state(joints)
    poses = chain.to(dtype=torch.float64).forward_kinematics(joints)
    for hand in HANDS:
        matrix = poses[hand].get_matrix()
        # it keeps the origins of the joints in float32
        torch.testing.assert_close(state.position(hand), matrix[:, :3, 3], rtol=0, atol=1e-6)
        rotation = quaternions.to_matrix(state.orientation(hand))
        torch.testing.assert_close(rotation, matrix[:, :3, :3], rtol=0, atol=1e-6)


@pytest.mark.parametrize("count", [1, 3])
def test_second_derivatives_are_those_of_finite_differences(count):
    robot = zoo()
    joints = random_joints(robot, count).requires_grad_()

    def position(q):
        return robot.state(q).positions

    assert torch.autograd.gradgradcheck(position, joints, fast_mode=True)
