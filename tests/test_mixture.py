"""EM on blocks of columns: scikit-learn's contract and numbers, and the laws of the mixture."""

import json
import math
import os
import pickle
import subprocess
import sys
import warnings
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sklearn.base import clone
from sklearn.mixture import GaussianMixture
from torch.distributions import MultivariateNormal

from tpgmm_torch.exceptions import (
    ConvergenceWarning,
    DataError,
    DegenerateComponentWarning,
    NotFittedError,
    ShapeError,
)
from tpgmm_torch.mixture import BlockGaussianMixture
from tpgmm_torch.sufficient_statistics import (
    PackedStatistics,
    WhitenedStatistics,
    statistics,
)

COVARIANCE_TYPES = ("full", "tied", "diag", "spherical")
WIDTHS = (2, 3)


def fitted(model, X, *categories):
    """Fit and return the model; only warnings of the given categories may come."""
    with warnings.catch_warnings():
        for category in categories or (ConvergenceWarning,):
            warnings.simplefilter("ignore", category)
        return model.fit(X)


@pytest.fixture
def clusters():
    """Three anisotropic clusters, unequal columns, (300, 5)."""
    rng = np.random.RandomState(0)
    parts = [rng.randn(100, 5) @ rng.randn(5, 5) + 4 * rng.randn(5) for _ in range(3)]
    return np.concatenate(parts) * [1.0, 10.0, 0.1, 1.0, 3.0] + [0.0, 100.0, 0.0, -5.0, 0.0]


@pytest.fixture
def start(clusters):
    """Weights, means and isotropic covariances for the clusters, as one block."""
    rng = np.random.RandomState(1)
    variance = clusters.var(0).mean()
    weights = rng.dirichlet(np.full(3, 5.0))
    return weights, clusters[rng.choice(300, 3)], variance * np.stack([np.eye(5)] * 3)


def split(X, widths=WIDTHS):
    return np.split(X, np.cumsum(widths)[:-1], axis=-1)


def oracle_log_density(X, weights, means, covariances, widths):
    """Log-density by torch.distributions, one component and one block after the other."""
    blocks = [torch.from_numpy(part) for part in split(X, widths)]
    terms = []
    for k, weight in enumerate(weights):
        term = torch.log(weight)
        for x, mean, covariance in zip(blocks, means, covariances, strict=True):
            term = term + MultivariateNormal(mean[k], covariance[k]).log_prob(x)
        terms.append(term)
    return torch.stack(terms, 1)


def oracle_em(X, weights, means, covariances, widths, regularization, n_iter):
    """Plain EM, written out; returns the parameters and the history of the likelihood."""
    blocks = [torch.from_numpy(part) for part in split(X, widths)]
    history = []
    for _ in range(n_iter):
        joint = oracle_log_density(X, weights, means, covariances, widths)
        history.append(torch.logsumexp(joint, 1).mean().item())
        gamma = torch.softmax(joint, 1)
        mass = gamma.sum(0)
        weights = mass / len(X)
        means = [gamma.T @ x / mass[:, None] for x in blocks]
        covariances = []
        for x, m, extra in zip(blocks, means, regularization, strict=True):
            scatter = [
                (g[:, None] * (x - c)).T @ (x - c) for g, c in zip(gamma.T, m, strict=True)
            ]
            covariances.append(torch.stack(scatter) / mass[:, None, None] + torch.diag(extra))
    return weights, means, covariances, history


