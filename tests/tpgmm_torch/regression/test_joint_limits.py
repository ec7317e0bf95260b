"""Joints at a bound stand, and the others take over as the Gaussian says."""

import pytest
import torch

from tests.support.mixtures import CASES, Problem, assert_close, times


def test_inside_its_bounds_a_step_is_what_it_was():
    problem = Problem.of(CASES["the paper's"], 3, 2)
    now = times(2), problem.state, problem.frames
    plain = problem.regression().step(*now)
    bounds = plain.joints - 1e-9, plain.joints + 1e-9
    assert torch.equal(problem.regression().step(*now, bounds=bounds).joints, plain.joints)


@pytest.mark.parametrize("width", [0.01, 0.1])
def test_joints_at_a_bound_stand_and_the_others_take_over(width):
    problem = Problem.of(CASES["the paper's"], 3, 2)
    now = times(2), problem.state, problem.frames
    plain = problem.regression().step(*now)
    lower, upper = problem.state.joints - width, problem.state.joints + width
    bounded = problem.regression().step(*now, bounds=(lower, upper)).joints
    assert bool(((bounded >= lower) & (bounded <= upper)).all())
    for index in range(2):
        mean, covariance = plain.joints[index], plain.covariance[index]
        low, high = lower[index], upper[index]
        joints, stands = mean.clone(), torch.zeros(17, dtype=torch.bool)
        while bool((beyond := ((joints < low) | (joints > high)) & ~stands).any()):
            joints = torch.where(beyond, joints.clamp(low, high), joints)
            stands |= beyond
            inverse = torch.linalg.inv(covariance[stands][:, stands])
            gain = covariance[~stands][:, stands] @ inverse
            joints[~stands] = mean[~stands] + gain @ (joints[stands] - mean[stands])
        assert int(stands.sum()) > 0
        assert_close(bounded[index], joints, 1e-6)
