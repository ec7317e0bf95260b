"""Steps and loop of EM against the definition: chunks, gate, floor, reseeding."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support.blocks import COVARIANCE_TYPES
from tests.support.em_reference import (
    WIDTHS,
    assert_same_mixture,
    binned,
    columns,
    family,
    movements,
    nearly_singular,
    points_of,
    reference_joint,
    reference_step,
)
from tpgmm_torch.mixture import expectation_maximization as em
from tpgmm_torch.mixture.expectation_maximization import (
    Parameters,
    dead_components,
    e_step,
    expectation_maximization,
    log_joint,
    m_step,
    restart_components,
)

K = 8


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    monkeypatch.setattr("tpgmm_torch.mixture.points.CHUNK_SIZE", {"cpu": 2**12})


def badly_scaled():
    return movements() * 10.0 ** np.arange(-4, 3) * [1, 1, 1, 1, 1, 1, 100] + 1e4


def constant_time():
    X = movements()
    X[:, [0, 3]] = 7.0
    return X


def outliers():
    X = movements()
    X[[100, 3000], 1] = 1e3
    X[17, 0] = -50.0
    return X


def time_runs_backwards_in_the_other_block():
    X = movements()
    X[:, 3] = X[::-1, 3]
    return X


def shuffle():
    return np.random.RandomState(0).permutation(movements())


DATA = [movements, badly_scaled, nearly_singular, constant_time, outliers, shuffle,
        time_runs_backwards_in_the_other_block]  # fmt: skip


@pytest.mark.parametrize("data", DATA)
def test_gated_iterations_equal_the_reference(data):
    points, lambdas = points_of(data()), family()
    blocks, parameters, least = columns(points), binned(points, lambdas, K), None
    for _ in range(6):
        expected, bound = reference_step(parameters, blocks, lambdas)
        found = e_step(parameters, points, least)
        assert found.bound == pytest.approx(bound, rel=1e-9, abs=1e-9)
        parameters, least = m_step(found, lambdas, floor=False), found.least
        # what cancels in a covariance of two nearly equal columns has fewer digits
        tolerance = 1e-6 if data is nearly_singular else 1e-8
        assert_same_mixture(parameters, expected, tolerance)


@pytest.mark.parametrize("covariance_type", COVARIANCE_TYPES)
@pytest.mark.parametrize("group_size", [1, 5])
def test_all_families_and_groups_equal_the_reference(covariance_type, group_size):
    points = points_of(movements(), group_size=group_size)
    lambdas = family(1e-6, covariance_type)
    parameters, least = lambdas.admit(binned(points, lambdas, K)), None
    for _ in range(4):
        expected, bound = reference_step(parameters, columns(points), lambdas, group_size)
        found = e_step(parameters, points, least)
        assert found.bound == pytest.approx(bound, rel=1e-9)
        parameters, least = m_step(found, lambdas, floor=False), found.least
        assert_same_mixture(parameters, expected)


def evaluate(monkeypatch):
    """How many components each chunk was evaluated for, in a list that grows."""
    counts = []

    def count_call(blocks, maps, peaks, group_size=1):
        counts.append(len(peaks))
        return log_joint(blocks, maps, peaks, group_size)

    monkeypatch.setattr(em, "log_joint", count_call)
    return counts


def test_along_time_most_components_are_left_out(monkeypatch):
    counts = evaluate(monkeypatch)
    points = points_of(movements())
    parameters = binned(points, family(), 20)
    least = e_step(parameters, points).least
    assert counts == [20] * len(least)
    counts.clear()
    e_step(parameters, points, least)
    assert len(counts) == len(least) and np.mean(counts) < 5


@pytest.mark.parametrize("shift", [1e-3, 0.5])
def test_a_wrong_guess_is_noticed(shift, monkeypatch):
    points, lambdas = points_of(movements()), family()
    start = binned(points, lambdas, 20)
    least = e_step(start, points).least
    moved = Parameters(start.weights, tuple(m + shift for m in start.means), start.covariances)
    counts = evaluate(monkeypatch)
    gated = e_step(moved, points, least)
    assert (len(counts) > len(least)) == (shift == 0.5)
    dense = e_step(moved, points)
    assert gated.bound == pytest.approx(dense.bound, rel=1e-12)
    torch.testing.assert_close(gated.least, dense.least)
    for own, expected in zip((gated.mass, *gated.sums), (dense.mass, *dense.sums), strict=True):
        torch.testing.assert_close(own, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("narrow", [1e-1, 1e-2, 1e-3])
def test_float32_keeps_narrow_covariances(narrow):
    """Components with sigma / range down to 1e-3, narrow in rotated directions."""
    rng = np.random.RandomState(0)
    time = np.sort(rng.rand(20_000))
    plane = np.linalg.qr(rng.randn(7, 7))[0]
    X = np.stack([np.sin((i + 1) * 3 * time + i) for i in range(7)], 1)
    X += 2 * narrow * (rng.randn(len(X), 7) * [1, 1, 1, 3, 3, 3, 3]) @ plane
    X = X.astype(np.float32).astype(np.float64)
    results = []
    for dtype in (torch.float64, torch.float32):
        points, lambdas = points_of(X, dtype), family(2e-6)
        parameters, least = binned(points_of(X), lambdas, 40), None
        for _ in range(3):
            found = e_step(parameters, points, least)
            parameters, least = m_step(found, lambdas, floor=False), found.least
        results.append((parameters, found.bound))
    (exact, bound), (single, other) = results
    assert other == pytest.approx(bound, rel=1e-4)
    for expected, covariance in zip(exact.covariances, single.covariances, strict=True):
        inverse = torch.linalg.inv(torch.linalg.cholesky(expected))
        seen = inverse @ covariance @ inverse.mT  # the identity, if they agree
        assert float((seen - torch.eye(len(seen[0]))).abs().max()) < 2e-4


def test_responsibilities_of_far_components_are_no_denormal_numbers():
    points = points_of(movements())
    start = binned(points, family(), 3)
    far = Parameters(start.weights, tuple(m * 1e3 for m in start.means), start.covariances)
    mass = e_step(far, points).mass
    assert float(mass.sum()) == pytest.approx(points.total)
    assert float(mass.min()) >= points.total * np.finfo(np.float64).eps ** 2 / 3.1


def test_the_floor_is_the_most_likely_covariance_not_below_it():
    rng = np.random.RandomState(0)
    lambdas = family(0.5)
    scatter = torch.from_numpy(np.cov(rng.randn(3, 9) * [[0.3], [1.0], [2.0]]))[None]
    found = lambdas.regularize(scatter, 0, floor=True)[0]
    assert float(torch.linalg.eigvalsh(found - 0.5 * torch.eye(3)).min()) > -1e-12

    def likelihood(covariance):
        distance = torch.trace(torch.linalg.solve(covariance, scatter[0]))
        return -float(covariance.logdet() + distance)

    for seed in range(200):
        root = torch.from_numpy(np.random.RandomState(seed).randn(3, 3))
        for other in (found + 1e-3 * root @ root.mT, 0.5 * torch.eye(3) + root @ root.mT):
            assert likelihood(other) <= likelihood(found) + 1e-12
    added = lambdas.regularize(scatter, 0, floor=False)[0]
    torch.testing.assert_close(added, scatter[0] + 0.5 * torch.eye(3))


@pytest.mark.parametrize("covariance_type", COVARIANCE_TYPES)
def test_admitting_brings_into_the_family_and_above_the_floor(covariance_type):
    points, lambdas = points_of(movements()), family(0.2, covariance_type)
    start = binned(points, family(), K)
    admitted = lambdas.admit(start)
    for before, after in zip(start.covariances, admitted.covariances, strict=True):
        torch.testing.assert_close(lambdas.restrict(after, start.weights), after)
        values = torch.linalg.eigvalsh(lambdas.restrict(before, start.weights))
        torch.testing.assert_close(torch.linalg.eigvalsh(after), values.clamp(min=0.2))


def test_a_component_without_data_keeps_its_place_and_shape():
    points, lambdas = points_of(movements()), family()
    start = binned(points, lambdas, K)
    found = e_step(start, points)
    found.mass[3] = 0.0
    for own in found.sums:
        own[:, 3] = 0.0
    after = m_step(found, family(0.0), floor=False)
    for before, own in zip(start.means, after.means, strict=True):
        torch.testing.assert_close(own[3], before[3])
    for before, own in zip(start.covariances, after.covariances, strict=True):
        torch.testing.assert_close(own[3], before[3])


@pytest.mark.parametrize(("mass", "variance", "total", "dead"), [
    (500.0, 1.0, 1000, False),
    (500.0, 1e-4, 1000, False),  # narrow, but with data
    (2.0, 1e-4, 1000, True),  # the variance is the regularisation
    (2.0, 1.9e-4, 1000, True),
    (2.0, 2.1e-4, 1000, False),
    (2.1, 1e-4, 1000, False),
    (2.0, 1e-4, 6, False),  # there is not data enough for more
    (2.0, 1e-4, 7, True),
    (2e-12, 1.0, 1000, True),
    (3e-12, 1.0, 1000, False),
])  # fmt: skip
def test_components_without_mass_or_spread_are_dead(mass, variance, total, dead):
    points, lambdas = points_of(movements()), family(1e-4)
    found = e_step(binned(points, lambdas, 3), points)
    eyes = [variance * torch.eye(width).double().repeat(3, 1, 1) for width in WIDTHS]
    parameters = replace(found.parameters, covariances=tuple(eyes))
    mass = torch.tensor([400.0, mass, 300.0], dtype=torch.float64)
    points.total = total
    found = replace(found, parameters=parameters, mass=mass)
    assert dead_components(found, lambdas, points).tolist() == [False, dead, False]


@pytest.mark.parametrize("group_size", [1, 5])
def test_dead_components_start_at_badly_explained_points(group_size):
    """Not the very worst, which are often outliers: any of the worst twentieth."""
    points, lambdas = points_of(movements(2000), group_size=group_size), family()
    parameters = binned(points, lambdas, K)
    dead = torch.zeros(K, dtype=torch.bool)
    dead[[1, 4]] = True
    rows = torch.cat(columns(points), 1)
    order = reference_joint(parameters, columns(points), group_size).logsumexp(1).argsort()
    ranks = []
    for seed in range(30):
        found = restart_components(
            parameters, dead, parameters, points, np.random.RandomState(seed)
        )
        places = torch.cat(found.means, 1)
        torch.testing.assert_close(places[~dead], torch.cat(parameters.means, 1)[~dead])
        ranks += [int((rows[order] == place).all(1).nonzero()[0, 0]) for place in places[dead]]
    assert 80 < max(ranks) < 100
    assert 30 < np.median(ranks) < 70
    pairs = np.array(ranks).reshape(-1, 2)
    assert (pairs[:, 0] != pairs[:, 1]).all()  # no two at one point
    weights = torch.where(dead, 1 / K, parameters.weights)
    torch.testing.assert_close(found.weights, weights / weights.sum())
    alive = parameters.weights[~dead]
    for own, before in zip(found.covariances, parameters.covariances, strict=True):
        mean = (alive[:, None, None] * before[~dead]).sum(0) / alive.sum()
        torch.testing.assert_close(own[dead], mean.expand(2, -1, -1))
        torch.testing.assert_close(own[~dead], before[~dead])


def with_a_component_far_away(parameters):
    means = [mean.clone() for mean in parameters.means]
    for mean in means:
        mean[0] += 1e6
    return Parameters(parameters.weights, tuple(means), parameters.covariances)


def learn(start, points, lambdas, **settings):
    rng = np.random.RandomState(0)
    return expectation_maximization(start, points, lambdas, rng, **{"tol": 0.0, **settings})


@pytest.mark.parametrize(("measured", "counted"), [
    ([-1.0, -5.0], [-5.0]),  # the start, and what reseeding has lowered it to
    ([-1.0, -0.5], [-1.0]),
    ([-1.0, -5.0, -4.0, -3.0], [-5.0, -4.0]),
    ([-1.0, -0.5, -0.4, -0.3], [-1.0, -0.5, -0.4]),
])  # fmt: skip
def test_bounds_are_counted_from_where_reseeding_lowered_them(measured, counted, monkeypatch):
    points, lambdas = points_of(movements(2000)), family()
    start = with_a_component_far_away(binned(points, lambdas, K))
    bounds = iter(measured)

    def given(*arguments):
        return replace(e_step(*arguments), bound=next(bounds))

    monkeypatch.setattr(em, "e_step", given)
    fit = learn(start, points, lambdas, max_iter=len(measured) - 1)
    assert fit.reseedings == ["component(s) [0] in iteration 1"]
    assert fit.bounds == counted
    assert (fit.n_iter, fit.converged) == (len(measured) - 1, False)


def test_a_step_that_lowers_the_likelihood_even_so_is_undone(monkeypatch):
    points, lambdas = points_of(movements(2000)), family()
    start, bounds = binned(points, lambdas, K), iter([-1.0, -2.0, -3.0, -2.5, -1.5])
    floors = []

    def given(*arguments):
        return replace(e_step(*arguments), bound=next(bounds))

    def note_call(expectation, family, *, floor):
        floors.append(floor)
        return m_step(expectation, family, floor=floor)

    monkeypatch.setattr(em, "e_step", given)
    monkeypatch.setattr(em, "m_step", note_call)
    fit = learn(start, points, lambdas, tol=1e-6, max_iter=10)
    assert floors == [False, True, True]
    assert fit.converged and fit.bounds == [-1.0, -1.0]
    assert_same_mixture(fit.parameters, start, 0)
