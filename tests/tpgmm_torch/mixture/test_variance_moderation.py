"""Moderation of variances: its formula, its limits, what it gains, and what it leaves alone."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import digamma, polygamma

from tpgmm_torch.em.parameters import Parameters
from tpgmm_torch.mixture.variance_moderation import (
    moderate,
    moderated_variances,
    trigamma_inverse,
)


def drawn(prior, n, size=2000, scale=1.0, seed=0):
    """True variances of the prior with so many degrees of freedom, and estimates of them."""
    rng = np.random.default_rng(seed)
    true = scale * prior / rng.chisquare(prior, size)
    return torch.from_numpy(true), torch.from_numpy(true * rng.chisquare(n, size) / n)


def mixture(width=5, n_components=3, seed=0):
    rng = torch.Generator().manual_seed(seed)
    options = {"generator": rng, "dtype": torch.float64}
    root = torch.randn(n_components, width, width, **options)
    covariance = root @ root.mT + 1e-3 * torch.eye(width, dtype=torch.float64)
    means = torch.randn(n_components, width, **options)
    weights = torch.tensor([0.2, 0.3, 0.5], dtype=torch.float64)
    return Parameters.from_covariances(weights, [means], [covariance])


def conditional(parameters):
    """Covariances of what follows time, given time, and the slopes over it."""
    [covariance] = parameters.covariances
    slope = covariance[:, 1:, :1] / covariance[:, :1, :1]
    return covariance[:, 1:, 1:] - slope @ covariance[:, :1, 1:], slope


@given(st.floats(-9, 9))
def test_the_inverse_is_one(exponent):
    value = torch.tensor(10.0**exponent, dtype=torch.float64)
    found = torch.polygamma(1, trigamma_inverse(value))
    torch.testing.assert_close(found, value, rtol=1e-6, atol=0)


@pytest.mark.parametrize("n", [1.0, 2.0, 9.0])
@pytest.mark.parametrize("seed", range(5))
def test_it_is_the_published_formula(n, seed):
    variances = np.exp(3 * np.random.default_rng(seed).standard_normal(8))
    e = np.log(variances) - digamma(n / 2) + np.log(n / 2)
    excess = e.var(ddof=1) - polygamma(1, n / 2)
    low, high = 1e-6, 1e6  # bisection for d with trigamma(d / 2) = excess
    for _ in range(200):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if polygamma(1, middle / 2) > excess else (low, middle)
    scale = np.exp(e.mean() + digamma(low / 2) - np.log(low / 2))
    expected = (low * scale + n * variances) / (low + n) if excess > 0 else np.exp(e.mean())
    found = moderated_variances(torch.from_numpy(variances), n)
    np.testing.assert_allclose(found.numpy(), np.broadcast_to(expected, 8), rtol=1e-6)


@pytest.mark.parametrize("n", [1, 2, 4, 9])
@pytest.mark.parametrize("prior", [2.0, 6.0, 30.0])
def test_it_comes_closer_to_the_truth_than_the_samples(n, prior):
    true, estimated = drawn(prior, n)
    moderated = moderated_variances(estimated, n)
    before, after = (((x / true).log() ** 2).mean() for x in (estimated, moderated))
    assert after < before * (n + 1) / (n + 2)
    # one in ten is ten times too small with two degrees of freedom: not any more
    assert (moderated < true / 10).sum() <= (estimated < true / 10).sum()


def test_variances_of_one_size_become_one_and_it_is_right():
    rng = np.random.default_rng(1)
    estimated = torch.from_numpy(rng.chisquare(2, (400, 6)) / 2)
    moderated = moderated_variances(estimated, 2)
    alike = (moderated == moderated[:, :1]).all(1)
    assert alike.double().mean() > 0.5
    assert moderated[alike].log().abs().mean() < 0.6 < estimated.log().abs().mean()


def test_what_differs_by_orders_of_magnitude_stays():
    variances = torch.tensor([1e-10, 2e-10, 1.5e-10, 1e-2, 2e-2, 3e-2], dtype=torch.float64)
    moderated = moderated_variances(variances, 2)
    assert ((moderated / variances).log2().abs() < 1).all()


def test_many_samples_are_believed():
    _, estimated = drawn(4.0, 1e6, size=12)
    torch.testing.assert_close(
        moderated_variances(estimated, 1e6), estimated, rtol=1e-4, atol=0
    )


@settings(max_examples=30)
@given(st.integers(0, 10_000), st.floats(-6, 6), st.sampled_from([1.0, 2.0, 5.0]))
def test_units_and_order_make_no_difference(seed, exponent, n):
    _, estimated = drawn(3.0, n, size=7, seed=seed)
    expected, scale = moderated_variances(estimated, n), 10.0**exponent
    torch.testing.assert_close(
        moderated_variances(scale * estimated, n), scale * expected, rtol=1e-6, atol=0
    )
    torch.testing.assert_close(moderated_variances(estimated.flip(0), n).flip(0), expected)


def test_correlations_slopes_and_what_is_like_no_other_stay():
    old, names = mixture(7), ["m", "m", None, "rad", "m", "rad"]
    new = moderate(old, [names], 3, given=1)
    (before, slope), (after, same) = conditional(old), conditional(new)
    torch.testing.assert_close(same, slope)
    variances, moderated = (x.diagonal(dim1=1, dim2=2) for x in (before, after))
    torch.testing.assert_close(moderated[:, 2], variances[:, 2])
    for columns in ([0, 1, 4], [3, 5]):
        torch.testing.assert_close(
            moderated[:, columns], moderated_variances(variances[:, columns], 2)
        )
    ratio = (moderated / variances).sqrt()
    torch.testing.assert_close(after, before * ratio[:, :, None] * ratio[:, None, :])


@pytest.mark.parametrize("n_samples", [0.5, 1.0])
def test_one_demonstration_says_nothing_of_variances(n_samples):
    old = mixture()
    new = moderate(old, [["m"] * 4], n_samples, given=1)
    torch.testing.assert_close(new.factors[0], old.factors[0])