BATTERY = """
import json, warnings
from sklearn.utils.estimator_checks import check_estimator
from tpgmm_torch.mixture import BlockGaussianMixture

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
    assert len(results) >= 40


@pytest.mark.parametrize("many_points", [0, 10_000], ids=["packed", "whitened"])
@pytest.mark.parametrize("n_iter", [1, 4, 25])
@pytest.mark.parametrize("covariance_type", COVARIANCE_TYPES)
def test_one_block_equals_scikit_learn(
    clusters, start, covariance_type, n_iter, many_points, monkeypatch
):
    monkeypatch.setattr("tpgmm_torch.sufficient_statistics.MANY_POINTS", many_points)
    weights, means, covariances = start
    precision = 1 / covariances[0, 0, 0]
    reference = GaussianMixture(
        3,
        covariance_type=covariance_type,
        tol=0.0,
        max_iter=n_iter,
        weights_init=weights,
        means_init=means,
        precisions_init={
            "full": np.linalg.inv(covariances),
            "tied": precision * np.eye(5),
            "diag": np.full((3, 5), precision),
            "spherical": np.full(3, precision),
        }[covariance_type],
    )
    model = BlockGaussianMixture(
        3,
        covariance_type=covariance_type,
        regularization="absolute",
        tol=0.0,
        max_iter=n_iter,
        weights_init=weights,
        means_init=[means],
        covariances_init=[covariances],
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reference.fit(clusters)
        model.fit(clusters)
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
    np.testing.assert_allclose(model.lower_bound_, reference.lower_bound_, **close)
    np.testing.assert_allclose(model.lower_bounds_, reference.lower_bounds_, **close)
    np.testing.assert_allclose(
        model.score_samples(clusters), reference.score_samples(clusters), **close
    )
    np.testing.assert_allclose(
        model.predict_proba(clusters), reference.predict_proba(clusters), **close
    )
    np.testing.assert_array_equal(model.predict(clusters), reference.predict(clusters))
    np.testing.assert_allclose(model.bic(clusters), reference.bic(clusters), **close)
    np.testing.assert_allclose(model.aic(clusters), reference.aic(clusters), **close)
    assert model.n_iter_ == reference.n_iter_


def test_several_blocks_equal_plain_em(clusters, start):
    weights, means, covariances = start
    means = split(means)
    covariances = [covariances[:, :2, :2], covariances[:, 2:, 2:]]
    model = BlockGaussianMixture(
        3,
        blocks=WIDTHS,
        reg_covar=1e-3,
        tol=0.0,
        max_iter=12,
        weights_init=weights,
        means_init=means,
        covariances_init=covariances,
    )
    fitted(model, clusters)
    extra = [torch.from_numpy(1e-3 * part) for part in split(clusters.var(0))]
    tensors = [[torch.from_numpy(a) for a in part] for part in (means, covariances)]
    expected = oracle_em(clusters, torch.from_numpy(weights), *tensors, WIDTHS, extra, 12)
    torch.testing.assert_close(model.weights_, expected[0])
    torch.testing.assert_close(model.means_, expected[1])
    torch.testing.assert_close(model.covariances_, expected[2])
    np.testing.assert_allclose(model.lower_bounds_, expected[3], rtol=1e-10)
    joint = oracle_log_density(clusters, *expected[:3], WIDTHS)
    np.testing.assert_allclose(model.score_samples(clusters), torch.logsumexp(joint, 1))
    np.testing.assert_allclose(
        model.predict_proba(clusters), torch.softmax(joint, 1), atol=1e-10
    )


def nearly_singular(offset=0.0):
    """Two smooth curves in 6 columns with almost no noise: covariances close to singular."""
    rng = np.random.RandomState(3)
    time = np.tile(np.linspace(0, 1, 200), 3)
    base = np.stack([time, np.sin(3 * time), time**2], 1) + 1e-5 * rng.randn(600, 3)
    return np.concatenate([base, base @ rng.randn(3, 3) + 1e-5 * rng.randn(600, 3)], 1) + offset


@pytest.mark.parametrize("offset", [0.0, 1e4])
def test_nearly_singular_densities_are_accurate(offset):
    X = nearly_singular(offset)
    model = fitted(BlockGaussianMixture(6, blocks=(3, 3), reg_covar=1e-7, max_iter=30), X)
    deviations = X.std(0)
    conditions = [
        np.linalg.cond(covariance / np.outer(s, s))
        for block, s in zip(model.covariances_, split(deviations, (3, 3)), strict=True)
        for covariance in block.numpy()
    ]
    assert max(conditions) > 1e5
    expected = np.stack(
        [
            sum(
                exact_log_normal(x, mean[k].numpy(), covariance[k].numpy())
                for x, mean, covariance in zip(
                    split(X[::60], (3, 3)), model.means_, model.covariances_, strict=True
                )
            )
            + np.log(float(model.weights_[k]))
            for k in range(6)
        ]
    )
    expected = np.logaddexp.reduce(expected)
    np.testing.assert_allclose(
        model.score_samples(X[::60]), expected, atol=1e-6 if offset else 1e-7
    )


@pytest.mark.parametrize(
    ("reg_covar", "form"), [(1e-6, PackedStatistics), (1e-10, WhitenedStatistics)]
)
def test_packed_moments_serve_only_where_they_are_accurate(reg_covar, form, monkeypatch):
    X = nearly_singular()
    settings = {"blocks": (3, 3), "reg_covar": reg_covar, "max_iter": 10, "tol": 0.0}
    reference = fitted(BlockGaussianMixture(6, **settings), X)
    forms = []

    def spy(*arguments):
        forms.append(statistics(*arguments))
        return forms[-1]

    monkeypatch.setattr("tpgmm_torch.sufficient_statistics.MANY_POINTS", 0)
    monkeypatch.setattr("tpgmm_torch.expectation_maximization.statistics", spy)
    model = fitted(BlockGaussianMixture(6, **settings), X)
    assert type(forms[-1]) is form
    np.testing.assert_allclose(model.lower_bounds_, reference.lower_bounds_, atol=1e-7)
    np.testing.assert_allclose(model.predict_proba(X), reference.predict_proba(X), atol=1e-5)


def exact_log_normal(x, mean, covariance):
    """Gaussian log-densities by elimination in rational numbers, rounded at the end."""
    rows = [[Fraction(float(value)) for value in row] for row in covariance]
    center = [Fraction(float(value)) for value in mean]
    values = []
    for point in x:
        table = [
            [*row, Fraction(float(p)) - c]
            for row, p, c in zip(rows, point, center, strict=True)
        ]
        norm, determinant = Fraction(0), Fraction(1)
        while table:
            (pivot, *rest), *others = table
            norm += rest[-1] ** 2 / pivot
            determinant *= pivot
            table = [
                [a - row[0] / pivot * b for a, b in zip(row[1:], rest, strict=True)]
                for row in others
            ]
        log_determinant = math.log(determinant * Fraction(2 * math.pi) ** len(mean))
        values.append(-(float(norm) + log_determinant) / 2)
    return np.array(values)


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


@settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    seed=st.integers(0, 2**32 - 1),
    covariance_type=st.sampled_from(COVARIANCE_TYPES),
    n_components=st.integers(1, 4),
    widths=st.sampled_from([(1,), (3,), (1, 2), (2, 1, 1)]),
    init_params=st.sampled_from(["time", "kmeans", "random"]),
    reg_covar=st.sampled_from([0.0, 1e-7, 1e-4, 1e-1]),
    regularization=st.sampled_from(["relative", "absolute"]),
)
def test_the_log_likelihood_never_falls(
    seed, covariance_type, n_components, widths, init_params, reg_covar, regularization
):
    X = random_problem(seed, sum(widths))
    model = BlockGaussianMixture(
        n_components,
        blocks=widths,
        covariance_type=covariance_type,
        init_params=init_params,
        reg_covar=reg_covar,
        regularization=regularization,
        tol=1e-7,
        max_iter=40,
        random_state=seed,
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.fit(X)
    bounds = model.lower_bounds_
    slack = 1e-9 * max(1.0, *map(abs, bounds), 0.0)
    assert all(later >= earlier - slack for earlier, later in pairwise(bounds))
    if reg_covar > 0:  # else the covariances in units of the data may be singular to rounding
        assert model.score(X) >= model.lower_bound_ - 1e-6
    # the history begins again only where a component was placed anew
    if not any(issubclass(w.category, DegenerateComponentWarning) for w in caught):
        assert len(model.lower_bounds_) == model.n_iter_


def test_adding_the_regularization_alone_can_lower_the_likelihood():
    """What the floor is there for: scikit-learn's history falls, this one does not."""
    X = nearly_singular()
    settings = {"n_components": 4, "tol": 0.0, "max_iter": 60, "reg_covar": 1e-2}
    first = BlockGaussianMixture(**{**settings, "max_iter": 1}, regularization="absolute")
    fitted(first, X)
    reference = GaussianMixture(
        **settings,
        weights_init=first.weights_,
        means_init=first.means_[0],
        precisions_init=np.linalg.inv(first.covariances_[0]),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reference.fit(X)
    model = BlockGaussianMixture(
        **settings,
        regularization="absolute",
        weights_init=first.weights_,
        means_init=first.means_,
        covariances_init=first.covariances_,
    )
    fitted(model, X)
    assert np.diff(reference.lower_bounds_).min() < -1e-6
    assert np.diff(model.lower_bounds_).min() > -1e-12
    assert model.lower_bound_ > reference.lower_bound_
    smallest = torch.linalg.eigvalsh(model.covariances_[0]).min()
    assert smallest >= 1e-2 * (1 - 1e-9)


@pytest.mark.parametrize("covariance_type", COVARIANCE_TYPES)
def test_order_of_points_and_blocks_does_not_matter(clusters, covariance_type):
    settings = {"covariance_type": covariance_type, "init_params": "random", "tol": 1e-6}
    drawn = fitted(BlockGaussianMixture(3, blocks=WIDTHS, random_state=0, **settings), clusters)

    def refit(X, order):
        model = BlockGaussianMixture(
            3,
            blocks=[WIDTHS[j] for j in order],
            weights_init=drawn.weights_,
            means_init=[drawn.means_[j] + 0.1 for j in order],
            covariances_init=[drawn.covariances_[j] for j in order],
            **settings,
        )
        return fitted(model, X)

    plain = refit(clusters, (0, 1))
    shuffled = refit(clusters[np.random.RandomState(0).permutation(300)], (0, 1))
    swapped = refit(np.concatenate(split(clusters)[::-1], 1), (1, 0))
    for other, order in ((shuffled, (0, 1)), (swapped, (1, 0))):
        torch.testing.assert_close(other.weights_, plain.weights_)
        torch.testing.assert_close([other.means_[j] for j in order], plain.means_)
        torch.testing.assert_close([other.covariances_[j] for j in order], plain.covariances_)
        assert other.lower_bound_ == pytest.approx(plain.lower_bound_, rel=1e-10)


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


def test_constant_columns_are_regularized_by_their_block():
    rng = np.random.RandomState(0)
    X = np.column_stack([2.0 * rng.randn(100), np.full(100, 7.3), np.full(100, -1e4)])
    model = fitted(BlockGaussianMixture(1, blocks=(2, 1), reg_covar=1e-2), X)
    variance = X[:, 0].var()
    expected = torch.diag(torch.tensor([1.01 * variance, 0.01 * variance / 2]))
    torch.testing.assert_close(model.covariances_[0][0], expected.double())
    torch.testing.assert_close(model.covariances_[1][0], torch.tensor([[0.01]]).double())
    assert np.isfinite(model.score_samples(X)).all()


def test_time_bins_hold_equal_counts():
    time = np.random.RandomState(0).permutation(np.repeat(np.arange(30.0), 3))
    X = np.column_stack([time**3, time])
    with pytest.warns(ConvergenceWarning, match=r"raise max_iter"):
        model = BlockGaussianMixture(5, time_feature=1, max_iter=1).fit(X)
    with pytest.warns(ConvergenceWarning):
        other = BlockGaussianMixture(5, max_iter=1).fit(X[:, ::-1].copy())
    torch.testing.assert_close(
        model.weights_, torch.full((5,), 0.2).double(), atol=0.05, rtol=0
    )
    torch.testing.assert_close(model.means_[0].flip(1), other.means_[0])


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


def test_the_same_random_state_gives_the_same_mixture(clusters):
    first, second = (
        fitted(
            BlockGaussianMixture(4, init_params="random", n_init=2, random_state=7), clusters
        )
        for _ in range(2)
    )
    torch.testing.assert_close(first.means_, second.means_, rtol=0, atol=0)


def test_a_warm_start_continues_where_the_last_fit_ended(clusters):
    parts = BlockGaussianMixture(3, blocks=WIDTHS, max_iter=4, tol=0.0, warm_start=True)
    fitted(fitted(parts, clusters), clusters)
    whole = fitted(BlockGaussianMixture(3, blocks=WIDTHS, max_iter=8, tol=0.0), clusters)
    torch.testing.assert_close(parts.means_, whole.means_)
    torch.testing.assert_close(parts.covariances_, whole.covariances_)
    assert parts.lower_bound_ == pytest.approx(whole.lower_bound_, rel=1e-10)


def test_a_dead_component_is_placed_anew_and_reported(clusters):
    far = np.full((1, 5), 1e7)
    means = np.concatenate([clusters[:2], far])
    model = BlockGaussianMixture(
        3,
        weights_init=np.full(3, 1 / 3),
        means_init=[means],
        covariances_init=[np.stack([np.diag(clusters.var(0))] * 3)],
        random_state=0,
    )
    with pytest.warns(DegenerateComponentWarning, match=r"\[2\] in .*fewer components"):
        model.fit(clusters)
    assert model.weights_.min() > 0.05
    placed = model.means_[0][2].numpy()
    assert (placed <= clusters.max(0)).all()
    assert (placed >= clusters.min(0)).all()
    assert np.diff(model.lower_bounds_).min() >= -1e-9
    with pytest.warns(DegenerateComponentWarning):
        again = clone(model).fit(clusters)
    torch.testing.assert_close(again.means_, model.means_, rtol=0, atol=0)


def test_a_component_on_a_single_point_is_placed_anew(clusters):
    outlier = np.concatenate([clusters, clusters[:1] + 1e3])
    tiny = 1e-6 * np.diag(outlier.var(0))
    wide = np.diag(outlier.var(0))
    model = BlockGaussianMixture(
        3,
        weights_init=np.array([0.45, 0.45, 0.1]),
        means_init=[np.stack([clusters[0], clusters[-1], outlier[-1]])],
        covariances_init=[np.stack([wide, wide, tiny])],
        random_state=0,
    )
    with pytest.warns(DegenerateComponentWarning, match=r"\[2\] in iteration 1"):
        fitted(model, outlier, ConvergenceWarning)
    assert model.weights_[2] * 301 > 50


def test_float32_agrees_with_float64(clusters):
    settings = {"n_components": 3, "blocks": WIDTHS, "reg_covar": 1e-5, "tol": 1e-4}
    double = fitted(BlockGaussianMixture(**settings), clusters)
    single = fitted(BlockGaussianMixture(**settings, dtype="float32"), clusters)
    assert {single.weights_.dtype, single.means_[0].dtype} == {torch.float32}
    assert single.score_samples(clusters).dtype == np.float32
    for j in range(2):
        scale = double.covariances_[j].diagonal(dim1=1, dim2=2).sqrt()
        assert ((single.means_[j] - double.means_[j]).abs() / scale).max() < 1e-3
        outer = scale[:, :, None] * scale[:, None]
        assert ((single.covariances_[j] - double.covariances_[j]).abs() / outer).max() < 1e-3
    assert single.score(clusters) == pytest.approx(double.score(clusters), abs=1e-3)


def test_float32_stands_nearly_singular_data():
    X = nearly_singular()
    model = fitted(BlockGaussianMixture(6, blocks=(3, 3), dtype="float32", reg_covar=1e-9), X)
    reference = fitted(BlockGaussianMixture(6, blocks=(3, 3), reg_covar=2e-6), X)
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


def test_chunks_do_not_show(clusters, monkeypatch):
    model = fitted(BlockGaussianMixture(3, blocks=WIDTHS), clusters)
    monkeypatch.setattr("tpgmm_torch.block_gaussians.CHUNK_SIZE", {"cpu": 64 * 3 * 7})
    chunked = fitted(BlockGaussianMixture(3, blocks=WIDTHS), clusters)
    torch.testing.assert_close(chunked.means_, model.means_)
    np.testing.assert_allclose(
        chunked.score_samples(clusters), model.score_samples(clusters), rtol=1e-9
    )


@pytest.mark.parametrize(
    ("covariance_type", "expected"),
    [("full", 44), ("tied", 26), ("diag", 32), ("spherical", 23)],
)
def test_parameters_are_counted_over_all_blocks(clusters, covariance_type, expected):
    model = BlockGaussianMixture(3, blocks=WIDTHS, covariance_type=covariance_type)
    fitted(model, clusters)
    assert model.n_parameters_ == expected
    total = 2 * len(clusters) * model.score(clusters)
    assert model.aic(clusters) == pytest.approx(2 * expected - total)
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


def test_tensors_are_accepted_and_left_alone(clusters):
    X = torch.from_numpy(clusters)
    before = X.clone()
    model = fitted(BlockGaussianMixture(3, device=torch.device("cpu")), X)
    assert torch.equal(X, before)
    np.testing.assert_array_equal(model.predict(X), model.predict(clusters))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_gpu_gives_the_same_mixture(clusters):
    settings = {"n_components": 3, "blocks": WIDTHS}
    model = fitted(BlockGaussianMixture(**settings, device="cuda"), clusters)
    reference = fitted(BlockGaussianMixture(**settings), clusters)
    assert model.means_[0].is_cuda
    torch.testing.assert_close([mean.cpu() for mean in model.means_], reference.means_)
    np.testing.assert_allclose(model.score_samples(clusters), reference.score_samples(clusters))


def test_progress_is_printed_on_request(clusters, capsys):
    fitted(BlockGaussianMixture(2, verbose=1), clusters)
    assert capsys.readouterr().out.count("\n") == 1
    model = fitted(BlockGaussianMixture(2, verbose=2), clusters)
    assert capsys.readouterr().out.count("iteration ") == model.n_iter_


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"blocks": (2, 2)}, ShapeError, r"blocks=\(2, 2\) add up to 4 .* have 5"),
        ({"blocks": (5, 0)}, ShapeError, "positive integers"),
        ({"blocks": WIDTHS, "time_feature": 2}, ShapeError, "time_feature=2 .* has 2"),
        ({"n_components": 301}, DataError, "n_components=301.*300 distinct.*n_samples = 300"),
        ({"means_init": [np.zeros((2, 5))]}, ShapeError, r"means\[0\] .*\(3, 5\).*\(2, 5\)"),
        (
            {"blocks": WIDTHS, "means_init": [np.zeros((3, 5))]},
            ShapeError,
            "array per block",
        ),
        ({"weights_init": [0.5, 0.5, 0.5]}, DataError, "add up to 1"),
        ({"weights_init": [0.5, np.nan, 0.5]}, DataError, "NaN"),
        ({"covariances_init": [np.zeros((3, 5, 5))]}, DataError, "component 0, block 0"),
        ({"covariance_type": "band"}, ValueError, "covariance_type"),
        ({"init_params": "guess"}, ValueError, "init_params"),
        ({"reg_covar": -1.0}, ValueError, "reg_covar"),
    ],
)
def test_bad_settings_are_named(clusters, settings, error, message):
    with pytest.raises(error, match=message):
        BlockGaussianMixture(**{"n_components": 3, **settings}).fit(clusters)


def test_more_components_than_distinct_points_are_refused(clusters):
    X = np.tile(clusters[:4], (50, 1))
    with pytest.raises(DataError, match=r"n_components=5.*only 4 distinct.*at most that many"):
        BlockGaussianMixture(5).fit(X)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200])
def test_values_that_are_no_measurements_are_refused(clusters, value):
    X = clusters.copy()
    X[3, 2] = value
    with pytest.raises(ValueError, match=r"NaN|infinity|overflow"):
        BlockGaussianMixture(2).fit(X)


def test_an_unfitted_mixture_says_so(clusters):
    with pytest.raises(NotFittedError, match="call fit"):
        BlockGaussianMixture().predict(clusters)
    with pytest.raises(NotFittedError, match="call fit"):
        BlockGaussianMixture().sample()


def test_a_wrong_number_of_samples_is_refused(clusters):
    model = fitted(BlockGaussianMixture(2), clusters)
    with pytest.raises(DataError, match="at least 1"):
        model.sample(0)
    with pytest.raises(ValueError, match="4 features"):
        model.predict(clusters[:, :4])
