"""Rows that share one responsibility: ``group_size`` consecutive ones."""

import warnings

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import logsumexp, softmax
from scipy.stats import multivariate_normal

from tpgmm_torch.exceptions import (
    ConvergenceWarning,
    DegenerateComponentWarning,
    ShapeError,
)
from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture

WIDTHS, GROUP, K = (2, 3), 4, 3
REG = 1e-3


def grouped_data(n_groups: int = 45, group: int = GROUP, seed: int = 0) -> np.ndarray:
    """Rows in groups that lie together, (n_groups * group, 5)."""
    rng = np.random.default_rng(seed)
    centres = rng.standard_normal((3, 5)) * 2
    rows = centres[np.arange(n_groups) * 3 // n_groups].repeat(group, 0)
    return rows + rng.standard_normal((n_groups * group, 5)) @ rng.standard_normal((5, 5))


def fit(X: np.ndarray, **options) -> BlockGaussianMixture:
    with warnings.catch_warnings():
        for category in (ConvergenceWarning, DegenerateComponentWarning):
            warnings.simplefilter("ignore", category)
        return BlockGaussianMixture(**{"n_components": K, "blocks": WIDTHS, **options}).fit(X)


def joint(X, weights, means, covariances) -> np.ndarray:
    """Log of weight times density of each row, (n, K)."""
    blocks = np.split(X, np.cumsum(WIDTHS)[:-1], axis=1)
    return np.stack(
        [
            np.log(weights[k])
            + sum(
                multivariate_normal(means[j][k], covariances[j][k]).logpdf(block)
                for j, block in enumerate(blocks)
            )
            for k in range(len(weights))
        ],
        axis=1,
    )


def oracle(X, weights, means, covariances, n_iter):
    """EM as the definition says: one responsibility per group, counted for each of its rows."""
    blocks = np.split(X, np.cumsum(WIDTHS)[:-1], axis=1)
    bounds = []
    for _ in range(n_iter):
        # the logarithm of the geometric mean is the mean of the logarithms
        log_joint = joint(X, weights, means, covariances)
        shared = log_joint.reshape(-1, GROUP, len(weights)).mean(1)
        bounds.append(logsumexp(shared, axis=1).mean())
        gamma = softmax(shared, axis=1).repeat(GROUP, 0)
        mass = gamma.sum(0)
        weights = mass / len(X)
        means = [(gamma.T @ block) / mass[:, None] for block in blocks]
        covariances = [
            np.stack(
                [
                    (gamma[:, k, None] * (block - mean[k])).T @ (block - mean[k]) / mass[k]
                    + REG * np.eye(block.shape[1])
                    for k in range(len(mass))
                ]
            )
            for block, mean in zip(blocks, means, strict=True)
        ]
    return weights, means, covariances, bounds


@pytest.mark.parametrize("n_iter", [1, 2, 12])
def test_groups_equal_plain_em_with_shared_responsibilities(n_iter):
    X = grouped_data()
    start = {
        "weights_init": np.array([0.5, 0.3, 0.2]),
        "means_init": np.split(X[[3, 80, 170]], [2], axis=1),
        "covariances_init": [np.stack([3.0 * np.eye(width)] * K) for width in WIDTHS],
    }
    model = fit(
        X,
        group_size=GROUP,
        max_iter=n_iter,
        tol=0.0,
        reg_covar=REG,
        regularization="absolute",
        **start,
    )
    weights, means, covariances, bounds = oracle(X, *start.values(), n_iter)
    np.testing.assert_allclose(model.weights_, weights, rtol=1e-8)
    for j in range(2):
        np.testing.assert_allclose(model.means_[j], means[j], rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(model.covariances_[j], covariances[j], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(model.lower_bounds_, bounds, rtol=1e-9)


def test_groups_of_one_are_points():
    X = grouped_data()
    alone, plain = fit(X, group_size=1), fit(X)
    assert torch.equal(alone.weights_, plain.weights_)
    for name in ("means_", "covariances_"):
        pairs = zip(getattr(alone, name), getattr(plain, name), strict=True)
        assert all(torch.equal(one, other) for one, other in pairs)
    assert alone.lower_bounds_ == plain.lower_bounds_


def test_groups_are_another_model_than_points():
    X = grouped_data()
    assert not torch.allclose(fit(X, group_size=GROUP).means_[0], fit(X).means_[0], atol=1e-3)


def test_groups_of_equal_rows_are_their_rows():
    X = grouped_data(group=1)
    repeated = fit(X.repeat(GROUP, 0), group_size=GROUP)
    once = fit(X)
    torch.testing.assert_close(repeated.weights_, once.weights_)
    torch.testing.assert_close(repeated.means_, once.means_)
    assert repeated.lower_bound_ == pytest.approx(once.lower_bound_)


def test_order_within_groups_and_of_groups_does_not_matter():
    X = grouped_data()
    start = {
        "weights_init": np.full(K, 1 / K),
        "means_init": np.split(X[[3, 80, 170]], [2], axis=1),
        "covariances_init": [np.stack([3.0 * np.eye(width)] * K) for width in WIDTHS],
        "group_size": GROUP,
    }
    rng = np.random.default_rng(0)
    groups = rng.permutation(X.reshape(-1, GROUP, 5))
    shuffled = rng.permuted(np.arange(GROUP)[None].repeat(len(groups), 0), axis=1)
    mixed = np.take_along_axis(groups, shuffled[..., None], axis=1).reshape(-1, 5)
    torch.testing.assert_close(fit(mixed, **start).means_, fit(X, **start).means_)


def test_prediction_is_of_single_rows():
    X = grouped_data()
    model = fit(X, group_size=GROUP)
    parameters = [model.weights_.numpy()], model.means_, model.covariances_
    log_joint = joint(X[:7], parameters[0][0], *parameters[1:])
    np.testing.assert_allclose(model.score_samples(X[:7]), logsumexp(log_joint, axis=1))
    np.testing.assert_allclose(model.predict_proba(X[:7]), softmax(log_joint, axis=1))


@pytest.mark.parametrize("covariance_type", ["full", "tied", "diag", "spherical"])
@settings(max_examples=25)
@given(
    seed=st.integers(0, 10**6),
    group=st.integers(2, 6),
    n_components=st.integers(1, 5),
    init=st.sampled_from(["time", "kmeans", "random"]),
    reg=st.sampled_from([0.0, 1e-6, 1e-1]),
)
def test_the_likelihood_never_falls(covariance_type, seed, group, n_components, init, reg):
    model = fit(
        grouped_data(12, group, seed),
        group_size=group,
        n_components=n_components,
        covariance_type=covariance_type,
        init_params=init,
        reg_covar=reg,
        random_state=seed,
        tol=0.0,
        max_iter=15,
    )
    bounds = np.array(model.lower_bounds_)
    assert (np.diff(bounds) >= -1e-9 * np.maximum(1, np.abs(bounds[1:]))).all()


@pytest.mark.parametrize("covariance_type", ["full", "tied", "diag", "spherical"])
@pytest.mark.parametrize("size", [1, 20, 64 * 3 * 7])
def test_chunks_are_cut_between_groups(covariance_type, size, monkeypatch):
    X = grouped_data()
    options = {"group_size": 9, "covariance_type": covariance_type}
    whole = fit(X, **options)
    monkeypatch.setattr("tpgmm_torch.em.block_gaussians.CHUNK_SIZE", {"cpu": size})
    chunked = fit(X, **options)
    torch.testing.assert_close(chunked.weights_, whole.weights_)
    torch.testing.assert_close(chunked.means_, whole.means_)
    torch.testing.assert_close(chunked.covariances_, whole.covariances_)
    np.testing.assert_allclose(chunked.score_samples(X), whole.score_samples(X), rtol=1e-9)


def test_a_group_larger_than_all_chunks_is_not_cut(monkeypatch):
    X = grouped_data(group=20)
    whole = fit(X, group_size=60)
    monkeypatch.setattr("tpgmm_torch.em.block_gaussians.CHUNK_SIZE", {"cpu": 8})
    torch.testing.assert_close(fit(X, group_size=60).means_, whole.means_)


@pytest.mark.parametrize("group_size", [7, 181])
def test_incomplete_groups_are_refused(group_size):
    with pytest.raises(ShapeError, match=rf"180 rows are no multiple of .*{group_size}"):
        fit(grouped_data(), group_size=group_size)


@pytest.mark.parametrize("group_size", [0, -1, 2.5, "4"])
def test_sizes_that_are_no_sizes_are_refused(group_size):
    with pytest.raises(ValueError, match="'group_size' parameter"):
        fit(grouped_data(), group_size=group_size)
