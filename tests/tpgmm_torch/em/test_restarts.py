"""Several ascents that share their passes: each as if it were alone, and interrupted ones."""

import copy
from itertools import pairwise

import numpy as np
import pytest
import torch

from tests.support.em_reference import (
    assert_same_mixture,
    binned,
    counted_passes,
    family,
    movements,
    standardized,
)
from tpgmm_torch.em.ascent import Run, ascend
from tpgmm_torch.em.block_gaussians import Parameters

K = 6


def jittered(parameters, seed):
    rng = np.random.RandomState(seed)
    noise = (0.1 * torch.from_numpy(rng.randn(*mean.shape)) for mean in parameters.means)
    means = tuple(mean + one for mean, one in zip(parameters.means, noise, strict=True))
    return Parameters(parameters.weights, means, parameters.factors)


def with_a_component_far_away(parameters):
    means = tuple(mean.clone() for mean in parameters.means)
    for mean in means:
        mean[0] += 1e3
    return Parameters(parameters.weights, means, parameters.factors)


def problem(reg_covar=1e-6, n_points=6000, dtype=torch.float64):
    points, units = standardized(movements(n_points), dtype)
    lambdas = family(units, reg_covar, dtype=dtype)
    return points, lambdas, binned(points, lambdas, K)


def starts(parameters):
    jitter = [jittered(parameters, seed) for seed in range(3)]
    return [parameters, *jitter, with_a_component_far_away(parameters)]


def runs_of(mixtures):
    return [Run(one, np.random.RandomState(seed)) for seed, one in enumerate(mixtures)]


def assert_same_runs(actual, expected, tolerance=1e-9):
    for own, other in zip(actual, expected, strict=True):
        assert own.n_iter == other.n_iter
        assert own.converged == other.converged
        assert own.floored == other.floored
        assert own.replaced == other.replaced
        np.testing.assert_allclose(own.bounds, other.bounds, rtol=tolerance)
        assert_same_mixture(own.parameters, other.parameters, tolerance)


@pytest.mark.parametrize("reg_covar", [1e-6, 1e-1], ids=["added", "floored"])
@pytest.mark.parametrize("n_points", [6000, 2000], ids=["packed", "whitened"])
def test_together_they_do_what_each_does_alone(n_points, reg_covar):
    points, lambdas, parameters = problem(reg_covar, n_points)
    settings = {"tol": 1e-3, "max_iter": 40}
    together, alone = (runs_of(starts(lambdas.admit(parameters))) for _ in range(2))
    ascend(together, points, lambdas, **settings)
    for run in alone:
        ascend([run], points, lambdas, **settings)
    assert_same_runs(together, alone, 1e-8 if reg_covar == 1e-1 else 1e-9)
    assert len({run.n_iter for run in together}) > 1
    assert together[-1].replaced
    assert not together[0].replaced
    assert any(run.floored for run in together) == (reg_covar == 1e-1)
    for run in together:
        assert all(later >= earlier - 1e-9 for earlier, later in pairwise(run.bounds))


def test_one_pass_serves_all(monkeypatch):
    points, lambdas, parameters = problem()
    passes = counted_passes(monkeypatch)
    runs = runs_of([parameters, jittered(parameters, 0), jittered(parameters, 1)])
    ascend(runs, points, lambdas, tol=1e-3, max_iter=30)
    assert passes[0] == 3
    assert len(passes) == 1 + max(run.n_iter for run in runs)
    assert sorted(passes, reverse=True) == passes
    assert sum(passes) == 3 + sum(run.n_iter for run in runs)


def test_interrupted_runs_go_on_as_if_nothing_had_happened():
    points, lambdas, parameters = problem()
    mixtures = starts(parameters)
    whole, halfway = runs_of(mixtures), runs_of(mixtures)
    ascend(whole, points, lambdas, tol=1e-4, max_iter=20)
    saved = []
    ascend(
        halfway,
        points,
        lambdas,
        tol=1e-4,
        max_iter=20,
        after=lambda runs: saved.append(copy.deepcopy(list(runs))),
    )
    assert_same_runs(halfway, whole)
    assert [run.n_iter for run in saved[0]] == [1] * 5
    for stop in (0, 2, 9):
        ascend(saved[stop], points, lambdas, tol=1e-4, max_iter=20)
        assert_same_runs(saved[stop], whole)


def test_runs_that_are_finished_stay_as_they_are():
    points, lambdas, parameters = problem()
    [run] = runs_of([parameters])
    ascend([run], points, lambdas, tol=1e-3, max_iter=50)
    assert run.converged
    before = copy.deepcopy(run)
    ascend([run], points, lambdas, tol=1e-3, max_iter=100)
    assert_same_runs([run], [before], 0)


def test_float32_restarts_agree_with_float64():
    bounds = []
    parameters = problem(1e-5)[2]
    for dtype in (torch.float64, torch.float32):
        points, lambdas, _ = problem(1e-5, dtype=dtype)
        runs = runs_of([parameters, jittered(parameters, 0)])
        ascend(runs, points, lambdas, tol=0.0, max_iter=5)
        bounds.append([run.bound for run in runs])
    np.testing.assert_allclose(*bounds, rtol=1e-4)
