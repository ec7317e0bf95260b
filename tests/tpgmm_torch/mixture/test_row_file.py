"""Rows in a file: written once, read in parts, and learned from as those in memory are."""

import numpy as np
import pytest
import torch

from tests.support.blocks import WIDTHS, fitted
from tests.support.refusals import refused
from tests.support.skills import same
from tpgmm_torch.exceptions import DataError, ShapeError
from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture
from tpgmm_torch.mixture.row_file import ColumnMoments, RowFile

SETTINGS = {"blocks": WIDTHS, "max_iter": 12, "tol": 0.0, "random_state": 0}


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch):
    monkeypatch.setattr("tpgmm_torch.mixture.points.FILE_ROWS", 800)


@pytest.fixture
def timed_rows():
    """Rows with shared, unordered times in the first column, (5000, 5)."""
    rng = np.random.RandomState(3)
    time = rng.randint(0, 400, 5000) * 0.01
    waves = np.stack([np.sin(time * k) for k in range(1, 5)], 1)
    return np.column_stack([time, waves + 0.05 * rng.standard_normal(waves.shape)])


def assert_same(model, other, tolerance=1e-9):
    same(model, other, tolerance)
    assert model.lower_bounds_ == pytest.approx(other.lower_bounds_, rel=tolerance)
    assert model.n_iter_ == other.n_iter_


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_it_is_indexed_like_an_array(dtype):
    rows, expected = RowFile(), np.arange(35, dtype=dtype).reshape(7, 5)
    for part in np.split(expected, [3, 4]):
        rows.append(part)
    assert (rows.shape, rows.dtype, len(rows)) == ((7, 5), dtype, 7)
    slices = slice(1, 6), slice(None), slice(9, 12)
    for index in (*slices, np.array([6, 0, 0]), (slice(2, 4), 0)):
        np.testing.assert_array_equal(rows[index], expected[index])
        assert rows[index].dtype == dtype
    copy = rows[:2]
    copy[:] = -1.0
    rows[:, [True, False, False, True, False]] = [[8.0, 9.0]]
    expected[:, [0, 3]] = [8.0, 9.0]
    rows.append(expected[:1])
    np.testing.assert_array_equal(rows[:], np.concatenate([expected, expected[:1]]))


@pytest.mark.parametrize("covariance_type", ["full", "tied", "diag", "spherical"])
@pytest.mark.parametrize("init_params", ["time", "kmeans", "random"])
def test_batches_give_the_mixture_of_the_whole(timed_rows, init_params, covariance_type):
    settings = SETTINGS | {"init_params": init_params, "covariance_type": covariance_type}
    whole = fitted(BlockGaussianMixture(4, **settings), timed_rows)
    parts = fitted(
        BlockGaussianMixture(4, **settings), RowFile.of(np.split(timed_rows, [700, 701, 3000]))
    )
    assert_same(parts, whole)
    assert parts.n_features_in_ == 5


@pytest.mark.parametrize("settings", [{"n_init": 3}, {"group_size": 4}, {"n_components": 1}])
def test_starts_and_groups_are_those_of_the_whole(timed_rows, settings):
    settings = {"n_components": 5} | SETTINGS | settings
    whole = fitted(BlockGaussianMixture(**settings), timed_rows)
    batches = (torch.from_numpy(part) for part in np.split(timed_rows, [0, 801, 1600, 4004]))
    assert_same(fitted(BlockGaussianMixture(**settings), RowFile.of(batches)), whole)


def with_nan(piece):
    piece = piece.copy()
    piece[3, 1] = np.nan
    return piece


@pytest.mark.parametrize(("spoil", "error", "message"), [
    (with_nan, DataError, "batch 2: .*NaN"),
    (lambda piece: piece[:, :4], ShapeError, "batch 2 has 4 columns.* before have 5"),
    (lambda piece: piece[:, 0], DataError, "batch 2: .*2D"),
    (lambda piece: np.char.add(piece.astype(str), "x"), DataError, "batch 2: .*string"),
    (lambda piece: None, DataError, "batch 2: "),
])  # fmt: skip
def test_a_bad_batch_is_named(timed_rows, spoil, error, message):
    pieces = np.split(timed_rows, [500, 1000, 2000])
    pieces[2] = spoil(pieces[2])
    refused(lambda: RowFile.of(iter(pieces)), error, message)


def test_no_rows_and_one_row_are_refused():
    with pytest.raises(DataError, match="there are no rows"):
        BlockGaussianMixture(2).fit(RowFile.of([np.empty((0, 3))]))
    with pytest.raises(DataError, match="1 sample"):
        BlockGaussianMixture(1).fit(RowFile.of([np.ones((1, 3))]))


# Moments of columns, and the units that follow from them


@pytest.mark.parametrize("part", [2**16, 40, 1])
@pytest.mark.parametrize("in_file", [False, True])
def test_moments_are_those_of_numpy(part, in_file, monkeypatch):
    monkeypatch.setattr("tpgmm_torch.mixture.row_file.FILE_ROWS", part)
    X = np.random.RandomState(0).randn(101, 4) * [1e-3, 1.0, 1e3, 2.0] + [0, 1e5, 0, -3]
    X[:, 3] = 0.1
    found = ColumnMoments.of(RowFile.of([X]) if in_file else X)
    assert found.count == 101
    np.testing.assert_allclose(found.mean, X.mean(0), rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(found.scatter / 101, X.var(0), rtol=1e-10, atol=1e-28)
    np.testing.assert_array_equal(found.smallest, X.min(0))
    np.testing.assert_array_equal(found.largest, X.max(0))
    assert found.scatter[3] == 0 and found.mean[3] == 0.1  # a constant varies by nothing


@pytest.mark.parametrize("isotropic", [False, True])
def test_units_have_deviation_one(isotropic):
    X = np.random.RandomState(0).randn(300, 5) * [1e-3, 1.0, 1e3, 2.0, 5.0]
    scales = ColumnMoments.of(X).scales((2, 3), isotropic=isotropic)
    variance = (X / scales).var(0)
    if isotropic:
        assert scales[0] == scales[1] and scales[2] == scales[3] == scales[4]
        variance = [variance[:2].mean(), variance[2:].mean()]
    np.testing.assert_allclose(variance, 1.0)


def test_a_constant_column_takes_the_mean_variance_of_its_block():
    X = np.random.RandomState(0).randn(300, 4)
    X[:, 1], X[:, 3] = 7.3, -1e4
    scales = ColumnMoments.of(X).scales((3, 1), isotropic=False)
    mean = (X[:, 0].var() + X[:, 2].var()) / 3
    np.testing.assert_allclose(scales**2, [X[:, 0].var(), mean, X[:, 2].var(), 1.0])


@pytest.mark.parametrize(("times", "varies"), [(5, False), (20, True)])
def test_rounding_is_ten_times_the_precision_of_the_largest(times, varies):
    X = np.array([[1e4, 1.0], [1e4, 3.0]])
    X[1, 0] += 2 * times * np.finfo(float).eps * 1e4
    [scale, _] = ColumnMoments.of(X).scales((2,), isotropic=False)
    assert (scale < 1e-6) == varies


@pytest.mark.parametrize(
    ("rows", "message"),
    [(np.empty((0, 3)), "there are no rows"), (np.array([[1e200], [-1e200]]), "overflows")],
)
def test_rows_without_moments_are_refused(rows, message):
    refused(lambda: ColumnMoments.of(rows), DataError, message)
