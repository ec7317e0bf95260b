"""Regression in joint space against dense oracles that keep time inside the Gaussians."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.support import oracles
from tests.support.mixtures import (
    BOTH_HANDS,
    CASES,
    Case,
    Problem,
    assert_close,
    assert_equal_estimates,
    conditionals_of,
    form,
    times,
)
from tests.support.worlds import LEFT, OBJECT, RIGHT, OnRobot, upper_body
from tpgmm_torch import AbsolutePosition, Canonical, Frame, RelativePosition, Stack
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.operators.base import leaves
from tpgmm_torch.regression.conditionals import Conditionals
from tpgmm_torch.regression.fusion_forms import CovarianceFusion, InformationFusion

EVERY_CASE = pytest.mark.parametrize("case", CASES.values(), ids=list(CASES))
FORMS = pytest.mark.parametrize(
    ("fusion", "activation"),
    [("information", "time"), ("covariance", "time"), ("covariance", "product")],
)
FUSIONS = pytest.mark.parametrize("fusion", ["information", "covariance"])
EPSILON, PRIOR_STD = 1e-2, 3.0


def options_of(case: Case, fusion: str) -> dict[str, float]:
    """What the oracle needs to know of the fusion."""
    if fusion == "covariance":
        return {"epsilon": EPSILON}
    closed = any(operator.determines_joints for operator in case.operators)
    return {} if closed else {"prior_std": PRIOR_STD}


# Eqs (1), (2)


@EVERY_CASE
@FORMS
@pytest.mark.parametrize("n_components", [1, 2, 5])
def test_a_step_is_the_conditional_of_the_fused_mixture(case, activation, fusion, n_components):
    problem = Problem.of(case, n_components, 2, 2)
    used = form(fusion, activation, EPSILON, prior_std=PRIOR_STD)
    regression = problem.regression(fusion=used)
    options = {"activation": activation, **options_of(case, fusion)}
    for time in (times(), times(2, 2)):
        estimate = regression.estimate(time, problem.state, problem.frames)
        assert estimate.joints.shape == problem.state.joints.shape
        for index in np.ndindex(2, 2):
            now = float(time.expand(2, 2)[index])
            expected = problem.answer(now, index, **options)
            activations = estimate.activation.expand(2, 2, n_components)
            assert_close(activations[index], expected.activation)
            assert_close(estimate.joints[index], expected.mean)
            assert_close(estimate.covariance[index], expected.covariance)


STACKED = [Stack(RelativePosition(LEFT, OBJECT), Canonical()), AbsolutePosition(RIGHT)]
GIVING = [CASES["the paper's"], CASES["three"], Case(OnRobot(), STACKED)]


@FORMS
@pytest.mark.parametrize("case", GIVING, ids=["the paper's", "three", "stacked"])
def test_joints_give_way_by_what_few_samples_leave_unknown(case, activation, fusion):
    problem = Problem.of(case, 3)
    how = {"fusion": form(fusion, activation, EPSILON)}
    estimate = problem.estimate(n_samples=3, **how)
    plain = problem.estimate(**how)
    assert float((estimate.joints - plain.joints).abs().max()) > 1e-3
    wider = []
    for operator, local in zip(case.operators, problem.mixtures, strict=True):
        scales = [
            [2.0 if isinstance(leaf, Canonical) else 1.0]
            * leaf.dimension(case.world.kinematics)
            for leaf in leaves([operator])
        ]
        wider.append(oracles.with_wider_rest(local, np.concatenate(scales)))
    options = {"activation": activation, **options_of(case, fusion)}
    expected = replace(problem, mixtures=wider).answer(float(times()), **options)
    assert_close(estimate.activation, expected.activation)
    assert_close(estimate.joints, expected.mean)
    assert_close(estimate.covariance, expected.covariance)
    # the law of the demonstrations themselves is as it was
    local = [
        operator.coordinates(problem.state, problem.frames)[None] for operator in case.operators
    ]
    both = [
        problem.regression(n_samples=n).log_density(times()[None], local) for n in (None, 3)
    ]
    assert torch.equal(*both)


def test_joints_alone_have_nobody_to_give_way_to():
    problem = Problem.of(CASES["canonical"], 3)
    plain, few = (problem.estimate(n_samples=n) for n in (None, 3))
    assert_equal_estimates(plain, few)


@EVERY_CASE
def test_the_activations_are_different_models_of_two_operators_and_one_of_one(case):
    problem = Problem.of(case, 4)
    weights = [
        problem.estimate(fusion=CovarianceFusion(activation=name))
        for name in ("time", "product")
    ]
    differ = (weights[0].activation - weights[1].activation).abs().max() > 1e-3
    assert differ == (len(case.operators) > 1)


@pytest.mark.parametrize("n_components", [1, 4])
def test_both_forms_agree_where_every_jacobian_is_invertible(n_components):
    problem = Problem.of(CASES["poses in two frames"], n_components, 3)
    information = problem.estimate(times(3))
    covariance = problem.estimate(times(3), fusion=CovarianceFusion(0.0))
    assert_equal_estimates(information, covariance)


def test_the_covariance_form_tends_to_the_information_form_as_epsilon_vanishes():
    problem = Problem.of(CASES["poses in two frames"], 3)
    limit = problem.estimate().joints
    errors = [
        (problem.estimate(fusion=CovarianceFusion(eps)).joints - limit).norm()
        for eps in (1e-4, 1e-5, 1e-6)
    ]
    for coarse, fine in itertools.pairwise(errors):
        assert float(fine / coarse) == pytest.approx(0.1, rel=0.05)


def test_the_forms_part_where_a_task_leaves_joints_free():
    problem = Problem.of(CASES["the paper's"], 1)
    information = problem.estimate().joints
    pinned = problem.estimate(fusion=CovarianceFusion(1e-09)).joints
    assert (information - pinned).abs().max() > 1e-2


def test_twelve_by_seventeen_is_the_explicit_sum_of_the_design():
    problem = Problem.of(CASES["the paper's"], 1)
    time, joints = 0.7, problem.state.joints.numpy()
    precision, vector = np.zeros((17, 17)), np.zeros(17)
    for row, local in zip(problem.rows(), problem.mixtures, strict=True):
        mean, covariance = local.means[0], local.covariances[0]
        gain = covariance[1:, 0] / covariance[0, 0]
        mu = mean[1:] + gain * (time - mean[0])
        sigma = covariance[1:, 1:] - np.outer(gain, covariance[0, 1:])
        weight = row.jacobian.T @ np.linalg.inv(row.matrix @ sigma @ row.matrix.T)
        precision += weight @ row.jacobian
        vector += weight @ (row.matrix @ mu + row.displacement + row.jacobian @ joints)
    assert problem.rows()[0].jacobian.shape == (12, 17)
    estimate = problem.estimate(torch.tensor(time))
    assert_close(estimate.joints, np.linalg.solve(precision, vector))
    assert_close(estimate.covariance, np.linalg.inv(precision))


def test_without_canonical_the_step_tends_to_the_pseudo_inverse():
    problem = Problem.of(CASES["both hands"], 1)
    now = torch.tensor(0.8, dtype=torch.float64), problem.state, problem.frames
    linear, offset = problem.rows()[0].linear_and_offset(problem.state.joints.numpy())
    mu = conditionals_of(problem.mixtures[0]).at(now[0])[0].numpy()
    limit = torch.from_numpy(linear @ mu + offset)
    forms = [problem.regression(fusion=InformationFusion(std)) for std in (10.0, 100.0, 1000.0)]
    distances = [float((one.estimate(*now).joints - limit).norm()) for one in forms]
    for near, nearer in itertools.pairwise(distances):
        assert nearer == pytest.approx(near / 100, rel=0.2)
    printed = problem.regression(fusion=CovarianceFusion()).estimate(*now).joints
    assert_close(printed, limit)


# Mixing


def test_activations_are_weights():
    problem = Problem.of(CASES["three"], 5, 3)
    for activation in ("time", "product"):
        regression = problem.regression(fusion=form("covariance", activation))
        weights = regression.estimate(times(3), problem.state, problem.frames).activation
        assert bool((weights >= 0).all())
        assert_close(weights.sum(-1), np.ones(3))


@pytest.mark.parametrize("threshold", [0.05, 0.15])
def test_leaving_components_out_moves_the_mean_by_no_more_than_their_weight(threshold):
    problem = Problem.of(CASES["the paper's"], 5, seed=3)
    full = problem.estimate(fusion=InformationFusion(negligible=0.0))
    fewer = problem.estimate(fusion=InformationFusion(negligible=threshold))
    dropped = fewer.activation == 0
    assert 0 < int(dropped.sum()) < 5
    assert bool((full.activation[dropped] < threshold * full.activation.max()).all())
    assert_close(fewer.activation.sum(), 1.0)
    components = problem.answer(float(times()), activation="time").component_means
    apart = (torch.from_numpy(components)[dropped] - fewer.joints).norm(dim=-1).max()
    moved = (full.joints - fewer.joints).norm()
    assert 0 < moved <= full.activation[dropped].sum() * apart * (1 + 1e-9)


def test_the_most_likely_component_is_never_left_out():
    problem = Problem.of(CASES["the paper's"], 5)
    best = problem.estimate().activation.argmax()
    one = problem.estimate(fusion=InformationFusion(negligible=0.99)).activation
    assert torch.equal(one, torch.eye(5, dtype=torch.float64)[best])


def test_expected_coordinates_are_those_of_regression_in_the_local_space():
    problem = Problem.of(CASES["the paper's"], 4)
    grid, local = times(6), problem.mixtures[0]
    regression = problem.regression()
    expected = regression.expect(0, grid)
    for time, actual in zip(grid.tolist(), expected, strict=True):
        marginals = [
            w * oracles.normal(time, m[0], c[0, 0])
            for w, m, c in zip(problem.weights, local.means, local.covariances, strict=True)
        ]
        at = [
            m[1:] + c[1:, 0] / c[0, 0] * (time - m[0])
            for m, c in zip(local.means, local.covariances, strict=True)
        ]
        assert_close(actual, np.array(marginals) / sum(marginals) @ np.array(at))


# Signs, batches, precision, gradients


def flipped(local: Conditionals, starts: tuple[int, ...]) -> Conditionals:
    signs = torch.ones_like(local.mean[0])
    for start in starts:
        signs[start : start + 4] = -1
    covariance = signs[:, None] * local.covariance * signs
    return replace(
        local, mean=signs * local.mean, gain=signs * local.gain, covariance=covariance
    )


@FORMS
@pytest.mark.parametrize("name", ["the paper's", "three"])
def test_signs_of_quaternions_mean_nothing(name, fusion, activation):
    problem = Problem.of(CASES[name], 3, 2)
    regression = problem.regression(fusion=form(fusion, activation))
    plain = regression.estimate(times(2), problem.state, problem.frames, candidates=True)
    mixtures = [
        flipped(mixture, operator.quaternion_starts(regression.kinematics))
        for mixture, operator in zip(regression.conditionals, regression.operators, strict=True)
    ]
    state = problem.case.world.flipped(problem.state)
    pose = problem.frames[OBJECT]
    frames = {OBJECT: Frame(pose.position, -pose.orientation)}
    other = replace(regression, conditionals=mixtures)
    for step in (
        other.estimate(times(2), problem.state, problem.frames, candidates=True),
        regression.estimate(times(2), state, problem.frames, candidates=True),
        regression.estimate(times(2), problem.state, frames, candidates=True),
        other.estimate(times(2), state, frames, candidates=True),
    ):
        assert_equal_estimates(step, plain)


def test_each_component_has_its_own_sign():
    problem = Problem.of(CASES["the paper's"], 3)
    regression = problem.regression()
    plain = regression.estimate(times(), problem.state, problem.frames)
    first = flipped(regression.conditionals[0], BOTH_HANDS.quaternion_starts(None))
    mixed = Conditionals(
        *(
            torch.cat((getattr(first, name)[:1], getattr(regression.conditionals[0], name)[1:]))
            for name in ("mean", "gain", "covariance", "time_mean", "time_variance")
        )
    )
    other = replace(regression, conditionals=[mixed, regression.conditionals[1]])
    assert_equal_estimates(other.estimate(times(), problem.state, problem.frames), plain)


@EVERY_CASE
@FORMS
def test_a_batch_is_its_members_one_at_a_time(case, fusion, activation):
    problem = Problem.of(case, 3, 2, 3)
    regression = problem.regression(fusion=form(fusion, activation))
    batch = regression.estimate(times(2, 3), problem.state, problem.frames, candidates=True)
    for index in np.ndindex(2, 3):
        frames = {name: frame[index] for name, frame in problem.frames.items()}
        single = regression.estimate(
            times(2, 3)[index], problem.state[index], frames, candidates=True
        )
        assert_close(batch.joints[index], single.joints)
        assert_close(batch.covariance[index], single.covariance)
        assert_close(batch.activation[index], single.activation)
        for many, one in zip(batch.candidates, single.candidates, strict=True):
            assert_close(many.mean[index], one.mean)
            assert_close(many.share[index], one.share)


@EVERY_CASE
def test_many_times_and_many_frames_serve_one_state(case):
    problem = Problem.of(case, 2, 3)
    state, regression = problem.state[0], problem.regression()
    batch = regression.estimate(times(3), state, problem.frames, candidates=True)
    for index in range(3):
        frames = {name: frame[index] for name, frame in problem.frames.items()}
        single = regression.estimate(times(3)[index], state, frames, candidates=True)
        assert_close(batch.joints[index], single.joints)
        for many, one in zip(batch.candidates, single.candidates, strict=True):
            assert_close(many.mean[index], one.mean)


@EVERY_CASE
def test_inference_mode_changes_nothing(case):
    problem = Problem.of(case, 3, 2)
    plain = problem.estimate(times(2), candidates=True)
    with torch.inference_mode():
        state = case.world.kinematics.state(problem.state.joints)
        step = problem.regression().estimate(times(2), state, problem.frames, candidates=True)
    assert_equal_estimates(step, plain, 0.0)
    assert not step.joints.requires_grad


@pytest.mark.parametrize("name", ["the paper's", "both hands", "poses in two frames"])
@FORMS
def test_single_precision_stays_single_and_near(name, fusion, activation):
    problem = Problem.of(CASES[name], 3, 2)
    regression = problem.regression(fusion=form(fusion, activation, EPSILON))
    exact = regression.estimate(times(2), problem.state, problem.frames, candidates=True)
    kinematics = regression.kinematics.to(torch.float32)
    rounded = replace(
        regression,
        kinematics=kinematics,
        conditionals=[
            Conditionals(*(value.float() for value in vars(mixture).values()))
            for mixture in regression.conditionals
        ],
        log_weights=regression.log_weights.float(),
    ).estimate(
        times(2).float(),
        kinematics.state(problem.state.joints),
        {name: frame.to(torch.float32) for name, frame in problem.frames.items()},
        candidates=True,
    )
    assert rounded.joints.dtype == rounded.covariance.dtype == torch.float32
    assert rounded.candidates[0].share.dtype == torch.float32
    # where the prior is corrected by the tasks, to its own precision
    update = name == "the paper's" and fusion == "information"
    near = {"rtol": 0, "atol": 2e-4} if update else {"rtol": 1e-3, "atol": 1e-3}
    torch.testing.assert_close(rounded.joints.double(), exact.joints, **near)
    if update:
        found = rounded.covariance.double()
        torch.testing.assert_close(found, exact.covariance, rtol=1e-3, atol=1e-5)
        torch.linalg.cholesky(rounded.covariance)


@pytest.mark.parametrize("name", ["the paper's", "both hands", "poses in two frames"])
@FORMS
def test_gradients_are_those_of_finite_differences(name, fusion, activation):
    problem = Problem.of(CASES[name], 2)
    regression = problem.regression(fusion=form(fusion, activation, EPSILON))
    mixture, pose = regression.conditionals[0], problem.frames[OBJECT]
    factor = torch.linalg.cholesky(mixture.covariance)
    joints = problem.state.joints.clone()
    inputs = times(), mixture.mean, factor, joints, pose.position, pose.orientation

    def step(
        time: Tensor,
        mean: Tensor,
        factor: Tensor,
        joints: Tensor,
        position: Tensor,
        orientation: Tensor,
    ) -> tuple[Tensor, ...]:
        learned = replace(mixture, mean=mean, covariance=factor @ factor.mT)
        estimate = replace(
            regression, conditionals=[learned, *regression.conditionals[1:]]
        ).estimate(
            time,
            regression.kinematics.state(joints),
            {OBJECT: Frame(position, orientation)},
            candidates=True,
        )
        alone = estimate.candidates[0]
        return estimate.joints, estimate.covariance, alone.mean, alone.covariance

    leaves = [leaf.detach().clone().requires_grad_() for leaf in inputs]
    assert torch.autograd.gradcheck(step, leaves, fast_mode=True, atol=1e-4, rtol=1e-3)


def test_a_component_without_variance_is_refused_with_advice():
    problem = Problem.of(CASES["canonical"], 2)
    regression = problem.regression()
    flat = replace(
        regression.conditionals[0],
        covariance=torch.zeros_like(regression.conditionals[0].covariance),
    )
    with pytest.raises(DataError, match=r"projected component .*2 of 2 .*reg_covar"):
        replace(regression, conditionals=[flat]).estimate(
            times(), problem.state, problem.frames
        )


# Candidates: each operator's own estimate, and its share of each joint (fig. 6)


@EVERY_CASE
@FUSIONS
def test_candidates_are_each_operators_own_projection(case, fusion):
    problem = Problem.of(case, 3, 2)
    estimate = problem.estimate(times(2), candidates=True, fusion=form(fusion))
    assert len(estimate.candidates) == len(case.operators)
    for index in range(2):
        time, joints = float(times(2)[index]), problem.state.joints[index].numpy()
        activation = estimate.activation[index].numpy()
        rows = problem.rows((index,))
        for each, row, local in zip(estimate.candidates, rows, problem.mixtures, strict=True):
            mean, covariance = oracles.candidate(time, joints, row, local, activation)
            assert_close(each.mean[index], mean)
            assert_close(each.covariance[index], covariance)


def test_candidates_are_not_computed_unless_asked_for():
    problem = Problem.of(CASES["the paper's"], 2)
    assert problem.estimate().candidates == ()


def shares(case: Case, *batch: int) -> Tensor:
    problem = Problem.of(case, 3, *batch)
    estimate = problem.estimate(times(*batch), candidates=True)
    return torch.stack([candidate.share for candidate in estimate.candidates])


@pytest.mark.parametrize("name", ["canonical", "the paper's", "three", "poses in two frames"])
def test_shares_are_fractions_of_the_marginal_precisions(name):
    problem = Problem.of(CASES[name], 3, 2)
    estimate = problem.estimate(times(2), candidates=True)
    variances = [c.covariance.diagonal(dim1=-2, dim2=-1) for c in estimate.candidates]
    fractions = shares(CASES[name], 2)
    assert bool(((fractions >= 0) & (fractions <= 1)).all())
    assert_close(fractions.sum(0), np.ones(problem.state.joints.shape))
    for one, other in itertools.combinations(range(len(variances)), 2):
        ratio = variances[other] / variances[one]
        seen = (fractions[one] > 0) & (fractions[other] > 0)
        assert_close((fractions[one] / fractions[other])[seen], ratio[seen])


def test_a_joint_that_an_operator_does_not_touch_gets_no_share_of_it():
    left, both, everything = shares(CASES["three"], 2)
    names = upper_body().joint_names
    right_arm = [name.startswith("r_") for name in names]
    assert bool((left[:, right_arm] == 0).all())
    assert bool((left[:, [not right for right in right_arm]] > 0).all())
    waist = [name.startswith("waist") for name in names]
    # the waist carries both hands: it does not move one relative to the other
    assert bool((both[:, waist] == 0).all())
    assert bool((everything > 0).all())


def test_a_joint_that_no_operator_touches_has_no_shares_and_no_nan():
    case = CASES["two that leave joints free"]
    alone = Case(case.world, case.operators[:1])
    [share] = shares(alone)
    right_arm = [name.startswith("r_") for name in upper_body().joint_names]
    assert bool((share[right_arm] == 0).all())
    assert bool((share[[not right for right in right_arm]] == 1).all())
