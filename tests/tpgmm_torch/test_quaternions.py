"""The laws of quaternion algebra, on random rotations and on the awkward ones."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from tests.support.refusals import refused
from tpgmm_torch import quaternions as Q
from tpgmm_torch.exceptions import DataError, ShapeError

TINY = [0.0, 1e-300, 1e-15, 1e-9, 0.999e-6, 1e-6, 1.001e-6, 1.999e-6, 2.001e-6, 1e-4, 0.01]
NEAR_HALF_TURN = [math.pi - angle for angle in (1e-15, 1e-12, 1e-9, 1e-6, 1e-3)]


def vectors(size: int) -> st.SearchStrategy[Tensor]:
    """Vectors with entries in [-1, 1] that are long enough to have a direction."""
    entries = st.lists(st.floats(-1, 1), min_size=size, max_size=size)
    return entries.map(lambda v: torch.tensor(v, dtype=torch.float64)).filter(
        lambda v: float(v.norm()) > 0.1
    )


units = vectors(4).map(lambda q: q / q.norm())
axes = vectors(3).map(lambda v: v / v.norm())
angles = st.one_of(st.floats(0, math.pi), st.sampled_from(TINY + NEAR_HALF_TURN))
rotations = st.one_of(units, st.builds(lambda axis, angle: Q.exp(axis * angle), axes, angles))
fractions = st.floats(0, 1)


def assert_equal(actual: Tensor, expected: Tensor, tolerance: float = 1e-13) -> None:
    torch.testing.assert_close(actual, expected, rtol=0, atol=tolerance)


def assert_same_rotation(a: Tensor, b: Tensor, tolerance: float = 1e-13) -> None:
    """``a`` is ``b`` or ``-b``."""
    assert_equal(Q.match_hemisphere(a, b), b.expand_as(a), tolerance)


def angle_between(a: Tensor, b: Tensor) -> Tensor:
    return torch.linalg.vector_norm(Q.log(Q.product(b, Q.conjugate(a))), dim=-1)


def independent_matrix(q: Tensor) -> Tensor:
    """The rotation matrix according to scipy."""
    return torch.from_numpy(Rotation.from_quat(q.numpy(), scalar_first=True).as_matrix())


# The group


def test_product_is_hamiltons():
    one, i, j, k = torch.eye(4, dtype=torch.float64)
    for square in (i, j, k):
        assert_equal(Q.product(square, square), -one)
    assert_equal(Q.product(i, j), k)
    assert_equal(Q.product(j, i), -k)
    assert_equal(Q.product(j, k), i)
    assert_equal(Q.product(k, i), j)


# The matrices of the appendix


@given(units, units)
def test_left_and_right_matrices_equal_the_product(a, b):
    product = Q.product(a, b)
    assert_equal(Q.left_matrix(a) @ b, product)
    assert_equal(Q.right_matrix(b) @ a, product)
    assert_equal(Q.vector_matrix(b) @ a, product[1:])
    assert_equal(Q.vector_matrix(b), Q.right_matrix(b)[1:])


# Rotating, and rotation matrices


@given(units, units, vectors(3))
def test_rotate_is_the_sandwich_and_the_matrix_and_an_action_from_the_left(a, b, v):
    pure = torch.cat((torch.zeros(1, dtype=torch.float64), v))
    sandwich = Q.product(Q.product(a, pure), Q.conjugate(a))
    assert_equal(Q.rotate(a, v), sandwich[1:])
    assert_equal(Q.rotate(a, v), Q.to_matrix(a) @ v)
    assert_equal(Q.rotate(-a, v), Q.rotate(a, v))
    assert_equal(Q.rotate(Q.product(a, b), v), Q.rotate(a, Q.rotate(b, v)))


@given(units)
def test_to_matrix_agrees_with_scipy(q):
    assert_equal(Q.to_matrix(q), independent_matrix(q))


@settings(max_examples=300)
@given(rotations)
def test_from_matrix_inverts_to_matrix_at_every_angle(q):
    back = Q.from_matrix(Q.to_matrix(q))
    assert back[0] >= 0
    assert_same_rotation(back, q)


@given(axes)
def test_from_matrix_is_exact_at_half_turns(axis):
    half_turn = 2 * torch.outer(axis, axis) - torch.eye(3, dtype=torch.float64)
    back = Q.from_matrix(half_turn)
    assert_same_rotation(back, torch.cat((torch.zeros(1, dtype=torch.float64), axis)))


@pytest.mark.parametrize("shape", [(3,), (3, 4), (4, 4), (2, 4, 3)])
def test_from_matrix_refuses_other_shapes(shape):
    refused(lambda: Q.from_matrix(torch.zeros(shape)), ShapeError, r"\(\.\.\., 3, 3\), got")


@pytest.mark.parametrize(("change", "message"), [
    (lambda m: 1.01 * m, "R\\^T R differs from the identity by 0.02"),
    (lambda m: -m, "a reflection"),
    (lambda m: torch.full_like(m, torch.nan), "no rotation"),
    (lambda m: torch.zeros_like(m), "no rotation"),
    (lambda m: torch.stack((m, m.flip(-1))), "reflection"),
])  # fmt: skip
def test_from_matrix_refuses_what_is_no_rotation(change, message):
    turn = Q.to_matrix(Q.exp(torch.tensor([0.3, -1.0, 0.2], dtype=torch.float64)))
    refused(lambda: Q.from_matrix(change(turn)), DataError, message)
    assert_same_rotation(Q.from_matrix(turn.round(decimals=3)), Q.from_matrix(turn), 2e-3)


# Exponential and logarithm


@given(axes, angles)
def test_exp_agrees_with_scipy(axis, angle):
    vector = axis * angle
    expected = Rotation.from_rotvec(vector.numpy()).as_quat(scalar_first=True)
    assert_same_rotation(Q.exp(vector), torch.from_numpy(expected))


@settings(max_examples=300)
@given(axes, angles)
def test_log_inverts_exp(axis, angle):
    vector = axis * angle
    back = Q.log(Q.exp(vector))
    if angle > math.pi - 1e-14:  # half a turn is one rotation with two vectors
        back = torch.where(back @ vector < 0, -back, back)
    assert_equal(back, vector)


@given(axes, st.sampled_from(TINY))
def test_log_inverts_exp_with_full_relative_precision_at_tiny_angles(axis, angle):
    vector = axis * angle
    assert (Q.log(Q.exp(vector)) - vector).norm() <= 1e-14 * vector.norm()


@given(units.filter(lambda q: abs(float(q[0])) > 1e-15))
def test_log_is_the_same_for_both_signs(q):
    assert_equal(Q.log(-q), Q.log(q))


# Interpolation


@given(units, units)
def test_slerp_ends_at_its_ends_and_starts_with_the_sign_of_the_first(a, b):
    assert_equal(Q.slerp(a, b, 0.0), a)
    assert_same_rotation(Q.slerp(a, b, 1.0), b)


@given(units, units, fractions, fractions)
def test_slerp_has_constant_speed_on_the_shorter_way(a, b, s, t):
    way = angle_between(a, b)
    assert way <= math.pi + 1e-14
    assert_equal(angle_between(Q.slerp(a, b, s), Q.slerp(a, b, t)), abs(s - t) * way)


@given(units, units, fractions)
def test_slerp_does_not_depend_on_signs_and_stays_in_the_hemisphere_of_the_first(a, b, t):
    between = Q.slerp(a, b, t)
    assert between @ a >= -1e-14
    if abs(a @ b) > 1e-12:  # half a turn apart, two ways are equally short
        assert_equal(Q.slerp(a, -b, t), between)
        assert_equal(Q.slerp(-a, b, t), -between)


def test_slerp_broadcasts_fractions():
    a, b = Q.identity(), Q.exp(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    t = torch.linspace(0, 1, 6, dtype=torch.float64).reshape(2, 3)
    expected = t[..., None] * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    assert_equal(Q.log(Q.slerp(a, b, t)), expected)


# Signs


@given(units, units)
def test_match_hemisphere_keeps_the_rotation_and_turns_it_to_the_reference(q, reference):
    matched = Q.match_hemisphere(q, reference)
    assert torch.equal(matched, q) or torch.equal(matched, -q)
    assert matched @ reference >= -1e-15


@given(axes, st.lists(st.tuples(st.floats(-1.5, 1.5), st.booleans()), min_size=1, max_size=12))
def test_continuous_removes_exactly_the_sign_jumps(axis, steps):
    angles, flips = zip(*steps, strict=True)
    smooth = Q.exp(torch.tensor(angles, dtype=torch.float64).cumsum(0)[:, None] * axis)
    signs = torch.where(torch.tensor(flips), -1.0, 1.0).double()[:, None]
    assert torch.equal(Q.continuous(signs * smooth), signs[0] * smooth)


def test_continuous_works_along_any_dimension_and_each_sequence_on_its_own():
    generator = torch.Generator().manual_seed(0)
    q = torch.randn(5, 3, 7, 4, dtype=torch.float64, generator=generator)
    by_last = Q.continuous(q)
    assert bool(((by_last[..., 1:, :] * by_last[..., :-1, :]).sum(-1) >= 0).all())
    for i in range(5):
        for j in range(3):
            assert torch.equal(by_last[i, j], Q.continuous(q[i, j]))
    assert torch.equal(Q.continuous(q.movedim(-2, 0), dim=0), by_last.movedim(-2, 0))
    assert Q.continuous(q[:, :, :0]).shape == (5, 3, 0, 4)


@given(vectors(4), st.floats(1e-100, 1e100))
def test_normalize_keeps_the_direction(q, scale):
    unit = Q.normalize(q * scale)
    assert_equal(unit, q / q.norm())


@pytest.mark.parametrize("value", [0.0, math.nan, math.inf])
def test_normalize_refuses_what_has_no_direction(value):
    batch = torch.stack((Q.identity(), torch.full((4,), value, dtype=torch.float64)))
    refused(lambda: Q.normalize(batch), DataError, "zero or not finite")


# All functions: gradients, shapes, types, untouched inputs

UNARY = {
    Q.conjugate: (4,),
    Q.left_matrix: (4, 4),
    Q.right_matrix: (4, 4),
    Q.vector_matrix: (3, 4),
    Q.normalize: (4,),
    Q.log: (3,),
    Q.to_matrix: (3, 3),
}
BINARY = {Q.product: 4, Q.match_hemisphere: 4, Q.rotate: 3}
by_name = {"ids": lambda f: f.__name__}


def random_quaternions(*shape: int, dtype: torch.dtype = torch.float64) -> Tensor:
    generator = torch.Generator().manual_seed(sum(shape))
    return Q.normalize(torch.randn(*shape, 4, dtype=dtype, generator=generator))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(), (1,), (0,), (2, 3)])
@pytest.mark.parametrize("function", UNARY, **by_name)
def test_functions_of_one_take_any_batch_and_keep_the_type(function, shape, dtype):
    q = random_quaternions(*shape, dtype=dtype)
    before = q.clone()
    result = function(q)
    assert result.shape == (*shape, *UNARY[function])
    assert result.dtype == dtype
    assert torch.equal(q, before)
    for index in torch.cartesian_prod(*map(torch.arange, shape)).tolist() if shape[1:] else ():
        assert_equal(result[tuple(index)], function(q[tuple(index)]), 1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("function", BINARY, **by_name)
def test_functions_of_two_broadcast(function, dtype):
    size = BINARY[function]
    a, b = random_quaternions(2, 1, dtype=dtype), random_quaternions(3, dtype=dtype)[:, :size]
    result = function(a, b)
    assert result.shape == (2, 3, size)
    assert result.dtype == dtype
    for i in range(2):
        for j in range(3):
            assert_equal(result[i, j], function(a[i, 0], b[j]), 1e-6)


@pytest.mark.parametrize("shape", [(), (0,), (2, 3)])
def test_exp_and_from_matrix_take_any_batch(shape):
    vector = torch.ones(*shape, 3, dtype=torch.float32)
    q = Q.exp(vector)
    assert q.shape == (*shape, 4)
    assert q.dtype == torch.float32
    assert_equal(Q.from_matrix(Q.to_matrix(q)), q, 1e-6)


@settings(max_examples=25)
@given(units, units, axes, angles.filter(lambda angle: angle < 3.0))
def test_gradients_are_those_of_finite_differences(a, b, axis, angle):
    vector = (axis * angle).requires_grad_()
    a, b = a.clone().requires_grad_(), b.clone().requires_grad_()
    near = Q.exp(vector.detach()).requires_grad_()
    torch.autograd.gradcheck(Q.product, (a, b))
    torch.autograd.gradcheck(Q.exp, (vector,))
    torch.autograd.gradcheck(Q.log, (near,))
    torch.autograd.gradcheck(Q.rotate, (a, vector))
    torch.autograd.gradcheck(Q.to_matrix, (a,))
    torch.autograd.gradcheck(lambda v: Q.from_matrix(Q.to_matrix(Q.exp(v))), (vector,))
    torch.autograd.gradcheck(lambda q, v: Q.slerp(q, Q.product(Q.exp(v), q), 0.3), (a, vector))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_at_no_rotation_are_exact(dtype):
    vector = torch.zeros(3, dtype=dtype)
    half = 0.5 * torch.eye(3, dtype=dtype)
    assert torch.equal(torch.func.jacrev(Q.exp)(vector)[1:], half)
    through = torch.func.jacrev(lambda v: Q.log(Q.exp(v)))(vector)
    assert torch.equal(through, torch.eye(3, dtype=dtype))


# The tangent space


@given(axes, st.one_of(st.floats(0, 6), st.sampled_from([0.0, 1e-9, 0.99e-2, 1.01e-2])))
def test_the_left_jacobian_is_the_derivative_of_exp(axis, angle):
    y = axis * angle
    jacobian = Q.left_jacobian(y)
    steps = 1e-5 * torch.eye(3, dtype=torch.float64)
    back = Q.conjugate(Q.exp(y - steps))
    turned = Q.log(Q.product(Q.exp(y + steps), back)) / 2e-5
    assert_equal(jacobian, turned.mT, 1e-8)
    inverse = Q.inverse_left_jacobian(y)
    if angle < 5:
        assert_equal(inverse @ jacobian, torch.eye(3, dtype=torch.float64), 1e-9)
    half = angle / 2
    volume = (math.sin(half) / half) ** 2 if half else 1.0
    assert float(torch.linalg.det(jacobian)) == pytest.approx(volume, abs=1e-9)


def test_jacobians_have_finite_gradients_where_nothing_turns():
    y = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    for function in (Q.left_jacobian, Q.inverse_left_jacobian):
        [gradient] = torch.autograd.grad(function(y).sum() + function(y)[..., 0, 1].sum(), y)
        assert bool(gradient.isfinite().all())


@given(st.lists(axes, min_size=3, max_size=6), units)
def test_to_the_mean_the_turns_add_up_to_nothing(directions, turn):
    q = Q.exp(torch.stack(directions) * 1.2)
    found = Q.mean(q)
    assert_equal(Q.log(Q.product(Q.conjugate(found), q)).sum(0), torch.zeros(3).double(), 1e-9)
    signs = torch.tensor([(-1.0) ** i for i in range(len(q))])[:, None]
    assert_same_rotation(Q.mean(q * signs), found, 1e-9)
    assert_same_rotation(Q.mean(Q.product(turn, q)), Q.product(turn, found), 1e-7)
    assert_same_rotation(Q.mean(torch.stack((q, q)))[1], found, 1e-9)


@given(axes, axes, st.floats(1e-7, 1e-5))
def test_displacement_of_a_quaternion_is_half_the_rotation_vector(axis, start, angle):
    """The fact behind the factor 2 of the orientation operators."""
    before = Q.exp(start)
    after = Q.product(Q.exp(axis * angle), before)
    displacement = Q.vector_matrix(Q.conjugate(before)) @ after
    assert (2 * displacement - axis * angle).norm() <= angle**2
