"""How many Gaussians: found by what was left out, never by what was learned from."""

import numpy as np
import pytest

from tpgmm_torch import Demonstration, SelectComponents, TaskParameterizedGMM
from tpgmm_torch.exceptions import ConvergenceWarning, DataError


def zigzags(n=5, corners=4, noise=0.03, seed=0):
    """Straight pieces between corners, and white noise [rad]."""
    rng, time = np.random.default_rng(seed), np.linspace(0, 4, 120)
    places = np.array([0.0, 1.0, -0.5, 0.8, 0.0, 1.2])[: corners + 1]
    path = np.interp(time, np.linspace(0, 4, corners + 1), places)
    return [
        Demonstration(time, (path + noise * rng.normal(size=120))[:, None]) for _ in range(n)
    ]


@pytest.fixture(scope="module")
def selection():
    return SelectComponents(TaskParameterizedGMM()).fit(zigzags())


def test_as_many_are_taken_as_the_motion_has_pieces_and_more_for_its_corners(selection):
    """Where straight pieces overlap, the path is round."""
    assert 4 < selection.n_components_ < 20
    assert len(selection.best_model_.weights_) == selection.n_components_


def test_it_is_not_the_likelihood_of_what_was_learned_from(selection):
    """That rises still where that of what was left out falls."""
    larger = TaskParameterizedGMM(selection.candidates_[-1]).fit(zigzags())
    assert larger.score(zigzags()) > selection.best_model_.score(zigzags())
    means = dict(zip(selection.candidates_, selection.scores_.mean(1), strict=True))
    assert means[selection.candidates_[-1]] < max(means.values())
    assert selection.scores_.shape == (len(selection.candidates_), 5)


@pytest.mark.parametrize("threshold", [0.0, 0.25])
def test_the_smallest_is_taken_that_is_as_good(threshold):
    """Within the threshold, or one standard error of the difference."""
    found = SelectComponents(TaskParameterizedGMM(), threshold=threshold).fit(zigzags())
    behind = found.scores_[found.scores_.mean(1).argmax()] - found.scores_
    within = behind.mean(1) <= np.maximum(behind.std(1, ddof=1) / 5**0.5, threshold)
    assert found.n_components_ == found.candidates_[int(within.argmax())]


def test_a_rhythm_asks_for_more_than_a_reach():
    time = np.linspace(0, 4, 160)
    noises = 0.1 * np.random.default_rng(0).normal(size=(5, 160, 1))
    found = [
        SelectComponents(TaskParameterizedGMM())
        .fit([Demonstration(time, path[:, None] + noise) for noise in noises])
        .n_components_
        for path in (0.5 * time, np.sin(2 * np.pi * time))
    ]
    assert found[0] <= 3 < 10 <= found[1]


def test_the_end_of_the_range_is_reported():
    with pytest.warns(ConvergenceWarning, match="the most that were tried"):
        SelectComponents(TaskParameterizedGMM(), (2, 3)).fit(zigzags())


@pytest.mark.parametrize(
    ("candidates", "count", "message"),
    [((2, 3), 2, "takes at least 3"), ((1000,), 5, "at least two of 120 instants")],
)
def test_what_cannot_be_compared_is_refused(candidates, count, message):
    with pytest.raises(DataError, match=message):
        SelectComponents(TaskParameterizedGMM(), candidates).fit(zigzags(count))
