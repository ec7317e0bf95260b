"""A prior of covariances that stands for what EM does: regularisation and shrinkage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from lerobot_policy_tpgmm.mixture_parameters import MixtureParameters
from tpgmm_torch.mixture.covariance_shrinkage import shrinkage_intensity

__all__ = ["CovariancePrior"]

#: A share of 1 would be infinitely many samples of the prior.
LARGEST_SHARE = 0.999


@dataclass(frozen=True, eq=False)
class CovariancePrior:
    """A prior whose most probable covariances are those that EM regularises and shrinks.

    Shrinkage by a share l, ``(1 - l) C + l diag(C)``, is what the most probable covariance is
    after ``l / (1 - l)`` times as many more samples, whose coordinates vary as much as those of
    the data, but independently.

    Parameters
    ----------
    regularization : list of Tensor of shape (1 + D_j,)
        The diagonals of ``Lambda``, which EM adds to covariances, in squared units of the
        coordinates.
    strengths : list of Tensor of shape (K,)
        ``l / (1 - l)``.
    """

    regularization: list[Tensor]
    strengths: list[Tensor]

    @classmethod
    @torch.no_grad()
    def of(
        cls,
        mixture: MixtureParameters,
        points: Sequence[Tensor],
        regularization: list[Tensor],
        intensity: float | str,
        n_demonstrations: int,
    ) -> Self:
        """The prior of a mixture, from the points that it answers for.

        Parameters
        ----------
        mixture : MixtureParameters
            Fitted.
        points : sequence of Tensor of shape (N, 1 + D_j)
            All of the demonstrations.
        regularization : list of Tensor of shape (1 + D_j,)
        intensity : float or "auto"
            ``covariance_shrinkage``.
        n_demonstrations : int
        """
        shares = torch.softmax(mixture.log_joint(points), 0)
        shares /= shares.sum(1, keepdim=True).clamp(min=torch.finfo(shares.dtype).tiny)
        strengths = []
        for x, added in zip(points, regularization, strict=True):
            scatters = []
            for share in shares:
                centred = x - share @ x
                scatters.append((share[:, None] * centred).mT @ centred)
            # as in EM: of what follows time, given time
            tail = torch.linalg.cholesky(torch.stack(scatters) + added.diag())[:, 1:, 1:]
            share = shrinkage_intensity(tail @ tail.mT, intensity, n_demonstrations)
            share = share.clamp(max=LARGEST_SHARE)
            strengths.append(share / (1 - share))
        return cls(regularization, strengths)

    def penalty(self, triangles: Sequence[Tensor]) -> Tensor:
        """Penalty added to the negative log-likelihood per point of each component, (K,).

        ``tr(Sigma^-1 Lambda) / 2``, and ``l / (1 - l)`` times the Kullback-Leibler divergence
        from the diagonal D of the covariance C given time to C itself,
        ``(tr(C^-1 D) - log det(C^-1 D) - D_j) / 2``. D is a constant to the gradient: its
        variances follow from the data alone.

        Parameters
        ----------
        triangles : sequence of Tensor of shape (K, 1 + D_j, 1 + D_j)
            Lower Cholesky factors of the covariances.
        """
        penalty = torch.zeros_like(triangles[0][:, 0, 0])
        pairs = zip(triangles, self.regularization, self.strengths, strict=True)
        for triangle, added, strength in pairs:
            penalty = penalty + _half_trace(triangle, added.expand(len(triangle), -1))
            tail = triangle[:, 1:, 1:]
            diagonal = tail.detach().square().sum(2)
            logarithms = 2 * tail.diagonal(dim1=-2, dim2=-1).log() - diagonal.log()
            divergence = _half_trace(tail, diagonal) + (logarithms - 1).sum(1) / 2
            penalty = penalty + strength * divergence
        return penalty


def _half_trace(triangle: Tensor, diagonal: Tensor) -> Tensor:
    """``tr(Sigma^-1 diag(d)) / 2`` of covariances of such factors."""
    roots = diagonal.sqrt().diag_embed()
    whitened = torch.linalg.solve_triangular(triangle, roots, upper=False)
    return whitened.square().sum((1, 2)) / 2
