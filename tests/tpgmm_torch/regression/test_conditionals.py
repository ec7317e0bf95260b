"""Components conditioned on time: their weights, their means, their stacks and products."""

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.support import oracles
from tests.support.mixtures import assert_close, conditionals_of, random_local
from tests.support.refusals import refused
from tpgmm_torch import gaussians
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.regression.conditionals import ActiveComponents, Conditionals, TimeMarginals

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
    stack = Conditionals.stack(parts)
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
    refused(lambda: Conditionals.product([first, second]), DataError, "a factor of the product")


# Windows of time


def marginals(seed: int, k: int = 12) -> TimeMarginals:
    rng = np.random.default_rng(seed)
    means = torch.from_numpy(rng.uniform(0, 10, k))
    variances = torch.from_numpy(10 ** rng.uniform(-4, 0, k))
    return TimeMarginals.of(torch.from_numpy(rng.dirichlet(np.ones(k))).log(), means, variances)


def shares(of: TimeMarginals, instants: Tensor) -> Tensor:
    """Weights of all components, relative to the largest one."""
    log_h = of.log_activation(instants[:, None])
    return torch.exp(log_h - log_h.amax(1, keepdim=True))


def evenly(negligible: float = 1e-9) -> ActiveComponents:
    """Eleven components of 0.2 s, a second apart."""
    means = torch.linspace(0, 10, 11, dtype=torch.float64)
    of = TimeMarginals.of(torch.zeros(11).double(), means, torch.full((11,), 0.04).double())
    return ActiveComponents(of, negligible)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("negligible", [1e-9, 1e-3])
def test_what_windows_leave_out_is_negligible_everywhere(seed, negligible):
    of = marginals(seed)
    active = ActiveComponents(of, negligible)
    instants = torch.from_numpy(np.random.default_rng(seed).uniform(-8, 18, 2000))
    fewer = 0
    for instant, share in zip(instants.tolist(), shares(of, instants), strict=True):
        left_out = sorted(set(range(12)) - set(active.at(instant)))
        assert bool((share[left_out] < negligible).all())
        fewer += len(left_out)
    assert fewer > 1000
    assert active.largest < 12 or negligible < 1e-3


def test_times_of_a_batch_are_asked_one_by_one():
    active = ActiveComponents(marginals(0), 1e-6)
    instants = torch.linspace(-20, 30, 101, dtype=torch.float64)
    both = active.counts(instants.view(101, 1).expand(101, 2))
    assert both.shape == (101, 2, 12)
    for time, counts in zip(instants.tolist(), both, strict=True):
        for row in counts:
            assert tuple(row.nonzero()[:, 0].tolist()) == active.at(time)


def test_near_a_component_only_its_neighbours_count():
    active = evenly()
    # a component at a distance of d s weighs exp(-25 d^2 / 2): its neighbours 4e-6 of it, those
    # beyond 2e-22; halfway to the next one, both neighbours weigh 1e-11
    assert active.at(5.0) == (4, 5, 6)
    assert active.at(5.5) == (5, 6)
    assert active.largest == 3


def test_the_bound_is_the_share_that_is_asked_for():
    # between two equal components the share of the farther one is exp(-(10 x)^2 / 2) at first
    loose, tight = evenly(0.5), evenly(1e-30)
    assert loose.at(5.01) == (5,)
    assert loose.at(5.5) == (5, 6)
    assert len(tight.at(5.0)) == 5


@pytest.mark.parametrize("negligible", [1e-9, 0.5])
def test_windows_reach_six_deviations_beyond_the_means(negligible):
    active = evenly(negligible)
    reach = 6 * 0.2
    assert len(active.at(-reach + 0.01)) < 11
    assert len(active.at(10 + reach - 0.01)) < 11
    for beyond in (-reach - 0.01, 10 + reach + 0.01, 1e9):
        assert active.at(beyond) == tuple(range(11))
        assert bool(active.counts(torch.tensor([beyond], dtype=torch.float64)).all())


def test_keeping_all_keeps_all():
    means = torch.tensor([0.0, 100.0], dtype=torch.float64)
    zeros = torch.zeros(2, dtype=torch.float64)
    assert ActiveComponents(TimeMarginals.of(zeros, means, zeros + 1), 0).at(0.0) == (0, 1)
