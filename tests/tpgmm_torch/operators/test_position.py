"""Position operators against eqs (4) and (6)."""

from tests.support import oracles
from tests.support.operator_battery import OperatorLaws, RelativeLaws
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
    AbsolutePosition,
    RelativePosition,
)


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


class CarriedPositionLaws(OperatorLaws):
    operator = AbsolutePosition(CARRIED)

    def row(self, at):
        return oracles.absolute_position(at, CARRIED)


class TestCarriedPositionOnRobot(CarryingOnRobot, CarriedPositionLaws):
    pass


class TestCarriedPositionOnPoses(CarryingOnPoses, CarriedPositionLaws):
    pass


class CarriedToPlacePositionLaws(RelativeLaws):
    operator = RelativePosition(CARRIED, OBJECT)

    def row(self, at):
        return oracles.relative_position(at, CARRIED, OBJECT)


class TestCarriedToPlacePositionOnRobot(CarryingOnRobot, CarriedToPlacePositionLaws):
    pass


class TestCarriedToPlacePositionOnPoses(CarryingOnPoses, CarriedToPlacePositionLaws):
    pass


class OtherHandToCarriedPositionLaws(RelativeLaws):
    operator = RelativePosition(LEFT, CARRIED, held=True)

    def row(self, at):
        return oracles.relative_position(at, LEFT, CARRIED)


class TestOtherHandToCarriedPositionOnRobot(CarryingOnRobot, OtherHandToCarriedPositionLaws):
    pass


class TestOtherHandToCarriedPositionOnPoses(CarryingOnPoses, OtherHandToCarriedPositionLaws):
    pass
