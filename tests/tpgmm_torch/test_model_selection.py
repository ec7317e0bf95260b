"""Folds learned together: the models, and the scores, of fold after fold."""

import numpy as np
import pytest
import torch
from sklearn.base import clone
from sklearn.model_selection import KFold, LeaveOneOut, ShuffleSplit
from sklearn.model_selection import cross_validate as one_by_one

from tests.support.skills import (
    bottle_demonstrations,
    bottle_model,
    canonical,
    handlings,
    hands_model,
    same,
    thinned,
    waves,
)
from tpgmm_torch import Canonical, Demonstration, TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError, NotFittedError, ShapeError
from tpgmm_torch.metrics import reproduction_scorer
from tpgmm_torch.model_selection import cross_validate, fit_folds

pytestmark = pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.ConvergenceWarning")

LEFT_OUT = LeaveOneOut()


def trains(cv, demonstrations):
    return [train for train, _ in cv.split(demonstrations)]


def alone(estimator, demonstrations, folds):
    return [clone(estimator).fit([demonstrations[index] for index in fold]) for fold in folds]


def assert_as_alone(estimator, demonstrations, folds, tolerance=1e-7):
    ours = fit_folds(estimator, demonstrations, folds)
    for one, other in zip(ours, alone(estimator, demonstrations, folds), strict=True):
        same(one, other, tolerance)
        assert (one.n_iter_, one.converged_) == (other.n_iter_, other.converged_)
        assert one.lower_bound_ == pytest.approx(other.lower_bound_, abs=1e-7)
        assert one.frame_names_ == other.frame_names_
        assert torch.equal(one.time_, other.time_)
        assert one.get_params() == other.get_params()
        assert one.mixture_.group_size == other.mixture_.group_size
    return ours


def unequal(n=5):
    """Demonstrations of different lengths and durations, joint space alone."""
    found = []
    for index in range(n):
        time = torch.linspace(0, 2 + 0.1 * index, 30 + 3 * index, dtype=torch.float64)
        joints = torch.stack((torch.sin(2 * time), torch.cos(time) + 0.05 * index), 1)
        found.append(Demonstration(time, joints))
    return found


@pytest.fixture
def never_alone(monkeypatch):
    """A fold that is fitted by itself is a mistake."""

    def fit(self, *_, **__):
        raise AssertionError("a fold was fitted by itself")

    monkeypatch.setattr(TaskParameterizedGMM, "fit", fit)


@pytest.mark.parametrize("responsibilities", ["auto", "instant", "point"])
@pytest.mark.parametrize("cv", [LEFT_OUT, KFold(3)], ids=["leave one out", "three folds"])
def test_folds_of_the_papers_skill(cv, responsibilities):
    shown = [thinned(item, 4) for item in bottle_demonstrations()[:7]]
    model = bottle_model(6, responsibilities=responsibilities, random_state=0)
    assert_as_alone(model, shown, trains(cv, shown))


@pytest.mark.parametrize("covariance_type", ["tied", "diag", "spherical"])
def test_folds_of_two_hands(covariance_type):
    shown = handlings(5)
    model = hands_model(covariance_type=covariance_type, random_state=0)
    assert_as_alone(model, shown, trains(LEFT_OUT, shown))


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_folds_of_demonstrations_that_are_not_aligned():
    shown = unequal()
    model = canonical(n_components=4, random_state=0)
    models = assert_as_alone(model, shown, trains(LEFT_OUT, shown))
    assert len({len(one.time_) for one in models}) > 1


def test_several_starts_and_kmeans():
    shown = waves(5)
    model = canonical(n_init=3, init_params="kmeans", random_state=3)
    assert_as_alone(model, shown, trains(KFold(2), shown))


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_they_are_learned_together(never_alone):
    for shown in (waves(4), unequal(4)):
        models = fit_folds(canonical(n_components=3), shown, trains(LEFT_OUT, shown))
        assert len({id(model.mixture_) for model in models}) == len(models) == 4


