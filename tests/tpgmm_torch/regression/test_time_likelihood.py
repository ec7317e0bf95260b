"""The likelihood of the times of a skill against plain formulas."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support.mixtures import CASES, Case, Problem
from tests.support.skills import (
    HANDS,
    few_bottles,
    handlings,
    hands,
    new_handling,
    small_bottle,
)
from tests.support.worlds import OBJECT
from tpgmm_torch import (
    Canonical,
    Demonstration,
    Frame,
    RelativePosition,
    Stack,
    TaskParameterizedGMM,
)
from tpgmm_torch.regression.conditionals import TimeMarginals
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.regression.time_likelihood import TimeLikelihood

GRID = torch.linspace(0, 2, 51, dtype=torch.float64)

NAMES = ["the paper's", "poses in two frames", "canonical"]
EVERY_WORLD = pytest.mark.parametrize("case", [CASES[name] for name in NAMES], ids=NAMES)


def dense(regression: Regression, joints, frames, instants) -> np.ndarray:
    """Log-likelihood of each instant for one robot, straight from the formula."""
    state = regression.kinematics.state(joints)
    first = regression.conditionals[0]
    result = []
    for now in torch.from_numpy(instants):
        times = torch.distributions.Normal(first.time_mean, first.time_variance.sqrt())
        total = torch.log_softmax(regression.log_weights + times.log_prob(now), -1)
        for operator, one in zip(regression.operators, regression.conditionals, strict=True):
            local = operator.coordinates(state, frames)
            mean, signs = one.at(now), torch.ones_like(one.mean)
            for start in operator.quaternion_starts(regression.kinematics):
                block = slice(start, start + 4)  # flipped to the side of the present one
                centre = one.recenter(first.time_mean)[:, block]
                signs[:, block] = torch.sign((centre * local[block]).sum(-1, keepdim=True))
            covariance = signs[:, :, None] * one.covariance * signs[:, None, :]
            given = torch.distributions.MultivariateNormal(signs * mean, covariance)
            total = total + given.log_prob(local)
        result.append(torch.logsumexp(total, -1))
    values = torch.stack(result).numpy()
    return values - values.max()


def exact(regression: Regression, times: torch.Tensor, **options) -> TimeLikelihood:
    parts = regression.kinematics, regression.operators, regression.conditionals
    first = regression.conditionals[0]
    marginals = TimeMarginals.of(regression.log_weights, first.time_mean, first.time_variance)
    return TimeLikelihood(*parts, marginals, times, **options)


@EVERY_WORLD
def test_the_likelihood_is_the_mixtures_given_time(case: Case):
    problem = Problem.of(case, 4, 3)
    regression, joints = problem.regression(), problem.state.joints
    likelihood = exact(regression, GRID, slack=0.0, negligible=0.0)
    got = likelihood(problem.state, problem.frames)
    assert got.shape == (3, 51)
    for robot in range(3):
        frames = {name: frame[robot] for name, frame in problem.frames.items()}
        expected = dense(regression, joints[robot], frames, GRID.numpy())
        relative = got[robot] - got[robot].max()
        np.testing.assert_allclose(relative, expected, rtol=1e-9, atol=1e-7)


def test_negligible_components_are_left_out():
    """At each time few of 8 components count; the others change nothing that is likely."""
    regression, demonstration = small_bottle().skill, few_bottles()[0]
    times = torch.linspace(*demonstration.time[[0, -1]].tolist(), 200, dtype=torch.float64)
    state = regression.kinematics.state(demonstration.joints)
    frames = dict(demonstration.frames)
    fast = regression.log_likelihood(times, state, frames).numpy()
    every = exact(regression, times, negligible=0.0)(state, frames)
    likely = every > every.max(1, keepdims=True) - 10
    np.testing.assert_allclose(fast[likely], every[likely], atol=0.01)
    part = slice(20, 60)
    window = regression.log_likelihood(times, state, frames, part).numpy()
    np.testing.assert_allclose(window, fast[:, part], rtol=1e-9)


def test_the_time_of_a_new_motion_is_found():
    """Of two tracked hands and a cup, any step of a motion never shown."""
    situation, wanted = new_handling()
    frames = {"cup": situation.frames["cup"]}
    likelihood = hands().skill.log_likelihood(GRID, HANDS.state(wanted), frames)
    found = GRID[likelihood.argmax(1)]
    assert (found - situation.time).abs().max() < 0.1


def test_quaternions_of_the_other_sign_are_the_same_rotation():
    situation, wanted = new_handling()
    regression, flipped = hands().skill, wanted.clone()
    flipped[:, 3:7] *= -1
    cup = situation.frames["cup"]
    one = regression.log_likelihood(GRID, HANDS.state(wanted), {"cup": cup})
    turned = {"cup": Frame(cup.position, -cup.orientation)}
    other = regression.log_likelihood(GRID, HANDS.state(flipped), turned)
    np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-7)


def test_operators_without_their_frames_are_left_out():
    """The right hand seen from the left one needs no cup."""
    _, wanted = new_handling()
    regression, state = hands().skill, HANDS.state(wanted)
    observed = regression.restrict_to(frozenset(HANDS.links))
    without = observed.log_likelihood(GRID, state, {}).numpy()
    alone = Regression(
        regression.kinematics,
        regression.operators[1:],
        regression.conditionals[1:],
        regression.log_weights,
    )
    # each operator has learned the components' times a little differently, by rounding
    expected = alone.log_likelihood(GRID, state, {}).numpy()
    np.testing.assert_allclose(without, expected, rtol=1e-4, atol=0.02)
    assert np.ptp(without, 1).min() > 1
    cup = frozenset((*HANDS.links, "cup"))
    assert regression.restrict_to(cup) is regression
    only = replace(
        regression, operators=regression.operators[:1], conditionals=regression.conditionals[:1]
    )
    assert only.restrict_to(frozenset(HANDS.links)) is None


def test_observations_that_are_not_finite_leave_every_time_alike():
    regression = small_bottle().skill
    state = regression.kinematics.state(few_bottles()[0].joints[:2])
    position = torch.tensor([[0.45, 0.0, 0.15], [0.45, torch.nan, 0.15]], dtype=torch.float64)
    bottle = Frame([[0.0, 0.0, 0.0]] * 2)
    object.__setattr__(bottle, "position", position)
    got = regression.log_likelihood(5 * GRID / 2, state, {"bottle": bottle}).numpy()
    assert np.isfinite(got).all()
    assert np.ptp(got[1]) == 0
    assert np.ptp(got[0]) > 1


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_of_a_stack_the_observed_operators_are_kept():
    """One stack over two objects, of which one is not there: its marginal."""
    situation, wanted = new_handling()
    both = Stack(*(RelativePosition(hand, name) for hand in ("left", "right") for name in "ab"))
    time = situation.time
    demonstrations = [
        Demonstration(d.time, d.joints, {"a": d.frames["cup"], "b": Frame([0.1 * k, 0, 0])})
        for k, d in enumerate(handlings())
    ]
    settings = {"n_components": 6, "robot": HANDS}
    model = TaskParameterizedGMM(operators=[both, Canonical()], **settings).fit(demonstrations)
    a, state = {"a": situation.frames["cup"]}, HANDS.state(wanted)
    observed = model.skill.restrict_to(frozenset((*HANDS.links, "a")))
    [first, canonical] = model.skill.conditionals
    columns = torch.tensor([0, 1, 2, 6, 7, 8])
    only = Stack(RelativePosition("left", "a"), RelativePosition("right", "a"))
    alone = replace(
        model.skill,
        operators=[only, Canonical()],
        conditionals=[first.marginal(columns), canonical],
    )
    likelihoods = [one.log_likelihood(GRID, state, a) for one in (observed, alone)]
    np.testing.assert_allclose(*likelihoods, atol=1e-6)
    references = [one.estimate(time, state, a).joints for one in (observed, alone)]
    assert torch.equal(*references)


@EVERY_WORLD
def test_robots_of_a_batch_are_what_they_are_alone(case: Case):
    problem = Problem.of(case, 4, 5)
    regression = problem.regression()
    together = regression.log_likelihood(GRID, problem.state, problem.frames).numpy()
    for robot in range(5):
        frames = {OBJECT: problem.frames[OBJECT][robot]}
        alone = regression.log_likelihood(GRID, problem.state[robot : robot + 1], frames)
        np.testing.assert_allclose(together[robot], alone[0], rtol=1e-10, atol=1e-8)


def test_the_times_of_demonstrations_are_found():
    """Median error of the time of single postures, of all steps of four demonstrations."""
    regression, errors = hands().skill, []
    for demonstration in handlings():
        state = HANDS.state(demonstration.joints)
        got = regression.log_likelihood(GRID, state, dict(demonstration.frames))
        errors.append(GRID[got.argmax(1)] - demonstration.time)
    assert torch.stack(errors).abs().median() < 0.03
