"""Units, order, limits and speeds of joint vectors, with the names and numbers in messages."""

from dataclasses import replace

import numpy as np
import torch

from tpgmm_datasets import check
from tpgmm_torch import Demonstration
from tpgmm_torch.robots import Poses
from tpgmm_torch.robots.kinematics import JointSpace

TIME = np.arange(100) / 50


def limit_joints(*limits, velocity=3.0):
    """Joints alone, with these limits."""
    robot = JointSpace(tuple(f"j{i}" for i in range(len(limits))))
    robot.lower, robot.upper = torch.tensor(limits, dtype=torch.float64).T
    robot.velocity = torch.full((len(limits),), velocity, dtype=torch.float64)
    return robot


def found(robot, *scales, names=None):
    path = np.sin(np.pi * TIME / 2)[:, None] * np.array(scales)
    return list(
        check([Demonstration(TIME, path + 0.01 * n, {}, names) for n in range(4)], robot)
    )


def test_joints_within_their_limits_are_plausible():
    assert found(limit_joints((-1, 1), (-0.1, 2)), 0.9, 1.5) == []
    assert found(None, 0.9, 12.0) == []


def test_speeds_beyond_the_robot_are_named_with_the_limit():
    [finding] = found(limit_joints((-2, 2), velocity=0.5), 1.5)
    assert finding.check == "speed" and finding.episodes == (0, 1, 2, 3)


def test_grippers_may_be_in_any_unit():
    assert found(None, 0.9, 100.0, names=("elbow", "gripper.pos")) == []
    [finding] = found(None, 0.9, 100.0, names=("elbow", "wrist.pos"))
    assert finding.check == "units" and finding.names == ("wrist.pos",)


def test_tracked_hands_are_in_metres():
    hand = Poses(("hand",), orientation=False)
    assert found(hand, 0.5, 0.2, 0.1) == []
    [finding] = found(hand, 11.0, 0.2, 0.1)
    assert finding.check == "units" and finding.names == ("hand.x",)


def test_a_stuck_joint_needs_others_that_move():
    path = np.sin(TIME)[:, None]
    items = [
        Demonstration(TIME, np.hstack((path, path * (n != 2))) + 0.01 * n) for n in range(5)
    ]
    [finding] = (one for one in check(items) if one.check == "stuck")
    assert (finding.episodes, finding.names) == ((2,), ("joint 1",))


def test_joints_that_never_move_are_named_but_not_coordinates_of_tracked_hands():
    path = np.sin(TIME)[:, None]
    idle = [Demonstration(TIME, np.hstack((path, 0 * path)) + 0.01 * n) for n in range(5)]
    [finding] = check(idle)
    assert (finding.check, finding.names) == ("still", ("joint 1",))
    assert "never move" in finding.message
    moves = replace(idle[3], joints=idle[3].joints + 1e-6 * torch.as_tensor(path))
    assert list(check([*idle, moves])) == []
    flat = [Demonstration(TIME, np.hstack((path, 2 * path, 0 * path)) + n / 99) for n in (1, 2)]
    assert list(check(flat, Poses(("hand",), orientation=False))) == []
