"""The most likely joints within bounds are exact."""

from functools import partial

import pytest
import torch

from tests.support.mixtures import CASES, Problem, assert_close, times
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.regression.joint_limits import step_within, within


def problems(count, n, seed=0, spread=1e-4):
    """Gaussians of random directions, whose variances differ by that factor, and bounds."""
    generator = torch.Generator().manual_seed(seed)
    options = {"dtype": torch.float64, "generator": generator}
    turn = torch.linalg.qr(torch.randn(count, n, n, **options))[0]
    variance = torch.rand(count, n, **options) * torch.logspace(0, -1, n).double()
    variance = variance.clamp(min=spread)
    covariance = (turn * variance.unsqueeze(-2)) @ turn.mT
    mean = torch.randn(count, n, **options)
    return mean, covariance, -torch.rand(count, n, **options), torch.rand(count, n, **options)


def assert_optimal(joints, mean, covariance, lower, upper):
    """The conditions of Karush, Kuhn and Tucker, in units of standard deviations."""
    deviation = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    gradient = torch.linalg.solve(covariance, joints - mean) * deviation
    tolerance = 1e-7 * gradient.abs().amax(-1, keepdim=True).clamp(min=1)
    assert bool(((joints >= lower) & (joints <= upper)).all())
    assert bool((gradient <= tolerance)[joints > lower].all())
    assert bool((gradient >= -tolerance)[joints < upper].all())


@pytest.mark.parametrize("n", [1, 2, 7, 17])
def test_a_batch_and_each_robot_of_it_find_the_minimum(n):
    mean, covariance, lower, upper = problems(40, n)
    together = within(mean, covariance, lower, upper)
    assert_optimal(together, mean, covariance, lower, upper)
    for one, *problem in zip(together, mean, covariance, lower, upper, strict=True):
        assert_close(within(*problem), one, 1e-9)


def test_joints_without_room_stand():
    mean, covariance, lower, upper = problems(20, 6, seed=3)
    lower[:, 0] = upper[:, 0]
    lower[10:, 3], upper[:, 5] = -torch.inf, torch.inf
    joints = within(mean, covariance, lower, upper)
    assert torch.equal(joints[:, 0], upper[:, 0])
    free = torch.ones(6, dtype=torch.bool)
    free[0] = False
    # the others as the conditional Gaussian says, within their own bounds
    gain = covariance[:, free][:, :, ~free] / covariance[:, ~free][:, :, ~free]
    rest = mean[:, free] + (gain @ (upper - mean)[:, :1, None])[..., 0]
    left = covariance[:, free][:, :, free] - gain @ covariance[:, ~free][:, :, free]
    assert_close(joints[:, free], within(rest, left, lower[:, free], upper[:, free]), 1e-8)
    for row in (0, 15):
        alone = within(mean[row], covariance[row], lower[row], upper[row])
        assert_close(alone, joints[row], 1e-9)


def test_contradicting_bounds_hold_the_upper_one():
    mean, covariance, lower, upper = problems(2, 5, seed=4)
    lower[:, 2] = upper[:, 2] + 1
    joints = within(mean, covariance, lower, upper)
    assert torch.equal(joints[:, 2], upper[:, 2])
    assert_close(within(mean[1], covariance[1], lower[1], upper[1]), joints[1], 1e-9)


def test_inside_nothing_is_asked():
    mean, covariance, _, _ = problems(3, 4)
    assert within(mean, covariance * torch.nan, mean, mean + 1) is mean


def test_the_robots_inside_keep_their_numbers():
    mean, covariance, lower, upper = problems(4, 5, seed=6)
    lower[1], upper[1] = mean[1] - 1e-9, mean[1] + 1e-9
    assert torch.equal(within(mean, covariance, lower, upper)[1], mean[1])


def test_a_singular_covariance_is_refused():
    mean = torch.ones(2, 3, dtype=torch.float64)
    with pytest.raises(DataError, match="the product is not positive definite"):
        within(mean, torch.zeros(2, 3, 3).double(), -mean, 0.5 * mean)


