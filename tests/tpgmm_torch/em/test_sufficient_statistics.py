"""Both forms of the statistics against sums in extended precision, and where each is taken."""

import numpy as np
import pytest
import torch

from tests.support.em_reference import binned, columns, family, movements, standardized
from tpgmm_torch.em import sufficient_statistics as statistics
from tpgmm_torch.em.sufficient_statistics import PackedStatistics, WhitenedStatistics
from tpgmm_torch.em.whitening import Whitener

FORMS = [PackedStatistics, WhitenedStatistics]
EPS = torch.finfo(torch.float64).eps


def problem(n_components=6, n_points=3000, noise=0.05, dtype=torch.float64):
    points, units = standardized(movements(n_points, noise), dtype)
    parameters = binned(points, family(units), n_components)
    rng = np.random.RandomState(0)
    responsibilities = torch.from_numpy(rng.dirichlet(np.ones(n_components), n_points).T.copy())
    return points, parameters, responsibilities.to(dtype)


def exact(parameters, points, responsibilities):
    """Log-densities (K, n) and moments in numpy's extended precision."""
    long = np.longdouble
    joint, moments = np.log(parameters.weights.numpy().astype(long))[:, None], []
    for x, mean, factor in zip(
        columns(points), parameters.means, parameters.factors, strict=True
    ):
        lower = factor.numpy().astype(long)
        y = x.numpy().astype(long) - mean.numpy().astype(long)[:, None]  # (K, n, D)
        for row in range(y.shape[2]):
            done = np.einsum("kj,knj->kn", lower[:, row, :row], y[:, :, :row])
            y[:, :, row] = (y[:, :, row] - done) / lower[:, row, row, None]
        size = np.log(np.stack([np.diag(one) for one in lower])).sum(1)
        size += y.shape[2] * np.log(2 * long(np.pi)) / 2
        joint = joint - (y**2).sum(2) / 2 - size[:, None]
        y = np.concatenate([y, np.ones_like(y[:, :, :1])], 2)
        moments.append(
            np.einsum("kn,kni,knj->kij", responsibilities.numpy().astype(long), y, y)
        )
    return joint, moments


def gathered(form, parameters, points, responsibilities, components=None):
    whitener = Whitener(parameters, points.dtype)
    sums, joint, start = form(whitener), [], 0
    for chunk in points:
        stop = start + chunk[0].shape[1]
        joint.append(sums.log_joint(chunk, components))
        own = responsibilities if components is None else responsibilities[components]
        sums.add(own[:, start:stop], components)
        start = stop
    return torch.cat(joint, 1), sums.moments(*sums.sums), statistics.sharpness(whitener)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("chunk_size", [2**10, 3 * 2**17])
def test_they_equal_sums_in_extended_precision(form, chunk_size, monkeypatch):
    """Rounding is that of the form: packed moments lose as many digits as 1 / sigma^2 has."""
    monkeypatch.setattr("tpgmm_torch.em.points.CHUNK_SIZE", {"cpu": chunk_size})
    points, parameters, responsibilities = problem()
    joint, moments, sharpness = gathered(form, parameters, points, responsibilities)
    expected_joint, expected_moments = exact(parameters, points, responsibilities)
    lost = float(sharpness.max()) if form is PackedStatistics else float(sharpness.max()) ** 0.5
    # coordinates reach 4 deviations: products of them 16, and so are whitened ones
    assert abs(joint.numpy() - expected_joint).max() < 64 * EPS * (
        lost + abs(expected_joint).max()
    )
    for own, expected in zip(moments, expected_moments, strict=True):
        size = np.maximum(expected[:, -1:, -1:], abs(expected).max((1, 2), keepdims=True))
        assert (abs(own.numpy() - expected) / size).max() < 64 * EPS * lost
        torch.testing.assert_close(own, own.mT, rtol=0, atol=0 if lost < 1e3 else 1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_some_components_are_those_of_all(form):
    points, parameters, responsibilities = problem()
    chosen = torch.tensor([4, 1])
    joint, moments, _ = gathered(form, parameters, points, responsibilities)
    some, own, _ = gathered(form, parameters, points, responsibilities, chosen)
    torch.testing.assert_close(some, joint[chosen], rtol=1e-10, atol=1e-8)
    for part, whole in zip(own, moments, strict=True):
        torch.testing.assert_close(part[chosen], whole[chosen], rtol=1e-9, atol=1e-8)
        assert not part[[0, 2, 3, 5]].any()


def test_float32_moments_are_whitened_by_exact_maps():
    points, parameters, responsibilities = problem(dtype=torch.float32)
    joint, moments, _ = gathered(WhitenedStatistics, parameters, points, responsibilities)
    expected_joint, expected_moments = exact(parameters, points, responsibilities)
    assert joint.dtype == torch.float32
    np.testing.assert_allclose(
        joint.numpy(), expected_joint.astype(float), rtol=1e-4, atol=1e-3
    )
    for own, expected in zip(moments, expected_moments, strict=True):
        assert own.dtype == torch.float64
        scale = abs(expected).max((1, 2), keepdims=True)
        assert (abs(own.numpy() - expected) / scale).max() < 1e-4


def whitener(n_components, dtype=torch.float64, narrow=1.0):
    _, parameters, _ = problem(n_components, 1000)
    factors = tuple(narrow * factor for factor in parameters.factors)
    return Whitener(type(parameters)(parameters.weights, parameters.means, factors), dtype)


@pytest.mark.parametrize(
    ("n_components", "n_points", "dtype", "narrow", "form"),
    [
        (32, 4096, torch.float64, 1.0, PackedStatistics),
        (31, 4096, torch.float64, 1.0, WhitenedStatistics),
        (32, 4095, torch.float64, 1.0, WhitenedStatistics),
        (32, 4096, torch.float32, 1.0, WhitenedStatistics),
        (32, 4096, torch.float64, 1e-3, WhitenedStatistics),
    ],
    ids=["many", "few components", "few points", "float32", "narrow"],
)
def test_products_are_made_where_they_pay_and_are_accurate(
    n_components, n_points, dtype, narrow, form
):
    chosen = statistics.sufficient_statistics(whitener(n_components, dtype, narrow), n_points)
    assert type(chosen) is form


def test_sharpness_is_the_trace_of_the_precision():
    _, parameters, _ = problem()
    expected = sum(
        torch.linalg.inv(covariance).diagonal(dim1=1, dim2=2).sum(1)
        for covariance in parameters.covariances
    )
    found = statistics.sharpness(Whitener(parameters, torch.float64))
    torch.testing.assert_close(found, expected)


def test_rounding_grows_with_sharpness():
    assert WhitenedStatistics(whitener(4)).rounding == 2e-13
    assert WhitenedStatistics(whitener(4, torch.float32)).rounding == 1e-5
    sharp = whitener(4, narrow=1e-2)
    expected = 1e-16 * float(statistics.sharpness(sharp).max())
    assert PackedStatistics(sharp).rounding == pytest.approx(max(2e-13, expected))
