"""Shrinkage and moderation: their formulas, what they gain, and what they leave alone."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import digamma, polygamma

from tpgmm_torch.mixture.covariance_shrinkage import (
    moderated_variances,
    shrink,
    shrinkage_intensity,
    trigamma_inverse,
)


def covariances(width=5, count=3):
    root = torch.from_numpy(np.random.RandomState(0).randn(count, width, width))
    return root @ root.mT + 1e-3 * torch.eye(width, dtype=torch.float64)


def conditional(covariance, before):
    """Of what follows the first columns, given them, and how it depends on them."""
    slope = covariance[:, before:, :before] @ torch.linalg.inv(covariance[:, :before, :before])
    own = covariance[:, before:, before:] - slope @ covariance[:, :before, before:]
    return own, slope


@pytest.mark.parametrize("before", [0, 1])
@pytest.mark.parametrize("share", [0.0, 0.03, 0.3, 1.0])
def test_shrinkage_is_its_definition(share, before):
    old, new = covariances(), shrink(covariances(), share, 4.0, given=before)
    (own, slope), (found, same) = conditional(old, before), conditional(new, before)
    expected = (1 - share) * own + share * torch.diag_embed(own.diagonal(dim1=1, dim2=2))
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(same, slope)
    torch.testing.assert_close(new[:, :before], old[:, :before], rtol=0, atol=0)


@pytest.mark.parametrize("freedom", [0.0, 1.0, 4.0, 30.0, 1e4])
@pytest.mark.parametrize("width", [2, 3, 8])
def test_the_intensity_is_the_published_formula_of_the_correlations(width, freedom):
    found = shrinkage_intensity(covariances(width), "auto", freedom + 1)
    for one, intensity in zip(covariances(width).numpy(), found.tolist(), strict=True):
        deviation = np.sqrt(np.diag(one))
        s, p, n = one / np.outer(deviation, deviation), width, freedom
        square, trace = np.trace(s @ s), np.trace(s)
        denominator = (n + 1 - 2 / p) * (square - trace**2 / p)
        expected = 1.0
        if denominator > 0:
            expected = min(1.0, ((1 - 2 / p) * square + trace**2) / denominator)
        assert intensity == pytest.approx(expected, rel=1e-9)


def test_one_sample_leaves_the_diagonal_and_one_column_nothing_to_do():
    shrunk = shrink(covariances(), "auto", 1.0)
    torch.testing.assert_close(shrunk, torch.diag_embed(covariances().diagonal(dim1=1, dim2=2)))
    pair = covariances(2)
    torch.testing.assert_close(shrink(pair, "auto", 1.0, given=1), pair)


def drawn(prior, n, size=2000, seed=0):
    """True variances of the prior with so many degrees of freedom, and estimates of them."""
    rng = np.random.default_rng(seed)
    true = prior / rng.chisquare(prior, size)
    return torch.from_numpy(true), torch.from_numpy(true * rng.chisquare(n, size) / n)


@given(st.floats(-9, 9))
def test_the_inverse_of_trigamma_is_one(exponent):
    value = torch.tensor(10.0**exponent, dtype=torch.float64)
    found = torch.polygamma(1, trigamma_inverse(value))
    torch.testing.assert_close(found, value, rtol=1e-6, atol=0)


@pytest.mark.parametrize("n", [1.0, 2.0, 9.0])
@pytest.mark.parametrize("seed", range(5))
def test_moderation_is_the_published_formula(n, seed):
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


@settings(max_examples=30)
@given(st.integers(0, 10_000), st.floats(-6, 6), st.sampled_from([1.0, 2.0, 5.0, 1e6]))
def test_units_and_order_make_no_difference(seed, exponent, n):
    _, estimated = drawn(3.0, n, size=7, seed=seed)
    expected, scale = moderated_variances(estimated, n), 10.0**exponent
    found = moderated_variances(scale * estimated, n)
    torch.testing.assert_close(found, scale * expected, rtol=1e-6, atol=0)
    torch.testing.assert_close(moderated_variances(estimated.flip(0), n).flip(0), expected)
    if n == 1e6:  # of many samples
        torch.testing.assert_close(expected, estimated, rtol=1e-4, atol=0)


def test_correlations_slopes_and_columns_of_no_unit_stay():
    units = [None, "m", "m", None, "rad", "m", "rad"]
    old = covariances(7)
    new = shrink(old, 0.0, 3, units, given=1)
    (before, slope), (after, same) = conditional(old, 1), conditional(new, 1)
    torch.testing.assert_close(same, slope)
    variances, moderated = (x.diagonal(dim1=1, dim2=2) for x in (before, after))
    torch.testing.assert_close(moderated[:, 2], variances[:, 2])
    for alike in ([0, 1, 4], [3, 5]):
        expected = moderated_variances(variances[:, alike], 2)
        torch.testing.assert_close(moderated[:, alike], expected)
    ratio = (moderated / variances).sqrt()
    torch.testing.assert_close(after, before * ratio[:, :, None] * ratio[:, None, :])


def test_the_variances_of_one_sample_stay():
    old, n_samples = covariances(), torch.tensor([0.5, 1.0, 3.0], dtype=torch.float64)
    new = shrink(old, 0.0, n_samples, ["s"] + ["m"] * 4, given=1)
    torch.testing.assert_close(new[:2], old[:2])
    assert not torch.allclose(new[2], old[2])


def test_shrunk_covariances_are_closer_to_the_truth():
    rng = np.random.default_rng(0)
    truth = np.eye(8) + 0.3 * (np.ones((8, 8)) - np.eye(8))
    drawn = [rng.multivariate_normal(np.zeros(8), truth, size=6) for _ in range(50)]
    found = torch.from_numpy(np.stack([np.cov(x.T) + 1e-9 * np.eye(8) for x in drawn]))
    of_samples, of_shrunk = (
        np.linalg.norm(c.numpy() - truth, axis=(1, 2)).mean()
        for c in (found, shrink(found, "auto", 6.0))
    )
    assert of_shrunk < 0.9 * of_samples


@pytest.mark.parametrize("n", [1, 2, 4, 9])
@pytest.mark.parametrize("prior", [2.0, 6.0, 30.0])
def test_moderated_variances_are_closer_to_the_truth(n, prior):
    true, estimated = drawn(prior, n)
    moderated = moderated_variances(estimated, n)
    before, after = (((x / true).log() ** 2).mean() for x in (estimated, moderated))
    assert after < before * (n + 1) / (n + 2)
    assert (moderated < true / 10).sum() <= (estimated < true / 10).sum()
