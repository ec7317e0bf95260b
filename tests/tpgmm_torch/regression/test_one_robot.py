"""The estimate of one robot in numpy is the one of a batch of one in torch."""

from dataclasses import replace

import pytest
import torch

from tests.support.mixtures import CASES, Case, Problem, assert_equal_estimates, form, times
from tests.support.operator_battery import CARRIED, PLACES
from tests.support.skills import few_bottles, small_bottle
from tests.support.worlds import LEFT, OBJECT, RIGHT, CarryingOnRobot, OnPoses, OnRobot
from tpgmm_torch import (
    AbsoluteOrientation,
    AbsolutePosition,
    Canonical,
    Frame,
    RelativeOrientation,
    RelativePosition,
    Stack,
)
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.regression.one_robot import OneRobot

ON_ROBOT = {name: case for name, case in CASES.items() if isinstance(case.world, OnRobot)}
KINDS = (AbsolutePosition, RelativePosition), (AbsoluteOrientation, RelativeOrientation)
SOME_JOINTS = Canonical(joints=["*elbow*", "*wrist*"])


def batched(problem: Problem, regression, time):
    """The same of a batch of one robot, which torch estimates."""
    frames = {name: frame.expand((1,)) for name, frame in problem.frames.items()}
    found = regression.estimate(time, problem.state.flatten(torch.Size([1])), frames)
    activation = found.activation.expand(1, -1)[0]
    return replace(
        found,
        joints=found.joints[0],
        covariance=found.covariance[0],
        activation=activation,
    )


def assert_served(problem: Problem, *, bare: bool = False, **options) -> None:
    """It is estimated in numpy, to twelve digits as in torch.

    Where a prior of 10 rad is all that some joints have, rounding takes two digits more.
    """
    regression, time = problem.regression(**options), times()
    state = problem.state.joints if bare else problem.state
    one = regression._one_robot
    assert one is not None
    found = one(regression._components_at(time), time, state, problem.frames)
    assert found is not None
    tolerance = 1e-12 if regression._update is not None else 1e-10
    assert_equal_estimates(found, batched(problem, regression, time), tolerance)


@pytest.mark.parametrize("case", ON_ROBOT.values(), ids=list(ON_ROBOT))
@pytest.mark.parametrize("bare", [True, False], ids=["joints", "state"])
@pytest.mark.parametrize("seed", range(3))
def test_every_case_of_regression_is_served(case, bare, seed):
    problem = Problem.of(case, 5, seed=seed)
    assert_served(problem, bare=bare)
    assert_served(problem, bare=bare, fusion=form(negligible=0.0))
    if len(case.operators) > 1 and Canonical() in case.operators:
        priorities = list(range(len(case.operators)))
        assert_served(problem, bare=bare, fusion=form(priorities=priorities))


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("kinds", KINDS, ids=["position", "orientation"])
@pytest.mark.parametrize("beside", [Canonical(), SOME_JOINTS], ids=["update", "sum"])
def test_every_operator_of_the_battery_is_served(place, kinds, beside):
    (world, _), *names = PLACES[place]
    held = {"held": True} if names[1:] == [CARRIED] else {}
    operator = kinds[len(names) == 2](*names, **held)
    assert_served(Problem.of(Case(world(), [operator, beside]), 4))


@pytest.mark.parametrize("beside", [Canonical(), SOME_JOINTS], ids=["update", "sum"])
def test_what_the_joints_do_not_move_has_no_say(beside):
    rigid = Stack(*(kind[1](RIGHT, CARRIED, held=True) for kind in KINDS))
    assert_served(Problem.of(Case(CarryingOnRobot(), [rigid, beside]), 4))
    problem = Problem.of(Case(CarryingOnRobot(), [AbsolutePosition(CARRIED), beside]), 4)
    free = problem.state.with_link(CARRIED, None, Frame([0.3, 0.1, 0.2]))
    assert_served(replace(problem, state=free))


def test_what_is_not_served_is_left_to_torch():
    robot, pose = OnRobot().kinematics, RelativePosition(LEFT, OBJECT)
    assert OneRobot.serves([pose, Canonical()], robot)
    assert not OneRobot.serves([pose], OnPoses().kinematics)
    assert not OneRobot.serves([pose], robot.to(torch.float32))
    tangent = RelativeOrientation(LEFT, OBJECT, geometry="tangent")
    assert not OneRobot.serves([tangent, Canonical()], robot)
    problem = Problem.of(CASES["the paper's"], 3)
    assert problem.regression(fusion=form("covariance"))._one_robot is None


def test_gradients_and_mistakes_are_those_of_torch():
    regression = Problem.of(CASES["the paper's"], 3).regression()
    problem, time = Problem.of(CASES["the paper's"], 3), times()
    joints = problem.state.joints.clone().requires_grad_()
    found = regression.estimate(time, joints, problem.frames).joints
    assert torch.autograd.grad(found.sum(), joints)[0].abs().max() > 0
    rows = torch.func.jacrev(lambda q: regression.estimate(time, q, problem.frames).joints)(
        problem.state.joints
    )
    torch.testing.assert_close(rows.sum(0), torch.autograd.grad(
        regression.estimate(time, joints, problem.frames).joints.sum(), joints
    )[0])  # fmt: skip
    with pytest.raises(UnknownNameError):
        regression.estimate(time, problem.state.joints, {})
    with pytest.raises(DataError):
        regression.estimate(time, problem.state.joints * torch.nan, problem.frames)


def test_a_fitted_skill_runs_to_the_same_end():
    model, shown = small_bottle(), few_bottles()[0]
    one = many = shown.joints[0]
    batch = {name: frame.expand((1,)) for name, frame in shown.frames.items()}
    for time in model.time_:
        one = model.step(time, one, shown.frames).joints
        many = model.step(time, many.reshape(1, -1), batch).joints[0]
    torch.testing.assert_close(one, many, rtol=0, atol=1e-11)
