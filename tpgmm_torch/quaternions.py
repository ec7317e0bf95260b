"""Unit quaternions: the algebra of the paper's appendix.

Quaternions are ``(w, x, y, z)`` in the last dimension, of unit norm, multiplied by the
Hamilton product; ``product(a, b)`` is the rotation ``b`` followed by the rotation ``a``,
both in the fixed (world) frame. ``eps`` and ``-eps`` are one rotation. All functions take
any leading batch dimensions, broadcast, and are differentiable: ``a``, ``b``, ``q`` and
``reference`` are tensors of shape (..., 4), vectors of shape (..., 3).

The paper (Silvério et al., Humanoids 2018) writes ``H+`` and ``Hbar`` for the quaternion
matrices of eqs (19), (20): here :func:`left_matrix` and :func:`right_matrix`; the lower
three rows of ``Hbar``, ``Hbar*`` of eq. (11), are :func:`vector_matrix`.
"""

import itertools
import math
from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from tpgmm_torch.exceptions import DataError, ShapeError

__all__ = [
    "conjugate",
    "continuous",
    "exp",
    "from_matrix",
    "inverse_left_jacobian",
    "left_matrix",
    "log",
    "match_hemisphere",
    "mean",
    "normalize",
    "product",
    "right_matrix",
    "rotate",
    "slerp",
    "to_matrix",
    "vector_matrix",
]


#: Which entry of q = (q_1, q_2, q_3, q_4) stands where in H+(q) of eq. (20), with its sign.
LEFT = ((1, -2, -3, -4), (2, 1, -4, 3), (3, 4, 1, -2), (4, -3, 2, 1))

#: Rotations are given with three digits at least, each number off by so much at most: a
#: quaternion's norm then by up to twice, an element of ``R^T R`` by up to six times that.
DIGITS = 5e-4


def _constant(name: str, like: Tensor) -> Tensor:
    return _constants(like.dtype, like.device)[name]


@lru_cache
def _constants(dtype: torch.dtype, device: torch.device) -> dict[str, Tensor]:
    """Structure constants: a product with one of them stands for dozens of operations."""
    # what is made while inference mode is on could not serve where gradients are wanted
    with torch.inference_mode(False):
        left = torch.zeros(4, 4, 4, dtype=dtype)
        for row, column in itertools.product(range(4), range(4)):
            entry = LEFT[row][column]
            left[abs(entry) - 1, row, column] = math.copysign(1, entry)
        right = left.permute(2, 1, 0)
        conjugate = torch.tensor([1.0, -1.0, -1.0, -1.0], dtype=dtype)
        # q v conj(q) = H+(q) Hbar(conj q) v in the products q_i q_j
        rotation = (left[:, None] @ (conjugate[:, None, None] * right))[..., 1:, 1:]
        rotation = (rotation + rotation.transpose(0, 1)) / 2
        constants = {
            "one": torch.ones((), dtype=dtype),
            "conjugate": conjugate,
            "left": left.flatten(1),
            "right": right.flatten(1),
            "rotation": rotation.reshape(16, 9),
        }
        return {key: value.contiguous().to(device) for key, value in constants.items()}


