"""Table I: every operator through the battery of laws, on a robot and on poses."""

import numpy as np
import pytest
import torch

from tests.support import oracles
from tests.support.operator_battery import OperatorLaws, OrientationLaws, RelativeLaws
from tests.support.worlds import LEFT, OBJECT, RIGHT, OnPoses, OnRobot, World
from tpgmm_torch import (
    AbsoluteOrientation,
    AbsolutePosition,
    Canonical,
    Demonstration,
    Frame,
    Poses,
    RelativeOrientation,
    RelativePosition,
    Stack,
)
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError
from tpgmm_torch.robots.joint_space import JointSpace


class CanonicalLaws(OperatorLaws):
    operator = Canonical()

    def row(self, at):
        return oracles.canonical(at)


class TestCanonicalOnRobot(OnRobot, CanonicalLaws):
    pass


class TestCanonicalOnPoses(OnPoses, CanonicalLaws, OrientationLaws):
    pass


class AbsolutePositionLaws(OperatorLaws):
    operator = AbsolutePosition(LEFT)

    def row(self, at):
        return oracles.absolute_position(at, LEFT)


class TestAbsolutePositionOnRobot(OnRobot, AbsolutePositionLaws):
    pass


class TestAbsolutePositionOnPoses(OnPoses, AbsolutePositionLaws):
    pass


class RelativePositionLaws(RelativeLaws):
    operator = RelativePosition(RIGHT, OBJECT)

    def row(self, at):
        return oracles.relative_position(at, RIGHT, OBJECT)


class TestRelativePositionOnRobot(OnRobot, RelativePositionLaws):
    pass


class TestRelativePositionOnPoses(OnPoses, RelativePositionLaws):
    pass


class HandToHandPositionLaws(RelativeLaws):
    operator = RelativePosition(LEFT, RIGHT)

    def row(self, at):
        return oracles.relative_position(at, LEFT, RIGHT)


class TestHandToHandPositionOnRobot(OnRobot, HandToHandPositionLaws):
    pass


class TestHandToHandPositionOnPoses(OnPoses, HandToHandPositionLaws):
    pass


class AbsoluteOrientationLaws(OrientationLaws):
    operator = AbsoluteOrientation(LEFT)

    def row(self, at):
        return oracles.absolute_orientation(at, LEFT)


class TestAbsoluteOrientationOnRobot(OnRobot, AbsoluteOrientationLaws):
    pass


class TestAbsoluteOrientationOnPoses(OnPoses, AbsoluteOrientationLaws):
    pass


class RelativeOrientationLaws(RelativeLaws, OrientationLaws):
    operator = RelativeOrientation(RIGHT, OBJECT)

    def row(self, at):
        return oracles.relative_orientation(at, RIGHT, OBJECT)


class TestRelativeOrientationOnRobot(OnRobot, RelativeOrientationLaws):
    pass


class TestRelativeOrientationOnPoses(OnPoses, RelativeOrientationLaws):
    pass


class HandToHandOrientationLaws(RelativeLaws, OrientationLaws):
    operator = RelativeOrientation(RIGHT, LEFT)

    def row(self, at):
        return oracles.relative_orientation(at, RIGHT, LEFT)


class TestHandToHandOrientationOnRobot(OnRobot, HandToHandOrientationLaws):
    pass


class TestHandToHandOrientationOnPoses(OnPoses, HandToHandOrientationLaws):
    pass


class BothHandsLaws(RelativeLaws, OrientationLaws):
    """The paper's first operator, eqs (16), (17)."""

    operator = Stack(
        RelativePosition(LEFT, OBJECT),
        RelativeOrientation(LEFT, OBJECT),
        RelativePosition(RIGHT, OBJECT),
        RelativeOrientation(RIGHT, OBJECT),
    )

    def row(self, at):
        return oracles.stack(
            oracles.relative_position(at, LEFT, OBJECT),
            oracles.relative_orientation(at, LEFT, OBJECT),
            oracles.relative_position(at, RIGHT, OBJECT),
            oracles.relative_orientation(at, RIGHT, OBJECT),
        )


