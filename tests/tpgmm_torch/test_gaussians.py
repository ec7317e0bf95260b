"""Gaussians in batches: every function against dense numpy, and the laws that tie them."""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_t
from torch import Tensor
from torch.distributions import MultivariateNormal

from tests.support import oracles
from tpgmm_torch import gaussians
from tpgmm_torch.exceptions import DataError

seeds = st.integers(0, 2**32 - 1)
sizes = st.integers(1, 6)
Generator = np.random.Generator


def normal(rng: Generator, *shape: int) -> Tensor:
    return torch.from_numpy(rng.standard_normal(shape))


def spd(rng: Generator, *shape: int, low: float = 0.05, high: float = 5.0) -> Tensor:
    """Random covariances (..., D, D) of the leading shape and size given, D last."""
    *batch, size = shape
    basis = torch.linalg.qr(normal(rng, *batch, size, size))[0]
    values = torch.from_numpy(rng.uniform(low, high, (*batch, 1, size)))
    return (basis * values) @ basis.mT


def square(rng: Generator, *shape: int) -> Tensor:
    """Random invertible matrices, singular values from 0.5 to 2, that are not symmetric."""
    *batch, size = shape
    left = torch.linalg.qr(normal(rng, *batch, size, size))[0]
    right = torch.linalg.qr(normal(rng, *batch, size, size))[0]
    return (left * torch.from_numpy(rng.uniform(0.5, 2, (*batch, 1, size)))) @ right


def assert_close(actual: Tensor, expected: object, tolerance: float = 1e-10) -> None:
    expected = torch.as_tensor(np.asarray(expected))
    torch.testing.assert_close(actual, expected, rtol=tolerance, atol=tolerance)


def dense_product(means: Tensor, covariances: Tensor) -> tuple[object, object]:
    """Eq. (2), with inverses."""
    inverses = [np.linalg.inv(c) for c in covariances.numpy()]
    covariance = np.linalg.inv(sum(inverses))
    weighted = sum(i @ m for i, m in zip(inverses, means.numpy(), strict=True))
    return covariance @ weighted, covariance


def affine(mean: Tensor, covariance: Tensor, linear: Tensor, offset: Tensor) -> list[Tensor]:
    """Eq. (1)."""
    return [(linear @ mean[..., None])[..., 0] + offset, linear @ covariance @ linear.mT]


# Eq. (2)


@given(seeds, sizes, st.integers(1, 5))
def test_product_is_the_dense_product(seed, size, n_factors):
    rng = np.random.default_rng(seed)
    means, covariances = normal(rng, n_factors, size), spd(rng, n_factors, size)
    mean, covariance = gaussians.product(means, covariances)
    expected_mean, expected_covariance = dense_product(means, covariances)
    assert_close(mean, expected_mean)
    assert_close(covariance, expected_covariance)


@given(seeds, sizes, st.permutations(range(4)))
def test_product_does_not_depend_on_the_order_of_its_factors(seed, size, order):
    rng = np.random.default_rng(seed)
    means, covariances = normal(rng, 4, size), spd(rng, 4, size)
    given_order = gaussians.product(means, covariances)
    other_order = gaussians.product(means[order], covariances[order])
    pairs = gaussians.product(means[order[:2]], covariances[order[:2]])
    rest = gaussians.product(means[order[2:]], covariances[order[2:]])
    nested = gaussians.product(*(torch.stack(both) for both in zip(pairs, rest, strict=True)))
    for results in zip(given_order, other_order, nested, strict=True):
        assert_close(results[1], results[0])
        assert_close(results[2], results[0])


# The information form


