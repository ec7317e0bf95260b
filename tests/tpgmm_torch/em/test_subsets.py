"""Mixtures learned from some of the rows each, in common passes: each as if it were alone."""

import copy
import warnings

import numpy as np
import pytest
import torch

from tests.support.blocks import COVARIANCE_TYPES
from tests.support.em_reference import WIDTHS, counted_passes, movements
from tpgmm_torch.em.points import StoredPoints, Subset
from tpgmm_torch.exceptions import ConvergenceWarning, DataError, DegenerateComponentWarning
from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture, fit_subsets

pytestmark = pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.ConvergenceWarning")

K = 6


def mixture(**settings):
    defaults = {"blocks": WIDTHS, "random_state": 0, "max_iter": 30}
    return BlockGaussianMixture(K, **{**defaults, **settings})


def start_of(model, means):
    """The settings by which EM starts from a mixture, with other means."""
    parts = {"weights": model.weights_, "means": means, "covariances": model.covariances_}
    return {f"{name}_init": part for name, part in parts.items()}


def folds(n_rows, n_folds=4):
    """Every fold leaves out other ones of ten rows, the same in each ten."""
    left_out = [[0, 1, 2], [3], [4, 5, 6, 7], [9]][:n_folds]
    one = np.array([[place not in out for place in range(10)] for out in left_out])
    return np.tile(one, n_rows // 10)


def together(X, members, group_size=1, sizes=None, **settings):
    sizes = [1] * len(members) if sizes is None else sizes
    models = [mixture(group_size=size, **settings) for size in sizes]
    fit_subsets(models, X, members, group_size)
    return models


def alone(X, members, sizes=None, **settings):
    sizes = [1] * len(members) if sizes is None else sizes
    return [
        mixture(group_size=size, **settings).fit(X[chosen])
        for size, chosen in zip(sizes, members, strict=True)
    ]


def assert_same(ours, expected, tolerance=1e-9):
    close = {"rtol": tolerance, "atol": tolerance}
    for one, other in zip(ours, expected, strict=True):
        assert one.n_iter_ == other.n_iter_
        assert one.converged_ == other.converged_
        assert one.n_features_in_ == other.n_features_in_
        torch.testing.assert_close(one.weights_, other.weights_, **close)
        torch.testing.assert_close(one.means_, other.means_, **close)
        torch.testing.assert_close(one.covariances_, other.covariances_, **close)
        np.testing.assert_allclose(one.lower_bounds_, other.lower_bounds_, **close)


@pytest.mark.parametrize("n_points", [6000, 2000], ids=["packed", "whitened"])
@pytest.mark.parametrize("covariance_type", COVARIANCE_TYPES)
def test_each_learns_what_it_would_alone(covariance_type, n_points):
    X = movements(n_points) * [1e3, 1e-3, 1.0, 1e3, 1.0, 50.0, 1e-2] + 7.0
    members = folds(n_points)
    settings = {"covariance_type": covariance_type, "reg_covar": 1e-4}
    assert_same(together(X, members, **settings), alone(X, members, **settings))


@pytest.mark.parametrize("init_params", ["time", "kmeans", "random"])
def test_starts_are_drawn_from_the_own_rows_in_their_own_units(init_params):
    X = movements(2000) * [1.0, 5.0, 1e-3, 1.0, 1e2, 1.0, 1.0]
    members, settings = folds(2000), {"init_params": init_params, "n_init": 3}
    assert_same(together(X, members, **settings), alone(X, members, **settings))


def test_a_start_that_is_given_serves_all():
    X = movements(2000)
    first = mixture().fit(X)
    members, start = folds(2000), start_of(first, [mean + 0.05 for mean in first.means_])
    assert_same(together(X, members, **start), alone(X, members, **start))


@pytest.mark.parametrize("n_points", [6000, 2000], ids=["packed", "whitened"])
def test_of_a_group_those_that_belong_share_a_responsibility(n_points):
    X, members = movements(n_points, noise=0.2), folds(n_points)
    sizes = members[:, :10].sum(1).tolist()
    assert sizes == [7, 9, 6, 9]
    ours = together(X, members, 10, sizes)
    assert_same(ours, alone(X, members, sizes))
    # and that is something else than one for each point
    assert abs(ours[0].means_[0] - together(X, members)[0].means_[0]).max() > 1e-6


def test_rows_in_any_order_are_the_same_rows():
    X, members = movements(6000), folds(6000)
    order = np.random.RandomState(0).permutation(6000)
    shuffled = together(X[order], members[:, order])
    assert_same(shuffled, alone(X, members))


def test_a_chunk_of_which_a_mixture_has_nothing():
    """Long stretches belong to the first one alone: the others' gates open for nobody."""
    X = movements(20000)
    members = np.ones((3, 20000), dtype=bool)
    members[1:, 8000:] = False
    members[2, :100] = False
    assert_same(together(X, members), alone(X, members))


def test_float32_is_as_exact_as_alone():
    X, members = movements(6000), folds(6000)
    settings = {"dtype": "float32", "reg_covar": 1e-4, "max_iter": 5, "tol": 0.0}
    assert_same(together(X, members, **settings), alone(X, members, **settings), 1e-3)


def test_a_component_without_data_is_placed_among_the_own_rows():
    X, members = movements(6000), folds(6000)
    far = mixture().fit(X)
    means = [mean.clone() for mean in far.means_]
    for mean in means:
        mean[0] += 1e3
    start = start_of(far, means)
    with warnings.catch_warnings(record=True) as ours:
        warnings.simplefilter("always", DegenerateComponentWarning)
        found = together(X, members, **start)
    with warnings.catch_warnings(record=True) as theirs:
        warnings.simplefilter("always", DegenerateComponentWarning)
        expected = alone(X, members, **start)
    assert_same(found, expected)
    said = [str(warning.message) for warning in ours]
    assert said == [str(warning.message) for warning in theirs]
    assert ["(left: 0 of 4200 points)" in text for text in said] == [True, False, False, False]


def test_a_regularization_that_becomes_a_floor_is_the_own_one():
    X, members = movements(6000), folds(6000)
    settings = {"reg_covar": 1e-1, "max_iter": 60}
    assert_same(together(X, members, **settings), alone(X, members, **settings), 1e-8)


def test_regularizations_may_differ():
    X, members = movements(2000), folds(2000, 2)
    amounts = (1e-6, 1e-2)
    ours = [mixture(reg_covar=amount) for amount in amounts]
    fit_subsets(ours, X, members)
    expected = [
        mixture(reg_covar=amount).fit(X[chosen])
        for amount, chosen in zip(amounts, members, strict=True)
    ]
    assert_same(ours, expected)


def test_one_pass_serves_all(monkeypatch):
    passes = counted_passes(monkeypatch)
    ours = together(movements(6000), folds(6000))
    assert passes[0] == 4
    assert len(passes) == 1 + max(model.n_iter_ for model in ours)
    assert len({model.n_iter_ for model in ours}) > 1  # some are done before others


def test_what_does_not_converge_says_so():
    with pytest.warns(ConvergenceWarning, match="did not converge in 2 iterations"):
        together(movements(2000), folds(2000, 1), max_iter=2)


def test_too_few_rows_are_refused():
    X, members = movements(2000), folds(2000, 2)
    members[1] = False
    members[1, :3] = True
    with pytest.raises(DataError, match=r"n_components=6, but the data hold only 3 distinct"):
        together(X, members)


def test_a_subset_is_a_source_of_points_itself():
    chunks = [(torch.arange(6.0).view(2, 3),), (torch.arange(4.0).view(2, 2),)]
    points = StoredPoints(copy.deepcopy(chunks))
    part = Subset(points, torch.tensor([True, False, True, False, False]), group_size=2)
    assert (part.n_points, part.total, part.offset, part.widths) == (2, 2, 0, (1,))
    [(only,)] = part  # nothing of the second chunk belongs to it
    assert torch.equal(only, chunks[0][0][:, [0, 2]])