def test_folds_of_which_only_one_shares_a_time_grid_are_as_alone():
    shown = [*waves(3), waves(1, 24)[0]]
    folds = [[0, 1, 2], [0, 1, 3]]
    models = assert_as_alone(canonical(random_state=0), shown, folds)
    assert [model.mixture_.group_size for model in models] == [3, 1]


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_a_demonstration_that_counts_twice_does_so():
    shown = waves(4)
    models = assert_as_alone(canonical(random_state=0), shown, [[0, 1, 1], [0, 1, 2]])
    assert float((models[0].means_[0] - models[1].means_[0]).abs().max()) > 1e-3


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_one_demonstration_in_a_fold():
    shown = waves(3)
    assert_as_alone(canonical(n_components=3, random_state=0), shown, [[1], [0, 2]])


def test_the_estimator_stays_as_it_is_and_models_are_whole(tmp_path):
    shown, model = waves(4), canonical(random_state=0)
    models = fit_folds(model, shown, trains(LEFT_OUT, shown))
    with pytest.raises(NotFittedError):
        model.predict(shown)
    models[0].save(tmp_path / "model")
    [before] = models[0].predict(shown[:1])
    [after] = TaskParameterizedGMM.load(tmp_path / "model").predict(shown[:1])
    assert torch.equal(before.joints, after.joints)


@pytest.mark.parametrize("scoring", [reproduction_scorer, None], ids=["error", "likelihood"])
@pytest.mark.parametrize("cv", [None, 2, LEFT_OUT, ShuffleSplit(3, random_state=0)], ids=str)
def test_scores_are_those_of_scikit_learn(cv, scoring):
    shown, model = waves(6), canonical(n_components=4, random_state=0)
    ours = cross_validate(model, shown, cv=cv, scoring=scoring, return_estimator=True)
    theirs = one_by_one(model, shown, cv=cv, scoring=scoring, return_estimator=True)
    assert ours.keys() == theirs.keys()
    np.testing.assert_allclose(ours["test_score"], theirs["test_score"], rtol=1e-6)
    for one, other in zip(ours["estimator"], theirs["estimator"], strict=True):
        same(one, other, 1e-7)
    assert ours["fit_time"].shape == ours["score_time"].shape == ours["test_score"].shape
    assert bool((ours["fit_time"] > 0).all())


def test_by_default_scores_are_errors_and_models_are_not_kept():
    shown, model = waves(5), canonical(random_state=0)
    found = cross_validate(model, shown)
    assert found.keys() == {"fit_time", "score_time", "test_score"}
    expected = one_by_one(model, shown, scoring=reproduction_scorer)["test_score"]
    np.testing.assert_allclose(found["test_score"], expected, rtol=1e-6)


def test_more_folds_than_demonstrations_are_refused():
    with pytest.raises(DataError, match="3 demonstrations: Cannot have number of splits"):
        cross_validate(canonical(), waves(3), cv=5)


@pytest.mark.parametrize(
    ("fold", "message"),
    [
        ([], "a fold is a list of numbers of demonstrations"),
        ([[0, 1]], "a fold is a list of numbers of demonstrations"),
        ([0.5, 1.0], "a fold is a list of numbers of demonstrations"),
        ([True, False, True], "a fold is a list of numbers of demonstrations"),
        ([0, 3], r"asks for \[0, 3\]; there are 3 demonstrations"),
        ([-1, 0], r"asks for \[-1, 0\]; there are 3 demonstrations"),
    ],
)
def test_folds_that_are_none_are_refused(fold, message):
    with pytest.raises(DataError, match=message):
        fit_folds(canonical(), waves(3), [[0, 1], fold])


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_errors_are_those_of_fit():
    with pytest.raises(DataError, match="operators is empty"):
        fit_folds(canonical(operators=[]), waves(3), [[0, 1]])
    with pytest.raises(ValueError, match="n_components"):
        fit_folds(canonical(n_components=0), waves(3), [[0, 1]])
    with pytest.raises(DataError, match="responsibilities='instant' needs"):
        fit_folds(canonical(responsibilities="instant"), unequal(3), [[0, 1]])
    with pytest.raises((DataError, ShapeError), match="joints"):
        mixed = [*waves(2), Demonstration([0.0, 1.0], [[0.0], [1.0]])]
        fit_folds(TaskParameterizedGMM(2, [Canonical()]), mixed, [[0, 1]])


def test_no_folds_are_no_models():
    assert fit_folds(canonical(), waves(3), []) == []