def test_the_minimum_is_differentiable():
    mean, covariance, lower, upper = problems(3, 4, seed=7)
    assert bool((within(mean, covariance, lower, upper) != mean).any(-1).all())

    def bounded(mean, factor):
        return within(mean, factor @ factor.mT, lower, upper)

    factor = torch.linalg.cholesky(covariance)
    assert torch.autograd.gradcheck(bounded, (mean.requires_grad_(), factor.requires_grad_()))


def test_single_precision_finds_it_too():
    mean, covariance, lower, upper = problems(20, 6, spread=1e-2)
    exact = within(mean, covariance, lower, upper)
    rough = within(*(x.float() for x in (mean, covariance, lower, upper)))
    assert rough.dtype == torch.float32
    assert_close(rough.double(), exact, 1e-3)


def test_a_hand_that_goes_first_by_far_is_no_obstacle():
    """Wanted far outside of the limits, as by a stretched arm; the solver cycles there."""
    generator = torch.Generator().manual_seed(0)
    random = partial(torch.randn, generator=generator, dtype=torch.float64)
    jacobian = random(100, 1, 4) + 1e-2 * random(100, 2, 4)
    precision = 1e11 * jacobian.mT @ jacobian + 0.3 * torch.eye(4)
    joints = 100 * random(100, 4).sign()
    lower, upper = joints - 5 * random(100, 4).abs(), joints + 5 * random(100, 4).abs()
    downhill = -(precision @ joints.unsqueeze(-1))[..., 0]
    there = step_within(joints, downhill, precision, lower, upper)
    before, after = ((q.unsqueeze(-2) @ precision @ q.unsqueeze(-1)) for q in (joints, there))
    assert bool((after <= before).all())
    assert float((after / before).median()) < 0.99


def test_inside_its_bounds_a_step_is_what_it_was():
    problem = Problem.of(CASES["the paper's"], 3, 2)
    now = times(2), problem.state, problem.frames
    plain = problem.regression().estimate(*now)
    bounds = plain.joints - 1e-9, plain.joints + 1e-9
    assert torch.equal(problem.regression().estimate(*now, bounds=bounds).joints, plain.joints)


@pytest.mark.parametrize("width", [0.01, 0.1])
def test_of_a_step_the_other_joints_take_over(width):
    problem = Problem.of(CASES["the paper's"], 3, 2)
    now = times(2), problem.state, problem.frames
    plain = problem.regression().estimate(*now)
    lower, upper = problem.state.joints - width, problem.state.joints + width
    bounded = problem.regression().estimate(*now, bounds=(lower, upper)).joints
    assert_optimal(bounded, plain.joints, plain.covariance, lower, upper)


def test_a_step_within_bounds_is_that_of_the_gaussian():
    generator = torch.Generator().manual_seed(3)
    random = partial(torch.randn, generator=generator, dtype=torch.float64)
    factor, joints, vector = random(40, 6, 6), random(40, 6), 3 * random(40, 6)
    precision = factor @ factor.mT + 0.1 * torch.eye(6)
    lower, upper = joints - 0.3, joints + random(40, 6).abs()
    upper[0, 2], lower[1] = lower[0, 2], upper[1] + 1  # no room, and a contradiction
    together = step_within(joints, vector, precision, lower, upper)
    mean = joints + torch.linalg.solve(precision, vector)
    expected = within(mean, torch.linalg.inv(precision), lower, upper)
    assert_close(together, expected, 1e-9)
    assert bool((together <= upper).all())
    for row in range(40):  # bit for bit what it is alone
        one = slice(row, row + 1)
        alone = step_within(joints[one], vector[one], precision[one], lower[one], upper[one])
        assert torch.equal(alone, together[one])
    with pytest.raises(DataError, match="the product is not positive definite"):
        step_within(joints, vector, -precision, lower, upper)
    with pytest.raises(DataError, match="not positive definite, or not finite"):
        step_within(joints, vector * torch.nan, precision, lower, upper)
