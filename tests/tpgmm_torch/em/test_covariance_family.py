"""The four families against their definitions, and the regularisation."""

import numpy as np
import pytest
import torch

from tests.support.blocks import COVARIANCE_TYPES
from tpgmm_torch.em.covariance_family import CovarianceFamily
from tpgmm_torch.em.parameters import Parameters, Standardization
from tpgmm_torch.exceptions import DataError, ShapeError

RNG = np.random.RandomState(0)


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def scatter(count=3, width=4, seed=0):
    root = torch.from_numpy(np.random.RandomState(seed).randn(count, width, width))
    return root @ root.mT


def units():
    return Standardization((tensor(1.0, 2.0), tensor(3.0)), (tensor(2.0, 0.5), tensor(10.0)))


def regularized(amount, relative=True, dtype=torch.float64):
    return CovarianceFamily.regularized(
        "full", units(), amount, relative=relative, dtype=dtype
    ).diagonals


def test_regularization_is_a_share_or_in_units_of_the_data():
    for own, expected in zip(regularized(0.1), (tensor(0.1, 0.1), tensor(0.1)), strict=True):
        torch.testing.assert_close(own, expected)
    absolute = regularized([0.1, 0.2, 0.3], relative=False)
    torch.testing.assert_close(absolute[0], tensor(0.1 / 4, 0.2 / 0.25))
    torch.testing.assert_close(absolute[1], tensor(0.3 / 100))


def test_regularization_is_not_below_rounding():
    assert regularized(0.0)[0].tolist() == [1e-12, 1e-12]
    assert regularized([1e-13, 1e-3, 0.0])[0].tolist() == [1e-12, 1e-3]
    assert regularized(1e-9, dtype=torch.float32)[1].tolist() == [2e-6]


@pytest.mark.parametrize("amount", [[1.0, 2.0], np.ones((3, 1))])
def test_a_regularization_of_another_shape_is_refused(amount):
    with pytest.raises(ShapeError, match=r"one for each of the 3 columns, got shape \("):
        regularized(amount)


@pytest.mark.parametrize("amount", [-1.0, np.nan, np.inf, [0.0, -1e-9, 0.0]])
def test_a_regularization_that_is_no_amount_is_refused(amount):
    with pytest.raises(DataError, match="finite and not negative"):
        regularized(amount)


def test_restriction_is_the_definition():
    covariance, weights = scatter(), tensor(0.2, 0.3, 0.5)
    found = {
        name: CovarianceFamily(name, (tensor(1.0),)).restrict(covariance, weights)
        for name in COVARIANCE_TYPES
    }
    assert torch.equal(found["full"], covariance)
    pooled = 0.2 * covariance[0] + 0.3 * covariance[1] + 0.5 * covariance[2]
    for k in range(3):
        torch.testing.assert_close(found["tied"][k], pooled)
        torch.testing.assert_close(found["diag"][k], torch.diag(torch.diag(covariance[k])))
        mean = torch.trace(covariance[k]) / 4
        torch.testing.assert_close(found["spherical"][k], mean * torch.eye(4).double())


@pytest.mark.parametrize("name", COVARIANCE_TYPES)
def test_stacked_families_are_each_its_own(name):
    covariances = torch.stack([scatter(seed=1), scatter(seed=2)])
    weights = torch.stack([tensor(0.2, 0.3, 0.5), tensor(0.6, 0.3, 0.1)])
    families = [
        CovarianceFamily(name, (tensor(*values),))
        for values in ((0.1, 0.2, 0.3, 0.4), (4.0, 3.0, 2.0, 1.0))
    ]
    both = CovarianceFamily.stack(families)
    for s, own in enumerate(families):
        restricted = own.restrict(covariances[s], weights[s])
        torch.testing.assert_close(both.restrict(covariances, weights)[s], restricted)
        torch.testing.assert_close(both.add(covariances, 0)[s], own.add(covariances[s], 0))
        torch.testing.assert_close(both.floor(covariances, 0)[s], own.floor(covariances[s], 0))
    assert torch.equal(both[torch.tensor([1])].diagonals[0][0], families[1].diagonals[0])
    assert both[[0]].covariance_type == name


def test_adding_adds_to_the_diagonal_of_the_block():
    own = CovarianceFamily("full", (tensor(9.0), tensor(0.1, 0.2, 0.3, 0.4)))
    expected = scatter() + torch.diag(tensor(0.1, 0.2, 0.3, 0.4))
    torch.testing.assert_close(own.add(scatter(), 1), expected)


def test_the_floor_is_the_most_likely_covariance_not_below_it():
    diagonal = tensor(2.0, 1.0, 3.0, 0.5)
    own, sample = CovarianceFamily("full", (diagonal,)), scatter()
    found = own.floor(sample, 0)
    above = torch.linalg.eigvalsh(found - torch.diag(diagonal))
    assert above.min() > -1e-12

    def likelihood(covariance):
        return -torch.logdet(covariance) - torch.trace(
            torch.linalg.solve(covariance, sample[0])
        )

    best = likelihood(found[0])
    for seed in range(200):
        root = 0.3 * torch.from_numpy(np.random.RandomState(seed).randn(4, 4))
        other = (found[0] + found[0].mT) / 2 + (root + root.mT)
        gap = torch.linalg.eigvalsh(other - torch.diag(diagonal)).min()
        if gap >= 0:
            assert likelihood(other) <= best + 1e-9
    large = 100 * torch.eye(4).double()[None] + sample
    torch.testing.assert_close(own.floor(large, 0), large)


def test_other_units_keep_the_regularization():
    old, new = units(), Standardization(units().shifts, (tensor(1.0, 5.0), tensor(2.0)))
    own = CovarianceFamily("diag", (tensor(0.1, 0.2), tensor(0.3))).rescaled(old, new)
    torch.testing.assert_close(own.diagonals[0], tensor(0.1 * 4, 0.2 * 0.01))
    torch.testing.assert_close(own.diagonals[1], tensor(0.3 * 25))
    assert own.covariance_type == "diag"


def test_admitting_brings_into_the_family_and_above_the_floor():
    own = CovarianceFamily("diag", (torch.full((4,), 2.0).double(),))
    before = Parameters.from_covariances(
        tensor(0.2, 0.3, 0.5), [torch.zeros(3, 4).double()], [scatter()]
    )
    [after] = own.admit(before).covariances
    expected = torch.diag_embed(scatter().diagonal(dim1=1, dim2=2).clamp(min=2.0))
    torch.testing.assert_close(after, expected)
