"""Data in batches: the same mixture as from data in memory, and clear words for bad sources."""

import threading

import numpy as np
import pytest
import torch

from tests.support.blocks import WIDTHS, fitted
from tpgmm_torch import BlockGaussianMixture
from tpgmm_torch.exceptions import ConvergenceWarning, DataError, ShapeError
from tpgmm_torch.large_data.row_batches import read_ahead

SETTINGS = {"blocks": WIDTHS, "max_iter": 12, "tol": 0.0, "random_state": 0}


class Pieces:
    """A re-iterable source of the rows in pieces; it counts its passes."""

    def __init__(self, rows, *cuts):
        self.pieces, self.passes = np.split(rows, cuts), 0

    def __iter__(self):
        self.passes += 1
        return iter(self.pieces)


@pytest.fixture(autouse=True)
def small_batches(monkeypatch):
    """Batches as small as they are given are not put together."""
    monkeypatch.setattr("tpgmm_torch.large_data.row_batches.FEWEST_ROWS", 1)


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
    assert model.lower_bound_ == pytest.approx(other.lower_bound_, rel=tolerance)
    assert model.lower_bounds_ == pytest.approx(other.lower_bounds_, rel=tolerance)
    assert model.n_iter_ == other.n_iter_


@pytest.mark.parametrize("covariance_type", ["full", "tied", "diag", "spherical"])
@pytest.mark.parametrize("init_params", ["time", "kmeans", "random"])
def test_batches_give_the_mixture_of_the_whole(timed, init_params, covariance_type):
    settings = SETTINGS | {"init_params": init_params, "covariance_type": covariance_type}
    whole = fitted(BlockGaussianMixture(4, **settings), timed)
    parts = fitted(BlockGaussianMixture(4, **settings), Pieces(timed, 700, 701, 3000))
    assert_same(parts, whole)
    assert parts.n_features_in_ == 5


@pytest.mark.parametrize("settings", [{"n_init": 3}, {"group_size": 4}, {"n_components": 1}])
def test_starts_and_groups_do_not_mind_batches(timed, settings):
    settings = {"n_components": 5} | SETTINGS | settings
    whole = fitted(BlockGaussianMixture(**settings), timed)
    parts = fitted(BlockGaussianMixture(**settings), Pieces(timed, 800, 1600, 4004))
    assert_same(parts, whole)


def test_badly_scaled_columns_do_not_mind_batches(timed):
    scaled = timed * [1e-4, 1e4, 1.0, 1e3, 1e-3] + [1e4, -1e4, 0.0, 1e6, 1.0]
    scaled = np.insert(scaled, 5, 7.25, axis=1)  # and one that is constant
    settings = SETTINGS | {"blocks": (2, 4)}
    whole = fitted(BlockGaussianMixture(4, **settings), scaled)
    parts = fitted(BlockGaussianMixture(4, **settings), Pieces(scaled, 1200, 3100))
    # what is left of an offset of 1e4 on a scale of 1e-4 has eight digits
    assert_same(parts, whole, 1e-7)


def test_float32_batches_give_the_mixture_of_the_float32_whole(timed):
    single = timed.astype(np.float32)
    whole = fitted(BlockGaussianMixture(4, **SETTINGS), single)
    assert_same(fitted(BlockGaussianMixture(4, **SETTINGS), Pieces(single, 900)), whole)


def test_a_list_of_arrays_or_tensors_is_batches(timed):
    whole = fitted(BlockGaussianMixture(3, **SETTINGS), timed)
    pieces = np.split(timed, [1000, 1001])
    assert_same(fitted(BlockGaussianMixture(3, **SETTINGS), pieces), whole)
    tensors = [torch.from_numpy(piece) for piece in pieces]
    assert_same(fitted(BlockGaussianMixture(3, **SETTINGS), tensors), whole)


def test_each_iteration_is_one_pass(timed):
    short, long = Pieces(timed, 900), Pieces(timed, 900)
    fitted(BlockGaussianMixture(4, **SETTINGS | {"max_iter": 5}), short)
    fitted(BlockGaussianMixture(4, **SETTINGS | {"max_iter": 11}), long)
    assert long.passes - short.passes == 6


def test_empty_batches_are_passed_over(timed):
    whole = fitted(BlockGaussianMixture(3, **SETTINGS), timed)
    assert_same(fitted(BlockGaussianMixture(3, **SETTINGS), Pieces(timed, 0, 50, 50)), whole)


def test_no_rows_at_all_are_refused():
    with pytest.raises(DataError, match="there are no rows"):
        BlockGaussianMixture(2).fit(Pieces(np.empty((0, 3))))


def test_what_can_be_walked_through_only_once_is_refused(timed):
    for once in (iter([timed]), (part for part in [timed]), map(np.asarray, [timed])):
        with pytest.raises(DataError, match=r"only once.*__iter__ starts anew"):
            BlockGaussianMixture(2).fit(once)


def test_a_source_that_runs_dry_is_noticed(timed):
    class Dry(Pieces):
        def __iter__(self):
            self.passes += 1
            return iter(self.pieces if self.passes < 4 else self.pieces[:1])

    with pytest.raises(DataError, match="gave 5000 rows before, and 700 now"):
        BlockGaussianMixture(4, **SETTINGS).fit(Dry(timed, 700))


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
        (lambda piece: piece + np.inf, DataError, "batch 2: .*infinity"),
    ],
)
def test_a_bad_batch_is_named(timed, spoil, error, message):
    pieces = np.split(timed, [500, 1000, 2000])
    pieces[2] = spoil(pieces[2])

    class Source:
        def __iter__(self):
            return iter(pieces)

    with pytest.raises(error, match=message):
        BlockGaussianMixture(2, **SETTINGS).fit(Source())


def test_a_batch_that_parts_a_group_is_refused(timed):
    with pytest.raises(ShapeError, match=r"batch 0 has 30 rows.*group_size=4"):
        BlockGaussianMixture(2, **SETTINGS, group_size=4).fit(Pieces(timed, 30))


def test_more_components_than_distinct_points_are_refused_in_batches(timed):
    few = np.tile(timed[:4], (50, 1))
    with pytest.raises(DataError, match=r"n_components=5.*only 4 distinct.*n_samples = 200"):
        BlockGaussianMixture(5).fit(Pieces(few, 2, 90))


def test_an_error_of_the_source_comes_through_as_it_is(timed):
    class Broken(Pieces):
        def __iter__(self):
            yield self.pieces[0]
            raise OSError("the disk is gone")

    with pytest.raises(OSError, match="the disk is gone") as caught:
        BlockGaussianMixture(2).fit(Broken(timed, 100))
    assert any("after 1 batches" in note for note in caught.value.__notes__)


def test_large_data_are_sampled_for_kmeans_and_random_starts(timed, monkeypatch):
    monkeypatch.setattr("tpgmm_torch.mixture.initialization.LARGEST_SAMPLE", 500)
    quiet = (ConvergenceWarning,)
    for method in ("kmeans", "random"):
        settings = SETTINGS | {"init_params": method}
        whole = fitted(BlockGaussianMixture(4, **settings), timed, *quiet)
        parts = fitted(BlockGaussianMixture(4, **settings), Pieces(timed, 700), *quiet)
        assert_same(parts, whole)
        assert whole.weights_.min() > 0.02


def test_reading_ahead_stops_when_nobody_asks_any_more():
    read = []

    def source():
        for number in range(1000):
            read.append(number)
            yield number

    before = threading.active_count()
    walk = read_ahead(source())
    assert [next(walk), next(walk)] == [0, 1]
    walk.close()
    assert threading.active_count() == before
    assert len(read) < 10
