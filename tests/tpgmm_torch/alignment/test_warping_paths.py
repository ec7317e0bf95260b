"""The warping of sequences, against dynamic programming written out."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tpgmm_torch.alignment.warping_paths import (
    barycenter,
    medoid,
    moving_average,
    resample,
    warping_map,
    warping_path,
)


def written_out(a, b, penalty, max_slope=2):
    """The cost of the cheapest path, by a recursion over its segments."""
    n, m = len(a), len(b)
    slopes = range(1, max_slope + 1)
    segments = {(1, k) for k in slopes} | {(k, 1) for k in slopes}

    def local(i, j):
        return np.inf if i < 0 or j < 0 else ((a[i] - b[j]) ** 2).sum()

    costs = {(-1, -1): 0.0}
    for i, j in itertools.product(range(n), range(m)):
        costs[i, j] = min(
            costs.get((i - p, j - q), np.inf)
            + sum(local(i - min(k, p - 1), j - min(k, q - 1)) for k in range(max(p, q)))
            + (max(p, q) - 1) * penalty**2
            for p, q in segments
        )
    return costs[n - 1, m - 1]


def walks(rng, lengths):
    return [rng.standard_normal((n, 2)).cumsum(axis=0) for n in lengths]


@given(
    seed=st.integers(0, 2**32 - 1),
    lengths=st.tuples(st.integers(1, 12), st.integers(1, 12)),
    penalty=st.sampled_from([0.0, 0.5, 2.0]),
    max_slope=st.integers(1, 4),
)
def test_the_path_is_optimal_within_the_slopes(seed, lengths, penalty, max_slope):
    a, b = walks(np.random.default_rng(seed), lengths)
    path, cost = warping_path(a, b, penalty, max_slope)
    assert cost == pytest.approx(written_out(a, b, penalty, max_slope))
    if np.isinf(cost):
        assert path.shape == (0, 2) and path.dtype == np.intp
        return
    steps = np.diff(path, axis=0)
    paid = ((a[path[:, 0]] - b[path[:, 1]]) ** 2).sum()
    assert paid + penalty**2 * (steps.sum(axis=1) == 1).sum() == pytest.approx(cost)
    assert ((steps >= 0) & (steps <= 1)).all()
    assert path[0].tolist() == [0, 0] and path[-1].tolist() == [len(a) - 1, len(b) - 1]
    # one sequence stands still for less than max_slope steps
    for stands in (steps[:, 0] == 0, steps[:, 1] == 0):
        runs = np.diff(np.flatnonzero(np.concatenate(([True], ~stands, [True]))))
        assert runs.max() - 1 < max_slope


@pytest.mark.parametrize("shape", [(30,), (30, 2)])
@pytest.mark.parametrize("width", [0, 1, 4, 29, 50])
def test_the_moving_average_is_a_hann_window_over_point_reflections(shape, width):
    values = np.random.default_rng(0).standard_normal(shape)
    smooth = moving_average(values, width)
    width = min(width, 29)
    offsets = np.arange(-width, width + 1)
    weights = 1 + np.cos(np.pi * offsets / (width + 1))
    reflected = {k: values[k] for k in range(30)}
    reflected |= {-k: 2 * values[0] - values[k] for k in range(1, 30)}
    reflected |= {29 + k: 2 * values[-1] - values[29 - k] for k in range(1, 30)}
    for i in range(30):
        around = np.array([reflected[k] for k in i + offsets])
        expected = np.tensordot(weights / weights.sum(), around, 1)
        np.testing.assert_allclose(smooth[i], expected, rtol=0, atol=1e-12)
    assert moving_average(np.array([3.0]), 5).tolist() == [3.0]


@given(
    seed=st.integers(0, 2**32 - 1), length=st.integers(2, 40), width=st.sampled_from([0, 1, 3])
)
def test_a_map_increases_and_keeps_the_ends_of_its_path_and_the_means_between(
    seed, length, width
):
    rng = np.random.default_rng(seed)
    steps = np.array([[1, 1], [1, 0], [0, 1]])[rng.integers(0, 3, length)]
    path = np.concatenate(([[0, 0]], steps.cumsum(axis=0)))
    if path[-1, 0] == 0 or path[-1, 1] == 0:
        return
    found = warping_map(path, width)
    assert len(found) == path[-1, 0] + 1
    assert found[[0, -1]] == pytest.approx(path[[0, -1], 1], abs=1e-12)
    assert (np.diff(found) > 0).all()
    means = np.array([path[path[:, 0] == i, 1].mean() for i in range(len(found))])
    means[[0, -1]] = path[[0, -1], 1]
    line = np.linspace(0, path[-1, 1], len(found))
    expected = 0.999 * moving_average(means, width) + 0.001 * line
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_columns_are_resampled_one_by_one():
    time, grid = np.array([0.0, 1.0, 3.0]), np.array([0.5, 2.0, 4.0])
    values = np.array([[0.0, 3.0], [2.0, 1.0], [4.0, 0.0]])
    assert resample(values, time, grid).tolist() == [[1.0, 2.0], [3.0, 0.5], [4.0, 0.0]]


def test_the_medoid_has_the_least_summed_distance():
    family = walks(np.random.default_rng(4), (20, 31, 25, 28))
    phase = np.linspace(0, 1, 31)
    even = [resample(s, np.linspace(0, 1, len(s)), phase) for s in family]
    distances = [[np.sqrt(written_out(a, b, 0.0)) for b in even] for a in even]
    first = int(np.argmin(np.sum(distances, axis=1)))
    assert medoid(family) == first
    # whatever place it has in the family
    order = [first, *np.delete(np.arange(4), first)]
    assert [medoid([family[i] for i in np.roll(order, k)]) for k in range(4)] == [0, 1, 2, 3]
    assert medoid(family[:1]) == medoid(family[:2]) == 0


def test_rounds_of_the_barycenter_are_means_of_what_is_matched_and_lower_the_cost():
    family = walks(np.random.default_rng(6), (30,) * 4)
    average, cost = family[0], np.inf
    for _ in range(10):
        paths, costs = zip(
            *(warping_path(average, other, penalty=0.5) for other in family), strict=True
        )
        if sum(costs) >= (1 - 1e-3) * cost:
            break
        matched = [[] for _ in average]
        for path, other in zip(paths, family, strict=True):
            for at, index in path:
                matched[at].append(other[index])
        average, cost = np.array([np.mean(m, axis=0) for m in matched]), sum(costs)
    np.testing.assert_allclose(barycenter(family, family[0], 0.5), average, atol=1e-12)
    assert cost < 0.9 * sum(warping_path(family[0], o, penalty=0.5)[1] for o in family)
    np.testing.assert_array_equal(barycenter([family[0], family[0]], family[0]), family[0])
