"""Families of covariances, and the regularisation that keeps them away from zero."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch.em.parameters import Parameters, Standardization
from tpgmm_torch.exceptions import DataError, ShapeError

__all__ = ["CovarianceFamily"]

#: Least regularisation, as a share of the variance, that survives rounding.
SMALLEST_SHARE = {torch.float64: 1e-12, torch.float32: 2e-6}


@dataclass(frozen=True)
class CovarianceFamily:
    """Which covariances a mixture may have, in standardised units.

    Parameters
    ----------
    covariance_type : {"full", "tied", "diag", "spherical"}
    diagonals : tuple of Tensor of shape ([S,] D_j)
        Per block the diagonal of the regularisation ``Lambda``; with a leading dimension, that
        of each of S mixtures.
    """

    covariance_type: str
    diagonals: tuple[Tensor, ...]

    @classmethod
    def regularized(
        cls,
        covariance_type: str,
        units: Standardization,
        amount: float | Sequence[float] | NDArray[np.float64],
        *,
        relative: bool,
        dtype: torch.dtype,
    ) -> "CovarianceFamily":
        """The family with a regularisation in units of the data.

        Parameters
        ----------
        covariance_type : {"full", "tied", "diag", "spherical"}
        units : Standardization
            The units of the family.
        amount : float or array-like of shape (n_features,)
            The regularisation: a share of the variance, or in squared units of the data.
        relative : bool
            Which of the two.
        dtype : torch.dtype
            Precision of the computation, which sets the least regularisation.

        Raises
        ------
        ShapeError, DataError
            If ``amount`` is neither one number nor one per column, or negative.
        """
        widths = units.widths
        amounts = np.asarray(amount, dtype=np.float64)
        if amounts.shape not in ((), (sum(widths),)):
            raise ShapeError(
                f"reg_covar is one number or one for each of the {sum(widths)} columns, "
                f"got shape {amounts.shape}"
            )
        if not (np.isfinite(amounts) & (amounts >= 0)).all():
            raise DataError(f"reg_covar must be finite and not negative, got {amount!r}")
        columns = torch.from_numpy(np.broadcast_to(amounts, sum(widths)).copy()).split(widths)
        shares = (
            column.to(scale) if relative else column.to(scale) / scale**2
            for column, scale in zip(columns, units.scales, strict=True)
        )
        smallest = SMALLEST_SHARE[dtype]
        return cls(covariance_type, tuple(share.clamp(min=smallest) for share in shares))

    @classmethod
    def stack(cls, families: Sequence["CovarianceFamily"]) -> "CovarianceFamily":
        """The families of S mixtures, of one covariance type."""
        diagonals = zip(*(family.diagonals for family in families), strict=True)
        return cls(families[0].covariance_type, tuple(map(torch.stack, diagonals)))

    def __getitem__(self, index: Any) -> "CovarianceFamily":
        """The families of some of S mixtures."""
        diagonals = tuple(diagonal[index] for diagonal in self.diagonals)
        return CovarianceFamily(self.covariance_type, diagonals)

    def rescaled(self, old: Standardization, new: Standardization) -> "CovarianceFamily":
        """The same in other units."""
        shares = zip(self.diagonals, old.scales, new.scales, strict=True)
        diagonals = tuple(share * (a / b) ** 2 for share, a, b in shares)
        return CovarianceFamily(self.covariance_type, diagonals)

    def restrict(self, covariance: Tensor, weights: Tensor) -> Tensor:
        """The most likely member for scatter matrices of the components.

        Parameters
        ----------
        covariance : Tensor of shape ([S,] K, D_j, D_j)
        weights : Tensor of shape ([S,] K)
        """
        match self.covariance_type:
            case "tied":
                pooled = (weights[..., None, None] * covariance).sum(-3, keepdim=True)
                return pooled.expand_as(covariance)
            case "diag":
                return torch.diag_embed(covariance.diagonal(dim1=-2, dim2=-1))
            case "spherical":
                variance = covariance.diagonal(dim1=-2, dim2=-1).mean(-1)
                eye = torch.eye(covariance.shape[-1]).to(covariance)
                return variance[..., None, None] * eye
        return covariance

    def add(self, covariance: Tensor, block: int) -> Tensor:
        """``Sigma + Lambda``, for covariances ([S,] K, D_j, D_j) of one block."""
        return covariance + torch.diag_embed(self.diagonals[block])[..., None, :, :]

    def floor(self, covariance: Tensor, block: int) -> Tensor:
        """Raise to ``Lambda`` what is below it: the most likely one with Sigma - Lambda >= 0.

        ``-log|Sigma| - tr(Sigma^-1 S)`` under that constraint is largest where the
        eigenvalues of ``Lambda^-1/2 S Lambda^-1/2`` below 1 are replaced by 1.
        """
        root = self.diagonals[block].sqrt()
        outer = (root[..., :, None] * root[..., None, :])[..., None, :, :]
        values, vectors = torch.linalg.eigh(covariance / outer)
        floored: Tensor = (vectors * values.clamp(min=1.0)[..., None, :]) @ vectors.mT * outer
        return floored

    def admit(self, parameters: Parameters) -> Parameters:
        """Bring any mixture into the family and above the regularisation."""
        covariances = [
            self.floor(self.restrict(covariance, parameters.weights), block)
            for block, covariance in enumerate(parameters.covariances)
        ]
        return Parameters.from_covariances(parameters.weights, parameters.means, covariances)
