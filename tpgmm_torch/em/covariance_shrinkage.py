"""Shrinkage of covariances towards their diagonals, for few demonstrations.

N samples that vary together in fewer than D directions leave a covariance that is certain of
the others, by chance. Between that and a diagonal one lies a better estimate than both, the
closer to the diagonal, the fewer samples there are.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tpgmm_torch.em.parameters import Parameters

__all__ = ["oracle_approximating_intensity", "shrink", "shrinkage_intensity"]


def oracle_approximating_intensity(covariance: Tensor, freedom: Tensor | float) -> Tensor:
    """How far to shrink towards the diagonal, (...), from 0 to 1.

    The oracle approximating shrinkage of Chen, Wiesel, Eldar, Hero: Shrinkage Algorithms for
    MMSE Covariance Estimation, IEEE Transactions on Signal Processing 2010, equation (23), of
    the correlations R, for which the identity that it shrinks to is the diagonal: with
    ``tr R = D``,
    ``((1 - 2/D) tr R^2 + D^2) / ((n + 1 - 2/D) (tr R^2 - D))``, and at most 1. It falls as 1/n.

    Parameters
    ----------
    covariance : Tensor of shape (..., D, D)
        Positive definite.
    freedom : float or Tensor of shape (...)
        Degrees of freedom n of the estimate, one less than there were samples.
    """
    size = covariance.shape[-1]
    deviation = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    correlation = covariance / (deviation[..., :, None] * deviation[..., None, :])
    squares = correlation.square().sum((-2, -1))
    # without correlations there is nothing to shrink, and any intensity will do
    excess = (squares - size).clamp(min=torch.finfo(squares.dtype).tiny)
    numerator = (1 - 2 / size) * squares + size**2
    denominator = (freedom + 1 - 2 / size) * excess
    # at n = 0, D = 2 the denominator is zero: nothing is known of the correlation
    return torch.where(denominator > 0, numerator / denominator, 1.0).clamp(0.0, 1.0)


def shrinkage_intensity(
    covariance: Tensor, intensity: float | str, n_samples: Tensor | float
) -> Tensor:
    """The share l by which covariances (..., D, D) go towards their diagonals, (...).

    Parameters
    ----------
    covariance : Tensor of shape (..., D, D)
        Positive definite.
    intensity : float or "auto"
        The share itself, or :func:`oracle_approximating_intensity`.
    n_samples : float or Tensor of shape (...)
        How many independent samples a covariance was learned from.
    """
    if not isinstance(intensity, str):
        return covariance.new_full(covariance.shape[:-2], intensity)
    freedom = torch.as_tensor(n_samples).to(covariance) - 1.0
    return oracle_approximating_intensity(covariance, freedom.clamp(min=0))


def shrink(
    parameters: Parameters,
    intensity: float | str,
    n_samples: Tensor | float,
    *,
    given: int = 0,
) -> Parameters:
    """The mixture with its covariances moved towards their diagonals.

    ``C <- (1 - l) C + l diag(C)``, where C is the covariance of each block, or of what
    follows its first ``given`` columns, given these: how the other columns depend on them
    stays as it is.

    Parameters
    ----------
    parameters : Parameters
        One mixture.
    intensity : float or "auto"
        The share l, from 0 to 1, for each component and block as in
        :func:`shrinkage_intensity`.
    n_samples : float or Tensor of shape (K,)
        How many independent samples a component was learned from.
    given : int, default=0
        1, where each block begins with time: slopes over time are kept.
    """
    factors = []
    for factor in parameters.factors:
        tail = factor[..., given:, given:]  # of the conditional covariance
        if tail.shape[-1] < 2:
            factors.append(factor)
            continue
        covariance = tail @ tail.mT
        share = shrinkage_intensity(covariance, intensity, n_samples)[..., None, None]
        diagonal = torch.diag_embed(covariance.diagonal(dim1=-2, dim2=-1))
        shrunk = torch.linalg.cholesky((1 - share) * covariance + share * diagonal)
        # a share of 0 is the factor itself, to the last digit
        shrunk = torch.where(share > 0, shrunk, tail)
        factors.append(factor.clone())
        factors[-1][..., given:, given:] = shrunk
    return Parameters(parameters.weights, parameters.means, tuple(factors))
