"""The mixture as an estimator: scikit-learn's contract and mixture, starts, groups, errors."""

import json
import os
import pickle
import subprocess
import sys
import warnings
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from scipy.special import logsumexp, softmax
from scipy.stats import multivariate_normal
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning as ScikitLearnWarning
from sklearn.mixture import GaussianMixture

from tests.support.blocks import COVARIANCE_TYPES, WIDTHS, fitted, split
from tests.support.em_reference import nearly_singular
from tests.support.refusals import refused
from tpgmm_torch.exceptions import (
    ConvergenceWarning,
    DataError,
    DegenerateComponentWarning,
    ShapeError,
)
from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture

BATTERY = """
import json, warnings
from sklearn.utils.estimator_checks import check_estimator
from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture

warnings.simplefilter("ignore")
results = check_estimator(BlockGaussianMixture(), on_fail=None, on_skip=None)
print(json.dumps([[r["check_name"], r["status"], str(r["exception"])] for r in results]))
"""


def test_every_check_of_scikit_learn_runs_and_passes():
    # one of the checks is skipped unless scipy was imported with this variable set
    environment = {**os.environ, "SCIPY_ARRAY_API": "1"}
    done = subprocess.run(
        [sys.executable, "-c", BATTERY], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    results = json.loads(done.stdout.splitlines()[-1])
    assert [result for result in results if result[1] != "passed"] == []
    assert len(results) in (40, 41)  # scikit-learn 1.6 has one less than 1.9


def starting(means, covariances, weights=None):
    """A fitted mixture to start from; one block, if means are no list."""
    if not isinstance(means, list):
        means, covariances = [means], [covariances]
    k = len(means[0])
    weights = np.full(k, 1 / k) if weights is None else weights
    return BlockGaussianMixture.from_parameters(weights, means, covariances)


def refit(model, X, start, *categories):
    with warnings.catch_warnings():
        for category in categories or (ConvergenceWarning,):
            warnings.simplefilter("ignore", category)
        return model.fit(X, start=start)


@pytest.fixture
def start(clusters):
    """Weights, means and isotropic covariances for the clusters, as one block."""
    rng = np.random.RandomState(1)
    variance = clusters.var(0).mean()
    weights = rng.dirichlet(np.full(3, 5.0))
    return weights, clusters[rng.choice(300, 3)], variance * np.stack([np.eye(5)] * 3)


@pytest.mark.parametrize("n_iter", [1, 4, 25])
@pytest.mark.parametrize("covariance_type", COVARIANCE_TYPES)
def test_one_block_equals_scikit_learn(clusters, start, covariance_type, n_iter):
    weights, means, covariances = start
    precision = 1 / covariances[0, 0, 0]
    settings = {"covariance_type": covariance_type, "tol": 0.0, "max_iter": n_iter}
    reference = GaussianMixture(
        3,
        weights_init=weights,
        means_init=means,
        precisions_init={
            "full": np.linalg.inv(covariances),
            "tied": precision * np.eye(5),
            "diag": np.full((3, 5), precision),
            "spherical": np.full(3, precision),
        }[covariance_type],
        **settings,
    )
    variance = clusters.var(0)
    if covariance_type == "spherical":
        variance = variance.mean()
    # scikit-learn's regularisation is in squared units of the data
    model = BlockGaussianMixture(3, reg_covar=1e-6 / variance, **settings)
    refit(model, clusters, starting(means, covariances, weights))
    fitted(reference, clusters, ScikitLearnWarning)
    expected = {
        "full": lambda c: c,
        "tied": lambda c: np.stack([c] * 3),
        "diag": lambda c: np.stack([np.diag(row) for row in c]),
        "spherical": lambda c: c[:, None, None] * np.eye(5),
    }[covariance_type](reference.covariances_)
    close = {"rtol": 1e-8, "atol": 1e-8}
    np.testing.assert_allclose(model.weights_, reference.weights_, **close)
    np.testing.assert_allclose(model.means_[0], reference.means_, **close)
    np.testing.assert_allclose(model.covariances_[0], expected, **close)
    # before its version 1.7, scikit-learn keeps the last one only
    bounds = getattr(reference, "lower_bounds_", [reference.lower_bound_])
    np.testing.assert_allclose(model.lower_bounds_[-len(bounds) :], bounds, **close)
    for name in ("score_samples", "predict_proba", "predict", "bic"):
        own, other = (getattr(one, name)(clusters) for one in (model, reference))
        np.testing.assert_allclose(own, other, **close)
    assert model.n_iter_ == reference.n_iter_


def test_rounding_never_takes_the_regularization_away():
    for seed in range(40):
        rng = np.random.default_rng(seed)
        data = rng.standard_normal((120, 1)) + 1e-3 * rng.standard_normal((120, 8))
        model = fitted(BlockGaussianMixture(1, reg_covar=1e-4), data)
        added = np.diagonal(model.covariances_[0][0].numpy()) / data.var(0) - 1
        np.testing.assert_allclose(added, 1e-4, rtol=1e-6)


@pytest.mark.parametrize("covariance_type", COVARIANCE_TYPES)
def test_relative_regularization_follows_the_units(clusters, covariance_type):
    per_column = np.array([1e3, 1e3, 1e-4, 1e-4, 1e-4])
    if covariance_type != "spherical":  # which compares columns of a block
        per_column = np.array([1e3, 1e-2, 1.0, 1e-4, 7.0])
    settings = {"blocks": WIDTHS, "covariance_type": covariance_type, "reg_covar": 1e-2}
    model = fitted(BlockGaussianMixture(3, **settings), clusters)
    scaled = fitted(BlockGaussianMixture(3, **settings), clusters * per_column + 5.0)
    torch.testing.assert_close(scaled.weights_, model.weights_)
    assert scaled.n_iter_ == model.n_iter_
    for j, scale in enumerate(map(torch.from_numpy, split(per_column))):
        torch.testing.assert_close(scaled.means_[j], model.means_[j] * scale + 5.0)
        torch.testing.assert_close(
            scaled.covariances_[j], model.covariances_[j] * torch.outer(scale, scale)
        )
    assert scaled.lower_bound_ == pytest.approx(model.lower_bound_ - np.log(per_column).sum())


@pytest.mark.parametrize("init_params", ["time", "kmeans", "random"])
def test_the_best_of_several_starts_wins(clusters, init_params):
    few = {"n_components": 5, "init_params": init_params, "max_iter": 8, "tol": 0.0}
    quiet = (ConvergenceWarning, DegenerateComponentWarning)
    bounds = [
        fitted(
            BlockGaussianMixture(**few, n_init=n, random_state=4), clusters, *quiet
        ).lower_bound_
        for n in (1, 2, 8)
    ]
    assert bounds[0] <= bounds[1] <= bounds[2]
    assert bounds[0] < bounds[2]


def test_em_goes_on_from_a_mixture(clusters):
    settings = {"n_components": 3, "blocks": WIDTHS, "tol": 0.0}
    half = fitted(BlockGaussianMixture(**settings, max_iter=4), clusters)
    parts = refit(BlockGaussianMixture(**settings, max_iter=4), clusters, half)
    whole = fitted(BlockGaussianMixture(**settings, max_iter=8), clusters)
    torch.testing.assert_close(parts.means_, whole.means_)
    torch.testing.assert_close(parts.covariances_, whole.covariances_)
    assert parts.lower_bounds_ == pytest.approx(whole.lower_bounds_[4:], rel=1e-10)


def test_a_start_of_another_shape_is_refused(clusters):
    other = fitted(BlockGaussianMixture(3, blocks=WIDTHS), clusters)
    with pytest.raises(ShapeError, match=r"3 components in blocks of \[2, 3\].* 3 .*\[5\]"):
        BlockGaussianMixture(3).fit(clusters, start=other)


def test_a_dead_component_is_reseeded_and_reported(clusters):
    means = np.concatenate([clusters[:2], np.full((1, 5), 1e7)])
    begin = starting(means, np.stack([np.diag(clusters.var(0))] * 3))
    model = BlockGaussianMixture(3, random_state=0)
    with pytest.warns(DegenerateComponentWarning, match=r"\[2\] in .*fewer components"):
        model.fit(clusters, start=begin)
    assert model.weights_.min() > 0.05
    placed = model.means_[0][2].numpy()
    assert (placed <= clusters.max(0)).all() and (placed >= clusters.min(0)).all()
    assert np.diff(model.lower_bounds_).min() >= -1e-9
    with pytest.warns(DegenerateComponentWarning):
        again = clone(model).fit(clusters, start=begin)
    torch.testing.assert_close(again.means_, model.means_, rtol=0, atol=0)


def test_a_component_on_a_single_point_is_reseeded(clusters):
    outlier = np.concatenate([clusters, clusters[:1] + 1e3])
    wide, tiny = np.diag(outlier.var(0)), 1e-6 * np.diag(outlier.var(0))
    means = np.stack([clusters[0], clusters[-1], outlier[-1]])
    begin = starting(means, np.stack([wide, wide, tiny]), np.array([0.45, 0.45, 0.1]))
    model = BlockGaussianMixture(3, random_state=0)
    with pytest.warns(DegenerateComponentWarning, match=r"\[2\] in iteration 1"):
        refit(model, outlier, begin)
    assert model.weights_[2] * 301 > 50


def random_problem(seed, n_features):
    """Few points, at random clustered, repeated, collinear, or offset."""
    rng = np.random.RandomState(seed)
    n_samples = rng.randint(8, 60)
    X = rng.randn(n_samples, n_features)
    if rng.rand() < 0.4:
        X += 6 * rng.randint(0, 3, (n_samples, 1))
    if rng.rand() < 0.3:
        X[:, -1] = X[:, 0]
    if rng.rand() < 0.3:
        X = X[rng.randint(0, n_samples, 2 * n_samples)]
    return X * 10.0 ** rng.randint(-3, 4, n_features) + 10.0 ** rng.randint(-2, 5)


@hypothesis_settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    seed=st.integers(0, 2**32 - 1),
    covariance_type=st.sampled_from(COVARIANCE_TYPES),
    n_components=st.integers(1, 4),
    widths=st.sampled_from([(1,), (3,), (1, 2), (2, 1, 1)]),
    init_params=st.sampled_from(["time", "kmeans", "random"]),
    reg_covar=st.sampled_from([0.0, 1e-7, 1e-4, 1e-1]),
    group_size=st.integers(1, 4),
)
def test_the_log_likelihood_never_falls(
    seed, covariance_type, n_components, widths, init_params, reg_covar, group_size
):
    X = random_problem(seed, sum(widths))
    model = BlockGaussianMixture(
        n_components,
        blocks=widths,
        covariance_type=covariance_type,
        init_params=init_params,
        reg_covar=reg_covar,
        group_size=group_size,
        tol=1e-7,
        max_iter=40,
        random_state=seed,
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.fit(X[: len(X) // group_size * group_size])
    bounds = model.lower_bounds_
    slack = 1e-9 * max(1.0, *map(abs, bounds), 0.0)
    assert all(later >= earlier - slack for earlier, later in pairwise(bounds))
    if reg_covar > 0 and group_size == 1:
        assert model.score(X) >= model.lower_bound_ - 1e-6
    # the history begins again only where a component was reseeded
    if not any(issubclass(w.category, DegenerateComponentWarning) for w in caught):
        assert len(model.lower_bounds_) == model.n_iter_


def test_adding_the_regularization_alone_can_lower_the_likelihood():
    """What the floor is there for: scikit-learn's history falls, this one does not."""
    X = nearly_singular()[::10]
    X = (X - X.mean(0)) / X.std(0)
    settings = {"n_components": 4, "tol": 0.0, "max_iter": 60, "reg_covar": 1e-2}
    first = fitted(BlockGaussianMixture(**{**settings, "max_iter": 1}), X)
    reference = GaussianMixture(
        **settings,
        weights_init=first.weights_,
        means_init=first.means_[0],
        precisions_init=np.linalg.inv(first.covariances_[0]),
    )
    fitted(reference, X, ScikitLearnWarning)
    model = refit(BlockGaussianMixture(**settings), X, first)
    if hasattr(reference, "lower_bounds_"):  # since scikit-learn 1.7
        assert np.diff(reference.lower_bounds_).min() < -1e-6
    assert np.diff(model.lower_bounds_).min() > -1e-12
    assert model.lower_bound_ > reference.lower_bound_
    assert torch.linalg.eigvalsh(model.covariances_[0]).min() >= 1e-2 * (1 - 1e-9)


def test_float32_stands_nearly_singular_data():
    X, settings = nearly_singular(), {"n_components": 6, "blocks": (3, 4)}
    model = fitted(BlockGaussianMixture(**settings, dtype="float32", reg_covar=1e-9), X)
    reference = fitted(BlockGaussianMixture(**settings, reg_covar=2e-6), X)
    assert np.isfinite(model.score_samples(X)).all()
    assert model.score(X) == pytest.approx(reference.score(X), abs=0.05)


@pytest.mark.parametrize("covariance_type", COVARIANCE_TYPES)
def test_samples_have_the_moments_of_the_mixture(clusters, covariance_type):
    model = BlockGaussianMixture(
        3, blocks=WIDTHS, covariance_type=covariance_type, random_state=0
    )
    fitted(model, clusters)
    X, labels = model.sample(40_000)
    assert X.shape == (40_000, 5)
    assert (np.diff(labels) >= 0).all()
    for k in range(3):
        own = X[labels == k]
        assert len(own) / 40_000 == pytest.approx(float(model.weights_[k]), abs=0.02)
        full = torch.block_diag(*(covariance[k] for covariance in model.covariances_)).numpy()
        deviations = np.sqrt(np.diag(full))
        mean = torch.cat([mean[k] for mean in model.means_]).numpy()
        np.testing.assert_allclose((own.mean(0) - mean) / deviations, 0, atol=0.06)
        outer = np.outer(deviations, deviations)
        np.testing.assert_allclose((np.cov(own.T) - full) / outer, 0, atol=0.06)


@pytest.mark.parametrize(
    ("covariance_type", "expected"),
    [("full", 44), ("tied", 26), ("diag", 32), ("spherical", 23)],
)
def test_parameters_are_counted_over_all_blocks(clusters, covariance_type, expected):
    model = BlockGaussianMixture(3, blocks=WIDTHS, covariance_type=covariance_type)
    fitted(model, clusters)
    assert model.n_parameters_ == expected
    total = 2 * len(clusters) * model.score(clusters)
    assert model.bic(clusters) == pytest.approx(expected * np.log(300) - total)


def test_pickle_clone_and_parameters_keep_the_mixture(clusters):
    model = fitted(BlockGaussianMixture(3, blocks=WIDTHS), clusters)
    copies = (
        pickle.loads(pickle.dumps(model)),
        BlockGaussianMixture.from_parameters(model.weights_, model.means_, model.covariances_),
    )
    for copy in copies:
        np.testing.assert_allclose(
            copy.score_samples(clusters), model.score_samples(clusters), rtol=1e-12
        )
    assert clone(model).get_params() == model.get_params()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_gpu_gives_the_same_mixture(clusters):
    settings = {"n_components": 3, "blocks": WIDTHS}
    model = fitted(BlockGaussianMixture(**settings, device="cuda"), clusters)
    reference = fitted(BlockGaussianMixture(**settings), clusters)
    assert model.means_[0].is_cuda
    torch.testing.assert_close([mean.cpu() for mean in model.means_], reference.means_)
    np.testing.assert_allclose(model.score_samples(clusters), reference.score_samples(clusters))


@pytest.mark.parametrize(("settings", "error", "message"), [
    ({"blocks": (2, 2)}, ShapeError, r"blocks=\(2, 2\) add up to 4 .* have 5"),
    ({"blocks": (5, 0)}, ShapeError, "positive integers"),
    ({"n_components": 301}, DataError, "n_components=301.*300 distinct.*n_samples = 300"),
    ({"reg_covar": [1.0, 2.0]}, ShapeError, r"one for each of the 5 .*shape \(2,\)"),
    ({"reg_covar": [0.0, 0.0, -1e-9, 0.0, 0.0]}, DataError, "finite and not negative"),
    ({"covariance_type": "band"}, ValueError, "covariance_type"),
    ({"init_params": "guess"}, ValueError, "init_params"),
    ({"reg_covar": -1.0}, ValueError, "reg_covar"),
])  # fmt: skip
def test_bad_settings_are_named(clusters, settings, error, message):
    with pytest.raises(error, match=message):
        BlockGaussianMixture(**{"n_components": 3, **settings}).fit(clusters)


@pytest.mark.parametrize(("changed", "error", "message"), [
    ({"weights": [0.5, 0.5, 0.5]}, DataError, "add up to 1"),
    ({"weights": [0.5, np.nan, 0.5]}, DataError, "NaN"),
    ({"means": [np.zeros((2, 2)), np.zeros((3, 3))]}, ShapeError, r"got .*\(2, 2\)"),
    ({"means": [np.zeros((3, 2))]}, ShapeError, "have the shapes"),
    ({"covariances": [np.zeros((3, 2, 2)), np.zeros((3, 3, 3))]}, DataError, "component 0"),
])  # fmt: skip
def test_parameters_that_are_no_mixture_are_refused(changed, error, message):
    given = {
        "weights": np.array([0.2, 0.3, 0.5]),
        "means": [np.zeros((3, width)) for width in WIDTHS],
        "covariances": [np.stack([np.eye(width)] * 3) for width in WIDTHS],
    }
    BlockGaussianMixture.from_parameters(**given)
    refused(lambda: BlockGaussianMixture.from_parameters(**given | changed), error, message)


def test_a_wrong_number_of_samples_is_refused(clusters):
    model = fitted(BlockGaussianMixture(2), clusters)
    refused(lambda: model.sample(0), DataError, "at least 1")
    refused(lambda: model.predict(clusters[:, :4]), ValueError, "4 features")


# Rows that share one responsibility: ``group_size`` consecutive ones.

GROUP, K = 4, 3
REG = 1e-3


def grouped_data(n_groups: int = 45, group: int = GROUP, seed: int = 0) -> np.ndarray:
    """Rows in groups that lie together, (n_groups * group, 5)."""
    rng = np.random.default_rng(seed)
    centres = rng.standard_normal((3, 5)) * 2
    rows = centres[np.arange(n_groups) * 3 // n_groups].repeat(group, 0)
    return rows + rng.standard_normal((n_groups * group, 5)) @ rng.standard_normal((5, 5))


def fit_grouped(X: np.ndarray, start=None, **options) -> BlockGaussianMixture:
    model = BlockGaussianMixture(**{"n_components": K, "blocks": WIDTHS, **options})
    return refit(model, X, start, ConvergenceWarning, DegenerateComponentWarning)


def from_rows(X: np.ndarray) -> tuple[list, list]:
    """Means at some rows, and isotropic covariances."""
    covariances = [np.stack([3.0 * np.eye(width)] * K) for width in WIDTHS]
    return np.split(X[[3, 80, 170]], [2], axis=1), covariances


def joint_density(X, weights, means, covariances) -> np.ndarray:
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


def oracle_of_groups(X, weights, means, covariances, n_iter):
    """EM as the definition says: one responsibility per group, counted for each of its rows."""
    blocks = np.split(X, np.cumsum(WIDTHS)[:-1], axis=1)
    bounds = []
    for _ in range(n_iter):
        # the logarithm of the geometric mean is the mean of the logarithms
        log_joint = joint_density(X, weights, means, covariances)
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
    weights = np.array([0.5, 0.3, 0.2])
    settings = {"group_size": GROUP, "max_iter": n_iter, "reg_covar": REG / X.var(0)}
    model = fit_grouped(X, starting(*from_rows(X), weights), tol=0.0, **settings)
    weights, means, covariances, bounds = oracle_of_groups(X, weights, *from_rows(X), n_iter)
    np.testing.assert_allclose(model.weights_, weights, rtol=1e-8)
    for j in range(2):
        np.testing.assert_allclose(model.means_[j], means[j], rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(model.covariances_[j], covariances[j], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(model.lower_bounds_, bounds, rtol=1e-9)


@pytest.mark.parametrize("group_size", [7, 181])
def test_incomplete_groups_are_refused(group_size):
    with pytest.raises(ShapeError, match=rf"180 rows are no multiple of .*{group_size}"):
        fit_grouped(grouped_data(), group_size=group_size)
