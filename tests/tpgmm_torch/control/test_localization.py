"""The likelihood of a skill's instants, and beliefs over them, against plain formulas."""

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
from tpgmm_torch.control import localization
from tpgmm_torch.control.localization import Localizer, local_mode, move
from tpgmm_torch.regression.regression import Regression

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
                centre = one.recentred(first.time_mean)[:, block]
                signs[:, block] = torch.sign((centre * local[block]).sum(-1, keepdim=True))
            covariance = signs[:, :, None] * one.covariance * signs[:, None, :]
            given = torch.distributions.MultivariateNormal(signs * mean, covariance)
            total = total + given.log_prob(local)
        result.append(torch.logsumexp(total, -1))
    values = torch.stack(result).numpy()
    return values - values.max()


@EVERY_WORLD
def test_the_likelihood_is_the_mixtures_given_time(case: Case, monkeypatch):
    monkeypatch.setattr(localization, "SLACK", 0.0)
    monkeypatch.setattr(localization, "NEGLIGIBLE", 0.0)
    problem = Problem.of(case, 4, 3)
    regression = problem.regression()
    localizer = Localizer(regression, 0.0, 2.0)
    joints = problem.state.joints
    got = localizer.look(problem.state, problem.frames).log_likelihood()
    assert got.shape == (3, 51)
    for robot in range(3):
        frames = {name: frame[robot] for name, frame in problem.frames.items()}
        expected = dense(regression, joints[robot], frames, localizer.instants)
        relative = got[robot] - got[robot].max()
        np.testing.assert_allclose(relative, expected, rtol=1e-9, atol=1e-7)


def test_instants_cover_the_skill_evenly():
    regression = hands().regression()
    localizer = Localizer(regression, 0.3, 1.7)
    assert localizer.instants[0] == 0.3
    assert localizer.instants[-1] == 1.7
    np.testing.assert_allclose(np.diff(localizer.instants), localizer.step)
    assert localizer.step == pytest.approx(0.04)
    assert len(Localizer(regression, 0.0, 1e4).instants) == 4096


def test_components_that_weigh_nothing_are_left_out(monkeypatch):
    """At each instant few of 8 components count; the others change nothing that is likely."""
    regression, demonstration = small_bottle().regression(), few_bottles()[0]
    begin, end = demonstration.time[[0, -1]].tolist()
    state = regression.kinematics.state(demonstration.joints)
    frames = dict(demonstration.frames)
    fast = Localizer(regression, begin, end).look(state, frames).log_likelihood()
    monkeypatch.setattr(localization, "NEGLIGIBLE", 0.0)
    every = Localizer(regression, begin, end).look(state, frames).log_likelihood()
    likely = every > every.max(1, keepdims=True) - 10
    np.testing.assert_allclose(fast[likely], every[likely], atol=0.01)


def test_the_instant_of_a_demonstration_is_found():
    """Of two tracked hands and a cup, any step of a motion never shown."""
    situation, wanted = new_handling()
    localizer = Localizer(hands().regression(), 0.0, 2.0)
    frames = {"cup": situation.frames["cup"]}
    found = localizer.instants[
        localizer.look(HANDS.state(wanted), frames).log_likelihood().argmax(1)
    ]
    assert np.abs(found - situation.time.numpy()).max() < 0.1


def test_quaternions_of_the_other_sign_are_the_same_rotation():
    situation, wanted = new_handling()
    localizer = Localizer(hands().regression(), 0.0, 2.0)
    flipped = wanted.clone()
    flipped[:, 3:7] *= -1
    cup = situation.frames["cup"]
    one = localizer.look(HANDS.state(wanted), {"cup": cup}).log_likelihood()
    other = localizer.look(
        HANDS.state(flipped), {"cup": Frame(cup.position, -cup.orientation)}
    ).log_likelihood()
    np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-7)


def test_a_frame_that_is_not_there_says_nothing_others_do():
    """The right hand seen from the left one needs no cup."""
    _, wanted = new_handling()
    regression = hands().regression()
    localizer = Localizer(regression, 0.0, 2.0)
    without = localizer.look(HANDS.state(wanted), {}).log_likelihood()
    alone = Regression(
        regression.kinematics,
        regression.operators[1:],
        regression.conditionals[1:],
        regression.log_weights,
    )
    # each operator has learned the components' times a little differently, by rounding
    expected = Localizer(alone, 0.0, 2.0).look(HANDS.state(wanted), {}).log_likelihood()
    np.testing.assert_allclose(without, expected, rtol=1e-4, atol=0.02)
    assert np.ptp(without, 1).min() > 1  # it does say something