class TestBothHandsOnRobot(OnRobot, BothHandsLaws):
    def test_equals_the_printed_blocks(self):
        state, frames = self.scene()
        expected = oracles.equations_16_17(self.at(state, frames), LEFT, RIGHT, OBJECT)
        linear = self.operator.linear(state, frames)
        offset = self.operator.offset(state, frames)
        np.testing.assert_allclose(linear.numpy(), expected[0], rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(offset.numpy(), expected[1], rtol=1e-11, atol=1e-11)

    def test_differs_from_its_members_projected_alone_as_they_share_the_waist(self):
        state, frames = self.scene()
        together = self.operator.linear(state, frames)
        alone = [operator.linear(state, frames) for operator in self.operator.operators]
        assert (together - torch.cat(alone, dim=-1)).abs().max() > 0.1


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

    def row(self, at):
        return oracles.stack(
            oracles.canonical(at),
            oracles.absolute_orientation(at, LEFT),
            oracles.absolute_position(at, RIGHT),
            oracles.relative_orientation(at, LEFT, RIGHT),
            oracles.relative_position(at, RIGHT, LEFT),
        )


class TestMixedStackOnRobot(OnRobot, MixedStackLaws):
    pass


class TestMixedStackOnPoses(OnPoses, MixedStackLaws):
    pass


class AsPrinted(OrientationLaws):
    """``gain=1``, the paper's text: it equals Table I, but asks for half of the rotation."""

    def test_the_jacobian_is_the_derivative_of_the_coordinates(self):
        (length, error), (_, finer) = self.derivative_error(2e-3), self.derivative_error(1e-3)
        assert error == pytest.approx(length / 2, rel=0.02)
        assert finer == pytest.approx(error / 2, rel=0.02)  # of first order only

    def test_one_full_step_removes_the_error_to_second_order(self):
        (before, after), (_, finer) = self.full_step(2e-3), self.full_step(1e-3)
        assert after == pytest.approx(before / 2, rel=0.02)
        assert finer == pytest.approx(after / 2, rel=0.02)


class TestAbsoluteOrientationAsPrinted(OnRobot, AsPrinted):
    operator = AbsoluteOrientation(RIGHT, gain=1.0)

    def row(self, at):
        return oracles.absolute_orientation(at, RIGHT, gain=1.0)


class TestRelativeOrientationAsPrinted(OnRobot, AsPrinted, RelativeLaws):
    operator = RelativeOrientation(LEFT, OBJECT, gain=1.0)

    def row(self, at):
        return oracles.relative_orientation(at, LEFT, OBJECT, gain=1.0)


class TestHandToHandOrientationAsPrinted(OnRobot, AsPrinted, RelativeLaws):
    operator = RelativeOrientation(LEFT, RIGHT, gain=1.0)

    def row(self, at):
        return oracles.relative_orientation(at, LEFT, RIGHT, gain=1.0)


# What the battery does not cover: relations between operators, names and errors


WORLDS = pytest.mark.parametrize("world", [OnRobot(), OnPoses()], ids=["robot", "poses"])


@WORLDS
@pytest.mark.parametrize("kind", [RelativePosition, RelativeOrientation])
def test_a_link_is_seen_from_another_like_from_an_object_but_moves_with_it(kind, world: World):
    state, _ = world.scene(3)
    there = {OBJECT: Frame(state.position(RIGHT), state.orientation(RIGHT))}
    link, thing = kind(LEFT, RIGHT), kind(LEFT, OBJECT)
    expected = thing.coordinates(state, there)
    torch.testing.assert_close(link.coordinates(state, {}), expected, rtol=0, atol=1e-14)
    assert not torch.allclose(link.linear(state, {}), thing.linear(state, there), atol=1e-2)


def test_the_gain_is_without_effect_where_nothing_is_linearised():
    state, frames = OnPoses().scene()
    for kind, names in ((AbsoluteOrientation, [LEFT]), (RelativeOrientation, [LEFT, OBJECT])):
        exact, printed = kind(*names), kind(*names, gain=1.0)
        assert torch.equal(exact.linear(state, frames), printed.linear(state, frames))


def test_poses_reach_a_pose_seen_from_an_object_in_one_step_however_far():
    operator = TestBothHandsOnPoses()
    state, frames = operator.scene(3)
    far, _ = operator.scene(3, seed=7)
    wanted = operator.operator.coordinates(far, frames)
    answer = operator.kinematics.state(operator.candidate(wanted, state, frames))
    torch.testing.assert_close(answer.positions, far.positions)
    inner = (answer.orientations * far.orientations).sum(-1)
    torch.testing.assert_close(inner.abs(), torch.ones_like(inner))


def test_operators_of_other_parameters_differ():
    operators = [
        Canonical(),
        AbsolutePosition(LEFT),
        AbsolutePosition(RIGHT),
        AbsoluteOrientation(LEFT),
        AbsoluteOrientation(LEFT, gain=1.0),
        RelativePosition(LEFT, OBJECT),
        RelativePosition(LEFT, RIGHT),
        RelativeOrientation(LEFT, OBJECT),
        Stack(Canonical()),
        Stack(AbsolutePosition(LEFT), AbsolutePosition(RIGHT)),
        Stack(AbsolutePosition(RIGHT), AbsolutePosition(LEFT)),
    ]
    assert len(set(operators)) == len(operators)


def test_a_stack_needs_operators():
    with pytest.raises(DataError, match="at least one operator"):
        Stack()
    with pytest.raises(DataError, match="takes operators, got str"):
        Stack(Canonical(), LEFT)
    with pytest.raises(DataError, match="takes operators, got list"):
        Stack([Canonical()])


def test_the_canonical_operator_alone_determines_every_joint():
    assert Canonical().determines_joints
    assert Stack(AbsolutePosition(LEFT), Canonical()).determines_joints
    assert not BothHandsLaws.operator.determines_joints


def test_the_size_of_the_canonical_operator_is_that_of_a_robot():
    assert Stack(Canonical(), Canonical()).dimension(JointSpace(["a", "b"])) == 4
    with pytest.raises(DataError, match="as many coordinates as the robot has joints"):
        Canonical().dimension(None)


def test_a_stack_knows_what_its_members_need():
    operator = BothHandsLaws.operator
    assert operator.links() == (LEFT, RIGHT)
    assert operator.references() == (OBJECT,)
    assert operator.quaternion_starts(None) == (3, 10)
    assert Stack(Canonical(), operator).quaternion_starts(Poses()) == (3, 10, 17, 24)


LINKED = [
    AbsolutePosition("elbow"),
    AbsoluteOrientation("elbow"),
    RelativePosition("elbow", OBJECT),
    RelativeOrientation("elbow", OBJECT),
    Stack(AbsolutePosition(LEFT), AbsolutePosition("elbow")),
]


@WORLDS
@pytest.mark.parametrize("operator", LINKED, ids=repr)
def test_an_unknown_link_is_named_with_those_that_exist(operator, world: World):
    state, frames = world.scene()
    listed = r"link 'elbow' is not in the .*\['l_hand', 'r_hand'\]"
    with pytest.raises(UnknownNameError, match=listed):
        operator.check(world.kinematics, frames)
    for call in (operator.linearize, operator.coordinates):
        with pytest.raises(UnknownNameError, match=listed):
            call(state, frames)


FRAMED = [
    RelativePosition(LEFT, "cup"),
    RelativeOrientation(LEFT, "cup"),
    Stack(RelativePosition(LEFT, OBJECT), RelativePosition(LEFT, "cup")),
]


@WORLDS
@pytest.mark.parametrize("operator", FRAMED, ids=repr)
def test_an_unknown_frame_is_named_with_those_that_exist(operator, world: World):
    state, frames = world.scene()
    with pytest.raises(UnknownNameError, match=r"frame 'cup' is not in .*\['object'"):
        operator.check(world.kinematics, frames)
    for call in (operator.linearize, operator.coordinates):
        with pytest.raises(UnknownNameError, match=r"frame 'cup' is not in .*\['l_hand', 'obj"):
            call(state, frames)


def test_links_and_frames_that_exist_pass():
    world = OnRobot()
    _, frames = world.scene()
    for operator in (Canonical(), BothHandsLaws.operator, MixedStackLaws.operator):
        operator.check(world.kinematics, frames)


@WORLDS
def test_a_frame_with_the_name_of_a_link_is_refused(world: World):
    _, frames = world.scene()
    with pytest.raises(UnknownNameError, match=r"'r_hand'.* it is a link .*rename the frame"):
        RelativePosition(LEFT, RIGHT).check(world.kinematics, {RIGHT: frames[OBJECT]})


def test_coordinates_of_another_size_than_announced_are_refused():
    class Liar(AbsolutePosition):
        def dimension(self, kinematics):
            return 2

    poses = OnPoses()
    joints = poses.joints(np.random.default_rng(0), 5)
    with pytest.raises(ShapeError, match=r"has 2 coordinates.*\(5, 3\) for 5 time steps"):
        Liar(LEFT).local(Demonstration(torch.arange(5.0), joints), poses.kinematics)
