"""Gaussians in batches: products, conditioning, mixing (paper, section II-C).

Means have shape (..., D) and covariances (..., D, D); leading dimensions broadcast, and
every function is differentiable. A product of Gaussians is available in covariance form,
eq. (2) as printed, and in information form, which also takes constraints ``J x = y`` that
leave directions of ``x`` free, where eq. (2) would invert a singular matrix.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch.exceptions import DataError

__all__ = [
    "condition",
    "from_information",
    "information",
    "log_density",
    "moment_match",
    "product",
    "whiten",
]


#: Up to this many numbers Python is faster than an operation of the library.
FEW = 64


def common_shape(*shapes: torch.Size) -> torch.Size:
    """Broadcast shapes; torch takes most of a second for its first."""
    if len(set(shapes)) == 1:
        return shapes[0]
    return torch.Size(np.broadcast_shapes(*shapes))


def block_diagonal(matrices: Sequence[Tensor], batch: Sequence[int]) -> Tensor:
    """Join matrices on the diagonal of one, zero elsewhere.

    Parameters
    ----------
    matrices : sequence of Tensor of shape (..., m, n)
        From the upper left on.
    batch : sequence of int
        Shape of the batch, with which theirs broadcast.
    """
    sizes = [matrix.shape[-2:] for matrix in matrices]
    whole = matrices[0].new_zeros(*batch, *map(sum, zip(*sizes, strict=True)))
    row = column = 0
    for matrix, (rows, columns) in zip(matrices, sizes, strict=True):
        whole[..., row : row + rows, column : column + columns] = matrix
        row, column = row + rows, column + columns
    return whole


def cholesky(matrix: Tensor, name: str) -> Tensor:
    """Compute lower Cholesky factors, with an error that names the matrix.

    Parameters
    ----------
    matrix : Tensor of shape (..., D, D)
        Symmetric positive definite matrices.
    name : str
        How the error message calls them.

    Raises
    ------
    DataError
        If a matrix is not positive definite.
    """
    factor, info = torch.linalg.cholesky_ex(matrix)
    # of a few matrices, Python is faster than an operation
    if any(info.tolist()) if info.ndim == 1 and info.shape[0] <= FEW else info.any():
        raise DataError(
            f"{name} is not positive definite ({int((info != 0).sum())} of {info.numel()} "
            f"matrices of size {matrix.shape[-1]}): a direction has no variance; a larger "
            "regularisation (reg_covar, or epsilon of the covariance form) gives it some"
        )
    return factor


def whiten(covariance: Tensor, right: Tensor, name: str) -> Tensor:
    """Compute ``L^-1 R`` with ``L L^T`` the covariance: residuals in their deviations.

    Parameters
    ----------
    covariance, right : Tensor of shape (..., m, m) and (..., m, r)
        ``R`` are columns to be whitened.
    name : str
        How the error message calls the covariance.

    Raises
    ------
    DataError
        If a covariance is not positive definite. In a compiled graph, which asks nothing of
        its numbers, the result is not a number then.
    """
    if torch.compiler.is_compiling():
        return _eliminate(covariance, right)
    factor = cholesky(covariance, name)
    # transposed, so that the result is stored row by row
    return torch.linalg.solve_triangular(factor.mT, right.mT, upper=True, left=False).mT


def _eliminate(covariance: Tensor, right: Tensor) -> Tensor:
    """Compute :func:`whiten` row by row: loops that a compiler joins with others."""
    size = covariance.shape[-1]
    matrix, rows = torch.cat((covariance, right), -1), []
    for left in range(size, 0, -1):  # what is left of the covariance
        row = matrix[..., 0, :] * torch.rsqrt(matrix[..., 0, :1])
        rows.append(row[..., left:])
        below = row[..., 1:left].unsqueeze(-1)
        matrix = matrix[..., 1:, 1:] - below * row[..., 1:].unsqueeze(-2)
    return torch.stack(rows, -2)


def product(means: Tensor, covariances: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the normalised product of P Gaussians in covariance form, eq. (2).

    Parameters
    ----------
    means, covariances : Tensor of shape (P, ..., n) and (P, ..., n, n)
        Of the factors; positive definite.

    Raises
    ------
    DataError
        If one of the covariances is singular.

    Examples
    --------
    >>> means = torch.tensor([[0.0], [3.0]])
    >>> variances = torch.tensor([[[1.0]], [[2.0]]])
    >>> mean, variance = product(means, variances)  # nearer to the firmer one
    >>> round(float(mean), 3), round(float(variance), 3)
    (1.0, 0.667)
    """
    precisions = torch.cholesky_inverse(cholesky(covariances, "a factor of the product"))
    precision = precisions.sum(0)
    vector = (precisions @ means[..., None]).sum(0)[..., 0]
    return from_information(precision, vector)