def add_up(terms: list[tuple[Tensor, Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    precision = torch.stack([term[0] for term in terms]).sum(0)
    vector = torch.stack([term[1] for term in terms]).sum(0)
    return gaussians.from_information(precision, vector[..., 0])


@given(seeds, sizes, st.integers(1, 4))
def test_both_forms_agree_where_every_jacobian_is_invertible(seed, size, n_factors):
    rng = np.random.default_rng(seed)
    jacobians, targets = square(rng, n_factors, size), normal(rng, n_factors, size)
    covariances = spd(rng, n_factors, size)
    inverses = torch.linalg.inv(jacobians)
    projected = [
        affine(y, s, a, torch.zeros_like(y))
        for y, s, a in zip(targets, covariances, inverses, strict=True)
    ]
    product = gaussians.product(*(torch.stack(parts) for parts in zip(*projected, strict=True)))
    terms = [
        gaussians.information(j, y[:, None], s)
        for j, y, s in zip(jacobians, targets, covariances, strict=True)
    ]
    for left, right in zip(add_up(terms), product, strict=True):
        assert_close(left, right, 1e-9)


@given(seeds, st.integers(1, 4))
def test_information_is_the_moore_penrose_inverse_of_the_projected_covariance(seed, rows):
    rng = np.random.default_rng(seed)
    jacobian = square(rng, 6)[:rows]  # full row rank
    target, covariance = normal(rng, rows), spd(rng, rows)
    inverse = np.linalg.pinv(jacobian.numpy())
    projected = inverse @ covariance.numpy() @ inverse.T
    precision, vector, square_ = gaussians.information(jacobian, target[:, None], covariance)
    singular = np.linalg.pinv(projected, rcond=1e-9)
    assert_close(precision, singular, 1e-9)
    assert_close(vector[:, 0], singular @ inverse @ target.numpy(), 1e-9)
    assert_close(square_[0, 0], target @ torch.linalg.inv(covariance) @ target)


def test_information_takes_dependent_rows():
    rng = np.random.default_rng(3)
    row, identity = normal(rng, 1, 3), torch.eye(2, dtype=torch.float64)
    targets = torch.ones(2, 1, dtype=torch.float64)
    twice = gaussians.information(torch.cat((row, row)), targets, identity)
    once = gaussians.information(row, targets[:1], 0.5 * identity[:1, :1])
    for left, right in zip(twice, once, strict=True):
        assert_close(left, right)


def test_no_jacobian_stands_for_the_identity():
    rng = np.random.default_rng(4)
    targets, covariance = normal(rng, 5, 3, 2), spd(rng, 5, 3)
    implicit = gaussians.information(None, targets, covariance)
    explicit = gaussians.information(torch.eye(3, dtype=torch.float64), targets, covariance)
    for left, right in zip(implicit, explicit, strict=True):
        assert_close(left, right)


# Conditioning, mixing, density


@given(seeds, st.integers(1, 3), st.integers(1, 4))
def test_condition_is_the_textbook_formula(seed, n_inputs, n_outputs):
    rng = np.random.default_rng(seed)
    size = n_inputs + n_outputs
    mean, covariance = normal(rng, size), spd(rng, size)
    gain, spread = gaussians.condition(mean, covariance, n_inputs)
    s = covariance.numpy()
    i, o = slice(None, n_inputs), slice(n_inputs, None)
    assert_close(gain, s[o, i] @ np.linalg.inv(s[i, i]))
    # the covariance of the outputs given the inputs is the inverse of a block of the precision
    assert_close(spread, np.linalg.inv(np.linalg.inv(s)[o, o]))


@given(seeds, st.integers(1, 4), st.integers(1, 5))
def test_moment_match_is_the_second_moment_less_the_square_of_the_mean(seed, size, n):
    rng = np.random.default_rng(seed)
    weights = torch.from_numpy(rng.dirichlet(np.ones(n)))
    means, covariances = normal(rng, n, size), spd(rng, n, size)
    mean, covariance = gaussians.moment_match(weights, means, covariances)
    expected = oracles.mix(weights.numpy(), means.numpy(), covariances.numpy())
    assert_close(mean, expected[0])
    assert_close(covariance, expected[1])


# Batches and gradients


BATCHES = [(), (3,), (2, 3)]


def everything(mean: Tensor, linear: Tensor, covariance: Tensor, noise: Tensor) -> list[Tensor]:
    """Every function of one Gaussian; ``linear`` has two rows."""
    return [
        *gaussians.information(linear, mean[..., :2, None], noise),
        *gaussians.from_information(covariance, mean),
    ]


@pytest.mark.parametrize(("left", "right"), list(itertools.product(BATCHES, BATCHES)))
def test_leading_dimensions_broadcast(left, right):
    rng = np.random.default_rng(6)
    batch = torch.broadcast_shapes(left, right)
    events = (4,), (2, 4), (4, 4), (2, 2)
    inputs = normal(rng, *left, 4), normal(rng, *left, 2, 4), spd(rng, *right, 4)
    inputs = *inputs, spd(rng, *right, 2)
    results = everything(*inputs)
    full = [t.expand(batch + event) for t, event in zip(inputs, events, strict=True)]
    for index in np.ndindex(*batch):
        singles = everything(*(t[index] for t in full))
        for result, single in zip(results, singles, strict=True):
            assert_close(result.expand(batch + single.shape)[index], single)


# Singular matrices


SINGULAR = torch.tensor([[1.0, 1.0], [1.0, 1.0]], dtype=torch.float64)
REGULAR = torch.eye(2, dtype=torch.float64)


@pytest.mark.parametrize(("call", "name"), [
    (lambda c: gaussians.cholesky(c, "the thing"), "the thing"),
    (lambda c: gaussians.product(torch.zeros(2, 2).double(), c), "a factor of the product"),
    (lambda c: gaussians.information(None, torch.zeros(2, 1).double(), c), "projected"),
    (lambda c: gaussians.information(REGULAR, torch.zeros(2, 1).double(), c), "projected"),
    (lambda c: gaussians.from_information(c, torch.zeros(2, 2).double()), "precision"),
], ids=["cholesky", "product", "information", "with J", "from_information"])  # fmt: skip
@pytest.mark.parametrize("bad", [SINGULAR - 1e-3 * REGULAR, torch.full((2, 2), torch.nan)])
def test_a_singular_matrix_is_named_counted_and_comes_with_advice(call, name, bad):
    with pytest.raises(DataError, match=rf"{name}.*1 of 2 matrices of size 2.*reg_covar"):
        call(torch.stack((REGULAR, bad.double())))


def test_a_constant_input_cannot_be_conditioned_on():
    covariance = torch.diag(torch.tensor([0.0, 1.0], dtype=torch.float64))
    with pytest.raises(DataError, match=r"the covariance of the input.*reg_covar"):
        gaussians.condition(torch.zeros(2), covariance, 1)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@pytest.mark.parametrize("smallest", [1.0, 1e-1, 1e-2, 1e-4, 1e-9, 0.0])
def test_the_pseudo_inverse_is_moore_and_penrose_s_at_any_rank(smallest, dtype):
    generator = torch.Generator().manual_seed(0)
    left, _ = torch.linalg.qr(torch.randn(5, 6, 6, generator=generator, dtype=torch.float64))
    right, _ = torch.linalg.qr(torch.randn(5, 9, 6, generator=generator, dtype=torch.float64))
    values = torch.ones(5, 6, dtype=torch.float64)
    values[2, 4] = smallest  # one of them may lack a direction
    matrix = ((left * values[:, None]) @ right.mT).to(dtype)
    tolerance = torch.finfo(dtype).eps ** (2 / 3) * torch.linalg.pinv(matrix).abs().max()
    lacking = matrix.clone()  # a coordinate or a row that is not there at all
    lacking[3, :, 5] = lacking[3, 2] = 0.0
    for one in (matrix, lacking, lacking.mT):
        found = gaussians.pseudo_inverse(one)
        expected = torch.linalg.pinv(one)
        torch.testing.assert_close(found, expected, rtol=0, atol=float(tolerance))


@pytest.mark.parametrize("shape", [(0, 5), (3, 0, 5), (0, 2, 5), (5, 0)])
def test_the_pseudo_inverse_of_nothing_has_its_shape(shape):
    empty = torch.empty(*shape)
    assert gaussians.pseudo_inverse(empty).shape == empty.mT.shape


def test_the_pseudo_inverse_has_gradients():
    matrix = torch.randn(2, 3, 5, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(gaussians.pseudo_inverse, matrix)


@given(seeds, sizes, st.sampled_from([None, 1.0, 4.0, 1e9]))
def test_densities_are_those_of_torch_and_scipy(seed, size, degrees):
    """Columns are deviations; with many degrees of freedom Student's t is the normal law."""
    rng = np.random.default_rng(seed)
    covariance, residuals = spd(rng, 2, size), 3 * normal(rng, 2, size, 4)
    found = gaussians.log_density(residuals, covariance, "a covariance", degrees)
    for columns, one, row in zip(residuals, covariance, found, strict=True):
        if degrees is None or degrees > 1e6:
            expected = MultivariateNormal(torch.zeros(size).double(), one).log_prob(columns.mT)
        else:
            expected = multivariate_t(shape=one.numpy(), df=degrees).logpdf(columns.mT.numpy())
        assert_close(row, np.atleast_1d(expected), 1e-6)


def test_sums_of_information_are_the_product_of_pseudo_inverses():
    rng = np.random.default_rng(2)
    identity_target, identity_covariance = normal(rng, 6), spd(rng, 6)
    jacobian, target, covariance = normal(rng, 3, 6), normal(rng, 3), spd(rng, 3)
    terms = [
        gaussians.information(None, identity_target[:, None], identity_covariance),
        gaussians.information(jacobian, target[:, None], covariance),
    ]
    inverse = np.linalg.pinv(jacobian.numpy())
    singular = np.linalg.pinv(inverse @ covariance.numpy() @ inverse.T, rcond=1e-9)
    full = np.linalg.inv(identity_covariance.numpy())
    expected = np.linalg.inv(full + singular)
    mean, spread = add_up(terms)
    assert_close(spread, expected)
    weighted = full @ identity_target.numpy() + singular @ inverse @ target.numpy()
    assert_close(mean, expected @ weighted)
