"""Moderation of variances of which few demonstrations say little, by those of the same kind.

Three demonstrations leave a variance with two degrees of freedom: one in ten then comes out ten
times too small. Where the fusion weighs one hand, one joint, one frame against another by such
variances, chance decides. Coordinates of one kind tell how far variances differ in truth.

References
----------
Smyth: Linear models and empirical Bayes methods for assessing differential expression in
microarray experiments, Statistical Applications in Genetics and Molecular Biology 3 (2004).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

from tpgmm_torch.em.parameters import Parameters

__all__ = ["moderate", "moderated_variances", "trigamma_inverse"]

#: Newton's steps for the inverse of the trigamma function, which double their digits each.
STEPS = 20
#: Logarithms of variances that differ by no more than this beyond chance are alike.
ALIKE = 1e-9


def trigamma_inverse(value: Tensor) -> Tensor:
    """The x with ``trigamma(x) = value``, elementwise: Newton's method on ``1 / trigamma``.

    Convex from the start on, so that it converges from there (Smyth 2004, appendix).

    Parameters
    ----------
    value : Tensor of shape (...)
        Positive.
    """
    x = 0.5 + 1 / value
    for _ in range(STEPS):
        trigamma = torch.polygamma(1, x)
        x = x + trigamma * (1 - trigamma / value) / torch.polygamma(2, x)
    return x


def moderated_variances(variances: Tensor, freedom: Tensor | float) -> Tensor:
    """Posterior variances under a prior that the variances themselves tell, (..., G).

    With ``s_g^2 ~ sigma_g^2 chi^2_n / n`` and ``1 / sigma_g^2 ~ chi^2_m / (m s_0^2)`` it is
    ``(m s_0^2 + n s_g^2) / (m + n)``: the prior counts like m more degrees of freedom. Mean and
    variance over g of ``e_g = log s_g^2 - digamma(n / 2) + log(n / 2)`` tell m and s_0:
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
    prior = trigamma_inverse(excess.clamp(min=ALIKE))  # m / 2
    scale = (mean + torch.digamma(prior) - prior.log()).exp()
    posterior = (prior * scale + half * variances) / (prior + half)
    return torch.where(excess > ALIKE, posterior, mean.exp())


def moderate(
    parameters: Parameters,
    units: Sequence[Sequence[str | None]],
    n_samples: Tensor | float,
    *,
    given: int = 0,
) -> Parameters:
    """The mixture with the variances of columns of one unit moderated by each other.

    In each component and block, and given what stands in the first columns: correlations, and
    how the other columns depend on those, stay as they are.

    Parameters
    ----------
    parameters : Parameters
        One mixture, in units of the data.
    units : sequence of sequence of str or None
        For each block the unit of each of its columns after those that are given; None is
        for columns that are like no other.
    n_samples : float or Tensor of shape (K,)
        How many independent samples a component was learned from; what has one at most stays.
    given : int, default=0
        1, where each block begins with time.
    """
    factors = []
    for factor, names in zip(parameters.factors, units, strict=True):
        tail = factor[..., given:, given:]  # of the conditional covariance
        freedom = torch.as_tensor(n_samples).to(factor).expand(len(factor)) - 1.0
        told = freedom > 0
        variances = tail.square().sum(-1)
        moderated = variances.clone()
        for columns in _alike(names):
            found = moderated_variances(variances[:, columns], freedom.where(told, 1.0))
            moderated[:, columns] = found.where(told[:, None], variances[:, columns])
        factors.append(factor.clone())
        factors[-1][..., given:, given:] = tail * (moderated / variances).sqrt()[..., None]
    return Parameters(parameters.weights, parameters.means, tuple(factors))


def _alike(names: Sequence[str | None]) -> list[list[int]]:
    """Numbers of the columns that share a unit, at least two each."""
    known = sorted((name, column) for column, name in enumerate(names) if name is not None)
    groups = itertools.groupby(known, key=lambda one: one[0])
    alike = [[column for _, column in group] for _, group in groups]
    return [columns for columns in alike if len(columns) > 1]
