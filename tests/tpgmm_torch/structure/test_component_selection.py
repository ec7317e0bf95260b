"""How many Gaussians: found by what was left out, never by what was learned from."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from sklearn.base import clone

from tests.support.planted import HAND, PlantedTask
from tests.support.skills import handlings, hands_model, waves
from tpgmm_torch import Canonical, Demonstration, TaskParameterizedGMM
from tpgmm_torch.exceptions import ConvergenceWarning, DataError
from tpgmm_torch.model_selection import fit_folds
from tpgmm_torch.operators.text import parse_operator
from tpgmm_torch.structure.component_selection import ComponentSelection


def zigzags(n=5, corners=4, noise=0.03, seed=0):
    """Straight pieces between corners, and white noise [rad]."""
    rng, time = np.random.default_rng(seed), np.linspace(0, 4, 120)
    places = np.array([0.0, 1.0, -0.5, 0.8, 0.0, 1.2])[: corners + 1]
    path = np.interp(time, np.linspace(0, 4, corners + 1), places)
    return [
        Demonstration(time, (path + noise * rng.normal(size=120))[:, None]) for _ in range(n)
    ]


@pytest.fixture(scope="module")
def model():
    return TaskParameterizedGMM("auto").fit(zigzags())


def test_as_many_are_taken_as_the_motion_has_pieces_and_more_for_its_corners(model):
    """Where straight pieces overlap, the path is round."""
    assert 4 < model.n_components_ < 20
    assert len(model.weights_) == model.n_components_ == model.mixture_.n_components


def test_it_is_not_the_likelihood_of_what_was_learned_from(model):
    """That rises still where that of what was left out falls."""
    selection = model.component_selection_
    larger = TaskParameterizedGMM(selection.candidates_[-1]).fit(zigzags())
    assert larger.score(zigzags()) > model.score(zigzags())
    means = dict(zip(selection.candidates_, selection.scores_.mean(1), strict=True))
    assert means[selection.candidates_[-1]] < max(means.values())
    assert selection.scores_.shape == (len(selection.candidates_), 5)


@pytest.mark.parametrize("threshold", [0.0, 0.25])
def test_the_smallest_is_taken_that_is_as_good(threshold):
    """Within the threshold, or one standard error of the difference."""
    model = TaskParameterizedGMM(ComponentSelection(threshold=threshold)).fit(zigzags())
    selection = model.component_selection_
    behind = selection.scores_[selection.scores_.mean(1).argmax()] - selection.scores_
    within = behind.mean(1) <= np.maximum(behind.std(1, ddof=1) / 5**0.5, threshold)
    assert selection.n_components_ == selection.candidates_[int(within.argmax())]


def test_it_is_the_same_again(model):
    again = clone(model).fit(zigzags())
    np.testing.assert_array_equal(
        again.component_selection_.scores_, model.component_selection_.scores_
    )


def test_a_rhythm_asks_for_more_than_a_reach():
    time = np.linspace(0, 4, 160)
    noises = 0.1 * np.random.default_rng(0).normal(size=(5, 160, 1))
    found = [
        TaskParameterizedGMM("auto")
        .fit([Demonstration(time, path[:, None] + noise) for noise in noises])
        .n_components_
        for path in (0.5 * time, np.sin(2 * np.pi * time))
    ]
    assert found[0] <= 3 < 10 <= found[1]


def test_points_that_share_no_instants_are_held_out_by_demonstration():
    """Other time grids: rows are not in groups."""
    shown = [
        Demonstration(one.time[: 120 - 2 * i], one.joints[: 120 - 2 * i])
        for i, one in enumerate(zigzags())
    ]
    found = TaskParameterizedGMM("auto", plausibility="ignore").fit(shown)
    assert 4 < found.n_components_ < 20


def test_frames_and_quaternions_are_served():
    model = hands_model(n_components=ComponentSelection([2, 4, 6]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        model.fit(handlings(5))
    assert np.isfinite(model.component_selection_.scores_).all()
    assert model.n_components_ > 2


def test_the_end_of_the_range_is_told():
    with pytest.warns(ConvergenceWarning, match="3 components, the most that were tried"):
        TaskParameterizedGMM(ComponentSelection([2, 3])).fit(zigzags())


def test_it_is_saved_as_a_number(model, tmp_path):
    model.save(tmp_path / "model")
    again = TaskParameterizedGMM.load(tmp_path / "model")
    assert again.n_components == again.n_components_ == model.n_components_
    assert again.component_selection_ is None


def test_a_number_stays_what_it_is():
    model = TaskParameterizedGMM(3).fit(zigzags())
    assert model.n_components_ == 3 and model.component_selection_ is None


def test_each_fold_finds_its_own():
    shown = zigzags()
    [fold] = fit_folds(TaskParameterizedGMM("auto"), shown, [[0, 1, 2, 3]])
    assert fold.n_components_ == TaskParameterizedGMM("auto").fit(shown[:4]).n_components_


@pytest.mark.parametrize(
    ("candidates", "count", "message"),
    [
        ([2, 3], 2, "at least 3, got 2; give n_components a number"),
        ([40], 3, r"none of the numbers of components \[40\] leaves each at least two of 30"),
    ],
)
def test_what_cannot_be_compared_is_refused(candidates, count, message):
    with pytest.raises(DataError, match=message):
        TaskParameterizedGMM(ComponentSelection(candidates)).fit(waves(count))


def test_batches_are_refused():
    with pytest.raises(DataError, match='n_components="auto" compare all demonstrations'):
        TaskParameterizedGMM("auto").fit([zigzags(2), zigzags(2)])


def test_what_is_left_out_is_scored_with_its_own_frames():
    """The likelihood is that of a reproduction there, not that of the mean."""
    task = PlantedTask(0, 1)
    operators = [parse_operator(f"pose:hand@{task.relevant[0]}"), Canonical()]
    model = TaskParameterizedGMM(ComponentSelection([8]), operators, HAND, robust=False)
    shown = task.demonstrations(5)
    right = model.fit(shown).component_selection_.scores_[0, 4]
    shown[4] = replace(shown[4], frames=shown[0].frames)
    assert model.fit(shown).component_selection_.scores_[0, 4] < right - 1


def test_learning_goes_on_with_the_number_that_was_found():
    shown = zigzags(6)
    model = TaskParameterizedGMM("auto").fit(shown[:5])
    number = model.n_components_
    assert len(model.partial_fit(shown[5:]).weights_) == number
