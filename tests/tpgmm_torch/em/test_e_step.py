"""The pass over the points: both forms of the statistics and the gate against dense EM."""

import math

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
    reference_joint,
    reference_step,
    standardized,
)
from tpgmm_torch.em import sufficient_statistics
from tpgmm_torch.em.component_gating import Gate
from tpgmm_torch.em.e_step import e_step, log_densities, normalize
from tpgmm_torch.em.parameters import Parameters

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


@pytest.mark.parametrize("members", [None, "folds"])
@pytest.mark.parametrize("group_size", [1, 5])
@pytest.mark.parametrize("gated", [False, True])
def test_mixtures_side_by_side_are_each_their_own(members, group_size, gated, monkeypatch):
    """Moments and bounds of S mixtures from their members, as of the definition."""
    monkeypatch.setattr("tpgmm_torch.em.points.CHUNK_SIZE", {"cpu": 2**12})
    points, units = standardized(movements(1500), group_size=group_size)
    lambdas = family(units)
    first = binned(points, lambdas, K)
    shifted = tuple(mean + 0.1 for mean in first.means)
    mixtures = [first, Parameters(first.weights, shifted, first.factors)]
    chosen = torch.ones(2, 1500, dtype=torch.bool)
    if members is not None:
        chosen[0, 3::10] = chosen[1, 0::5] = chosen[1, 1::5] = False
    found = e_step(
        Parameters.stack(mixtures), points, group_size=group_size,
        members=None if members is None else chosen, gate=Gate() if gated else None,
    )  # fmt: skip
    assert found.least.shape == (2, len(list(points)))
    for s, parameters in enumerate(mixtures):
        own = chosen[s]
        joint = reference_joint(parameters, columns(points)).unflatten(0, (-1, group_size))
        counted = own.view(-1, group_size, 1)
        mean = (joint * counted).sum(1) / counted.sum(1).clamp(min=1)
        joint = mean.repeat_interleave(group_size, 0)
        density = torch.logsumexp(joint, 1)
        gamma = torch.softmax(joint, 1) * own[:, None]
        assert float(found.n_points[s]) == own.sum()
        assert float(found.bound[s]) == pytest.approx(float(density[own].mean()), rel=1e-10)
        torch.testing.assert_close(found.mass[s], gamma.sum(0), rtol=1e-9, atol=1e-9)
        sizes = [chunk[0].shape[1] for chunk in points]
        lowest = [
            float(part[counted].min())
            for part, counted in zip(density.split(sizes), own.split(sizes), strict=True)
        ]
        np.testing.assert_allclose(found.least[s], lowest, rtol=1e-10)
        for j, x in enumerate(columns(points)):
            y = torch.linalg.solve_triangular(
                parameters.factors[j], (x - parameters.means[j][:, None]).mT, upper=False
            )
            y = torch.cat([y, torch.ones_like(y[:, :1])], 1)
            expected = torch.einsum("nk,kan,kbn->kab", gamma, y, y)
            torch.testing.assert_close(found.moments[j][s], expected, rtol=1e-8, atol=1e-8)


def test_expectations_are_taken_apart_and_replaced():
    points, units = standardized(movements(600))
    start = binned(points, family(units), K)
    far = tuple(mean + 1.0 for mean in start.means)
    mixtures = [start, Parameters(start.weights, far, start.factors), start]
    found = e_step(Parameters.stack(mixtures), points)
    part = found[torch.tensor([1, 2])]
    assert torch.equal(part.bound, found.bound[1:])
    assert torch.equal(part.moments[1], found.moments[1][1:])
    assert torch.equal(part.parameters.means[0], found.parameters.means[0][1:])
    assert torch.equal(part.least, found.least[1:])
    assert torch.equal(part.n_points, found.n_points[1:])
    other = found.replaced(torch.tensor([2]), part[:1])
    for name in ("bound", "least", "n_points"):
        assert torch.equal(getattr(other, name)[2], getattr(found, name)[1])
        assert torch.equal(getattr(other, name)[:2], getattr(found, name)[:2])
    assert torch.equal(other.moments[0][2], found.moments[0][1])
    assert torch.equal(other.parameters.weights[2], found.parameters.weights[1])
    assert torch.equal(other.parameters.means[1][2], found.parameters.means[1][1])
    assert other.rounding == part.rounding == found.rounding == 2e-13
    assert torch.equal(found.bound[2], found.bound[0])  # it stays as it was


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
def test_responsibilities_do_not_underflow(dtype):
    """What is smaller than exp(-500), in float32 exp(-60), counts as that: no denormals."""
    least = {torch.float64: -500.0, torch.float32: -60.0}[dtype]
    joint = torch.tensor([[[0.0, -1e5], [-1e4, -1e5 + 1.0], [-2.0, -1e5]]], dtype=dtype)
    expected = joint[0].clone()
    responsibilities, densities, lowest = normalize(joint, None)
    torch.testing.assert_close(densities[0], torch.logsumexp(expected, 0))
    torch.testing.assert_close(responsibilities.sum(1), torch.ones(1, 2, dtype=dtype))
    total = 1 + math.exp(-2.0)
    assert float(responsibilities[0, 1, 0]) == pytest.approx(math.exp(least) / total, rel=1e-4)
    assert lowest == pytest.approx([float(densities.min())])


def test_points_of_other_folds_do_not_count():
    joint = torch.zeros(2, 3, 4, dtype=torch.float64)
    joint[0, :, 1] = -50.0
    members = torch.tensor([[True, False, True, True], [True, True, False, False]])
    responsibilities, densities, least = normalize(joint, members)
    torch.testing.assert_close(
        responsibilities, (members[:, None] / 3.0).expand(2, 3, 4).double()
    )
    torch.testing.assert_close(densities, members.double() * math.log(3))
    assert least == pytest.approx([math.log(3)] * 2)


def test_log_densities_are_those_of_the_mixture():
    points, units = standardized(movements(600), group_size=5)
    parameters = binned(points, family(units), K)
    [chunk] = points
    joint = reference_joint(parameters, columns(points))
    torch.testing.assert_close(log_densities(parameters, chunk), torch.logsumexp(joint, 1))
    members = torch.arange(600) % 5 != 2
    counted = members.view(-1, 5, 1)
    mean = (joint.unflatten(0, (-1, 5)) * counted).sum(1) / 4
    expected = torch.logsumexp(mean, 1).repeat_interleave(5).masked_fill(~members, math.inf)
    torch.testing.assert_close(log_densities(parameters, chunk, 5, members), expected)
    mean = joint.unflatten(0, (-1, 5)).mean(1)
    expected = torch.logsumexp(mean, 1).repeat_interleave(5)
    torch.testing.assert_close(log_densities(parameters, chunk, 5), expected)


def test_densities_in_float32_are_summed_in_float64(monkeypatch):
    points, units = standardized(movements(), torch.float32)
    parameters = binned(points, family(units), K)
    densities = []

    def recorded(joint, members):
        result = normalize(joint, members)
        assert result[1].dtype == torch.float32
        densities.append(result[1].double())
        return result

    monkeypatch.setattr("tpgmm_torch.em.e_step.normalize", recorded)
    found = e_step(one(parameters), points)
    expected = torch.cat(densities, 1).mean(1)
    torch.testing.assert_close(found.bound, expected, rtol=1e-13, atol=0)
