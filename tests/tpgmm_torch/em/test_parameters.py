"""Mixtures as tensors: factors, stacks, units, samples."""

import numpy as np
import pytest
import torch

from tests.support.em_reference import random_mixture as mixture
from tpgmm_torch.em.parameters import Parameters, Standardization, check_blocks
from tpgmm_torch.exceptions import DataError, ShapeError

WIDTHS = (2, 3)


def units():
    return Standardization(
        (torch.tensor([1.0, -2.0]).double(), torch.tensor([0.5, 3.0, 100.0]).double()),
        (torch.tensor([2.0, 0.5]).double(), torch.tensor([10.0, 1.0, 1e-3]).double()),
    )


@pytest.mark.parametrize(
    ("blocks", "expected"), [(None, (5,)), ((2, 3), (2, 3)), (np.array([4, 1]), (4, 1))]
)
def test_blocks_add_up(blocks, expected):
    assert check_blocks(blocks, 5) == expected
    assert all(type(width) is int for width in check_blocks(blocks, 5))


@pytest.mark.parametrize(
    ("blocks", "message"),
    [
        ((2, 2), r"blocks=\(2, 2\) add up to 4 columns, but the data have 5"),
        ((6, -1), "positive integers"),
        ((5, 0), "positive integers"),
        ((2.5, 2.5), "positive integers"),
    ],
)
def test_blocks_that_are_none_are_refused(blocks, message):
    with pytest.raises(ShapeError, match=message):
        check_blocks(blocks, 5)


def test_factors_are_lower_and_of_the_covariances():
    parameters = mixture()
    for factor, covariance in zip(parameters.factors, parameters.covariances, strict=True):
        assert torch.equal(factor, factor.tril())
        torch.testing.assert_close(torch.linalg.cholesky(covariance), factor)


def test_a_covariance_that_is_none_is_named():
    parameters = mixture()
    first, second = parameters.covariances
    second = second.clone()
    second[2, 0, 0] = -1.0
    with pytest.raises(DataError, match="component 2, block 1 is not positive definite"):
        Parameters.from_covariances(parameters.weights, parameters.means, [first, second])
    stacked = [torch.stack([first, first]), torch.stack([parameters.covariances[1], second])]
    both = Parameters.stack([parameters, parameters])
    with pytest.raises(DataError, match="component 2, block 1 is not positive definite"):
        Parameters.from_covariances(both.weights, both.means, stacked)


def test_a_stack_holds_its_mixtures():
    mixtures = [mixture(seed) for seed in range(3)]
    both = Parameters.stack(mixtures)
    assert both.weights.shape == (3, 4)
    for s, expected in enumerate(mixtures):
        found = both[s]
        assert torch.equal(found.weights, expected.weights)
        for name in ("means", "factors"):
            for own, other in zip(getattr(found, name), getattr(expected, name), strict=True):
                assert torch.equal(own, other)
    assert torch.equal(both[torch.tensor([2, 0])].weights[0], mixtures[2].weights)


def test_functions_see_the_tensors_side_by_side():
    one, two = mixture(0), mixture(1)
    total = one.map(torch.add, two)
    torch.testing.assert_close(total.weights, one.weights + two.weights)
    torch.testing.assert_close(total.means[1], one.means[1] + two.means[1])
    torch.testing.assert_close(total.factors[0], one.factors[0] + two.factors[0])


def test_standard_units_and_back():
    parameters = mixture()
    standard = units().standardize(parameters)
    for j, (shift, scale) in enumerate(zip(units().shifts, units().scales, strict=True)):
        torch.testing.assert_close(standard.means[j], (parameters.means[j] - shift) / scale)
        expected = parameters.covariances[j] / torch.outer(scale, scale)
        torch.testing.assert_close(standard.covariances[j], expected)
    restored = units().restore(standard)
    torch.testing.assert_close(restored.means, parameters.means)
    torch.testing.assert_close(restored.factors, parameters.factors)
    assert torch.equal(standard.weights, parameters.weights)


def test_rows_are_standardised_in_float64():
    rows = np.random.RandomState(0).randn(6, 5).astype(np.float32)
    rows.flags.writeable = False
    found = units().rows(rows)
    shift, scale = (np.concatenate([p.numpy() for p in part])
                    for part in (units().shifts, units().scales))  # fmt: skip
    assert found.dtype == torch.float64
    np.testing.assert_array_equal(found, (rows.astype(np.float64) - shift) / scale)


def test_the_log_volume_is_that_of_the_scales():
    assert units().log_volume == pytest.approx(np.log(2.0 * 0.5 * 10.0 * 1e-3))
    assert units().widths == WIDTHS
    assert units().to(torch.device("cpu")).scales[0].tolist() == [2.0, 0.5]


def test_units_of_a_mixture_are_those_of_its_density():
    parameters = mixture()
    found = Standardization.of_mixture(parameters)
    rows, _ = parameters.sample(200_000, np.random.RandomState(0))
    shift, scale = (torch.cat(part).numpy() for part in (found.shifts, found.scales))
    np.testing.assert_allclose(rows.mean(0), shift, atol=0.02)
    np.testing.assert_allclose(rows.std(0), scale, rtol=0.01)


def test_samples_are_those_of_their_components():
    parameters = mixture()
    rows, labels = parameters.sample(100_000, np.random.RandomState(1))
    assert (np.diff(labels) >= 0).all()
    assert rows.shape == (100_000, 5)
    np.testing.assert_allclose(np.bincount(labels) / 1e5, parameters.weights, atol=0.01)
    for k in range(4):
        own = rows[labels == k]
        expected = torch.block_diag(*(c[k] for c in parameters.covariances)).numpy()
        np.testing.assert_allclose(np.cov(own.T), expected, atol=0.05 * abs(expected).max())
        mean = torch.cat([m[k] for m in parameters.means]).numpy()
        np.testing.assert_allclose(own.mean(0), mean, atol=0.05 * abs(expected).max() ** 0.5)
