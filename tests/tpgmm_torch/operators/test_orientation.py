"""Orientation operators against eqs (14) and (15), exact and as printed."""

from functools import partial

import pytest
import torch

from tests.support import oracles
from tests.support.operator_battery import OrientationLaws, laws_in_places
from tests.support.worlds import LEFT, OBJECT, RIGHT, OnPoses, OnRobot
from tpgmm_torch import AbsoluteOrientation, RelativeOrientation

KINDS = AbsoluteOrientation, RelativeOrientation
globals().update(laws_in_places(KINDS, OrientationLaws))


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


PRINTED = {
    "PrintedAbsolute": ([OnRobot], RIGHT),
    "PrintedRelative": ([OnRobot], LEFT, OBJECT),
    "PrintedHandToHand": ([OnRobot], LEFT, RIGHT),
}
ROWS = oracles.absolute_orientation, oracles.relative_orientation
HALF = [partial(row, gain=1.0) for row in ROWS]
globals().update(laws_in_places(KINDS, AsPrinted, PRINTED, HALF, gain=1.0))


def test_the_gain_is_without_effect_where_nothing_is_linearised():
    state, frames = OnPoses().scene()
    for kind, names in ((AbsoluteOrientation, [LEFT]), (RelativeOrientation, [LEFT, OBJECT])):
        exact, printed = kind(*names), kind(*names, gain=1.0)
        assert torch.equal(exact.linear(state, frames), printed.linear(state, frames))
