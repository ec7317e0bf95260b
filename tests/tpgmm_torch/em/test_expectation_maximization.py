"""EM against scikit-learn and a plain oracle, restarts side by side, interrupted fits."""

import copy
import math
import warnings
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sklearn.mixture import GaussianMixture
from torch.distributions import MultivariateNormal

from tests.support.blocks import COVARIANCE_TYPES, WIDTHS, fitted, split
from tests.support.em_reference import (
    assert_same_mixture,
    binned,
    counted_passes,
    family,
    movements,
    one,
    reference_step,
    standardized,
)
from tests.support.em_reference import columns as blocks_of
from tpgmm_torch.em import expectation_maximization as loop
from tpgmm_torch.em.covariance_family import CovarianceFamily
from tpgmm_torch.em.e_step import e_step
from tpgmm_torch.em.expectation_maximization import Fit, expectation_maximization, m_step
from tpgmm_torch.em.parameters import Parameters
from tpgmm_torch.em.sufficient_statistics import PackedStatistics, WhitenedStatistics
from tpgmm_torch.exceptions import DegenerateComponentWarning
from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture


def assert_same_bounds(model, reference, **close):
    """Of each iteration; before its version 1.7, scikit-learn keeps the last one only."""
    bounds = getattr(reference, "lower_bounds_", [reference.lower_bound_])
    np.testing.assert_allclose(model.lower_bounds_[-len(bounds) :], bounds, **close)


@pytest.fixture
def start(clusters):
    """Weights, means and isotropic covariances for the clusters, as one block."""
    rng = np.random.RandomState(1)
    variance = clusters.var(0).mean()
    weights = rng.dirichlet(np.full(3, 5.0))
    return weights, clusters[rng.choice(300, 3)], variance * np.stack([np.eye(5)] * 3)


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


@pytest.mark.parametrize("many_components", [0, 10_000], ids=["packed", "whitened"])
@pytest.mark.parametrize("n_iter", [1, 4, 25])
@pytest.mark.parametrize("covariance_type", COVARIANCE_TYPES)
def test_one_block_equals_scikit_learn(
    clusters, start, covariance_type, n_iter, many_components, monkeypatch
):
    monkeypatch.setattr("tpgmm_torch.em.sufficient_statistics.MANY_POINTS", 0)
    monkeypatch.setattr("tpgmm_torch.em.sufficient_statistics.MANY_COMPONENTS", many_components)
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
    assert_same_bounds(model, reference, **close)
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
    for name, kind in (("Packed", PackedStatistics), ("Whitened", WhitenedStatistics)):

        def spy(*arguments, kind=kind):
            forms.append(kind)
            return kind(*arguments)

        monkeypatch.setattr(f"tpgmm_torch.em.sufficient_statistics.{name}Statistics", spy)
    for limit in ("POINTS", "COMPONENTS"):
        monkeypatch.setattr(f"tpgmm_torch.em.sufficient_statistics.MANY_{limit}", 0)
    model = fitted(BlockGaussianMixture(6, **settings), X)
    assert forms[-1] is form
    assert_same_bounds(model, reference, atol=1e-7)
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
    if hasattr(reference, "lower_bounds_"):  # since scikit-learn 1.7
        assert np.diff(reference.lower_bounds_).min() < -1e-6
    assert np.diff(model.lower_bounds_).min() > -1e-12
    assert model.lower_bound_ > reference.lower_bound_
    smallest = torch.linalg.eigvalsh(model.covariances_[0]).min()
    assert smallest >= 1e-2 * (1 - 1e-9)


def test_float32_stands_nearly_singular_data():
    X = nearly_singular()
    model = fitted(BlockGaussianMixture(6, blocks=(3, 3), dtype="float32", reg_covar=1e-9), X)
    reference = fitted(BlockGaussianMixture(6, blocks=(3, 3), reg_covar=2e-6), X)
    assert np.isfinite(model.score_samples(X)).all()
    assert model.score(X) == pytest.approx(reference.score(X), abs=0.05)


def test_chunks_do_not_show(clusters, monkeypatch):
    model = fitted(BlockGaussianMixture(3, blocks=WIDTHS), clusters)
    monkeypatch.setattr("tpgmm_torch.em.points.CHUNK_SIZE", {"cpu": 64 * 3 * 7})
    chunked = fitted(BlockGaussianMixture(3, blocks=WIDTHS), clusters)
    torch.testing.assert_close(chunked.means_, model.means_)
    np.testing.assert_allclose(
        chunked.score_samples(clusters), model.score_samples(clusters), rtol=1e-9
    )


K = 6


def jittered(parameters, seed):
    rng = np.random.RandomState(seed)
    noise = (0.1 * torch.from_numpy(rng.randn(*mean.shape)) for mean in parameters.means)
    means = tuple(mean + one for mean, one in zip(parameters.means, noise, strict=True))
    return Parameters(parameters.weights, means, parameters.factors)


