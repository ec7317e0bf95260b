"""Starts: bins along time, distinct points, samples of large data."""

import numpy as np
import pytest
import torch

from tests.support.em_reference import family, movements
from tpgmm_torch.em.column_moments import ColumnMoments
from tpgmm_torch.exceptions import DataError, ShapeError
from tpgmm_torch.large_data.row_batches import BatchedRows, StoredRows
from tpgmm_torch.mixture import initialization
from tpgmm_torch.mixture.initialization import (
    bin_sizes,
    check_distinct,
    draw_starts,
    gaussians_of,
    sample_rows,
    time_bins,
)


def in_batches(rows, *cuts):
    """The rows as batches; known to be so many after a pass."""
    source = BatchedRows(np.split(rows, cuts))
    for _ in source:
        pass
    return source


@pytest.fixture(autouse=True)
def small_batches(monkeypatch):
    """Batches as small as they are given are not put together."""
    monkeypatch.setattr("tpgmm_torch.large_data.row_batches.FEWEST_ROWS", 1)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_equal_rows_are_one_whatever_their_places(dtype):
    """A product of matrices rounds equal rows differently at different places."""
    rng = np.random.RandomState(0)
    few = rng.standard_normal((3, 33)).astype(dtype)
    rows = few[rng.randint(0, 3, 2600)]
    for order in ("C", "F"):
        stored = StoredRows(np.asarray(rows, order=order))
        check_distinct(stored, 2600, 3)
        with pytest.raises(
            DataError, match=r"only 3 distinct point\(s\) among n_samples = 2600"
        ):
            check_distinct(stored, 2600, 4)


def test_copies_do_not_hide_distinct_rows():
    """Ten copies of each of 260 rows, as of a file that is read ten times."""
    rows = np.tile(np.random.RandomState(1).standard_normal((260, 33)), (10, 1))
    check_distinct(StoredRows(rows), 2600, 260)
    check_distinct(in_batches(rows, 5, 300, 2000), 2600, 260)
    with pytest.raises(DataError, match="only 260 distinct"):
        check_distinct(in_batches(rows, 5, 300, 2000), 2600, 261)


def test_rows_that_meet_on_the_line_are_told_apart():
    """Rounded to float32, the sums of different rows may be equal."""
    rows = np.zeros((8, 2), dtype=np.float32)
    rows[:, 1] = 1e-12 * np.arange(8)
    rows[:, 0] = 1e6
    check_distinct(StoredRows(rows), 8, 8)


def test_random_starts_are_different_points():
    rng = np.random.RandomState(0)
    few = rng.standard_normal((4, 33))
    rows = few[rng.randint(0, 4, 2600)]
    for seed in range(20):
        found = initialization._distinct_points(rows, 4, np.random.RandomState(seed))
        assert len(np.unique(found, axis=0)) == 4
    with pytest.raises(DataError, match="sample of 2600 points holds only 4 distinct ones"):
        initialization._distinct_points(rows, 5, rng)


