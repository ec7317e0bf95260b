"""Strict priorities: higher operators as if they were alone, lower ones in what is left."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support.mixtures import CASES, Problem
from tests.support.skills import waves
from tpgmm_torch import Canonical, TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.gaussians import information
from tpgmm_torch.regression import regression as module
from tpgmm_torch.regression.fusion import Projection
from tpgmm_torch.regression.fusion_forms import InformationFusion

NOW = torch.tensor(0.8, dtype=torch.float64)
PROBLEM = Problem.of(CASES["three"], 1)


def operators_information(regression):
    """Precision and vector of each operator in terms of the step, of one component."""
    local = regression._local(regression.conditionals, NOW, PROBLEM.state, PROBLEM.frames)
    for at, mean, _, covariance in local:
        one = Projection.of(at, mean.unsqueeze(-1), covariance)
        precision, vector, _ = information(one.jacobian, one.targets, one.covariance)
        yield precision[0].numpy(), vector[0, :, 0].numpy()


def projected(regression, priorities):
    """The hierarchy by null spaces: each level in what those above it leave."""
    told = list(operators_information(regression))
    step, free = np.zeros(len(told[0][1])), np.eye(len(told[0][1]))
    for level in sorted(set(priorities), reverse=True):
        own = [one for one, priority in zip(told, priorities, strict=True) if priority == level]
        precision, vector = sum(one[0] for one in own), sum(one[1] for one in own)
        within = free.T @ precision @ free
        values, vectors = np.linalg.eigh(within)
        known = values > 1e-9 * values.max()
        inverse = vectors[:, known] / values[known] @ vectors[:, known].T
        step = step + free @ inverse @ free.T @ (vector - precision @ step)
        free = free @ vectors[:, ~known]
    return step


def step(regression):
    return regression.estimate(NOW, PROBLEM.state, PROBLEM.frames).joints - PROBLEM.state.joints


@pytest.mark.parametrize("priorities", [[1, 0, 0], [0, 1, 0], [2, 1, 0], [9, 9, -3]])
def test_it_is_the_projection_into_null_spaces_as_the_scale_vanishes(priorities, monkeypatch):
    plain = PROBLEM.regression()
    expected = projected(plain, priorities)
    far = []
    for scale in (1e-4, 1e-6):
        monkeypatch.setattr(module, "STRICT", scale)
        found = step(replace(plain, fusion=InformationFusion(priorities=priorities))).numpy()
        far.append(np.abs(found - expected).max())
    soft = np.abs(step(plain).numpy() - expected).max()
    assert far[0] < 0.05 * soft
    assert far[1] < 0.05 * far[0] + 1e-9


def test_lower_operators_do_not_disturb_higher_ones():
    """What the joints would rather do changes the step, but not where it leads the hands."""
    soft = PROBLEM.regression()
    *tasks, joints = soft.conditionals
    other = replace(soft, conditionals=[*tasks, replace(joints, mean=joints.mean + 0.3)])
    moved = {}
    for name, priorities in (("soft", None), ("strict", [1, 1, 0])):
        difference = [
            step(replace(one, fusion=InformationFusion(priorities=priorities)))
            for one in (soft, other)
        ]
        change = difference[1] - difference[0]
        jacobians = [
            operator.linearize(PROBLEM.state, PROBLEM.frames).jacobian
            for operator in soft.operators[:-1]
        ]
        moved[name] = max(float((one @ change).abs().max()) for one in jacobians)
        assert float(change.abs().max()) > 0.05
    assert moved["strict"] < 0.01 * moved["soft"]


def test_equal_priorities_are_none():
    plain = PROBLEM.regression()
    assert torch.equal(
        step(replace(plain, fusion=InformationFusion(priorities=[5, 5, 5]))), step(plain)
    )


def test_what_is_said_of_one_operator_alone_stays():
    """Likelihoods and candidates are those of what was learned."""
    plain = PROBLEM.regression()
    strict = replace(plain, fusion=InformationFusion(priorities=[1, 0, 0]))
    at = NOW, PROBLEM.state, PROBLEM.frames
    estimate = plain.estimate(*at)
    for one, other in zip(
        plain.candidates(*at, estimate), strict.candidates(*at, estimate), strict=True
    ):
        assert torch.equal(one.covariance, other.covariance)


def test_the_sum_of_precisions_and_the_kalman_update_agree():
    class Joints(Canonical):
        """The same operator by another name, for which the precisions are summed."""

    strict = replace(PROBLEM.regression(), fusion=InformationFusion(priorities=[2, 1, 0]))
    summed = [Joints() if type(one) is Canonical else one for one in strict.operators]
    other = replace(strict, operators=summed)
    assert strict._update is not None and other._update is None
    torch.testing.assert_close(step(strict), step(other), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize(
    ("priorities", "message"),
    [([1, 0], "for 1 operators"), ([0.5], "holds integers"), ("high", "one integer per")],
)
def test_other_numbers_of_priorities_are_refused(priorities, message):
    with pytest.raises(DataError, match=message):
        TaskParameterizedGMM(2, fusion=InformationFusion(priorities=priorities)).fit(waves())
