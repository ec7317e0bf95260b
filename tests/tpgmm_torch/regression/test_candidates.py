"""Each operator's own estimate, and its share of what is known about each joint (fig. 6)."""

import itertools

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.support import oracles
from tests.support.mixtures import CASES, Case, Problem, assert_close, times
from tests.support.worlds import upper_body

EVERY_CASE = pytest.mark.parametrize("case", CASES.values(), ids=list(CASES))
FUSIONS = pytest.mark.parametrize("fusion", ["information", "covariance"])


@EVERY_CASE
@FUSIONS
def test_candidates_are_each_operators_own_projection(case, fusion):
    problem = Problem.of(case, 3, 2)
    estimate = problem.regression(fusion=fusion).step(
        times(2), problem.state, problem.frames, candidates=True
    )
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
    assert problem.regression().step(times(), problem.state, problem.frames).candidates == ()


def shares(case: Case, *batch: int) -> Tensor:
    problem = Problem.of(case, 3, *batch)
    estimate = problem.regression().step(
        times(*batch), problem.state, problem.frames, candidates=True
    )
    return torch.stack([candidate.share for candidate in estimate.candidates])


@pytest.mark.parametrize("name", ["canonical", "the paper's", "three", "poses in two frames"])
def test_shares_are_fractions_of_the_marginal_precisions(name):
    problem = Problem.of(CASES[name], 3, 2)
    estimate = problem.regression().step(
        times(2), problem.state, problem.frames, candidates=True
    )
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
    alone = Case(case.world, case.operators[:1], lambda at: case.rows(at)[:1])
    [share] = shares(alone)
    right_arm = [name.startswith("r_") for name in upper_body().joint_names]
    assert bool((share[right_arm] == 0).all())
    assert bool((share[[not right for right in right_arm]] == 1).all())