@pytest.mark.parametrize("cuts", [(), (30, 700, 701)])
@pytest.mark.parametrize("every", [1, 5])
def test_few_rows_are_sampled_whole(cuts, every):
    rows = movements(1000)[:1000]
    rows = rows if not cuts else rows[: len(rows)]
    cuts = tuple(cut // every * every for cut in cuts)
    found, numbers = sample_rows(
        in_batches(rows, *cuts),
        1000,
        np.random.RandomState(0),
        columns=slice(2, 4),
        every=every,
    )
    np.testing.assert_array_equal(found, rows[::every, 2:4])
    np.testing.assert_array_equal(numbers, np.arange(1000 // every))


def test_of_many_rows_a_sample_is_kept(monkeypatch):
    monkeypatch.setattr(initialization, "LARGEST_SAMPLE", 300)
    rows = movements(5000)
    found, numbers = sample_rows(in_batches(rows, 80, 4000), 5000, np.random.RandomState(3))
    assert 250 < len(found) <= 300
    np.testing.assert_array_equal(found, rows[numbers])
    assert (np.diff(numbers) > 0).all()
    assert numbers.max() > 4500
    again, same = sample_rows(StoredRows(rows), 5000, np.random.RandomState(3))
    np.testing.assert_array_equal(numbers, same)
    np.testing.assert_array_equal(found, again)


@pytest.mark.parametrize("n_bins", [1, 3, 11])
def test_bins_hold_all_points(n_bins):
    assert bin_sizes(11, n_bins).sum() == 11
    assert np.ptp(bin_sizes(11, n_bins)) <= 1
    sizes = [bin_sizes(1000, n_bins, np.random.RandomState(seed)) for seed in range(200)]
    assert all(own.sum() == 1000 and own.min() >= 1 for own in sizes)
    if n_bins > 1:
        np.testing.assert_allclose(np.mean(sizes, 0), 1000 / n_bins, rtol=0.1)
        assert 0.2 < np.std(sizes) / (1000 / n_bins) < 0.4
    assert bin_sizes(n_bins, n_bins, np.random.RandomState(0)).tolist() == [1] * n_bins


def labelled(times, sizes, cuts=(), group_size=1, sample=None):
    """Labels of all points, given in batches."""
    numbers = np.arange(len(times)) if sample is None else sample
    label = time_bins(times[numbers], numbers, np.array(sizes), 1, group_size)
    rows = np.column_stack([0 * times, times]).repeat(group_size, 0)
    found, first = [], 0
    for batch in np.split(rows, cuts):
        found.append(label(batch, first))
        first += len(batch)
    return np.concatenate(found)


@pytest.mark.parametrize("cuts", [(), (1, 5, 40)])
@pytest.mark.parametrize("distinct", [1, 3, 60])
def test_bins_of_a_whole_sample_are_exact(distinct, cuts):
    """In order of time, points of equal time in their order."""
    times = np.random.RandomState(0).randint(0, distinct, 60).astype(float)
    sizes = [7, 1, 22, 30]
    expected = np.empty(60, dtype=int)
    expected[np.argsort(times, kind="stable")] = np.repeat(range(4), sizes)
    np.testing.assert_array_equal(labelled(times, sizes, cuts), expected)


def test_groups_have_one_label():
    times = np.random.RandomState(0).permutation(20.0 * np.arange(12))
    found = labelled(times, [3, 4, 5], (9, 21), group_size=3).reshape(12, 3)
    assert (found == found[:, :1]).all()
    assert np.bincount(found[:, 0]).tolist() == [3, 4, 5]


@pytest.mark.parametrize("distinct", [2, 10**9])
def test_bins_of_a_sample_hold_nearly_equal_parts(distinct):
    """Ties or not, no bin is empty: points of equal time are told apart by their numbers."""
    rng = np.random.RandomState(0)
    times = rng.randint(0, distinct, 20_000).astype(float)
    sample = np.sort(rng.choice(20_000, 2000, replace=False))
    found = labelled(times, bin_sizes(2000, 8), (300, 9000), sample=sample)
    counts = np.bincount(found, minlength=8)
    np.testing.assert_allclose(counts, 2500, rtol=0.15)
    order = np.lexsort((np.arange(20_000), times))
    assert (np.diff(found[order]) >= 0).all()


def drawn(rows, method, seed=0, n_starts=2, **settings):
    units = ColumnMoments.of(movements(2000)).standardization((3, 4), isotropic=False)
    n_rows = 2000
    return draw_starts(
        method, n_starts, rows, n_rows, units, family(units), np.random.RandomState(seed),
        n_components=5, **settings,
    )  # fmt: skip


@pytest.mark.parametrize("method", ["time", "kmeans", "random"])
def test_batches_give_the_starts_of_the_whole(method):
    rows = movements(2000)
    ours = drawn(in_batches(rows, 90, 1300), method)
    for one, other in zip(ours, drawn(StoredRows(rows), method), strict=True):
        torch.testing.assert_close(one.weights, other.weights)
        torch.testing.assert_close(one.means, other.means)
        torch.testing.assert_close(one.factors, other.factors)
    assert not torch.allclose(ours[0].means[0], ours[1].means[0])


def test_bins_along_time_of_large_data_come_from_a_sample(monkeypatch):
    rows = movements(2000)
    [exact] = drawn(StoredRows(rows), "time", n_starts=1)
    np.testing.assert_allclose(exact.weights, 0.2)
    monkeypatch.setattr(initialization, "LARGEST_SAMPLE", 500)
    [near] = drawn(StoredRows(rows), "time", n_starts=1)
    [batches] = drawn(in_batches(rows, 500, 510), "time", n_starts=1)
    np.testing.assert_allclose(near.weights, 0.2, atol=0.03)
    assert not torch.equal(near.weights, exact.weights)
    torch.testing.assert_close(batches.means, near.means)


def test_groups_are_not_parted_unless_they_are_too_few():
    rows = movements(2000)
    [start] = drawn(StoredRows(rows), "time", n_starts=1, group_size=500)
    np.testing.assert_allclose(start.weights, 0.2)  # four groups, five components
    [start] = drawn(StoredRows(rows), "time", n_starts=1, group_size=250)
    assert np.allclose(sorted(start.weights.tolist()), [0.125, 0.125, 0.25, 0.25, 0.25])


def test_time_is_a_column_of_the_first_block():
    with pytest.raises(ShapeError, match=r"time_feature=3 is no column .* which has 3"):
        drawn(StoredRows(movements(2000)), "time", time_feature=3)


@pytest.mark.parametrize("covariance_type", ["full", "tied", "diag", "spherical"])
def test_gaussians_are_those_of_the_labelled_points(covariance_type, monkeypatch):
    monkeypatch.setattr(initialization, "PIECE", 64)
    rows = movements(600)
    units = ColumnMoments.of(rows).standardization((3, 4), isotropic=False)
    own = family(units, 1e-2, covariance_type)
    labels = np.random.RandomState(0).randint(0, 3, 600)
    [found] = gaussians_of(
        in_batches(rows, 100, 350), units, [lambda piece, at: labels[at : at + len(piece)]],
        own, 3,
    )  # fmt: skip
    standard = units.rows(rows).numpy()
    np.testing.assert_allclose(found.weights, np.bincount(labels) / 600)
    for j, columns in enumerate(np.split(standard, [3], 1)):
        means = np.stack([columns[labels == k].mean(0) for k in range(3)])
        np.testing.assert_allclose(found.means[j], means, atol=1e-12)
        scatter = np.stack([np.cov(columns[labels == k].T, bias=True) for k in range(3)])
        expected = own.add(own.restrict(torch.from_numpy(scatter), found.weights), j)
        torch.testing.assert_close(found.covariances[j], expected)