@lru_cache
def _quaternion_sums(
    starts: tuple[int, ...], size: int, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Tabulate what sums each quaternion's coordinates, and a 1 for those of none."""
    with torch.inference_mode(False):
        sums = torch.zeros(size, size, dtype=dtype)
        for start in starts:
            sums[start : start + 4, start : start + 4] = 1.0
        return sums.to(device), (1.0 - sums.diagonal()).to(device)


def identity(dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Tensor:
    """Return the quaternion of no rotation, of that ``dtype``, on that ``device``."""
    return torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=dtype, device=device)


def product(a: Tensor, b: Tensor) -> Tensor:
    """Compute the Hamilton product ``a * b`` (eq. 18).

    Examples
    --------
    >>> i, j = torch.eye(4)[1], torch.eye(4)[2]
    >>> product(i, j).tolist()  # k
    [0.0, 0.0, 0.0, 1.0]
    """
    return (left_matrix(a) @ b[..., None])[..., 0]


def conjugate(q: Tensor) -> Tensor:
    """Compute ``(w, -x, -y, -z)``: the inverse rotation of a unit quaternion ``q``."""
    return q * _constant("conjugate", q)


def left_matrix(q: Tensor) -> Tensor:
    """Compute ``H+(q)`` of eq. (20): ``product(q, b) == left_matrix(q) @ b``."""
    return (q @ _constant("left", q)).unflatten(-1, (4, 4))


def right_matrix(q: Tensor) -> Tensor:
    """Compute ``Hbar(q)`` of eq. (20): ``product(a, q) == right_matrix(q) @ a``."""
    return (q @ _constant("right", q)).unflatten(-1, (4, 4))


def vector_matrix(q: Tensor) -> Tensor:
    """Compute ``Hbar*(q)`` of eq. (11): the lower three rows of :func:`right_matrix`.

    ``vector_matrix(q) @ a`` is the vector part of ``a * q``.
    """
    return right_matrix(q)[..., 1:, :]


def normalize(q: Tensor) -> Tensor:
    """Scale ``q`` to unit norm.

    Raises
    ------
    DataError
        If a quaternion is zero or not finite, so that it has no direction.
    """
    norm = torch.linalg.vector_norm(q, dim=-1, keepdim=True)
    if not bool(((norm > 0) & (norm < torch.inf)).all()):
        raise DataError("a quaternion is zero or not finite: it cannot be brought to unit norm")
    return q / norm


def hemisphere_sign(inner: Tensor) -> Tensor:
    """Return the sign, 1 or -1, that brings a quaternion to the side of a reference.

    Parameters
    ----------
    inner : Tensor
        Inner products of quaternions with their references; the real parts, where the
        reference is no rotation.
    """
    return torch.copysign(_constant("one", inner), inner)


def hemisphere_signs(x: Tensor, reference: Tensor, starts: Sequence[int] = (0,)) -> Tensor:
    """Return signs (..., D) that bring quaternions among coordinates to the reference.

    Parameters
    ----------
    x, reference : Tensor of shape (..., D)
        Coordinates, some of them quaternions; of others the sign is 1.
    starts : sequence of int, default=(0,)
        Where the quaternions begin.

    Examples
    --------
    >>> x, reference = -torch.ones(6), torch.ones(6)
    >>> hemisphere_signs(x, reference, [2]).tolist()
    [1.0, 1.0, -1.0, -1.0, -1.0, -1.0]
    """
    sums, others = _quaternion_sums(tuple(starts), x.shape[-1], x.dtype, x.device)
    return hemisphere_sign((x * reference) @ sums + others)


def match_hemisphere(x: Tensor, reference: Tensor, starts: Sequence[int] = (0,)) -> Tensor:
    """Choose of q and -q, one rotation, that whose inner product is not negative.

    Parameters
    ----------
    x, reference : Tensor of shape (..., D)
        Coordinates, and those to which sides are compared.
    starts : sequence of int, default=(0,)
        Where quaternions begin among the coordinates; others stay as they are.
    """
    return x * hemisphere_signs(x, reference, starts)


def continuous(q: Tensor, dim: int = -2, starts: Sequence[int] = (0,)) -> Tensor:
    """Remove the sign jumps along a sequence; the first quaternion keeps its sign.

    Parameters
    ----------
    q : Tensor of shape (..., T, D)
        A sequence of unit quaternions, or of coordinates with some among them, along ``dim``.
    dim : int, default=-2
        The dimension of time.
    starts : sequence of int, default=(0,)
        Where quaternions begin among the coordinates.

    Returns
    -------
    Tensor of the shape of ``q``
        The same rotations, each in the hemisphere of its predecessor.
    """
    q = q.movedim(dim, -2)
    if q.shape[-2] > 1:
        flips = hemisphere_signs(q[..., 1:, :], q[..., :-1, :], starts).cumprod(dim=-2)
        q = q * torch.cat((torch.ones_like(flips[..., :1, :]), flips), dim=-2)
    return q.movedim(-2, dim)


def exp(rotation_vector: Tensor) -> Tensor:
    """Compute the unit quaternion of a ``rotation_vector`` (axis times angle, rad).

    Examples
    --------
    >>> half_turn = exp(torch.tensor([0.0, 0.0, torch.pi]))
    >>> half_turn.round(decimals=6).abs().tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    square = (rotation_vector * rotation_vector).sum(-1, keepdim=True)
    small = square < 1e-12
    angle = torch.where(small, torch.ones_like(square), square).sqrt()
    # sin(angle / 2) / angle and cos(angle / 2), with their series where the angle vanishes
    scale = torch.where(small, 0.5 - square / 48.0, torch.sin(0.5 * angle) / angle)
    real = torch.where(small, 1.0 - square / 8.0, torch.cos(0.5 * angle))
    return torch.cat((real, scale * rotation_vector), dim=-1)


def log(q: Tensor) -> Tensor:
    """Compute the rotation vector (axis times angle in [0, pi], rad) of a unit quaternion.

    ``q`` and ``-q`` give the same vector, the shorter of the two ways; at half a turn, where
    both are equally long, opposite ones.
    """
    q = q * hemisphere_sign(q[..., :1])
    real, vector = q[..., :1], q[..., 1:]
    square = (vector * vector).sum(-1, keepdim=True)
    small = square < 1e-12
    sine = torch.where(small, torch.ones_like(square), square).sqrt()
    # angle / sin(angle / 2), with its series where the angle vanishes
    scale = torch.where(small, 2.0 + square / 3.0, 2.0 * torch.atan2(sine, real) / sine)
    return scale * vector


def left_jacobian(rotation_vector: Tensor) -> Tensor:
    """Compute ``J_l(y)`` of a ``rotation_vector`` y: how ``exp(y)`` turns with y.

    ``exp(y + dy) = exp(J_l(y) dy) exp(y)`` to first order.

    Its determinant, ``(sin(|y|/2) / (|y|/2))^2``, is the volume of rotations per volume of
    rotation vectors. Sola, Deray, Atchuthan: A micro Lie theory for state estimation in
    robotics, 2018, eq. (145).

    Examples
    --------
    >>> quarter = torch.tensor([0.0, 0.0, torch.pi / 2])
    >>> round(float(torch.linalg.det(left_jacobian(quarter))), 3)
    0.811
    """
    eye, cross, square, angle, small = _cross_and_angle(rotation_vector)
    first = torch.where(small, 0.5 - square / 24, (1 - torch.cos(angle)) / angle.square())
    second = torch.where(small, 1 / 6 - square / 120, (angle - torch.sin(angle)) / angle**3)
    return eye + first * cross + second * cross @ cross


def inverse_left_jacobian(rotation_vector: Tensor) -> Tensor:
    """Compute the inverse of :func:`left_jacobian` (eq. 146).

    Parameters
    ----------
    rotation_vector : Tensor of shape (..., 3)
        Of less than a full turn.
    """
    eye, cross, square, angle, small = _cross_and_angle(rotation_vector)
    exact = (1 - 0.5 * angle / torch.tan(0.5 * angle)) / angle.square()
    two = torch.where(small, 1 / 12 + square / 720, exact)
    return eye - 0.5 * cross + two * (cross @ cross)


def _cross_and_angle(vector: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Compute I, ``[y]x``, ``|y|^2``, ``|y|`` (1 where small) and whether it is small."""
    eye = torch.eye(3, dtype=vector.dtype, device=vector.device).expand(*vector.shape, 3)
    cross = torch.linalg.cross(vector.unsqueeze(-1).expand_as(eye), eye, dim=-2)
    square = vector.square().sum(-1)[..., None, None]
    small = square < 1e-4  # where the series serve
    angle = torch.where(small, torch.ones_like(square), square).sqrt()
    return eye, cross, square, angle, small


def mean(q: Tensor) -> Tensor:
    """Compute the Karcher mean (..., 4): to it squared angles add up to the least.

    Signs of quaternions do not matter. It is looked for from the eigenvector of
    ``sum q q^T`` to the largest eigenvalue, which decides where there are several.

    Parameters
    ----------
    q : Tensor of shape (..., N, 4)
        Unit quaternions.

    Examples
    --------
    >>> turns = torch.tensor([0.1, 0.2, 0.6]).double()[:, None] * torch.tensor([0.0, 0.0, 1.0])
    >>> round(float(log(mean(-exp(turns)))[2]), 6)
    0.3
    """
    found = torch.linalg.eigh(q.mT @ q).eigenvectors[..., -1]
    for _ in range(100):  # at most; a few are the rule
        step = log(product(conjugate(found).unsqueeze(-2), q)).mean(-2)
        found = normalize(product(found, exp(step)))
        if float(step.abs().amax()) < 1e2 * torch.finfo(q.dtype).eps:
            break
    return found


def interpolate(time: Tensor, knots: Tensor, q: Tensor) -> Tensor:
    """Interpolate orientations (..., 4) at ``time`` (...) of a path by slerp.

    Parameters
    ----------
    time : Tensor of shape (...)
        When orientations are wanted.
    knots : Tensor of shape (T,)
        Ascending times.
    q : Tensor of shape (T, 4)
        Unit quaternions at these.
    """
    if len(knots) == 1:
        return q[0].expand(*time.shape, 4)
    high = torch.searchsorted(knots, time.detach().contiguous()).clamp(1, len(knots) - 1)
    begin, end = knots[high - 1], knots[high]
    return slerp(q[high - 1], q[high], ((time - begin) / (end - begin)).clamp(0, 1))


def slerp(a: Tensor, b: Tensor, fraction: Tensor | float) -> Tensor:
    """Interpolate along the shorter great arc (spherical linear interpolation).

    Parameters
    ----------
    a, b : Tensor of shape (..., 4)
        Rotations at fraction 0 and 1.
    fraction : Tensor of shape (...) or float
        Where between them.

    Returns
    -------
    Tensor of shape (..., 4)
        In the hemisphere of ``a``.
    """
    step = log(product(match_hemisphere(b, a), conjugate(a)))
    fraction = torch.as_tensor(fraction, dtype=step.dtype, device=step.device)
    return product(exp(fraction[..., None] * step), a)


def rotate(q: Tensor, vector: Tensor) -> Tensor:
    """Rotate a ``vector`` by ``q``: ``R(q) v``."""
    real, axis = q[..., :1], q[..., 1:]
    axis, vector = torch.broadcast_tensors(axis, vector)
    twice = 2.0 * torch.linalg.cross(axis, vector)
    return vector + real * twice + torch.linalg.cross(axis, twice)


def to_matrix(q: Tensor) -> Tensor:
    """Compute rotation matrices (..., 3, 3) of unit quaternions ``q``."""
    pairs = (q[..., :, None] * q[..., None, :]).flatten(-2)
    return (pairs @ _constant("rotation", q)).unflatten(-1, (3, 3))


def from_matrix(matrix: Tensor) -> Tensor:
    """Compute unit quaternions of rotation matrices, real part non-negative.

    Of the four textbook formulas the one with the largest divisor is taken, so the result
    is exact to rounding at every angle, half turns included.

    Parameters
    ----------
    matrix : Tensor of shape (..., 3, 3)
        Rotation matrices.

    Raises
    ------
    ShapeError
        If the last two dimensions are not 3 x 3.
    DataError
        If a matrix is no rotation: its columns are no right-handed system of orthogonal unit
        vectors, by more than rounding to three digits would explain.
    """
    if matrix.shape[-2:] != (3, 3):
        raise ShapeError(f"rotation matrices have shape (..., 3, 3), got {tuple(matrix.shape)}")
    gram = matrix.mT @ matrix
    eye = torch.eye(4, dtype=matrix.dtype, device=matrix.device)
    error = (gram.detach() - eye[:3, :3]).abs().amax((-2, -1))
    if not bool((error <= 6 * DIGITS).all()):  # NaN is refused, too
        raise DataError(
            "a matrix is no rotation: R^T R differs from the identity by "
            f"{float(error.max()):.3g}, the tolerance is {6 * DIGITS:g}"
        )
    if bool((torch.linalg.det(matrix.detach()) < 0).any()):
        raise DataError("a matrix is no rotation but a reflection: its determinant is -1")
    outer = (matrix.flatten(-2) @ _constant("rotation", matrix).mT).unflatten(-1, (4, 4)) + eye
    # the column of the symmetric 4 q q^T that belongs to the largest entry of q
    largest = outer.diagonal(dim1=-2, dim2=-1).argmax(-1, keepdim=True).unsqueeze(-1)
    q = outer.gather(-1, largest.expand(*outer.shape[:-1], 1)).squeeze(-1)
    norm = torch.linalg.vector_norm(q, dim=-1, keepdim=True)
    return q / norm * hemisphere_sign(q[..., :1])
