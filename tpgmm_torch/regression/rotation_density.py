"""The density of what was seen, orientations counted as rotations: one measure for all.

Quaternions have a density over four coordinates, rotation vectors one over three: as they stand
they cannot be compared. What both are about is a rotation, whose volume element is that of
small rotation vectors [rad^3], ``8 pi^2`` in all.

A rotation vector y takes up ``|J_l(y)| = (sin(|y|/2) / (|y|/2))^2`` of it, so that its density
is divided by that. A Gaussian over four coordinates gives most of its mass to numbers that are
no unit quaternions. Of these nothing is asked: it is restricted to the sphere and normalised,

    p(x, eps | t) = sum_i h_i p_i(x, eps | t) / sum_i h_i Z_i,
    Z_i = int p_i(eps | t) d eps   over one hemisphere about the mean,

which favours it, as EM spent some of its likelihood elsewhere. The integral is found by
importance sampling in the tangent space of the mean's direction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from tpgmm_torch import gaussians, quaternions
from tpgmm_torch.regression.conditionals import Conditionals
from tpgmm_torch.regression.regression import Regression

__all__ = ["rotation_log_density"]

#: How much wider proposals are than what is integrated, as a factor of the covariance.
WIDER = 1.2


def rotation_log_density(
    regression: Regression, time: Tensor, local: Sequence[Tensor], n_samples: int = 400
) -> Tensor:
    """Log-density (T,) of time and local coordinates, orientations per volume of rotations.

    Without orientations it is :meth:`Regression.log_density`.

    Parameters
    ----------
    regression : Regression
        Of a robot without quaternions among its joints.
    time : Tensor of shape (T,)
    local : sequence of Tensor of shape (T, D_j)
        Local coordinates of each operator; quaternions on the side that is expected.
    n_samples : int, default=400
        Of the importance sampling, the same at each call.
    """
    total = regression.log_density(time, local)
    constant, four = time.new_zeros(()), False
    for operator, one, x in zip(
        regression.operators, regression.conditionals, local, strict=True
    ):
        for start in operator.rotation_vector_starts(regression.kinematics):
            vector = x[:, start : start + 3]
            total = total - torch.linalg.det(quaternions.left_jacobian(vector)).log()
        starts = operator.quaternion_starts(regression.kinematics)
        if starts and operator.links():
            columns = torch.tensor([start + i for start in starts for i in range(4)])
            constant = constant + _log_mass(one.marginal(columns), time, n_samples)
            four = True
    if not four:
        return total
    activation = torch.log_softmax(regression.marginals.log_activation(time[:, None]), -1)
    return total - torch.logsumexp(activation + constant, -1)


def _log_mass(one: Conditionals, time: Tensor, n_samples: int) -> Tensor:
    """Logarithm of Z (T, K): what Gaussians over quaternions leave to rotations."""
    mean, covariance = one.at(time), one.covariance
    count = mean.shape[-1] // 4
    centre = torch.nn.functional.normalize(mean.unflatten(-1, (count, 4)), dim=-1)
    basis = mean.new_zeros(*mean.shape, 3 * count)
    for k in range(count):
        turned = quaternions.left_matrix(centre[..., k, :])[..., 1:]
        basis[..., 4 * k : 4 * k + 4, 3 * k : 3 * k + 3] = 0.5 * turned
    factor = gaussians.cholesky(covariance, "the covariance of a component")
    white = torch.linalg.solve_triangular(factor, basis, upper=False)
    wide = gaussians.cholesky(WIDER * torch.linalg.inv(white.mT @ white), "a proposal")
    generator = torch.Generator().manual_seed(0)
    draws = torch.randn(n_samples, 3 * count, generator=generator, dtype=torch.float64)
    draws = draws.to(mean)
    vectors = (wide.unsqueeze(-3) @ draws.unsqueeze(-1))[..., 0].unflatten(-1, (count, 3))
    proposal = -0.5 * draws.square().sum(-1) - _log_normaliser(wide).unsqueeze(-1)
    q = quaternions.product(centre.unsqueeze(-3), quaternions.exp(vectors)).flatten(-2)
    residual = torch.linalg.solve_triangular(factor, (q - mean.unsqueeze(-2)).mT, upper=False)
    density = -0.5 * residual.square().sum(-2) - _log_normaliser(factor).unsqueeze(-1)
    volume = torch.linalg.det(quaternions.left_jacobian(vectors)).clamp(min=1e-300).log()
    inside = (torch.linalg.vector_norm(vectors, dim=-1) < math.pi).all(-1)
    terms = torch.where(inside, density + volume.sum(-1) - proposal, -torch.inf)
    return terms.logsumexp(-1) - math.log(n_samples)


def _log_normaliser(factor: Tensor) -> Tensor:
    """``log sqrt(|2 pi L L^T|)``."""
    diagonal = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return diagonal + 0.5 * factor.shape[-1] * math.log(2 * math.pi)
