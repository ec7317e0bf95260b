"""Operators stacked before the pseudo-inverse, eqs (16), (17)."""

import numpy as np
import pytest
import torch

from tests.support import oracles
from tests.support.mixtures import BOTH_HANDS
from tests.support.operator_battery import OrientationLaws, RelativeLaws
from tests.support.refusals import refused
from tests.support.worlds import LEFT, OBJECT, RIGHT, OnPoses, OnRobot, upper_body
from tpgmm_torch import (
    AbsoluteOrientation,
    AbsolutePosition,
    Canonical,
    RelativeOrientation,
    RelativePosition,
    Stack,
)
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.robots import Poses
from tpgmm_torch.robots.kinematics import JointSpace


class BothHandsLaws(RelativeLaws, OrientationLaws):
    """The paper's first operator, eqs (16), (17)."""

    operator = BOTH_HANDS


class TestBothHandsOnRobot(OnRobot, BothHandsLaws):
    def test_equals_the_printed_blocks(self):
        state, frames = self.scene()
        expected = oracles.equations_16_17(self.at(state, frames), LEFT, RIGHT, OBJECT)
        linear = self.operator.linear(state, frames)
        offset = self.operator.offset(state, frames)
        np.testing.assert_allclose(linear.numpy(), expected[0], rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(offset.numpy(), expected[1], rtol=1e-11, atol=1e-11)


class TestBothHandsOnPoses(OnPoses, BothHandsLaws):
    pass


class MixedStackLaws(OrientationLaws):
    """All kinds at once, more rows than joints."""

    operator = Stack(
        Canonical(),
        AbsoluteOrientation(LEFT),
        Stack(AbsolutePosition(RIGHT), RelativeOrientation(LEFT, RIGHT)),
        RelativePosition(RIGHT, LEFT),
    )


class TestMixedStackOnRobot(OnRobot, MixedStackLaws):
    pass


class TestMixedStackOnPoses(OnPoses, MixedStackLaws):
    pass


def test_a_stack_needs_operators():
    refused(lambda: Stack(), DataError, "at least one operator")
    refused(lambda: Stack(Canonical(), LEFT), DataError, "takes operators, got str")
    refused(lambda: Stack([Canonical()]), DataError, "takes operators, got list")


def test_the_canonical_operator_alone_determines_every_joint():
    assert Canonical().determines_joints
    assert Stack(AbsolutePosition(LEFT), Canonical()).determines_joints
    assert not BothHandsLaws.operator.determines_joints


def test_a_stack_knows_what_its_members_need():
    operator = BothHandsLaws.operator
    assert operator.links() == (LEFT, RIGHT)
    assert operator.references() == (OBJECT,)
    assert operator.quaternion_starts(None) == (3, 10)
    assert Stack(Canonical(), operator).quaternion_starts(Poses()) == (3, 10, 17, 24)


def test_a_stack_has_the_tolerances_of_its_members():
    stack = Stack(AbsolutePosition("l_hand"), Canonical(0.01))
    assert stack.tolerances(upper_body()) == (0.0,) * 3 + (0.01,) * 17


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_joints_stacked_with_joints_keep_their_type(dtype):
    robot = upper_body().to(dtype=dtype)
    state = robot.state(torch.linspace(-0.5, 0.5, 17, dtype=dtype).expand(2, 17))
    at = Stack(Canonical(), Canonical()).linearize(state, {})
    identity = torch.eye(17, dtype=dtype)
    assert at.jacobian.dtype == at.matrix.dtype == at.displacement.dtype == dtype
    assert torch.equal(at.jacobian, torch.cat((identity, identity)).expand(2, -1, -1))
    assert torch.equal(at.matrix, torch.block_diag(identity, identity).expand(2, -1, -1))
    assert torch.equal(at.displacement, -torch.cat((state.joints, state.joints), dim=-1))


def test_the_units_of_its_coordinates_are_those_of_its_members():
    robot = upper_body()
    turn = RelativeOrientation(LEFT, OBJECT)
    stack = Stack(RelativePosition(LEFT, OBJECT), turn, Canonical())
    assert stack.units(robot) == ("m",) * 3 + (None,) * 4 + ("rad",) * 17
    tangent = RelativeOrientation(LEFT, OBJECT, geometry="tangent")
    assert Stack(tangent).units(robot) == ("rad",) * 3
    hands = Poses([LEFT, RIGHT])  # of quaternions no coordinate is like another
    assert Canonical().units(hands) == (*("m",) * 3, *(None,) * 4) * 2
    assert Canonical().units(JointSpace(["knee", "gripper"])) == (None, None)  # not known
