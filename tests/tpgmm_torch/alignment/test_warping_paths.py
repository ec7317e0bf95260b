"""The warping of sequences, against dynamic programming written out."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tpgmm_torch.alignment.warping_paths import moving_average, warping_map, warping_path


def written_out(a, b, window, penalty, open_end):
    costs = np.full((len(a) + 1, len(b) + 1), np.inf)
    costs[0, 0] = 0
    for i, x in enumerate(a, 1):
        for j, y in enumerate(b, 1):
            if window is None or abs(i - j) <= window:
                before = (costs[i - 1, j] + penalty**2, costs[i, j - 1] + penalty**2)
                costs[i, j] = ((x - y) ** 2).sum() + min(costs[i - 1, j - 1], *before)
    return costs[-1, 1:].min() if open_end else costs[-1, -1]


@given(
    seed=st.integers(0, 2**32 - 1),
    lengths=st.tuples(st.integers(1, 20), st.integers(1, 20)),
    window=st.none() | st.integers(0, 12),
    penalty=st.sampled_from([0.0, 0.5, 2.0]),
    open_end=st.booleans(),
)
def test_the_path_is_optimal_and_inside_the_window(seed, lengths, window, penalty, open_end):
    rng = np.random.default_rng(seed)
    a, b = (rng.standard_normal((n, 2)).cumsum(axis=0) for n in lengths)
    path, cost = warping_path(a, b, window, penalty, open_end)
    assert cost == pytest.approx(written_out(a, b, window, penalty, open_end))
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


@pytest.mark.parametrize("window", [4, 9])
def test_the_window_is_right_where_dtaidistance_misplaces_costs(window):
    rng = np.random.default_rng(window)
    length = 2 * (window + 1)
    a, b = rng.standard_normal((2, length, 2)).cumsum(axis=1)
    for n in range(1, length):
        _, cost = warping_path(a[:n], b, window, open_end=True)
        assert cost == pytest.approx(written_out(a[:n], b, window, 0.0, True))


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
