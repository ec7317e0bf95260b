"""Shrinkage of covariances towards their diagonals, and of variances towards each other.

N samples that vary together in fewer than D directions leave a covariance that is certain of
the others, by chance. Between that and a diagonal one lies a better estimate than both, the
closer to the diagonal, the fewer samples there are. Three samples leave a variance with two
degrees of freedom: one in ten then comes out ten times too small, and the other variances of
quantities of one kind say how far they differ in truth.

References
----------
Chen, Wiesel, Eldar, Hero: Shrinkage Algorithms for MMSE Covariance Estimation, IEEE
Transactions on Signal Processing 58 (2010).

Smyth: Linear models and empirical Bayes methods for assessing differential expression in
microarray experiments, Statistical Applications in Genetics and Molecular Biology 3 (2004).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def shrinkage_intensity(
    covariance: Tensor, intensity: float | str, n_samples: Tensor | float
) -> Tensor:
    """Compute the share l by which covariances go towards their diagonals, (...).

    "auto" is the oracle approximating shrinkage of Chen et al., equation (23), of the
    correlations R, for which the identity that it shrinks to is the diagonal: with
    ``tr R = D`` and n one less than there were samples,
    ``((1 - 2/D) tr R^2 + D^2) / ((n + 1 - 2/D) (tr R^2 - D))``, and at most 1. It falls as 1/n.

    Parameters
    ----------
    covariance : Tensor of shape (..., D, D)
        Positive definite.
    intensity : float or "auto"
        The share itself, or "auto" to estimate it.
    n_samples : float or Tensor of shape (...)
        How many independent samples a covariance was learned from.
    """
    if not isinstance(intensity, str):
        return covariance.new_full(covariance.shape[:-2], intensity)
    size, freedom = covariance.shape[-1], torch.as_tensor(n_samples).to(covariance) - 1.0
    deviation = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    correlation = covariance / (deviation[..., :, None] * deviation[..., None, :])
    squares = correlation.square().sum((-2, -1))
    # without correlations there is nothing to shrink, and any intensity will do
    excess = (squares - size).clamp(min=torch.finfo(squares.dtype).tiny)
    denominator = (freedom.clamp(min=0) + 1 - 2 / size) * excess
    # at n = 0, D = 2 the denominator is zero: nothing is known of the correlation
    share = ((1 - 2 / size) * squares + size**2) / denominator
    return torch.where(denominator > 0, share, 1.0).clamp(0.0, 1.0)


def shrink(
    covariances: Tensor,
    intensity: float | str,
    n_samples: Tensor | float,
    units: Sequence[str | None] = (),
    *,
    given: int = 0,
) -> Tensor:
    """Move covariances towards their diagonals, variances of one unit towards each other.

    ``C <- (1 - l) C + l diag(C)``, where C is the covariance of what follows the first
    ``given`` columns, given these: how the other columns depend on them stays as it is. Then
    the variances of C change, and its correlations stay.

    Parameters
    ----------
    covariances : Tensor of shape (K, D, D)
        Positive definite, one for each component.
    intensity : float or "auto"
        The share l, from 0 to 1, as in :func:`shrinkage_intensity`.
    n_samples : float or Tensor of shape (K,)
        How many independent samples a component was learned from; the variances of what has
        one at most stay.
    units : sequence of str or None, of shape (D,)
        Columns of one unit are moderated by each other; None is for those that are like no
        other. By default all are.
    given : int, default=0
        1, where the first column is time.
    """
    before, mixed = covariances[:, :given, :given], covariances[:, given:, :given]
    explained = mixed @ torch.linalg.solve(before, mixed.mT)
    residual = covariances[:, given:, given:] - explained
    if residual.shape[-1] > 1:
        share = shrinkage_intensity(residual, intensity, n_samples)[:, None, None]
        residual = (1 - share) * residual + share * torch.diag_embed(
            residual.diagonal(dim1=1, dim2=2)
        )
    freedom = torch.as_tensor(n_samples).to(residual).expand(len(residual)) - 1.0
    several = freedom > 0
    variances = residual.diagonal(dim1=1, dim2=2)
    moderated = variances.clone()
    for unit in sorted({unit for unit in units[given:] if unit is not None}):
        alike = [column for column, other in enumerate(units[given:]) if other == unit]
        if len(alike) > 1:
            found = moderated_variances(variances[:, alike], freedom.where(several, 1.0))
            moderated[:, alike] = found.where(several[:, None], variances[:, alike])
    ratio = (moderated / variances).sqrt()
    shrunk = covariances.clone()
    shrunk[:, given:, given:] = residual * ratio[:, :, None] * ratio[:, None] + explained
    return shrunk


def moderated_variances(variances: Tensor, freedom: Tensor | float) -> Tensor:
    """Compute posterior variances (..., G) under a prior estimated from them.

    With ``s_g^2 ~ sigma_g^2 chi^2_n / n`` and ``1 / sigma_g^2 ~ chi^2_m / (m s_0^2)`` it is
    ``(m s_0^2 + n s_g^2) / (m + n)``: the prior counts like m more degrees of freedom. Mean and
    variance over g of ``e_g = log s_g^2 - digamma(n / 2) + log(n / 2)`` give m and s_0 (Smyth):
    ``trigamma(m / 2) = var e - trigamma(n / 2)``,
    ``log s_0^2 = mean e + digamma(m / 2) - log(m / 2)``. Variances that differ by less than
    chance would have them differ are all the same one, ``m = inf``; what differ by orders of
    magnitude stay as they are.

    Parameters
    ----------
    variances : Tensor of shape (..., G)
        Positive, of quantities of one kind and unit, G at least 2.
    freedom : float or Tensor of shape (...)
        Degrees of freedom n of each, positive.
    """
    half = torch.as_tensor(freedom).to(variances)[..., None] / 2
    logs = variances.log() - torch.digamma(half) + half.log()
    mean = logs.mean(-1, keepdim=True)
    excess = logs.var(-1, keepdim=True) - torch.polygamma(1, half)
    alike = torch.finfo(excess.dtype).eps ** 0.5  # below it the two results are equal
    prior = trigamma_inverse(excess.clamp(min=alike))  # m / 2
    scale = (mean + torch.digamma(prior) - prior.log()).exp()
    posterior = (prior * scale + half * variances) / (prior + half)
    return torch.where(excess > alike, posterior, mean.exp())


def trigamma_inverse(value: Tensor, n_steps: int = 20) -> Tensor:
    """Solve ``trigamma(x) = value`` for x, elementwise, of positive values.

    By Newton's method on ``1 / trigamma``, which is convex from the start on and converges from
    there (Smyth, appendix); each of ``n_steps`` doubles the number of right digits.
    """
    x = 0.5 + 1 / value
    for _ in range(n_steps):
        trigamma = torch.polygamma(1, x)
        x = x + trigamma * (1 - trigamma / value) / torch.polygamma(2, x)
    return x
