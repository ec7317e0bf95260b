"""Which components count as dead, and where they start again."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support.em_reference import (
    WIDTHS,
    binned,
    columns,
    family,
    movements,
    one,
    reference_joint,
    standardized,
)
from tpgmm_torch.em import reseeding
from tpgmm_torch.em.e_step import e_step
from tpgmm_torch.em.parameters import Parameters
from tpgmm_torch.em.reseeding import dead_components, reseed, worst_points

K = 8


@pytest.fixture
def problem(monkeypatch):
    """Points in small chunks, the family, and a mixture of K components."""
    monkeypatch.setattr("tpgmm_torch.em.points.CHUNK_SIZE", {"cpu": 2**10})
    points, units = standardized(movements(2000))
    lambdas = family(units)
    return points, lambdas, binned(points, lambdas, K)


def density(points, parameters):
    return torch.logsumexp(reference_joint(parameters, columns(points)), 1)


def test_worst_points_are_the_worst(problem):
    points, _, parameters = problem
    rows = torch.cat(columns(points), 1)
    expected = rows[density(points, parameters).argsort()[:300]]
    torch.testing.assert_close(worst_points(parameters, points, 300), expected)
    assert worst_points(parameters, points, 10**5).shape == (points.total, sum(WIDTHS))


def test_worst_points_of_a_fold_are_its_own(problem):
    points, _, parameters = problem
    members = torch.arange(points.total) % 3 > 0
    rows = torch.cat(columns(points), 1)[members]
    expected = rows[density(points, parameters)[members].argsort()[:50]]
    found = worst_points(parameters, points, 50, members=members)
    torch.testing.assert_close(found, expected)
    assert len(worst_points(parameters, points, 10**5, members=members)) == len(rows)


def test_worst_points_of_groups_are_whole_groups():
    points, units = standardized(movements(2000), group_size=5)
    parameters = binned(points, family(units), K)
    joint = reference_joint(parameters, columns(points))
    grouped = torch.logsumexp(joint.unflatten(0, (-1, 5)).mean(1), 1)
    rows = torch.cat(columns(points), 1).unflatten(0, (-1, 5))
    expected = rows[grouped.argsort()[:6]].flatten(0, 1)
    torch.testing.assert_close(worst_points(parameters, points, 30, 5), expected)


def expectation(masses, n_points=1000.0, deviation=1.0):
    """Components in one block of two columns, with these masses and this deviation."""
    mass = torch.tensor([masses], dtype=torch.float64)
    count = mass.shape[1]
    factors = deviation * torch.eye(2, dtype=torch.float64).expand(1, count, 2, 2)
    moment = torch.zeros(1, count, 3, 3, dtype=torch.float64)
    moment[..., -1, -1] = mass
    points, units = standardized(np.random.RandomState(0).randn(50, 2), widths=(2,))
    lambdas = family(units, 1e-4)
    start = binned(points, lambdas, count)
    found = e_step(one(start), points)
    parameters = Parameters(found.parameters.weights, found.parameters.means, (factors,))
    n_points = torch.tensor([n_points], dtype=torch.float64)
    return replace(found, parameters=parameters, moments=(moment,), n_points=n_points), lambdas


@pytest.mark.parametrize(
    ("mass", "deviation", "n_points", "dead"),
    [
        (500.0, 1.0, 1000.0, False),
        (500.0, 1e-2, 1000.0, False),  # narrow, but with data
        (2.0, 1e-2, 1000.0, True),  # deviation^2 is the regularisation
        (2.0, 1.4e-2, 1000.0, True),
        (2.0, 1.5e-2, 1000.0, False),
        (2.1, 1e-2, 1000.0, False),
        (2.0, 1e-2, 6.0, False),  # there is not data enough for more
        (2.0, 1e-2, 7.0, True),
        (0.0, 1.0, 1000.0, True),
        (2e-12, 1.0, 1000.0, True),
        (3e-12, 1.0, 1000.0, False),
        (2e-12, 1.0, 6.0, False),
    ],
)
def test_components_without_mass_or_spread_are_dead(mass, deviation, n_points, dead):
    found, lambdas = expectation([400.0, mass, 300.0], n_points, deviation)
    assert dead_components(found, lambdas, torch.float64).tolist() == [[False, dead, False]]


def test_in_float32_less_is_nothing():
    found, lambdas = expectation([400.0, 1e-3, 300.0])
    assert dead_components(found, lambdas, torch.float32)[0, 1]
    assert not dead_components(found, lambdas, torch.float64)[0, 1]


def reseeded(problem, seed=0, members=None, dead=(1, 4)):
    points, _, parameters = problem
    flags = torch.zeros(K, dtype=torch.bool)
    flags[list(dead)] = True
    rng = np.random.RandomState(seed)
    return flags, reseed(parameters, flags, parameters, points, rng, members=members)


def test_dead_components_start_at_points_with_the_mean_covariance(problem):
    points, _, parameters = problem
    dead, found = reseeded(problem)
    rows = torch.cat(columns(points), 1)
    places = torch.cat(found.means, 1)
    for place in places[dead]:
        assert (rows == place).all(1).any()
    torch.testing.assert_close(places[~dead], torch.cat(parameters.means, 1)[~dead])
    weights = torch.where(dead, 1 / K, parameters.weights)
    torch.testing.assert_close(found.weights, weights / weights.sum())
    alive = parameters.weights[~dead]
    for own, before in zip(found.covariances, parameters.covariances, strict=True):
        mean = (alive[:, None, None] * before[~dead]).sum(0) / alive.sum()
        torch.testing.assert_close(own[dead], mean.expand(2, -1, -1))
        torch.testing.assert_close(own[~dead], before[~dead])


def test_they_are_drawn_among_the_worst_twentieth(problem):
    """Not the very worst, which are often outliers: any of the hundred worst of 2000."""
    points, _, parameters = problem
    rows = torch.cat(columns(points), 1)
    order = density(points, parameters).argsort()
    rank = {tuple(rows[index].tolist()): place for place, index in enumerate(order.tolist())}
    ranks = [
        rank[tuple(torch.cat(reseeded(problem, seed)[1].means, 1)[k].tolist())]
        for seed in range(30)
        for k in (1, 4)
    ]
    assert max(ranks) < 100
    assert max(ranks) > 80
    assert 30 < np.median(ranks) < 70
    pairs = np.array(ranks).reshape(-1, 2)
    assert (pairs[:, 0] != pairs[:, 1]).all()  # no two at one point


def test_candidates_are_bounded(problem, monkeypatch):
    points, _, parameters = problem
    monkeypatch.setattr(reseeding, "MOST_CANDIDATES", 3)
    worst = worst_points(parameters, points, 3)
    for seed in range(10):
        places = torch.cat(reseeded(problem, seed)[1].means, 1)[[1, 4]]
        assert all((worst == place).all(1).any() for place in places)


def test_of_few_points_there_are_as_many_candidates_as_dead_components(problem):
    _, _, _ = problem
    members = torch.zeros(problem[0].total, dtype=torch.bool)
    members[[5, 700, 1500]] = True
    rows = torch.cat(columns(problem[0]), 1)[members]
    worst = worst_points(problem[2], problem[0], 2, members=members)
    places = torch.cat(reseeded(problem, members=members)[1].means, 1)[[1, 4]]
    assert sorted(places.tolist()) == sorted(worst.tolist())
    assert all((rows == place).all(1).any() for place in places)
