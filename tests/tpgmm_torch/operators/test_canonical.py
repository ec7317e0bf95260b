"""The joints themselves as local coordinates, and their tolerance."""

from dataclasses import replace

import pytest
import torch
from sklearn.base import clone

from tests.support import oracles
from tests.support.operator_battery import OperatorLaws, OrientationLaws
from tests.support.skills import (
    bottle_demonstrations,
    bottle_model,
    generator,
    handlings,
    hands_model,
    waves,
)
from tests.support.worlds import OnPoses, OnRobot
from tpgmm_datasets.bottle.skill import bottle_operators
from tpgmm_torch import (
    Canonical,
    RelativeOrientation,
    RelativePosition,
    Situation,
    Stack,
    TaskParameterizedGMM,
)
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.robots import Poses
from tpgmm_torch.robots.kinematics import JointSpace


class CanonicalLaws(OperatorLaws):
    operator = Canonical()


class TestCanonicalOnRobot(OnRobot, CanonicalLaws):
    pass


class TestCanonicalOnPoses(OnPoses, CanonicalLaws, OrientationLaws):
    pass


class SomeJointsLaws(OperatorLaws):
    def row(self, at):
        return oracles.canonical_of(at, self.operator.columns(self.kinematics.joint_names))


class TestSomeJointsOnRobot(OnRobot, SomeJointsLaws):
    operator = Canonical(joints=("l_*", "waist_yaw"))


class TestSomeJointsOnPoses(OnPoses, SomeJointsLaws, OrientationLaws):
    operator = Canonical(joints=("r_hand.*",))


def test_the_size_of_the_canonical_operator_is_that_of_a_robot():
    assert Stack(Canonical(), Canonical()).dimension(JointSpace(["a", "b"])) == 4
    with pytest.raises(DataError, match="as many coordinates as the robot has joints"):
        Canonical().dimension(None)


@pytest.mark.parametrize("covariance_type", ["full", "diag", "tied", "spherical"])
@pytest.mark.parametrize("tolerance", [0.02, 0.1])
def test_no_canonical_variance_is_below_the_squared_tolerance(covariance_type, tolerance):
    model = TaskParameterizedGMM(
        6, [Canonical(tolerance)], covariance_type=covariance_type, reg_covar=0.0
    ).fit(waves())
    smallest = torch.linalg.eigvalsh(model.covariances_[0][:, 1:, 1:]).min()
    assert smallest > 0.999 * tolerance**2


def test_it_is_an_absolute_variance_whatever_the_spread_of_the_data():
    added = []
    for tolerance in (0.0, 0.03):
        model = TaskParameterizedGMM(1, [Canonical(tolerance)]).fit(waves())
        added.append(model.covariances_[0][0].diagonal())
    expected = torch.tensor([0.0, *[0.03**2] * 3]).double()  # time has none
    torch.testing.assert_close(added[1] - added[0], expected)


def test_with_ten_demonstrations_it_keeps_the_joints_from_contradicting_the_task():
    """Relations that full covariances keep by chance pull the hands off the bottle."""
    situations = generator().situations(8, seed=21)
    time = bottle_demonstrations()[0].time
    grasp = sum(d.events["grasp"] for d in bottle_demonstrations()) / len(
        bottle_demonstrations()
    )
    contact = int(torch.searchsorted(time, grasp))
    task, _ = bottle_operators()
    errors = {}
    for tolerance in (0.0, Canonical().tolerance):
        model = bottle_model(30, covariance_shrinkage=0)
        model.set_params(operators=[task, Canonical(tolerance)])
        reproductions = model.fit(bottle_demonstrations()).predict(situations, candidates=False)
        errors[tolerance] = sum(
            float(generator().grasp_error(r.joints[contact], s.frames["bottle"])[0])
            for r, s in zip(reproductions, situations, strict=True)
        )
    assert errors[Canonical().tolerance] < errors[0.0] / 3


def test_every_operator_has_a_tolerance_in_its_unit():
    """Their squares are added to the variances, for quaternions half of them."""
    position = RelativePosition("left", "cup", tolerance=0.003)
    orientation = RelativeOrientation("left", "cup", tolerance=0.02)
    model = hands_model(
        operators=[position, orientation], n_components=1, covariance_type="diag", reg_covar=0.0
    )
    exact = clone(model).set_params(
        operators=[replace(position, tolerance=0.0), replace(orientation, tolerance=0.0)]
    )
    found = [model.fit(handlings()).covariances_, exact.fit(handlings()).covariances_]
    for tolerant, strict, added in zip(*found, (0.003, 0.01), strict=True):
        difference = (tolerant - strict).diagonal(dim1=1, dim2=2)[:, 1:]
        torch.testing.assert_close(difference, torch.full_like(difference, added**2))


@pytest.mark.parametrize("tolerance", [-0.01, float("nan"), float("inf"), "2 mm", [1, 2]])
def test_what_is_no_tolerance_is_refused(tolerance):
    with pytest.raises(DataError, match=r"a tolerance is a number of at least 0, Canonical"):
        TaskParameterizedGMM(2, [Canonical(tolerance)]).fit(waves())


def test_some_joints_are_learned_and_the_others_go_their_way():
    """They follow what was shown; the prior holds the rest where it starts."""
    shown = waves()
    names = JointSpace("abc")
    some = TaskParameterizedGMM(1, [Canonical(joints=("b",))], names)
    every = TaskParameterizedGMM(1, [Canonical()], names)
    start = Situation.of(shown[0])
    [one], [all_of_them] = some.fit(shown).predict(start), every.fit(shown).predict(start)
    torch.testing.assert_close(one.joints[:, 1], all_of_them.joints[:, 1], rtol=0, atol=2e-3)
    still = one.joints[:, [0, 2]] - one.joints[:1, [0, 2]]
    assert float(still.abs().max()) < 1e-6 < float(one.joints[:, 1].std())


@pytest.mark.parametrize("joints", ["left_*", [], [3]])
def test_what_names_no_joints_is_refused(joints):
    with pytest.raises(DataError, match="joints is a sequence of at least one name or pattern"):
        Canonical(joints=joints)


def test_joints_that_the_robot_does_not_have_are_refused():
    shown = waves()
    with pytest.raises(UnknownNameError, match=r"joint 'left_\*' is not in the robot; it has"):
        TaskParameterizedGMM(2, [Canonical(joints=["left_*"])]).fit(shown)


def test_a_quaternion_is_not_cut():
    with pytest.raises(DataError, match=r"\['hand.qw', .* of a quaternion: name all four"):
        Canonical(joints=["hand.qw"]).check(Poses(["hand"]), ())


def test_a_robot_that_does_not_name_its_joints_is_told_so():
    state = JointSpace(["a", "b"]).state([0.0, 1.0])
    with pytest.raises(DataError, match="has to pass joint_names to RobotState"):
        Canonical(joints=["a"]).coordinates(replace(state, joint_names=()), {})
