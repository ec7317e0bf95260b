"""The estimator under scikit-learn: one sample is one demonstration."""

import copy
import inspect
import pickle

import numpy as np
import pytest
import torch
from sklearn.base import clone
from sklearn.model_selection import GridSearchCV, KFold, LeaveOneOut, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.utils.validation import check_is_fitted

from tests.support.skills import (
    HANDLING,
    HANDS,
    few_bottles,
    handlings,
    hands,
    hands_model,
    small_bottle,
    waves,
)
from tests.support.worlds import upper_body
from tpgmm_torch import Canonical, TaskParameterizedGMM
from tpgmm_torch.alignment import LinearTimeNormalization
from tpgmm_torch.metrics import reproduction_scorer

SETTINGS = {
    "n_components": 7,
    "operators": [Canonical()],
    "robot": HANDS,
    "covariance_type": "tied",
    "reg_covar": 1e-3,
    "tol": 1e-2,
    "max_iter": 50,
    "n_init": 2,
    "init_params": "kmeans",
    "responsibilities": "point",
    "fusion": "covariance",
    "activation": "product",
    "epsilon": 1e-5,
    "prior_std": 5.0,
    "negligible": 1e-8,
    "blend": 0.5,
    "keep_limits": False,
    "random_state": 1,
    "warm_start": True,
    "dtype": "float32",
    "device": "cpu",
    "verbose": 1,
}


def search(grid, **options) -> GridSearchCV:
    return GridSearchCV(hands_model(), grid, cv=KFold(2), error_score="raise", **options)


def test_the_constructor_only_stores():
    assert set(SETTINGS) == set(inspect.signature(TaskParameterizedGMM).parameters)
    model = TaskParameterizedGMM(**SETTINGS)
    assert set(vars(model)) == set(SETTINGS)
    assert all(vars(model)[name] is value for name, value in SETTINGS.items())
    nonsense = {name: object() for name in SETTINGS}
    assert vars(TaskParameterizedGMM(**nonsense)) == nonsense


def test_every_parameter_is_validated():
    assert set(TaskParameterizedGMM._parameter_constraints) == set(SETTINGS)


def test_parameters_are_got_set_and_cloned():
    model = TaskParameterizedGMM(**SETTINGS)
    assert model.get_params() == SETTINGS
    copied = clone(small_bottle())
    assert copied.get_params() == small_bottle().get_params()
    assert copied.robot is small_bottle().robot
    assert not hasattr(copied, "weights_")
    assert copied.set_params(n_components=3).n_components == 3
    with pytest.raises(ValueError, match="n_component"):
        copied.set_params(n_component=3)


def test_fitting_changes_no_parameter():
    model = hands_model()
    before = dict(model.get_params())
    model.fit(handlings())
    assert all(model.get_params()[name] is value for name, value in before.items())
    check_is_fitted(model)


def test_a_model_prints_what_is_not_the_default():
    assert repr(TaskParameterizedGMM()) == "TaskParameterizedGMM()"
    text = repr(TaskParameterizedGMM(5, [Canonical()], upper_body()))
    assert "n_components=5" in text and "Canonical(" in text and "Robot(" in text
    assert "fusion" not in text


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m))])
@pytest.mark.parametrize("model", [small_bottle, hands], ids=["robot", "poses"])
def test_copies_answer_the_same(copied, model):
    model = model()
    given = few_bottles()[:1] if model is small_bottle() else handlings()[:1]
    other = copied(model)
    [a], [b] = model.predict(given), other.predict(given)
    assert torch.equal(a.joints, b.joints)
    assert torch.equal(a.candidates[0].covariance, b.candidates[0].covariance)
    assert other.score(given) == model.score(given)
    assert other.operators == model.operators and other.robot == model.robot


def test_settings_of_reproduction_take_effect_without_a_new_fit():
    model = copy.deepcopy(hands())
    [before] = model.predict(handlings()[:1])
    [product] = model.set_params(activation="product").predict(handlings()[:1])
    assert not torch.equal(before.joints, product.joints)
    [again] = model.set_params(activation="time").predict(handlings()[:1])
    assert torch.equal(before.joints, again.joints)


def test_a_new_fit_replaces_the_old_model():
    model = copy.deepcopy(hands())
    model.predict(handlings()[:1])
    model.set_params(n_components=3).fit(handlings())
    [a] = model.predict(handlings()[:1])
    [b] = hands_model(n_components=3).fit(handlings()).predict(handlings()[:1])
    assert torch.equal(a.joints, b.joints)


def test_the_number_of_components_is_searched():
    found = search({"n_components": np.arange(2, 7, 2)}).fit(handlings())
    scores = found.cv_results_["mean_test_score"]
    assert scores.shape == (3,) and np.isfinite(scores).all()
    assert found.best_params_["n_components"] == (2, 4, 6)[int(scores.argmax())]
    assert len(found.best_estimator_.weights_) == found.best_params_["n_components"]


def test_operators_are_searched_by_the_error_of_reproduction():
    choices = [[HANDLING[0], HANDLING[1]], [Canonical()]]
    found = search({"operators": choices}, scoring=reproduction_scorer).fit(handlings())
    # joints alone cannot follow the cup
    assert found.best_params_["operators"] == choices[0]
    about_the_cup, alone = found.cv_results_["mean_test_score"]
    assert alone < 10 * about_the_cup < 0


@pytest.mark.parametrize("scoring", [None, reproduction_scorer])
def test_demonstrations_are_left_out_one_by_one(scoring):
    scores = cross_val_score(
        hands_model(), handlings(), cv=LeaveOneOut(), scoring=scoring, error_score="raise"
    )
    assert scores.shape == (4,) and np.isfinite(scores).all()
    for left_out, score in enumerate(scores):
        rest = [d for i, d in enumerate(handlings()) if i != left_out]
        model = hands_model().fit(rest)
        score_of = scoring or (lambda m, X: m.score(X))
        assert score == pytest.approx(score_of(model, [handlings()[left_out]]))


def test_folds_are_lists_of_demonstrations():
    scores = cross_val_score(hands_model(), handlings(6), cv=KFold(3), error_score="raise")
    assert scores.shape == (3,) and np.isfinite(scores).all()


def test_a_pipeline_aligns_and_learns():
    uneven = [*waves(2, length=30), *waves(2, length=45)]
    model = make_pipeline(LinearTimeNormalization(), TaskParameterizedGMM(4, blend=0.0))
    model.fit(uneven)
    assert model[-1].mixture_.group_size == 4
    [trajectory] = model[-1].predict(uneven[:1])
    assert trajectory.joints.shape == (30, 3)


def test_it_says_that_samples_are_no_rows():
    tags = TaskParameterizedGMM().__sklearn_tags__()
    assert tags.input_tags.two_d_array is False
    assert tags.target_tags.required is False
