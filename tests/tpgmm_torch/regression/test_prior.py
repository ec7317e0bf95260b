"""The prior that closes the fusion: in the unit of each joint."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support.skills import HANDS, handlings, hands, hands_model
from tests.support.worlds import upper_body
from tpgmm_torch import (
    Demonstration,
    Frame,
    RelativePosition,
    Robot,
    TaskParameterizedGMM,
)
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError
from tpgmm_torch.regression.fusion_forms import InformationFusion
from tpgmm_torch.regression.prior import prior_widths
from tpgmm_torch.robots import Poses

LIFT = """<robot name="lift"><link name="base"/><link name="arm"/><link name="hand"/>
<joint name="lift" type="prismatic"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
<limit lower="0" upper="1" velocity="1" effort="1"/></joint>
<joint name="turn" type="revolute"><parent link="arm"/><child link="hand"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>"""


def widths(prior_std, robot, model=None):
    model = hands() if model is None else model
    return prior_widths(
        prior_std, robot, model.operators_, model.skill.conditionals, model.weights_
    )


def tracked(unit: float) -> list[Demonstration]:
    """Positions of a hand about a cup, in a unit of so many metres."""
    return [
        Demonstration(
            one.time,
            one.joints[:, :3] / unit,
            {"cup": Frame(one.frames["cup"].position / unit, one.frames["cup"].orientation)},
        )
        for one in handlings(4, noise=1e-2)
    ]


def predicted(unit: float, **options: object) -> torch.Tensor:
    hand = Poses(["left"], orientation=False)
    operators = [RelativePosition("left", "cup")]
    model = TaskParameterizedGMM(6, operators, hand, **options)
    *shown, new = tracked(unit)
    [trajectory] = model.fit(shown).predict(new)
    return trajectory.joints * unit


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_the_same_motion_in_millimetres_gives_the_same_prediction():
    torch.testing.assert_close(predicted(1e-3), predicted(1.0), rtol=0, atol=1e-9)
    # what is given joint by joint is in the joint's unit
    listed = predicted(1e-3, fusion=InformationFusion([50.0, 50.0, 50.0]))
    torch.testing.assert_close(
        listed, predicted(1.0, fusion=InformationFusion([0.05] * 3)), rtol=0, atol=1e-9
    )
    assert (listed - predicted(1.0)).abs().max() > 1e-5


def test_angles_have_the_number_in_radians():
    assert widths(10.0, upper_body()).tolist() == [10.0] * 17
    lift = Robot.from_urdf(LIFT, links=["hand"])
    assert lift.lengths == (0,)
    assert widths(7.0, lift)[1] == 7.0


def test_lengths_have_it_in_units_of_the_learned_positions():
    model = hands()
    squares = [
        model.weights_ @ (mean[:, 1:4].square() + covariance.diagonal(dim1=1, dim2=2)[:, 1:4])
        for mean, covariance in zip(model.means_, model.covariances_, strict=True)
    ]
    expected = 3 * torch.cat(squares).mean().sqrt()
    found = widths(3.0, HANDS)
    assert HANDS.lengths == (0, 1, 2, 7, 8, 9)
    torch.testing.assert_close(found[list(HANDS.lengths)], expected.expand(6))
    assert found[3] == 3.0


def test_joints_may_be_named_or_listed():
    named = widths({"left.x": 5.0}, HANDS)
    assert named[0] == 5.0
    torch.testing.assert_close(named[1:], widths(10.0, HANDS)[1:])
    listed = np.arange(1.0, 15.0)
    assert widths(listed, HANDS).tolist() == listed.tolist()


@pytest.mark.parametrize(("prior_std", "error", "message"), [
    ({"left.w": 1.0}, UnknownNameError, "'left.w'"),
    ({"left.x": -1.0}, DataError, "must be positive"),
    ({"left.x": float("nan")}, DataError, "NaN"),
    ([1.0, 2.0], ShapeError, r"got shape \(2,\)"),
    ([0.0] * 14, DataError, "must be positive"),
    ({"left.x": [1.0, 2.0]}, ShapeError, "one number"),
])  # fmt: skip
def test_what_is_no_width_is_refused(prior_std, error, message):
    with pytest.raises(error, match=message):
        hands_model(fusion=InformationFusion(prior_std)).fit(handlings())


def test_a_number_that_is_no_width_is_refused_at_once():
    for wrong in (0.0, -1.0, "wide"):
        with pytest.raises((DataError, ShapeError), match="prior_std"):
            hands_model(fusion=InformationFusion(wrong)).fit(handlings())


def test_what_was_learned_to_be_nan_is_no_unit_of_lengths():
    skill = hands().skill
    lost = [replace(one, mean=one.mean * torch.nan) for one in skill.conditionals]
    with pytest.raises(DataError, match="must be positive"):
        prior_widths(10.0, HANDS, skill.operators, lost, skill.log_weights.exp())
