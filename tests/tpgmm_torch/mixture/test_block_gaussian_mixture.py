"""The mixture as an estimator: scikit-learn's contract, starts, groups, folds, bad input."""

import json
import os
import pickle
import subprocess
import sys
import warnings

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from scipy.special import logsumexp, softmax
from scipy.stats import multivariate_normal
from sklearn.base import clone

from tests.support.blocks import COVARIANCE_TYPES, WIDTHS, fitted, split
from tests.support.em_reference import WIDTHS as FOLD_WIDTHS
from tests.support.em_reference import counted_passes, movements
from tpgmm_torch.em.covariance_shrinkage import oracle_approximating_intensity
from tpgmm_torch.exceptions import (
    ConvergenceWarning,
    DataError,
    DegenerateComponentWarning,
    NotFittedError,
    ShapeError,
)
from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture, fit_subsets
from tpgmm_torch.mixture.variance_moderation import moderated_variances

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
    assert len(results) >= 40  # scikit-learn 1.6 has one less than 1.9


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


def test_a_dead_component_is_reseeded_and_reported(clusters):
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


def test_a_component_on_a_single_point_is_reseeded(clusters):
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


@pytest.mark.parametrize("covariance_type", COVARIANCE_TYPES)
def test_shrinkage_comes_after_em(clusters, covariance_type):
    X = clusters
    settings = {"n_components": 3, "blocks": WIDTHS, "covariance_type": covariance_type}
    plain = fitted(BlockGaussianMixture(**settings), X)
    settings |= {"covariance_shrinkage": 0.5, "warm_start": True, "tol": 1e-9}
    shrunk = fitted(BlockGaussianMixture(**settings | {"tol": 1e-3}), X)
    assert shrunk.lower_bound_ == plain.lower_bound_
    for block, (one, other) in enumerate(
        zip(plain.covariances_, shrunk.covariances_, strict=True)
    ):
        diagonal = torch.diag_embed(one.diagonal(dim1=1, dim2=2))
        torch.testing.assert_close(other, (one + diagonal) / 2, msg=f"block {block}")
    # a warm start goes on from where EM was, not from what was shrunk
    again = fitted(clone(shrunk), X)
    bounds = fitted(again.set_params(max_iter=1), X).lower_bounds_
    assert bounds[0] >= plain.lower_bound_ - 1e-9


def test_automatic_shrinkage_follows_the_samples_of_each_component(clusters):
    X = clusters
    settings = {"n_components": 3, "blocks": WIDTHS}
    plain = fitted(BlockGaussianMixture(**settings), X)
    settings["covariance_shrinkage"] = "auto"
    points = fitted(BlockGaussianMixture(**settings), X)
    shown = fitted(BlockGaussianMixture(**settings, n_demonstrations=3), X)
    for model, n_samples in ((points, len(X) * plain.weights_), (shown, torch.tensor(3.0))):
        for one, other in zip(plain.covariances_, model.covariances_, strict=True):
            if one.shape[-1] == 1:
                continue
            share = oracle_approximating_intensity(one, n_samples - 1)[:, None, None]
            diagonal = torch.diag_embed(one.diagonal(dim1=1, dim2=2))
            torch.testing.assert_close(other, (1 - share) * one + share * diagonal)


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


# Rows that share one responsibility: ``group_size`` consecutive ones.

GROUP, K = 4, 3
REG = 1e-3


