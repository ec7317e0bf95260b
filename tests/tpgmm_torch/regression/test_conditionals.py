"""Components conditioned on time: their weights, their means, their stacks and products."""

import numpy as np
import pytest
import torch

from tests.support import oracles
from tests.support.mixtures import assert_close, conditionals_of, random_local
from tpgmm_torch import gaussians
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.regression.conditionals import Conditionals, TimeMarginals

K = 4


def local(seed: int, size: int) -> oracles.Local:
    return random_local(np.random.default_rng(seed), K, np.arange(float(size)))


def test_activations_are_the_weighted_densities_of_time():
    means, variances = torch.rand(K).double(), 0.1 + torch.rand(K).double()
    weights = torch.softmax(torch.rand(K).double(), 0)
    times = torch.linspace(-1, 2, 7).double()
    log_h = TimeMarginals.of(weights.log(), means, variances).log_activation(times[:, None])
    for time, row in zip(times.tolist(), torch.softmax(log_h, -1), strict=True):
        moments = zip(weights.tolist(), means.tolist(), variances.tolist(), strict=True)
        expected = np.array([w * oracles.normal(time, m, v) for w, m, v in moments])
        assert_close(row, expected / expected.sum())


def test_conditional_moments_are_those_of_each_component():
    given = local(0, 3)
    conditionals = conditionals_of(given)
    time = torch.tensor([0.3, 1.7], dtype=torch.float64)
    for k in range(K):
        mean, covariance = given.means[k], given.covariances[k]
        gain = covariance[1:, 0] / covariance[0, 0]
        for row, now in enumerate(time.tolist()):
            assert_close(conditionals.at(time)[row, k], mean[1:] + gain * (now - mean[0]))
        rest = covariance[1:, 1:] - np.outer(gain, covariance[0, 1:])
        assert_close(conditionals.covariance[k], rest)


def test_selecting_keeps_what_belongs_together():
    conditionals, index = conditionals_of(local(1, 2)), torch.tensor([3, 1])
    some, time = conditionals.select(index), torch.tensor(0.4, dtype=torch.float64)
    assert torch.equal(some.at(time), conditionals.at(time)[index])
    assert torch.equal(some.covariance, conditionals.covariance[index])


def test_a_stack_is_its_parts_side_by_side_at_any_time():
    parts = [conditionals_of(local(2, 3)), conditionals_of(local(3, 2))]
    stack = Conditionals.stacked(parts)
    time = torch.tensor([0.0, 0.9], dtype=torch.float64)
    assert_close(stack.at(time), torch.cat([part.at(time) for part in parts], -1))
    for k in range(K):
        blocks = [part.covariance[k] for part in parts]
        assert torch.equal(stack.covariance[k], torch.block_diag(*blocks))


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_product_of_conditionals_is_the_product_of_gaussians_at_any_time(count):
    parts = [conditionals_of(local(seed, 3)) for seed in range(count)]
    product = Conditionals.product(parts)
    for now in (-1.0, 0.5, 3.0):
        time = torch.tensor(now, dtype=torch.float64)
        means = torch.stack([part.at(time) for part in parts])
        covariances = torch.stack([part.covariance for part in parts])
        mean, covariance = gaussians.product(means, covariances)
        assert_close(product.at(time), mean)
        assert_close(product.covariance, covariance)


def test_a_singular_factor_is_refused():
    first, second = conditionals_of(local(0, 2)), conditionals_of(local(1, 2))
    second.covariance.zero_()
    with pytest.raises(DataError, match="a factor of the product"):
        Conditionals.product([first, second])
