"""Starts: bins along time, distinct points, samples of large data, labelled Gaussians."""

import numpy as np
import pytest
import torch

from tests.support.blocks import COVARIANCE_TYPES
from tests.support.em_reference import columns, family, movements, points_of
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.mixture.expectation_maximization import labelled_step, m_step
from tpgmm_torch.mixture.initialization import bin_sizes, draw_starts, nearest, time_bins
from tpgmm_torch.mixture.row_file import RowFile


def drawn(points, method, n_starts=2, n_components=5):
    rng = np.random.RandomState(0)
    return draw_starts(method, n_starts, n_components, points, family(), rng)


@pytest.mark.parametrize("n_bins", [1, 3, 11])
def test_bins_hold_all_points(n_bins):
    assert sum(bin_sizes(11, n_bins)) == 11
    assert np.ptp(bin_sizes(11, n_bins)) <= 1
    sizes = np.array([bin_sizes(1000, n_bins, np.random.RandomState(s)) for s in range(200)])
    assert (sizes.sum(1) == 1000).all() and sizes.min() >= 1
    if n_bins > 1:
        np.testing.assert_allclose(sizes.mean(0), 1000 / n_bins, rtol=0.1)
        assert 0.2 < sizes.std() / (1000 / n_bins) < 0.4


def label_points(times, sizes, group_size=1, sample=None):
    """Labels of all points, given in any order."""
    numbers = np.arange(len(times)) if sample is None else sample
    tensors = torch.from_numpy(times[numbers]), torch.from_numpy(numbers)
    label = time_bins(*tensors, sizes, group_size)
    order = np.random.RandomState(1).permutation(len(times))
    rows = np.column_stack([times, 0 * times])[order].repeat(group_size, 0)
    own = (order[:, None] * group_size + np.arange(group_size)).ravel()
    found = np.empty(len(own), dtype=int)
    found[own] = label(torch.from_numpy(rows), torch.from_numpy(own))
    return found


@pytest.mark.parametrize("distinct", [1, 3, 60])
def test_bins_of_a_whole_sample_are_exact(distinct):
    """In order of time, points of equal time in their order."""
    times = np.random.RandomState(0).randint(0, distinct, 60).astype(float)
    sizes = [7, 1, 22, 30]
    expected = np.empty(60, dtype=int)
    expected[np.argsort(times, kind="stable")] = np.repeat(range(4), sizes)
    np.testing.assert_array_equal(label_points(times, sizes), expected)


@pytest.mark.parametrize("distinct", [2, 10**9])
def test_bins_of_a_sample_hold_nearly_equal_parts(distinct):
    """Ties or not, no bin is empty: points of equal time differ by their numbers."""
    rng = np.random.RandomState(0)
    times = rng.randint(0, distinct, 20_000).astype(float)
    sample = np.sort(rng.choice(20_000, 2000, replace=False))
    found = label_points(times, bin_sizes(2000, 8), sample=sample)
    np.testing.assert_allclose(np.bincount(found, minlength=8), 2500, rtol=0.15)
    order = np.lexsort((np.arange(20_000), times))
    assert (np.diff(found[order]) >= 0).all()


def test_a_center_is_nearest_to_itself():
    centers = torch.from_numpy(1e6 + np.random.RandomState(0).standard_normal((50, 33)) * 1e-4)
    assert nearest(centers)(centers, centers).tolist() == list(range(50))


@pytest.mark.parametrize("method", ["time", "kmeans", "random"])
def test_rows_in_a_file_give_the_starts_of_those_in_memory(method, monkeypatch):
    monkeypatch.setattr("tpgmm_torch.mixture.points.FILE_ROWS", 300)
    rows = movements(2000)
    ours = drawn(points_of(rows, rows=RowFile.of(np.split(rows, [90, 1300]))), method)
    for one, other in zip(ours, drawn(points_of(rows), method), strict=True):
        torch.testing.assert_close(one.weights, other.weights)
        torch.testing.assert_close(one.means, other.means)
        torch.testing.assert_close(one.covariances, other.covariances)
    assert not torch.allclose(ours[0].means[0], ours[1].means[0])


def test_bins_along_time_of_large_data_come_from_a_sample(monkeypatch):
    rows = movements(2000)
    [exact] = drawn(points_of(rows), "time", n_starts=1)
    np.testing.assert_allclose(exact.weights, 0.2)
    monkeypatch.setattr("tpgmm_torch.mixture.points.FILE_ROWS", 500)
    [near] = drawn(points_of(rows), "time", n_starts=1)
    np.testing.assert_allclose(near.weights, 0.2, atol=0.03)
    assert not torch.equal(near.weights, exact.weights)


def test_groups_stay_together_unless_they_are_too_few():
    rows = movements(2000)
    [start] = drawn(points_of(rows, group_size=500), "time", n_starts=1)
    np.testing.assert_allclose(start.weights, 0.2)  # four groups, five components
    [start] = drawn(points_of(rows, group_size=250), "time", n_starts=1)
    assert np.allclose(sorted(start.weights.tolist()), [0.125, 0.125, 0.25, 0.25, 0.25])


@pytest.mark.parametrize("method", ["time", "kmeans", "random"])
def test_fewer_distinct_points_than_components_are_refused(method):
    few = movements(2000)[::500][:4]
    points = points_of(few[np.random.RandomState(0).randint(0, 4, 2600)])
    [start] = drawn(points, method, n_starts=1, n_components=4)
    assert float(start.weights.min()) > 0.2
    with pytest.raises(DataError, match=r"only 4 distinct point\(s\) among n_samples = 2600"):
        drawn(points, method)


@pytest.mark.parametrize("covariance_type", COVARIANCE_TYPES)
def test_gaussians_are_those_of_the_labelled_points(covariance_type, monkeypatch):
    monkeypatch.setattr("tpgmm_torch.mixture.points.CHUNK_SIZE", {"cpu": 2**10})
    points, own = points_of(movements(600)), family(1e-2, covariance_type)
    labels = torch.from_numpy(np.random.RandomState(0).randint(0, 3, 600))
    found = m_step(labelled_step(points, lambda _, n: labels[n], 3), own, floor=False)
    numbers = torch.cat([numbers for _, numbers in points])
    counts = torch.bincount(labels) / 600
    torch.testing.assert_close(found.weights, counts.double(), rtol=1e-6, atol=0)
    for j, block in enumerate(columns(points)):
        parts = [block[labels[numbers] == k] for k in range(3)]
        torch.testing.assert_close(found.means[j], torch.stack([x.mean(0) for x in parts]))
        scatter = torch.stack([torch.cov(x.T, correction=0) for x in parts])
        expected = own.regularize(own.restrict(scatter, found.weights), j, floor=False)
        torch.testing.assert_close(found.covariances[j], expected)
