"""Products along the tree, for one robot and for many, against products written out."""

import numpy as np
import pytest
import torch

from tests.support.robot_zoo import g1, random_joints, upper_body, written_out, zoo
from tpgmm_torch import quaternions
from tpgmm_torch.robots.one_posture import OnePosture

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


@pytest.mark.parametrize("count", [1, 3])
def test_second_derivatives_are_those_of_finite_differences(count):
    robot = zoo()
    joints = random_joints(robot, count).requires_grad_()

    def position(q):
        return robot.state(q).positions

    assert torch.autograd.gradgradcheck(position, joints, fast_mode=True)


@pytest.mark.parametrize("make", ROBOTS.values(), ids=list(ROBOTS))
def test_one_posture_in_numpy_is_the_same(make):
    robot = make()
    one = OnePosture(robot.tree, len(robot.links), robot.n_joints)
    for joints in random_joints(robot, 20, seed=3):
        state = robot.state(joints)
        positions, orientations, rows = one(joints.numpy())
        jacobians = torch.from_numpy(rows[:-1]).reshape(state.jacobians.shape)
        found = torch.from_numpy(positions), torch.from_numpy(orientations), jacobians
        torch.testing.assert_close(found[0], state.positions, rtol=0, atol=1e-12)
        torch.testing.assert_close(found[1], state.orientations, rtol=0, atol=1e-12)
        torch.testing.assert_close(found[2], state.jacobians, rtol=0, atol=1e-12)
        assert not rows[-1].any()
