"""The local data sets of demonstrations: time, coordinates, sides of the quaternion sphere."""

import numpy as np
import pytest
import torch

from tests.support.local_coordinates import local_coordinates
from tests.support.motions import turning
from tpgmm_torch import AbsoluteOrientation, AbsolutePosition, Canonical, Demonstration, Stack
from tpgmm_torch.exceptions import ShapeError, UnknownNameError
from tpgmm_torch.robots.kinematics import JointSpace
from tpgmm_torch.robots.tracked_poses import Poses
from tpgmm_torch.training.local_data import constant_columns, like, local_data

HAND = Poses(["hand"])
TIME = np.linspace(0, 2, 40)
#: Time; the hand's orientation; time; its pose, in one operator.
OPERATORS = [
    AbsoluteOrientation("hand"),
    Stack(AbsolutePosition("hand"), AbsoluteOrientation("hand")),
]
QUATERNIONS = [slice(1, 5), slice(9, 13)]


def expected_of(motion):
    return like([local_coordinates(operator, motion, HAND) for operator in OPERATORS])


def flip_signs(demonstration):
    """The same motion; every quaternion is its negative."""
    joints = demonstration.joints * torch.tensor([1.0, 1, 1, -1, -1, -1, -1])
    return Demonstration(demonstration.time, joints, None, demonstration.joint_names)


def test_rows_are_times_and_coordinates_side_by_side():
    motion = turning(TIME, TIME / 2)
    [rows] = local_data([motion], OPERATORS, HAND)
    assert rows.shape == (40, 1 + 4 + 1 + 7)
    place, turn = motion.joints.split((3, 4), 1)
    time = torch.from_numpy(TIME)[:, None]
    sign = (rows[:1, 1:5] * turn[:1]).sum().sign()
    expected = torch.cat((time, sign * turn, time, place, sign * turn), 1)
    torch.testing.assert_close(rows, expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 1.0])
def test_quaternions_lie_on_the_side_of_the_first_demonstration(share):
    first, second = turning(TIME, TIME / 2), turning(TIME, (TIME / 2) ** 1.2)
    quick = turning(TIME[:25] / 2, np.linspace(share, 1, 25))
    demonstrations = [first, flip_signs(second), second, flip_signs(quick), quick]
    reference, *others = local_data(demonstrations, OPERATORS, HAND)
    for rows in others:
        template = reference[np.linspace(0, 39, len(rows)).round()]
        for block in QUATERNIONS:
            assert (rows[:, block] * template[:, block]).sum() > 0
    for one, other in (others[:2], others[2:]):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-15)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_quaternions_lie_on_the_side_that_a_model_expects(sign):
    motion = turning(TIME, TIME / 2)
    [rows] = local_data([motion], OPERATORS, HAND)
    templates = expected_of(motion)
    asked = []

    def template_at(j, time):
        asked.append((j, time))
        side = torch.ones(7, dtype=torch.float64)
        side[-4:] = sign
        return templates(j, time) * side[-templates(j, time).shape[1] :]

    [turned] = local_data([flip_signs(motion)], OPERATORS, HAND, template_at)
    for block in QUATERNIONS:
        torch.testing.assert_close(turned[:, block], sign * rows[:, block], rtol=0, atol=1e-15)
    torch.testing.assert_close(turned[:, 6:9], rows[:, 6:9], rtol=0, atol=0)
    assert [j for j, _ in asked] == [0, 1]
    assert all(torch.equal(time, motion.time) for _, time in asked)


def test_what_varies_by_rounding_alone_is_made_constant():
    rng = np.random.default_rng(0)
    time = np.arange(30.0)
    joints = rng.normal(size=(30, 3))
    joints[:, 1] = 0.5 + 1e-15 * rng.normal(size=30)
    joints[:, 2] = 0.5 + 1e-9 * rng.normal(size=30)
    pair = [Demonstration(time, joints[way]) for way in (slice(None), slice(None, None, -1))]
    kinematics = Poses(["point"], orientation=False)
    rows = local_data(pair, [Canonical()], kinematics)
    assert all((one[:, 2] == rows[0][0, 2]).all() for one in rows)
    np.testing.assert_array_equal(rows[0][:, [1, 3]], joints[:, [0, 2]])
    np.testing.assert_array_equal(rows[1][:, [1, 3]], joints[::-1, [0, 2]])
    # with a model's sides nothing is made constant: the model has learned what varies
    [same] = local_data(pair[:1], [Canonical()], kinematics, lambda j, time: None)
    np.testing.assert_array_equal(same[:, 1:], joints)


def test_rounding_is_measured_by_the_largest_coordinate_of_the_operator():
    eps = np.finfo(np.float64).eps
    low = torch.tensor([0.0, -1000.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    spread = torch.tensor([9.0, 9.0, 0.99e-7, 1.01e-7, 9.0, 1e3 * eps])
    two = [AbsolutePosition("hand"), Canonical()], JointSpace(["a"])
    mask = constant_columns(low, low + spread, *two)
    assert mask.tolist() == [False, False, True, False, False, False]
    # rotation vectors are logarithms of quaternions, which are of size 1
    tiny = torch.tensor([0.0, 1e-16, 2e-16, 3e-16], dtype=torch.float64)
    turn = AbsoluteOrientation("hand", geometry="tangent")
    assert constant_columns(0 * tiny, tiny, [two[0][0]], HAND).tolist() == [True] + [False] * 3
    assert constant_columns(0 * tiny, tiny, [turn], HAND).tolist() == [True] * 4
    eps = np.finfo(np.float32).eps
    spread = torch.tensor([9.0, 9.0, 99e3 * eps, 101e3 * eps, 9.0, 1e3 * eps])
    mask = constant_columns(low.float(), low.float() + spread, *two)
    assert mask.tolist() == [False, False, True, False, False, False]


def test_a_demonstration_without_the_joints_of_the_robot_is_named():
    motion = turning(TIME, TIME / 2)
    for names, width, error, text in (
        (None, 6, ShapeError, "a demonstration has 6 joints, .* has 7"),
        (None, 8, ShapeError, "a demonstration has 8 joints, .* has 7"),
        (HAND.joint_names[:6], 6, UnknownNameError, "joint 'hand.qz' is not in the demonstr"),
    ):
        wrong = Demonstration(TIME, np.ones((40, width)), None, names)
        with pytest.raises(error, match=text):
            local_data([motion, wrong], OPERATORS, HAND)
    # further columns may stand beside those of the robot if their names say which are which
    wider = Demonstration(
        TIME, np.c_[np.ones(40), motion.joints], None, ("lift", *HAND.joint_names)
    )
    one, other = local_data([motion, wider], OPERATORS, HAND)
    torch.testing.assert_close(one, other, rtol=0, atol=0)
