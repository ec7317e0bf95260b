"""The pass over the points: both forms of the statistics and the gate against dense EM."""

import numpy as np
import pytest
import torch

from tests.support.em_reference import (
    assert_same_mixture,
    binned,
    columns,
    family,
    m_step,
    movements,
    one,
    reference_step,
    standardized,
)
from tpgmm_torch.em import sufficient_statistics
from tpgmm_torch.em.component_gating import Gate
from tpgmm_torch.em.e_step import e_step

K = 8


def random_data():
    rng = np.random.RandomState(1)
    centers = 3 * rng.randn(K, 7)
    return centers[rng.randint(0, K, 6000)] + rng.randn(6000, 7) @ rng.randn(7, 7)


def badly_scaled():
    return movements() * 10.0 ** np.arange(-4, 3) * [1, 1, 1, 1, 1, 1, 100] + 1e4


def nearly_singular():
    X = movements(noise=1e-5)
    X[:, 2] = X[:, 1] + 1e-5 * np.random.RandomState(2).randn(len(X))
    return X


DATA = {"random": random_data, "badly scaled": badly_scaled, "singular": nearly_singular}


@pytest.mark.parametrize("form", ["packed", "whitened"])
@pytest.mark.parametrize("name", DATA)
def test_iterations_equal_the_reference(name, form, monkeypatch):
    many = 0 if form == "packed" else 10**9
    monkeypatch.setattr(sufficient_statistics, "MANY_COMPONENTS", many)
    points, units = standardized(DATA[name]())
    lambdas = family(units)
    blocks = columns(points)
    parameters = binned(points, lambdas, K)
    gate, previous = Gate(), None
    for _ in range(6):
        expected, bound = reference_step(parameters, blocks, lambdas)
        previous = e_step(one(parameters), points, gate=gate, previous=previous)
        assert float(previous.bound) == pytest.approx(bound, rel=1e-9, abs=1e-9)
        parameters = m_step(previous, lambdas)
        assert_same_mixture(parameters, expected)


@pytest.mark.parametrize("covariance_type", ["full", "tied", "diag", "spherical"])
@pytest.mark.parametrize("group_size", [1, 5])
def test_all_families_and_groups_equal_the_reference(covariance_type, group_size):
    points, units = standardized(movements(), group_size=group_size)
    lambdas = family(units, covariance_type=covariance_type)
    blocks = columns(points)
    parameters = lambdas.admit(binned(points, lambdas, K))
    gate, previous = Gate(), None
    for _ in range(4):
        expected, bound = reference_step(parameters, blocks, lambdas, group_size)
        previous = e_step(
            one(parameters), points, group_size=group_size, gate=gate, previous=previous
        )
        assert float(previous.bound) == pytest.approx(bound, rel=1e-9)
        parameters = m_step(previous, lambdas)
        assert_same_mixture(parameters, expected)


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


def two_clocks():
    """Points at two instants only."""
    X = movements()
    X[:, [0, 3]] = np.round(X[:, [0, 3]])
    return X


def shuffled():
    return np.random.RandomState(0).permutation(movements())


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@pytest.mark.parametrize(
    "data",
    [movements, constant_time, outliers, two_clocks, shuffled,
     time_runs_backwards_in_the_other_block, badly_scaled, nearly_singular],
)  # fmt: skip
def test_the_gate_does_not_show(data, dtype, monkeypatch):
    monkeypatch.setattr("tpgmm_torch.em.points.CHUNK_SIZE", {"cpu": 2**13})
    points, units = standardized(data(), dtype)
    lambdas = family(units, dtype=dtype)
    parameters = binned(points, lambdas, K)
    gate, previous = Gate(), None
    tolerance = {torch.float64: 1e-9, torch.float32: 1e-5}[dtype]
    for _ in range(8):
        previous = e_step(one(parameters), points, gate=gate, previous=previous)
        dense = e_step(one(parameters), points)
        assert float(previous.bound) == pytest.approx(
            float(dense.bound), rel=tolerance, abs=tolerance
        )
        after = [m_step(each, lambdas) for each in (previous, dense)]
        assert_same_mixture(*after, tolerance)
        parameters = after[0]


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
        points, units = standardized(X, dtype)
        lambdas = family(units, 2e-6)
        parameters = binned(standardized(X)[0], lambdas, 40)
        gate, previous = Gate(), None
        for _ in range(3):
            previous = e_step(one(parameters), points, gate=gate, previous=previous)
            parameters = m_step(previous, lambdas)
        results.append((parameters, float(previous.bound)))
    (exact, bound), (single, other) = results
    assert other == pytest.approx(bound, rel=1e-4)
    for factor, covariance in zip(exact.factors, single.covariances, strict=True):
        inverse = torch.linalg.inv(factor)
        seen = inverse @ covariance @ inverse.mT  # the identity, if they agree
        assert float((seen - torch.eye(len(seen[0]))).abs().max()) < 1e-4
