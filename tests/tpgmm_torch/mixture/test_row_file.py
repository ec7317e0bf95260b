"""Rows in a file: written once, read in parts, and learned from as those in memory are."""

import numpy as np
import pytest
import torch

from tests.support.blocks import WIDTHS, fitted
from tpgmm_torch.exceptions import DataError, ShapeError
from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture
from tpgmm_torch.mixture.row_file import RowFile

SETTINGS = {"blocks": WIDTHS, "max_iter": 12, "tol": 0.0, "random_state": 0}


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch):
    monkeypatch.setattr("tpgmm_torch.mixture.points.FILE_ROWS", 800)


@pytest.fixture
def timed():
    """Rows with shared, unordered times in the first column, (5000, 5)."""
    rng = np.random.RandomState(3)
    time = rng.randint(0, 400, 5000) * 0.01
    waves = np.stack([np.sin(time * k) for k in range(1, 5)], 1)
    return np.column_stack([time, waves + 0.05 * rng.standard_normal(waves.shape)])


def assert_same(model, other, tolerance=1e-9):
    close = {"rtol": tolerance, "atol": tolerance}
    torch.testing.assert_close(model.weights_, other.weights_, **close)
    torch.testing.assert_close(model.means_, other.means_, **close)
    torch.testing.assert_close(model.covariances_, other.covariances_, **close)
    assert model.lower_bounds_ == pytest.approx(other.lower_bounds_, rel=tolerance)
    assert model.n_iter_ == other.n_iter_


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_it_is_indexed_like_an_array(dtype):
    rows, expected = RowFile(), np.arange(35, dtype=dtype).reshape(7, 5)
    for part in np.split(expected, [3, 4]):
        rows.append(part)
    assert (rows.shape, rows.dtype, len(rows)) == ((7, 5), dtype, 7)
    for index in (
        slice(1, 6),
        slice(None),
        np.array([6, 0, 0]),
        (slice(2, 4), 0),
        slice(9, 12),
    ):
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
def test_batches_give_the_mixture_of_the_whole(timed, init_params, covariance_type):
    settings = SETTINGS | {"init_params": init_params, "covariance_type": covariance_type}
    whole = fitted(BlockGaussianMixture(4, **settings), timed)
    parts = fitted(
        BlockGaussianMixture(4, **settings), RowFile.of(np.split(timed, [700, 701, 3000]))
    )
    assert_same(parts, whole)
    assert parts.n_features_in_ == 5


@pytest.mark.parametrize("settings", [{"n_init": 3}, {"group_size": 4}, {"n_components": 1}])
def test_starts_and_groups_are_those_of_the_whole(timed, settings):
    settings = {"n_components": 5} | SETTINGS | settings
    whole = fitted(BlockGaussianMixture(**settings), timed)
    batches = (torch.from_numpy(part) for part in np.split(timed, [0, 801, 1600, 4004]))
    assert_same(fitted(BlockGaussianMixture(**settings), RowFile.of(batches)), whole)


def with_nan(piece):
    piece = piece.copy()
    piece[3, 1] = np.nan
    return piece


@pytest.mark.parametrize(
    ("spoil", "error", "message"),
    [
        (with_nan, DataError, "batch 2: .*NaN"),
        (lambda piece: piece[:, :4], ShapeError, "batch 2 has 4 columns.* before have 5"),
        (lambda piece: piece[:, 0], DataError, "batch 2: .*2D"),
        (lambda piece: piece.astype(str) + "x", DataError, "batch 2: .*string"),
        (lambda piece: None, DataError, "batch 2: "),
    ],
)
def test_a_bad_batch_is_named(timed, spoil, error, message):
    pieces = np.split(timed, [500, 1000, 2000])
    pieces[2] = spoil(pieces[2])
    with pytest.raises(error, match=message):
        RowFile.of(iter(pieces))


def test_no_rows_and_one_row_are_refused():
    with pytest.raises(DataError, match="there are no rows"):
        BlockGaussianMixture(2).fit(RowFile.of([np.empty((0, 3))]))
    with pytest.raises(DataError, match="1 sample"):
        BlockGaussianMixture(1).fit(RowFile.of([np.ones((1, 3))]))