def grouped_data(n_groups: int = 45, group: int = GROUP, seed: int = 0) -> np.ndarray:
    """Rows in groups that lie together, (n_groups * group, 5)."""
    rng = np.random.default_rng(seed)
    centres = rng.standard_normal((3, 5)) * 2
    rows = centres[np.arange(n_groups) * 3 // n_groups].repeat(group, 0)
    return rows + rng.standard_normal((n_groups * group, 5)) @ rng.standard_normal((5, 5))


def fit_grouped(X: np.ndarray, **options) -> BlockGaussianMixture:
    with warnings.catch_warnings():
        for category in (ConvergenceWarning, DegenerateComponentWarning):
            warnings.simplefilter("ignore", category)
        return BlockGaussianMixture(**{"n_components": K, "blocks": WIDTHS, **options}).fit(X)


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
    start = {
        "weights_init": np.array([0.5, 0.3, 0.2]),
        "means_init": np.split(X[[3, 80, 170]], [2], axis=1),
        "covariances_init": [np.stack([3.0 * np.eye(width)] * K) for width in WIDTHS],
    }
    model = fit_grouped(
        X,
        group_size=GROUP,
        max_iter=n_iter,
        tol=0.0,
        reg_covar=REG,
        regularization="absolute",
        **start,
    )
    weights, means, covariances, bounds = oracle_of_groups(X, *start.values(), n_iter)
    np.testing.assert_allclose(model.weights_, weights, rtol=1e-8)
    for j in range(2):
        np.testing.assert_allclose(model.means_[j], means[j], rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(model.covariances_[j], covariances[j], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(model.lower_bounds_, bounds, rtol=1e-9)


def test_groups_of_one_are_points():
    X = grouped_data()
    alone, plain = fit_grouped(X, group_size=1), fit_grouped(X)
    assert torch.equal(alone.weights_, plain.weights_)
    for name in ("means_", "covariances_"):
        pairs = zip(getattr(alone, name), getattr(plain, name), strict=True)
        assert all(torch.equal(one, other) for one, other in pairs)
    assert alone.lower_bounds_ == plain.lower_bounds_


def test_groups_are_another_model_than_points():
    X = grouped_data()
    assert not torch.allclose(
        fit_grouped(X, group_size=GROUP).means_[0], fit_grouped(X).means_[0], atol=1e-3
    )


def test_groups_of_equal_rows_are_their_rows():
    X = grouped_data(group=1)
    repeated = fit_grouped(X.repeat(GROUP, 0), group_size=GROUP)
    once = fit_grouped(X)
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
    torch.testing.assert_close(
        fit_grouped(mixed, **start).means_, fit_grouped(X, **start).means_
    )


def test_prediction_is_of_single_rows():
    X = grouped_data()
    model = fit_grouped(X, group_size=GROUP)
    parameters = [model.weights_.numpy()], model.means_, model.covariances_
    log_joint = joint_density(X[:7], parameters[0][0], *parameters[1:])
    np.testing.assert_allclose(model.score_samples(X[:7]), logsumexp(log_joint, axis=1))
    np.testing.assert_allclose(model.predict_proba(X[:7]), softmax(log_joint, axis=1))


@pytest.mark.parametrize("covariance_type", ["full", "tied", "diag", "spherical"])
@hypothesis_settings(max_examples=25)
@given(
    seed=st.integers(0, 10**6),
    group=st.integers(2, 6),
    n_components=st.integers(1, 5),
    init=st.sampled_from(["time", "kmeans", "random"]),
    reg=st.sampled_from([0.0, 1e-6, 1e-1]),
)
def test_the_likelihood_of_groups_never_falls(
    covariance_type, seed, group, n_components, init, reg
):
    model = fit_grouped(
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
    whole = fit_grouped(X, **options)
    monkeypatch.setattr("tpgmm_torch.em.points.CHUNK_SIZE", {"cpu": size})
    chunked = fit_grouped(X, **options)
    torch.testing.assert_close(chunked.weights_, whole.weights_)
    torch.testing.assert_close(chunked.means_, whole.means_)
    torch.testing.assert_close(chunked.covariances_, whole.covariances_)
    np.testing.assert_allclose(chunked.score_samples(X), whole.score_samples(X), rtol=1e-9)


def test_a_group_larger_than_all_chunks_is_not_cut(monkeypatch):
    X = grouped_data(group=20)
    whole = fit_grouped(X, group_size=60)
    monkeypatch.setattr("tpgmm_torch.em.points.CHUNK_SIZE", {"cpu": 8})
    torch.testing.assert_close(fit_grouped(X, group_size=60).means_, whole.means_)


@pytest.mark.parametrize("group_size", [7, 181])
def test_incomplete_groups_are_refused(group_size):
    with pytest.raises(ShapeError, match=rf"180 rows are no multiple of .*{group_size}"):
        fit_grouped(grouped_data(), group_size=group_size)


@pytest.mark.parametrize("group_size", [0, -1, 2.5, "4"])
def test_sizes_that_are_no_sizes_are_refused(group_size):
    with pytest.raises(ValueError, match="'group_size' parameter"):
        fit_grouped(grouped_data(), group_size=group_size)


# Mixtures learned from some of the rows each, in common passes.


unconverged = pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.ConvergenceWarning")


def mixture(**settings):
    defaults = {"blocks": FOLD_WIDTHS, "random_state": 0, "max_iter": 30}
    return BlockGaussianMixture(6, **{**defaults, **settings})


def start_of(model, means):
    """The settings by which EM starts from a mixture, with other means."""
    parts = {"weights": model.weights_, "means": means, "covariances": model.covariances_}
    return {f"{name}_init": part for name, part in parts.items()}


def folds(n_rows, n_folds=4):
    """Every fold leaves out other ones of ten rows, the same in each ten."""
    left_out = [[0, 1, 2], [3], [4, 5, 6, 7], [9]][:n_folds]
    one = np.array([[place not in out for place in range(10)] for out in left_out])
    return np.tile(one, n_rows // 10)


def together(X, members, group_size=1, sizes=None, **settings):
    sizes = [1] * len(members) if sizes is None else sizes
    models = [mixture(group_size=size, **settings) for size in sizes]
    fit_subsets(models, X, members, group_size)
    return models


def alone(X, members, sizes=None, **settings):
    sizes = [1] * len(members) if sizes is None else sizes
    return [
        mixture(group_size=size, **settings).fit(X[chosen])
        for size, chosen in zip(sizes, members, strict=True)
    ]


def assert_same(ours, expected, tolerance=1e-9):
    close = {"rtol": tolerance, "atol": tolerance}
    for one, other in zip(ours, expected, strict=True):
        assert one.n_iter_ == other.n_iter_
        assert one.converged_ == other.converged_
        assert one.n_features_in_ == other.n_features_in_
        torch.testing.assert_close(one.weights_, other.weights_, **close)
        torch.testing.assert_close(one.means_, other.means_, **close)
        torch.testing.assert_close(one.covariances_, other.covariances_, **close)
        np.testing.assert_allclose(one.lower_bounds_, other.lower_bounds_, **close)


@pytest.mark.parametrize("n_points", [6000, 2000], ids=["packed", "whitened"])
@pytest.mark.parametrize("covariance_type", COVARIANCE_TYPES)
def test_each_learns_what_it_would_alone(covariance_type, n_points):
    X = movements(n_points) * [1e3, 1e-3, 1.0, 1e3, 1.0, 50.0, 1e-2] + 7.0
    members = folds(n_points)
    settings = {"covariance_type": covariance_type, "reg_covar": 1e-4}
    assert_same(together(X, members, **settings), alone(X, members, **settings))


@unconverged
@pytest.mark.parametrize("init_params", ["time", "kmeans", "random"])
def test_starts_are_drawn_from_the_own_rows_in_their_own_units(init_params):
    X = movements(2000) * [1.0, 5.0, 1e-3, 1.0, 1e2, 1.0, 1.0]
    members, settings = folds(2000), {"init_params": init_params, "n_init": 3}
    assert_same(together(X, members, **settings), alone(X, members, **settings))


def test_a_start_that_is_given_serves_all():
    X = movements(2000)
    first = mixture().fit(X)
    members, start = folds(2000), start_of(first, [mean + 0.05 for mean in first.means_])
    assert_same(together(X, members, **start), alone(X, members, **start))


@pytest.mark.parametrize("n_points", [6000, 2000], ids=["packed", "whitened"])
def test_of_a_group_those_that_belong_share_a_responsibility(n_points):
    X, members = movements(n_points, noise=0.2), folds(n_points)
    sizes = members[:, :10].sum(1).tolist()
    assert sizes == [7, 9, 6, 9]
    ours = together(X, members, 10, sizes)
    assert_same(ours, alone(X, members, sizes))
    # and that is something else than one for each point
    assert abs(ours[0].means_[0] - together(X, members)[0].means_[0]).max() > 1e-6


def test_rows_in_any_order_are_the_same_rows():
    X, members = movements(6000), folds(6000)
    order = np.random.RandomState(0).permutation(6000)
    shuffled = together(X[order], members[:, order])
    assert_same(shuffled, alone(X, members))


def test_a_chunk_of_which_a_mixture_has_nothing():
    """Long stretches belong to the first one alone: the others' gates open for nobody."""
    X = movements(20000)
    members = np.ones((3, 20000), dtype=bool)
    members[1:, 8000:] = False
    members[2, :100] = False
    assert_same(together(X, members), alone(X, members))


@unconverged
def test_float32_is_as_exact_as_alone():
    X, members = movements(6000), folds(6000)
    settings = {"dtype": "float32", "reg_covar": 1e-4, "max_iter": 5, "tol": 0.0}
    assert_same(together(X, members, **settings), alone(X, members, **settings), 1e-3)


def test_a_component_without_data_is_reseeded_among_the_own_rows():
    X, members = movements(6000), folds(6000)
    far = mixture().fit(X)
    means = [mean.clone() for mean in far.means_]
    for mean in means:
        mean[0] += 1e3
    start = start_of(far, means)
    with warnings.catch_warnings(record=True) as ours:
        warnings.simplefilter("always", DegenerateComponentWarning)
        found = together(X, members, **start)
    with warnings.catch_warnings(record=True) as theirs:
        warnings.simplefilter("always", DegenerateComponentWarning)
        expected = alone(X, members, **start)
    assert_same(found, expected)
    said = [str(warning.message) for warning in ours]
    assert said == [str(warning.message) for warning in theirs]
    assert ["(left: 0 of 4200 points)" in text for text in said] == [True, False, False, False]


def test_a_regularization_that_becomes_a_floor_is_the_own_one():
    X, members = movements(6000), folds(6000)
    settings = {"reg_covar": 1e-1, "max_iter": 60}
    assert_same(together(X, members, **settings), alone(X, members, **settings), 1e-8)


def test_regularizations_may_differ():
    X, members = movements(2000), folds(2000, 2)
    amounts = (1e-6, 1e-2)
    ours = [mixture(reg_covar=amount) for amount in amounts]
    fit_subsets(ours, X, members)
    expected = [
        mixture(reg_covar=amount).fit(X[chosen])
        for amount, chosen in zip(amounts, members, strict=True)
    ]
    assert_same(ours, expected)


def test_one_pass_serves_all(monkeypatch):
    passes = counted_passes(monkeypatch)
    ours = together(movements(6000), folds(6000))
    assert passes[0] == 4
    assert len(passes) == 1 + max(model.n_iter_ for model in ours)
    assert len({model.n_iter_ for model in ours}) > 1  # some are done before others


def test_what_does_not_converge_says_so():
    with pytest.warns(ConvergenceWarning, match="did not converge in 2 iterations"):
        together(movements(2000), folds(2000, 1), max_iter=2)


def test_too_few_rows_are_refused():
    X, members = movements(2000), folds(2000, 2)
    members[1] = False
    members[1, :3] = True
    with pytest.raises(DataError, match=r"n_components=6, but the data hold only 3 distinct"):
        together(X, members)


def test_units_of_other_data_say_which_variances_are_moderated():
    X = movements(200)
    blocks, n = FOLD_WIDTHS, sum(FOLD_WIDTHS)
    settings = {"n_components": 2, "blocks": blocks, "covariance_shrinkage": "auto"}
    settings |= {"n_demonstrations": 3, "random_state": 0}
    plain = BlockGaussianMixture(**settings).fit(X)
    alone = BlockGaussianMixture(**settings, column_units=[None] * n).fit(X)
    alike = BlockGaussianMixture(**settings, column_units=["m"] * n).fit(X)
    for before, same, after in zip(
        plain.covariances_, alone.covariances_, alike.covariances_, strict=True
    ):
        torch.testing.assert_close(same, before)
        variances = before.diagonal(dim1=1, dim2=2)
        if variances.shape[-1] > 1:
            torch.testing.assert_close(
                after.diagonal(dim1=1, dim2=2), moderated_variances(variances, 2)
            )
    with pytest.raises(ShapeError, match=f"1 units, but the data have {n} columns"):
        BlockGaussianMixture(**settings, column_units=["m"]).fit(X)