def with_a_component_far_away(parameters):
    means = tuple(mean.clone() for mean in parameters.means)
    for mean in means:
        mean[0] += 1e3
    return Parameters(parameters.weights, means, parameters.factors)


def problem(reg_covar=1e-6, n_points=6000, dtype=torch.float64):
    points, units = standardized(movements(n_points), dtype)
    lambdas = family(units, reg_covar, dtype=dtype)
    return points, lambdas, binned(points, lambdas, K)


def starts(parameters):
    jitter = [jittered(parameters, seed) for seed in range(3)]
    return [parameters, *jitter, with_a_component_far_away(parameters)]


def fits_of(mixtures):
    return [Fit(each, np.random.RandomState(seed)) for seed, each in enumerate(mixtures)]


def assert_same_fits(actual, expected, tolerance=1e-9):
    for own, other in zip(actual, expected, strict=True):
        assert own.n_iter == other.n_iter
        assert own.converged == other.converged
        assert own.floored == other.floored
        assert own.reseedings == other.reseedings
        np.testing.assert_allclose(own.bounds, other.bounds, rtol=tolerance)
        assert_same_mixture(own.parameters, other.parameters, tolerance)


@pytest.mark.parametrize("reg_covar", [1e-6, 1e-1], ids=["added", "floored"])
@pytest.mark.parametrize("many", [0, 10**9], ids=["packed", "whitened"])
def test_together_they_do_what_each_does_alone(many, reg_covar, monkeypatch):
    monkeypatch.setattr("tpgmm_torch.em.sufficient_statistics.MANY_COMPONENTS", many)
    points, lambdas, parameters = problem(reg_covar)
    settings = {"tol": 1e-3, "max_iter": 40}
    together, alone = (fits_of(starts(lambdas.admit(parameters))) for _ in range(2))
    expectation_maximization(together, points, lambdas, **settings)
    for fit in alone:
        expectation_maximization([fit], points, lambdas, **settings)
    assert_same_fits(together, alone, 1e-8 if reg_covar == 1e-1 else 1e-9)
    assert len({fit.n_iter for fit in together}) > 1
    assert together[-1].reseedings
    assert not together[0].reseedings
    assert any(fit.floored for fit in together) == (reg_covar == 1e-1)
    for fit in together:
        assert all(later >= earlier - 1e-9 for earlier, later in pairwise(fit.bounds))


def test_one_pass_serves_all(monkeypatch):
    points, lambdas, parameters = problem()
    passes = counted_passes(monkeypatch)
    fits = fits_of([parameters, jittered(parameters, 0), jittered(parameters, 1)])
    expectation_maximization(fits, points, lambdas, tol=1e-3, max_iter=30)
    assert passes[0] == 3
    assert len(passes) == 1 + max(fit.n_iter for fit in fits)
    assert sorted(passes, reverse=True) == passes
    assert sum(passes) == 3 + sum(fit.n_iter for fit in fits)


def test_interrupted_fits_go_on_as_if_nothing_had_happened():
    points, lambdas, parameters = problem()
    mixtures = starts(parameters)
    whole, halfway = fits_of(mixtures), fits_of(mixtures)
    expectation_maximization(whole, points, lambdas, tol=1e-4, max_iter=20)
    saved = []
    expectation_maximization(
        halfway,
        points,
        lambdas,
        tol=1e-4,
        max_iter=20,
        after=lambda fits: saved.append(copy.deepcopy(list(fits))),
    )
    assert_same_fits(halfway, whole)
    assert [fit.n_iter for fit in saved[0]] == [1] * 5
    for stop in (0, 2, 9):
        expectation_maximization(saved[stop], points, lambdas, tol=1e-4, max_iter=20)
        assert_same_fits(saved[stop], whole)


def test_fits_that_are_finished_stay_as_they_are():
    points, lambdas, parameters = problem()
    [fit] = fits_of([parameters])
    expectation_maximization([fit], points, lambdas, tol=1e-3, max_iter=50)
    assert fit.converged
    before = copy.deepcopy(fit)
    expectation_maximization([fit], points, lambdas, tol=1e-3, max_iter=100)
    assert_same_fits([fit], [before], 0)


def test_float32_restarts_agree_with_float64():
    bounds = []
    parameters = problem(1e-5)[2]
    for dtype in (torch.float64, torch.float32):
        points, lambdas, _ = problem(1e-5, dtype=dtype)
        fits = fits_of([parameters, jittered(parameters, 0)])
        expectation_maximization(fits, points, lambdas, tol=0.0, max_iter=5)
        bounds.append([fit.bounds[-1] for fit in fits])
    np.testing.assert_allclose(*bounds, rtol=1e-4)