def test_where_nothing_is_known_every_instant_is_alike():
    regression = small_bottle().regression()
    state = regression.kinematics.state(few_bottles()[0].joints[:2])
    position = torch.tensor([[0.45, 0.0, 0.15], [0.45, torch.nan, 0.15]], dtype=torch.float64)
    bottle = Frame([[0.0, 0.0, 0.0]] * 2)
    object.__setattr__(bottle, "position", position)
    got = Localizer(regression, 0.0, 5.0).look(state, {"bottle": bottle}).log_likelihood()
    assert np.isfinite(got).all()
    assert np.ptp(got[1]) == 0
    assert np.ptp(got[0]) > 1


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_of_a_stack_some_may_be_seen_and_references_are_as_far():
    """One stack over two objects, of which one is not there: its marginal."""
    situation, wanted = new_handling()
    both = Stack(*(RelativePosition(hand, name) for hand in ("left", "right") for name in "ab"))
    time = situation.time
    demonstrations = [
        Demonstration(d.time, d.joints, {"a": d.frames["cup"], "b": Frame([0.1 * k, 0, 0])})
        for k, d in enumerate(handlings())
    ]
    settings = {"n_components": 6, "robot": HANDS, "blend": 0.0}
    model = TaskParameterizedGMM(operators=[both, Canonical()], **settings).fit(demonstrations)
    localizer = Localizer(model.regression(), 0.0, 2.0)
    a = {"a": situation.frames["cup"]}
    look = localizer.look(HANDS.state(wanted), a)
    [first, canonical] = model.regression().conditionals
    columns = torch.tensor([0, 1, 2, 6, 7, 8])
    only = Stack(RelativePosition("left", "a"), RelativePosition("right", "a"))
    alone = replace(
        model.regression(),
        operators=[only, Canonical()],
        conditionals=[first.marginal(columns), canonical],
    )
    expected = Localizer(alone, 0.0, 2.0).look(HANDS.state(wanted), a)
    np.testing.assert_allclose(look.log_likelihood(), expected.log_likelihood(), atol=1e-6)
    reference = look.reference(time.numpy())
    step = alone.step(time, HANDS.state(wanted), a)
    assert reference is not None
    assert torch.equal(reference.joints, step.joints)
    cup_only = replace(
        hands().regression(),
        operators=hands().regression().operators[:1],
        conditionals=hands().regression().conditionals[:1],
    )
    blind = Localizer(cup_only, 0.0, 2.0).look(HANDS.state(wanted), {})
    assert blind.reference(time.numpy()) is None
    assert np.ptp(blind.log_likelihood()) < 1e-9


@EVERY_WORLD
def test_robots_of_a_batch_are_what_they_are_alone(case: Case):
    problem = Problem.of(case, 4, 5)
    localizer = Localizer(problem.regression(), 0.0, 2.0)
    together = localizer.look(problem.state, problem.frames).log_likelihood()
    for robot in range(5):
        frames = {OBJECT: problem.frames[OBJECT][robot]}
        alone = localizer.look(problem.state[robot : robot + 1], frames).log_likelihood()
        np.testing.assert_allclose(together[robot], alone[0], rtol=1e-10, atol=1e-8)


# Beliefs


def test_a_belief_moves_and_widens_as_it_is_told():
    instants = np.arange(41.0)
    belief = np.zeros((3, 41))
    belief[:, 10] = 1.0
    shift, spread = np.array([0.0, 1.3, 2.0]), np.array([0.4, 0.2, 0.0])
    moved = move(belief, shift, spread)
    mean = moved @ instants
    variance = moved @ instants**2 - mean**2
    np.testing.assert_allclose(moved.sum(1), 1.0)
    np.testing.assert_allclose(mean, 10 + shift)
    # between two instants, both are believed
    np.testing.assert_allclose(variance, spread + np.array([0.0, 0.3 * 0.7, 0.0]), atol=1e-12)
    assert (belief[:, 10] == 1).all()


def test_what_leaves_at_the_ends_stays_there():
    belief = np.zeros((2, 9))
    belief[0, 0] = belief[1, 7] = 1.0
    for _ in range(20):
        belief = move(belief, np.array([0.0, 3.0]), np.array([0.0, 0.4]))
    np.testing.assert_allclose(belief.sum(1), 1.0)
    assert belief[0, 0] == 1
    assert belief[1, -1] > 0.7


def test_the_mode_is_the_highest_place_not_the_mean_of_two():
    instants = np.linspace(0, 10, 251)
    belief = np.exp(-0.5 * ((instants - 2.01) / 0.1) ** 2)
    belief += 0.5 * np.exp(-0.5 * ((instants - 8) / 0.1) ** 2)
    assert local_mode(belief[None], instants) == pytest.approx(2.01, abs=0.01)


def test_demonstrations_are_what_the_likelihood_was_learned_from():
    """Median error of the time of single postures, of all steps of four demonstrations."""
    localizer = Localizer(hands().regression(), 0.0, 2.0)
    errors = []
    for demonstration in handlings():
        got = localizer.look(
            HANDS.state(demonstration.joints), dict(demonstration.frames)
        ).log_likelihood()
        errors.append(localizer.instants[got.argmax(1)] - demonstration.time.numpy())
    assert np.median(np.abs(errors)) < 0.03
