"""Shrinkage towards the diagonal: its definition, its intensity, and what it leaves alone."""

import numpy as np
import pytest
import torch

from tpgmm_torch.em.covariance_shrinkage import oracle_approximating_intensity, shrink
from tpgmm_torch.em.parameters import Parameters


def mixture(width=5, n_components=3, seed=0):
    rng = torch.Generator().manual_seed(seed)
    options = {"generator": rng, "dtype": torch.float64}
    root = torch.randn(n_components, width, width, **options)
    covariance = root @ root.mT + 1e-3 * torch.eye(width, dtype=torch.float64)
    means = torch.randn(n_components, width, **options)
    weights = torch.tensor([0.2, 0.3, 0.5], dtype=torch.float64)
    return Parameters.from_covariances(weights, [means], [covariance])


def conditional(covariance, given):
    """Of what follows the first columns, given them."""
    cross, time = covariance[:, given:, :given], covariance[:, :given, :given]
    return covariance[:, given:, given:] - cross @ np.linalg.solve(
        time, np.swapaxes(cross, -1, -2)
    )


@pytest.mark.parametrize("given", [0, 1])
@pytest.mark.parametrize("share", [0.0, 0.03, 0.3, 1.0])
def test_it_is_the_definition(share, given):
    old, new = mixture(), shrink(mixture(), share, 4.0, given=given)
    before, after = old.covariances[0].numpy(), new.covariances[0].numpy()
    expected = conditional(before, given)
    expected = (1 - share) * expected + share * expected * np.eye(expected.shape[-1])
    np.testing.assert_allclose(conditional(after, given), expected, rtol=1e-9, atol=1e-12)
    # what is given, and the slopes over it, stay; so do means and weights
    np.testing.assert_allclose(after[:, :given], before[:, :given], rtol=1e-12)
    torch.testing.assert_close(new.means[0], old.means[0], rtol=0, atol=0)
    torch.testing.assert_close(new.weights, old.weights, rtol=0, atol=0)


def test_none_changes_no_digit():
    old, new = mixture(), shrink(mixture(), 0.0, 4.0, given=1)
    assert torch.equal(new.factors[0], old.factors[0])


@pytest.mark.parametrize("freedom", [0.0, 1.0, 4.0, 30.0, 1e4])
@pytest.mark.parametrize("width", [2, 3, 8])
def test_the_intensity_is_the_published_formula_of_the_correlations(width, freedom):
    [covariance] = mixture(width).covariances
    found = oracle_approximating_intensity(covariance, freedom)
    for one, intensity in zip(covariance.numpy(), found.tolist(), strict=True):
        deviation = np.sqrt(np.diag(one))
        s, p, n = one / np.outer(deviation, deviation), width, freedom
        square, trace = np.trace(s @ s), np.trace(s)
        denominator = (n + 1 - 2 / p) * (square - trace**2 / p)
        expected = 1.0
        if denominator > 0:
            expected = min(1.0, ((1 - 2 / p) * square + trace**2) / denominator)
        assert intensity == pytest.approx(expected, rel=1e-9)


def test_the_intensity_follows_the_samples_and_no_units():
    [covariance] = mixture().covariances
    few, more, many = (oracle_approximating_intensity(covariance, n) for n in (2, 20, 2000))
    assert (few > more).all() and (more > many).all() and (many < 0.01).all()
    scale = torch.tensor([1e-3, 1.0, 57.3, 1e6, 2.0], dtype=torch.float64)
    other = oracle_approximating_intensity(scale[:, None] * covariance * scale, 20)
    torch.testing.assert_close(other, more)


def test_it_comes_closer_to_the_truth_than_the_samples():
    rng = np.random.default_rng(0)
    truth = np.eye(8) + 0.3 * (np.ones((8, 8)) - np.eye(8))
    errors = []
    for _ in range(50):
        points = rng.multivariate_normal(np.zeros(8), truth, size=6)
        found = torch.from_numpy(np.cov(points.T, bias=False) + 1e-9 * np.eye(8))
        given = Parameters.from_covariances(
            torch.ones(1, dtype=torch.float64),
            [torch.zeros(1, 8, dtype=torch.float64)],
            [found[None]],
        )
        [shrunk] = shrink(given, "auto", 6.0).covariances
        errors.append([np.linalg.norm(c - truth) for c in (found.numpy(), shrunk[0].numpy())])
    of_samples, of_shrunk = np.mean(errors, 0)
    assert of_shrunk < 0.9 * of_samples


def test_one_sample_leaves_the_diagonal_and_one_column_nothing_to_do():
    [covariance] = shrink(mixture(), "auto", 1.0).covariances
    torch.testing.assert_close(
        covariance, torch.diag_embed(covariance.diagonal(dim1=1, dim2=2)), rtol=0, atol=1e-12
    )
    pair = mixture(2)
    assert torch.equal(shrink(pair, "auto", 1.0, given=1).factors[0], pair.factors[0])
