"""Orientation operators against eqs (14) and (15), exact and as printed."""

import pytest
import torch

from tests.support import oracles
from tests.support.operator_battery import OrientationLaws, RelativeLaws
from tests.support.worlds import (
    CARRIED,
    LEFT,
    OBJECT,
    RIGHT,
    CarryingOnPoses,
    CarryingOnRobot,
    OnPoses,
    OnRobot,
)
from tpgmm_torch import (
    AbsoluteOrientation,
    RelativeOrientation,
)


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


def test_the_gain_is_without_effect_where_nothing_is_linearised():
    state, frames = OnPoses().scene()
    for kind, names in ((AbsoluteOrientation, [LEFT]), (RelativeOrientation, [LEFT, OBJECT])):
        exact, printed = kind(*names), kind(*names, gain=1.0)
        assert torch.equal(exact.linear(state, frames), printed.linear(state, frames))


class CarriedOrientationLaws(OrientationLaws):
    operator = AbsoluteOrientation(CARRIED)

    def row(self, at):
        return oracles.absolute_orientation(at, CARRIED)


class TestCarriedOrientationOnRobot(CarryingOnRobot, CarriedOrientationLaws):
    pass


class TestCarriedOrientationOnPoses(CarryingOnPoses, CarriedOrientationLaws):
    pass


class CarriedToPlaceOrientationLaws(RelativeLaws, OrientationLaws):
    operator = RelativeOrientation(CARRIED, OBJECT)

    def row(self, at):
        return oracles.relative_orientation(at, CARRIED, OBJECT)


class TestCarriedToPlaceOrientationOnRobot(CarryingOnRobot, CarriedToPlaceOrientationLaws):
    pass


class TestCarriedToPlaceOrientationOnPoses(CarryingOnPoses, CarriedToPlaceOrientationLaws):
    pass


class OtherHandToCarriedOrientationLaws(RelativeLaws, OrientationLaws):
    operator = RelativeOrientation(LEFT, CARRIED, held=True)

    def row(self, at):
        return oracles.relative_orientation(at, LEFT, CARRIED)


class TestOtherHandToCarriedOrientationOnRobot(
    CarryingOnRobot, OtherHandToCarriedOrientationLaws
):
    pass


class TestOtherHandToCarriedOrientationOnPoses(
    CarryingOnPoses, OtherHandToCarriedOrientationLaws
):
    pass
