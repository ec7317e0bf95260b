"""The warping of sequences, against dynamic programming written out."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tpgmm_torch.alignment import warping_paths
from tpgmm_torch.alignment.warping_paths import (
    barycenter,
    medoid,
    moving_average,
    resample,
    warping_map,
    warping_path,
)


def written_out(a, b, window, penalty, open_end, max_slope=2):
    """The cost of the cheapest path, by a recursion over its segments."""
    n, m = len(a), len(b)
    segments = {(1, k) for k in range(1, max_slope + 1)} | {
        (k, 1) for k in range(1, max_slope + 1)
    }

    def local(i, j):
        if i < 0 or j < 0 or (window is not None and abs(i - j) > window):
            return np.inf
        return ((a[i] - b[j]) ** 2).sum()

    costs = {(-1, -1): 0.0}
    for i in range(n):
        for j in range(m):
            costs[i, j] = min(
                costs.get((i - p, j - q), np.inf)
                + sum(local(i - min(k, p - 1), j - min(k, q - 1)) for k in range(max(p, q)))
                + (max(p, q) - 1) * penalty**2
                for p, q in segments
            )
    return min(costs[n - 1, j] for j in (range(m) if open_end else [m - 1]))


@given(
    seed=st.integers(0, 2**32 - 1),
    lengths=st.tuples(st.integers(1, 12), st.integers(1, 12)),
    window=st.none() | st.integers(0, 8),
    penalty=st.sampled_from([0.0, 0.5, 2.0]),
    open_end=st.booleans(),
    max_slope=st.integers(1, 4),
)
def test_the_path_is_optimal_inside_the_window_and_the_slopes(
    seed, lengths, window, penalty, open_end, max_slope
):
    rng = np.random.default_rng(seed)
    a, b = (rng.standard_normal((n, 2)).cumsum(axis=0) for n in lengths)
    path, cost = warping_path(a, b, window, penalty, open_end, max_slope)
    assert cost == pytest.approx(written_out(a, b, window, penalty, open_end, max_slope))
    if np.isinf(cost):
        assert len(path) == 0
        return
    steps = np.diff(path, axis=0)
    paid = ((a[path[:, 0]] - b[path[:, 1]]) ** 2).sum()
    assert paid + penalty**2 * (steps.sum(axis=1) == 1).sum() == pytest.approx(cost)
    assert ((steps >= 0) & (steps <= 1)).all()
    assert path[0].tolist() == [0, 0] and path[-1, 0] == len(a) - 1
    assert open_end or path[-1, 1] == len(b) - 1
    assert window is None or np.abs(path[:, 0] - path[:, 1]).max() <= window
    # what stands still in one sequence does so for less than max_slope steps
    for stands in (steps[:, 0] == 0, steps[:, 1] == 0):
        runs = np.diff(np.flatnonzero(np.concatenate(([True], ~stands, [True]))))
        assert runs.max() - 1 < max_slope


@given(seed=st.integers(0, 2**32 - 1), max_slope=st.integers(1, 5))
def test_no_part_of_a_path_is_steeper_or_flatter_than_allowed(seed, max_slope):
    a, b = np.random.default_rng(seed).standard_normal((2, 60, 1)).cumsum(axis=1)
    path, _ = warping_path(a, b, max_slope=max_slope)
    for early, late in itertools.combinations(path[::7], 2):
        i, j = late - early
        assert i <= max_slope * (j + 2) and j <= max_slope * (i + 2)


def test_a_path_without_a_bound_in_effect_is_that_of_dynamic_time_warping():
    rng = np.random.default_rng(1)
    a, b = (rng.standard_normal((n, 2)).cumsum(axis=0) for n in (15, 11))
    costs = np.full((16, 12), np.inf)
    costs[0, 0] = 0
    for i, x in enumerate(a, 1):
        for j, y in enumerate(b, 1):
            before = (costs[i - 1, j] + 0.25, costs[i, j - 1] + 0.25, costs[i - 1, j - 1])
            costs[i, j] = ((x - y) ** 2).sum() + min(before)
    assert warping_path(a, b, penalty=0.5, max_slope=15)[1] == pytest.approx(costs[-1, -1])


def test_a_slope_of_one_is_the_diagonal():
    a, b = np.random.default_rng(2).standard_normal((2, 9, 1))
    path, _ = warping_path(a, b, max_slope=1)
    assert path.tolist() == [[i, i] for i in range(9)]


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 60), width=st.integers(0, 80))
def test_smoothing_keeps_ends_order_and_straight_lines(seed, n, width):
    increasing = np.random.default_rng(seed).uniform(0, 1, n).round().cumsum()
    smooth = moving_average(increasing, width)
    assert smooth[[0, -1]] == pytest.approx(increasing[[0, -1]])
    assert (np.diff(smooth) >= -1e-12).all()
    line = np.linspace(-1, 4, n)
    assert moving_average(line, width) == pytest.approx(line)


def test_a_path_becomes_a_strictly_increasing_map():
    path = np.array([[0, 0], [0, 1], [1, 2], [2, 2], [3, 2], [4, 3], [4, 4], [4, 5], [5, 6]])
    steps = warping_map(path)
    assert (np.diff(steps) > 0).all()
    assert steps == pytest.approx([0, 2, 2, 2, 4, 6], abs=0.01)
    assert steps[[0, -1]].tolist() == [0, 6]


@given(
    seed=st.integers(0, 2**32 - 1), length=st.integers(2, 40), width=st.sampled_from([0, 1, 3])
)
def test_a_map_keeps_both_ends_of_its_path_and_the_means_between(seed, length, width):
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


@pytest.mark.parametrize("shape", [(30,), (30, 2)])
@pytest.mark.parametrize("width", [0, 1, 4, 29, 50])
def test_the_moving_average_is_a_hann_window_over_point_reflections(shape, width):
    values = np.random.default_rng(0).standard_normal(shape)
    smooth = moving_average(values, width)
    assert smooth.shape == shape
    width = min(width, 29)
    offsets = np.arange(-width, width + 1)
    weights = 1 + np.cos(np.pi * offsets / (width + 1))
    for i in range(30):
        around = []
        for k in i + offsets:
            if k < 0:
                around.append(2 * values[0] - values[-k])
            elif k > 29:
                around.append(2 * values[-1] - values[58 - k])
            else:
                around.append(values[k])
        expected = np.tensordot(weights / weights.sum(), np.array(around), 1)
        np.testing.assert_allclose(smooth[i], expected, rtol=0, atol=1e-12)


def test_a_single_value_cannot_be_smoothed():
    assert moving_average(np.array([3.0]), 5).tolist() == [3.0]


def test_columns_are_resampled_one_by_one():
    time, grid = np.array([0.0, 1.0, 3.0]), np.array([0.5, 2.0, 4.0])
    values = np.array([[0.0, 3.0], [2.0, 1.0], [4.0, 0.0]])
    assert resample(values, time, grid).tolist() == [[1.0, 2.0], [3.0, 0.5], [4.0, 0.0]]


@pytest.mark.parametrize("window", [None, 0.1])
def test_the_medoid_has_the_least_summed_distance(window):
    rng = np.random.default_rng(4)
    family = [rng.standard_normal((n, 2)).cumsum(axis=0) for n in (20, 31, 25, 28)]
    phase = np.linspace(0, 1, 31)
    even = [resample(s, np.linspace(0, 1, len(s)), phase) for s in family]
    band = None if window is None else 3
    distances = [[np.sqrt(written_out(a, b, band, 0.0, False)) for b in even] for a in even]
    sums = np.sum(distances, axis=1)
    assert medoid(family, window) == int(np.argmin(sums))
    # whatever place it has in the family
    order = [int(np.argmin(sums)), *np.delete(np.arange(4), int(np.argmin(sums)))]
    assert [medoid([family[i] for i in np.roll(order, k)], window) for k in range(4)] == [
        0,
        1,
        2,
        3,
    ]


@pytest.mark.parametrize("count", [1, 2])
def test_of_two_the_first_is_the_medoid(count):
    assert medoid([np.eye(3), np.ones((4, 3))][:count]) == 0


def test_one_round_of_the_barycenter_averages_what_is_matched_with_each_point():
    rng = np.random.default_rng(5)
    family = [rng.standard_normal((n, 2)).cumsum(axis=0) for n in (12, 15, 10)]
    start = family[0]
    expected = [[] for _ in start]
    for sequence in family:
        for at, other in warping_path(start, sequence, penalty=0.5)[0]:
            expected[at].append(sequence[other])
    found = barycenter(family, start, 1, penalty=0.5)
    np.testing.assert_allclose(found, [np.mean(e, axis=0) for e in expected], atol=1e-12)


def test_rounds_of_the_barycenter_lower_the_cost_until_they_do_not():
    rng = np.random.default_rng(6)
    family = [rng.standard_normal((30, 2)).cumsum(axis=0) for _ in range(4)]

    def cost(average):
        return sum(warping_path(average, sequence)[1] for sequence in family)

    costs = [cost(barycenter(family, family[0], rounds)) for rounds in (1, 2, 3, 30, 31)]
    assert cost(family[0]) > costs[0] > costs[1] > costs[2] >= costs[3] == costs[4]
    np.testing.assert_array_equal(barycenter([family[0], family[0]], family[0], 5), family[0])


@pytest.mark.parametrize("steps, expected", [(1, 4), (2, 4), (3, 0), (4, 3)])
def test_the_window_of_the_medoid_is_a_fraction_of_the_duration(steps, expected):
    # two peaks have the distance 0 if the window lets one reach the other
    peaks = np.array([13, 10, 16, 20, 24, 24])
    family = list((np.arange(41) == peaks[:, None]).astype(float)[:, :, None])
    reached = (np.abs(peaks[:, None] - peaks) <= steps).sum(axis=0)
    assert expected == np.argmax(reached)
    assert medoid(family, steps / 40) == expected


def test_where_a_window_reaches_no_end_there_is_no_path():
    path, cost = warping_path(np.zeros((9, 1)), np.zeros((3, 1)), window=2)
    assert cost == np.inf
    assert path.shape == (0, 2) and path.dtype == np.intp


@pytest.mark.parametrize("options", [{}, {"window": 5, "penalty": 0.1}])
def test_the_barycenter_is_averaged_until_a_round_gains_less_than_a_thousandth(
    options, monkeypatch
):
    rng = np.random.default_rng(4)
    family = [rng.standard_normal((n, 2)).cumsum(axis=0) for n in (30, 31, 29, 30)]
    rounds = []

    def recorded(average, sequence, **given):
        path, cost = warping_path(average, sequence, **given)
        if sequence is family[0]:
            rounds.append(0.0)
        rounds[-1] += cost
        return path, cost

    monkeypatch.setattr(warping_paths, "warping_path", recorded)
    last = barycenter(family, family[0], 100, **options)
    gains = 1 - np.divide(rounds[1:], rounds[:-1])
    assert len(gains) > 3 and (gains[:-1] > 1e-3).all() and gains[-1] <= 1e-3
    # the average of the round that gained nothing is not taken
    np.testing.assert_array_equal(barycenter(family, family[0], len(gains), **options), last)