@pytest.mark.parametrize("floored", [False, True])
@pytest.mark.parametrize("covariance_type", COVARIANCE_TYPES)
def test_the_m_step_of_each_mixture_is_its_own(covariance_type, floored):
    points, units = standardized(movements(2000))
    families = [family(units, share, covariance_type) for share in (1e-4, 1e-1)]
    start = families[0].admit(binned(points, families[0], K))
    mixtures = [start, jittered(start, 3)]
    flags = torch.tensor([floored, not floored])
    after = m_step(
        e_step(Parameters.stack(mixtures), points), CovarianceFamily.stack(families), flags
    )
    for s, (mixture, own) in enumerate(zip(mixtures, families, strict=True)):
        alone = m_step(e_step(one(mixture), points), own, flags[s : s + 1])[0]
        assert_same_mixture(after[s], alone)
        if not flags[s]:
            expected, _ = reference_step(mixture, blocks_of(points), own)
            assert_same_mixture(after[s], expected)


def test_a_component_without_data_keeps_its_place_and_shape():
    points, units = standardized(movements(2000))
    lambdas = family(units)
    start = binned(points, lambdas, K)
    expectation = e_step(one(start), points)
    for moment in expectation.moments:  # as where the gate leaves it out everywhere
        moment[0, 2] = 0.0
    after = m_step(expectation, lambdas, torch.tensor([False]))[0]
    assert float(after.weights[2]) == 0.0
    for own, before in zip(after.means, start.means, strict=True):
        assert torch.equal(own[2], before[2])
    for j, (own, before) in enumerate(zip(after.covariances, start.covariances, strict=True)):
        expected = before[2] + torch.diag(lambdas.diagonals[j])
        torch.testing.assert_close(own[2], expected)


def test_a_step_that_lowers_the_likelihood_even_so_is_undone(monkeypatch):
    points, lambdas, parameters = problem()
    bounds = iter([-1.0, -2.0, -2.5, -3.0])  # start, a step, the same with the floor, a step

    def falling(*arguments, **settings):
        expectation = e_step(*arguments, **settings)
        bound = torch.full_like(expectation.bound, next(bounds))
        return replace(expectation, bound=bound)

    monkeypatch.setattr(loop, "e_step", falling)
    [fit] = fits_of([parameters])
    expectation_maximization([fit], points, lambdas, tol=1e-6, max_iter=10)
    assert fit.floored and fit.converged
    assert fit.bounds == [-1.0, -1.0]
    assert_same_mixture(fit.parameters, parameters, 0)


def test_what_is_reseeded_is_told_and_the_bounds_begin_again():
    points, lambdas, parameters = problem()
    [fit] = fits_of([with_a_component_far_away(parameters)])
    expectation_maximization([fit], points, lambdas, tol=0.0, max_iter=1)
    assert fit.reseedings == ["component(s) [0] in iteration 1 (left: 0 of 6000 points)"]
    assert (fit.n_reseeded, fit.n_iter, len(fit.bounds), fit.converged) == (1, 1, 1, False)


def test_components_are_reseeded_at_most_once_each():
    points, lambdas, parameters = problem()
    [fit] = fits_of([with_a_component_far_away(parameters)])
    fit.n_reseeded = K
    expectation_maximization([fit], points, lambdas, tol=0.0, max_iter=2)
    assert not fit.reseedings
    assert fit.n_reseeded == K
    assert float(fit.parameters.weights[0]) < 1e-100


def test_progress_is_printed(capsys):
    points, lambdas, parameters = problem(n_points=2000)
    for verbose, lines in ((0, 0), (1, 1), (2, 4)):
        expectation_maximization(
            fits_of([parameters]), points, lambdas, tol=0.0, max_iter=3, verbose=verbose
        )
        printed = capsys.readouterr().out
        assert printed.count("\n") == lines
        assert ("start: not converged in 3 iterations, bound" in printed) == (verbose > 0)
        assert ("  iteration 1: bound" in printed) == (verbose > 1)


@pytest.mark.parametrize(
    ("measured", "counted"),
    [
        ([-1.0, -5.0], [-5.0]),  # the start, and what reseeding has lowered it to
        ([-1.0, -0.5], [-1.0]),
        ([-1.0, -5.0, -4.0, -3.0], [-5.0, -4.0]),
        ([-1.0, -0.5, -0.4, -0.3], [-1.0, -0.5, -0.4]),
    ],
)
def test_bounds_are_counted_from_where_reseeding_lowered_them(measured, counted, monkeypatch):
    points, lambdas, parameters = problem(n_points=2000)
    bounds = iter(measured)

    def given(*arguments, **settings):
        expectation = e_step(*arguments, **settings)
        return replace(expectation, bound=torch.full_like(expectation.bound, next(bounds)))

    monkeypatch.setattr(loop, "e_step", given)
    [fit] = fits_of([with_a_component_far_away(parameters)])
    max_iter = len(measured) - 1
    expectation_maximization([fit], points, lambdas, tol=0.0, max_iter=max_iter)
    assert (fit.n_reseeded, fit.n_iter) == (1, max_iter)
    assert fit.bounds == counted
