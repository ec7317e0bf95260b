"""The prior over the joints corrected by the tasks, against the sum of precisions."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support.mixtures import CASES, Problem, conditionals_of, random_local, times
from tests.support.worlds import CARRIED, GRASP, OBJECT, RIGHT
from tpgmm_torch import Canonical, Frame, RelativeOrientation, RelativePosition, Stack
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.regression.fusion import KalmanUpdate
from tpgmm_torch.regression.fusion_forms import InformationFusion
from tpgmm_torch.regression.regression import PART


class Joints(Canonical):
    """The same operator by another name, for which the precisions are summed."""


def assert_same(first, second, atol=1e-9):
    for name in ("joints", "covariance", "activation"):
        torch.testing.assert_close(
            getattr(first, name), getattr(second, name), rtol=1e-9, atol=atol
        )


def alone(regression, problem, whole, index, now, atol=1e-8):
    """Estimate one robot of a batch, which has to be as it is among the others."""
    frames = {name: frame[index] for name, frame in problem.frames.items()}
    one = regression.estimate(now, problem.state[index], frames)
    for name in ("joints", "covariance"):
        found = getattr(whole, name)[index]
        torch.testing.assert_close(found, getattr(one, name), rtol=0, atol=atol)
    return one


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
@pytest.mark.parametrize("name", ["the paper's", "canonical", "positions", "three"])
def test_the_update_is_the_sum_of_precisions(name, batch):
    problem = Problem.of(CASES[name], 4, *batch)
    regression = problem.regression()
    summed = [Joints() if type(o) is Canonical else o for o in regression.operators]
    other = replace(regression, operators=summed)
    for now in (torch.tensor(0.8, dtype=torch.float64), times(*batch)):
        at = now, problem.state, problem.frames
        assert_same(regression.estimate(*at), other.estimate(*at))
    assert regression._update is not None
    assert other._update is None


def test_two_operators_of_the_joints_are_one_prior():
    problem = Problem.of(CASES["the paper's"], 3)
    plain = problem.regression()
    more = random_local(np.random.default_rng(5), 3, problem.state.joints.numpy())
    conditionals = [*plain.conditionals, conditionals_of(more)]
    twice = replace(plain, operators=[*plain.operators, Canonical()], conditionals=conditionals)
    summed = [Joints() if type(o) is Canonical else o for o in twice.operators]
    at = times(), problem.state, problem.frames
    assert_same(twice.estimate(*at), replace(twice, operators=summed).estimate(*at))


def test_a_mixture_of_another_kind_is_left_to_the_sum():
    case = CASES["the paper's"]
    kinematics = case.world.kinematics
    assert KalmanUpdate.serves(case.operators, kinematics)
    assert not KalmanUpdate.serves(case.operators[:1], kinematics)
    assert not KalmanUpdate.serves([Stack(Canonical()), Canonical()], kinematics)
    poses = CASES["poses in two frames"]
    assert not KalmanUpdate.serves([*poses.operators, Canonical()], poses.world.kinematics)


@pytest.mark.parametrize("alike", [True, False], ids=["one time", "own times"])
def test_thousands_of_robots_are_parts_of_a_few(alike):
    count = 2 * PART + 5
    problem = Problem.of(CASES["the paper's"], 5, count)
    regression = problem.regression()
    now = times() if alike else times(count)
    whole = regression.estimate(now, problem.state.joints, problem.frames)
    for index in (0, PART - 1, PART, count - 1):
        alone(regression, problem, whole, index, now if alike else now[index])


def test_frames_that_no_operator_asks_for_make_no_batch():
    problem = Problem.of(CASES["the paper's"], 5)
    regression, at = problem.regression(), (times(), problem.state.joints)
    other = Frame(torch.zeros(PART + 1, 3, dtype=torch.float64))
    alone = regression.estimate(*at, problem.frames)
    assert_same(regression.estimate(*at, {**problem.frames, "other": other}), alone)


SILENT = {
    "free": [RelativePosition(CARRIED, OBJECT), RelativeOrientation(CARRIED, OBJECT)],
    "in the hand": [RelativePosition(RIGHT, "cup", held=True), RelativePosition("cup", RIGHT)],
}


@pytest.mark.parametrize("form", [Canonical, Joints], ids=["update", "sum"])
@pytest.mark.parametrize("operators", SILENT.values(), ids=list(SILENT))
def test_what_no_joint_moves_adds_nothing_even_where_it_is_correlated(operators, form):
    paper = CASES["the paper's"]
    [hands, _] = paper.operators
    problem = Problem.of(paper, 4, 3)
    state = problem.state.with_link("cup", RIGHT, GRASP)
    frames = {**problem.frames, CARRIED: Frame([0.5, 0.1, -0.3])}
    extra = Stack(*operators)
    rng, width = np.random.default_rng(3), hands.dimension(None)
    # far from what is measured, and sure of it: as observations they would decide everything
    wide = random_local(rng, 4, np.zeros(width + extra.dimension(None)))
    wide.means[:, 1 : 1 + width] = problem.mixtures[0].means[:, 1:]
    narrow = slice(0, 1 + width)
    both = conditionals_of(wide)
    alone = conditionals_of(
        replace(
            wide, means=wide.means[:, narrow], covariances=wide.covariances[:, narrow, narrow]
        )
    )
    plain = problem.regression()
    joints = plain.conditionals[1]
    without = replace(plain, operators=[hands, form()], conditionals=[alone, joints])
    stacked = replace(
        plain, operators=[Stack(hands, extra), form()], conditionals=[both, joints]
    )
    assert (stacked._update is None) is (form is Joints)
    at = times(), state, frames
    assert_same(stacked.estimate(*at), without.estimate(*at))
    # and by itself
    other = random_local(rng, 4, np.zeros(extra.dimension(None)))
    three = replace(
        plain,
        operators=[hands, extra, form()],
        conditionals=[alone, conditionals_of(other), joints],
    )
    estimate = three.estimate(*at)
    assert_same(estimate, without.estimate(*at))
    _, silent, _ = three.candidates(*at, estimate)
    assert (silent.share == 0).all()
    assert torch.equal(silent.mean, state.joints.expand(3, 17))


def test_a_task_without_variance_is_named():
    problem = Problem.of(CASES["the paper's"], 4, 3)
    regression = problem.regression()
    regression._update.conditionals.covariance[2, :14, :14] *= -1
    with pytest.raises(DataError, match=r"covariance of the tasks .*3 of 12"):
        regression.estimate(times(), problem.state, problem.frames)


@pytest.mark.parametrize("negligible", [1e-9, 1e-2])
def test_robots_at_their_own_times_are_each_as_if_it_were_alone(negligible):
    count = 40
    problem = Problem.of(CASES["the paper's"], 5, count)
    wide = problem.regression(fusion=InformationFusion(negligible=negligible))
    narrow = [replace(one, time_variance=one.time_variance / 40) for one in wide.conditionals]
    regression = replace(wide, conditionals=narrow)
    together = regression.estimate(times(count), problem.state.joints, problem.frames)
    left_out = 0
    for index in range(count):
        one = alone(regression, problem, together, index, times(count)[index], 1e-12)
        assert torch.equal(together.activation[index] == 0, one.activation == 0)
        left_out += int((one.activation == 0).sum())
    assert left_out > 0


def test_a_grid_of_many_robots_may_have_times_along_one_side():
    rows, columns = 3, PART // 2 + 1
    problem = Problem.of(CASES["the paper's"], 4, rows, columns)
    regression = problem.regression()
    for now in (times(columns), times(rows)[:, None], times(rows, columns)):
        whole = regression.estimate(now, problem.state.joints, problem.frames)
        assert whole.joints.shape == problem.state.joints.shape
        for place in ((0, 0), (2, 1), (1, columns - 1)):
            alone(regression, problem, whole, place, now.expand(rows, columns)[place])