def information(
    jacobian: Tensor | None, targets: Tensor, covariance: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the information about ``x`` in ``J x = y``, given with covariance ``S``.

    ``J^T S^-1 J`` is the Moore-Penrose inverse of ``J^+ S J^+^T`` where J has full row rank,
    so that sums of these terms are the product (2) of the projected Gaussians
    (1) without any pseudo-inverse; rows may also be dependent.

    Parameters
    ----------
    jacobian : Tensor of shape (..., m, n), optional
        ``J``; None stands for the identity.
    targets : Tensor of shape (..., m, r)
        Right-hand sides ``y``, as columns.
    covariance : Tensor of shape (..., m, m)
        ``S``, positive definite.

    Returns
    -------
    precision : Tensor of shape (..., n, n)
        ``J^T S^-1 J``.
    vector : Tensor of shape (..., n, r)
        ``J^T S^-1 y``.
    square : Tensor of shape (..., r, r)
        ``y^T S^-1 y``.

    Raises
    ------
    DataError
        If ``S`` is singular.

    Examples
    --------
    The sum of two numbers is observed, their difference is not:

    >>> jacobian, target = torch.tensor([[1.0, 1.0]]), torch.tensor([[2.0]])
    >>> precision, _, _ = information(jacobian, target, torch.tensor([[0.25]]))
    >>> precision.tolist()
    [[4.0, 4.0], [4.0, 4.0]]
    """
    name = "the covariance of a projected component"
    if jacobian is None:
        precision = torch.cholesky_inverse(cholesky(covariance, name))
        vector = precision @ targets
        return precision, vector, targets.mT @ vector
    n = jacobian.shape[-1]
    batch = common_shape(jacobian.shape[:-2], targets.shape[:-2], covariance.shape[:-2])
    right = torch.cat((jacobian.expand(*batch, -1, -1), targets.expand(*batch, -1, -1)), dim=-1)
    white = whiten(covariance, right, name)
    gram = white.mT @ white
    return gram[..., :n, :n], gram[..., :n, n:], gram[..., n:, n:]


def from_information(precision: Tensor, vector: Tensor) -> tuple[Tensor, Tensor]:
    """Compute mean ``precision^-1 vector`` and covariance ``precision^-1``.

    Parameters
    ----------
    precision, vector : Tensor of shape (..., n, n) and (..., n)
        Precision matrix and information vector.

    Raises
    ------
    DataError
        If the precision is singular: a direction is not determined by anything.
    """
    factor = cholesky(precision, "the precision of the product")
    mean = torch.cholesky_solve(vector[..., None], factor)[..., 0]
    return mean, torch.cholesky_inverse(factor)


def condition(mean: Tensor, covariance: Tensor, n_inputs: int) -> tuple[Tensor, Tensor]:
    """Condition a Gaussian on its first coordinates: regression of the others.

    ``E[x_o | x_i] = mean_o + gain (x_i - mean_i)``.

    Parameters
    ----------
    mean, covariance : Tensor of shape (..., D) and (..., D, D)
        Of inputs and outputs; of the mean only the shape matters.
    n_inputs : int
        How many of the leading coordinates are inputs.

    Returns
    -------
    gain : Tensor of shape (..., D - n_inputs, n_inputs)
        ``Sigma_oi Sigma_ii^-1``.
    covariance : Tensor of shape (..., D - n_inputs, D - n_inputs)
        ``Sigma_oo - gain Sigma_io``.

    Examples
    --------
    >>> covariance = torch.tensor([[1.0, 0.5], [0.5, 1.0]])
    >>> gain, rest = condition(torch.zeros(2), covariance, n_inputs=1)
    >>> float(gain), float(rest)
    (0.5, 0.75)
    """
    inputs = covariance[..., :n_inputs, :n_inputs]
    cross = covariance[..., :n_inputs, n_inputs:]
    gain = torch.cholesky_solve(cross, cholesky(inputs, "the covariance of the input")).mT
    return gain, covariance[..., n_inputs:, n_inputs:] - gain @ cross


def moment_match(weights: Tensor, means: Tensor, covariances: Tensor) -> tuple[Tensor, Tensor]:
    """Compute mean and covariance of a mixture (law of total variance).

    Parameters
    ----------
    weights : Tensor of shape (..., K)
        Sum to one.
    means, covariances : Tensor of shape (..., K, D) and (..., K, D, D)
        Of the components.

    Returns
    -------
    mean : Tensor of shape (..., D)
    covariance : Tensor of shape (..., D, D)
        Within the components and between them.

    Examples
    --------
    >>> means, variances = torch.tensor([[-1.0], [1.0]]), torch.zeros(2, 1, 1)
    >>> mean, covariance = moment_match(torch.tensor([0.5, 0.5]), means, variances)
    >>> float(mean), float(covariance)
    (0.0, 1.0)
    """
    row = weights.unsqueeze(-2)
    mean = row @ means
    residual = means - mean
    within = row @ covariances.flatten(-2)
    between = (weights.unsqueeze(-1) * residual).mT @ residual
    return mean.squeeze(-2), within.view(*within.shape[:-2], *covariances.shape[-2:]) + between


def log_density(
    residuals: Tensor, covariance: Tensor, name: str, degrees: float | None = None
) -> Tensor:
    """Compute the log-density of deviations from a mean, (..., r), in nats.

    Parameters
    ----------
    residuals : Tensor of shape (..., D, r)
        Deviations, as columns.
    covariance : Tensor of shape (..., D, D)
        Positive definite.
    name : str
        How the error message calls the covariance.
    degrees : float, optional
        Of freedom nu: Student's t, of which the covariance is the scale matrix. A covariance
        that is itself an estimate leaves wider tails. None is the normal law, its limit.

    Raises
    ------
    DataError
        If a covariance is not positive definite.

    Examples
    --------
    >>> far, variance = torch.tensor([[5.0]]), torch.tensor([[1.0]])
    >>> round(float(log_density(far, variance, "the variance")), 1)
    -13.4
    >>> round(float(log_density(far, variance, "the variance", degrees=2.0)), 1)
    -4.9
    """
    factor, size = cholesky(covariance, name), covariance.shape[-1]
    squares = torch.linalg.solve_triangular(factor, residuals, upper=False).square().sum(-2)
    log_root = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1, keepdim=True)
    if degrees is None:
        return -0.5 * (size * math.log(2 * math.pi) + squares) - log_root
    constant = math.lgamma((degrees + size) / 2) - math.lgamma(degrees / 2)
    constant -= size / 2 * math.log(degrees * math.pi)
    return constant - log_root - (degrees + size) / 2 * torch.log1p(squares / degrees)


def pseudo_inverse(matrix: Tensor) -> Tensor:
    """Compute the Moore-Penrose inverse ``J^+``, of eq. (1)'s A and b.

    Where every ``matrix`` (..., m, n) is well conditioned it is ``J^T (J J^T)^-1``: a singular
    value decomposition takes some ten times as long.

    Examples
    --------
    >>> pseudo_inverse(torch.tensor([[2.0, 0.0, 0.0], [0.0, 0.0, 0.0]])).T.tolist()
    [[0.5, 0.0, 0.0], [0.0, 0.0, 0.0]]
    """
    m, n = matrix.shape[-2:]
    if m <= n and matrix.numel():
        matrix = matrix.contiguous()  # products of matrices stored otherwise are slow
        gram = matrix @ matrix.mT
        factor, info = torch.linalg.cholesky_ex(gram)
        if not bool(info.any()):
            inverse = torch.cholesky_inverse(factor)
            # as many digits go as the condition number has: at most a third of them
            most = torch.finfo(matrix.dtype).eps ** (-1 / 3)
            norms = map(torch.linalg.matrix_norm, (gram.detach(), inverse.detach()))
            if bool((math.prod(norms) < most).all()):
                return matrix.mT @ inverse
    return torch.linalg.pinv(matrix)
