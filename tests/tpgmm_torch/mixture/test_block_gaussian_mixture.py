"""The mixture as an estimator: scikit-learn's contract, symmetries, starts, bad input."""

import json
import os
import pickle
import subprocess
import sys

import numpy as np
import pytest
import torch
from sklearn.base import clone

from tests.support.blocks import COVARIANCE_TYPES, WIDTHS, fitted, split
from tpgmm_torch.exceptions import (
    ConvergenceWarning,
    DataError,
    DegenerateComponentWarning,
    NotFittedError,
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
    assert len(results) >= 40


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
