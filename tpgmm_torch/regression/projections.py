"""Components of an operator as measurements of the joints, and in joint space by eq. (1)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from tpgmm_torch import gaussians
from tpgmm_torch.operators import Linearization

__all__ = ["Projection"]


@dataclass(frozen=True, eq=False)
class Projection:
    """Components that say ``J (q - q_{t-1}) ~ N(targets, covariance)``.

    Parameters
    ----------
    jacobian : Tensor of shape (..., 1, m, n), or None
        None is the identity.
    targets : Tensor of shape (..., K, m, r)
        Columns: the mean and, for the product activation, its time derivative.
    covariance : Tensor of shape (..., K, m, m)
    """

    jacobian: Tensor | None
    targets: Tensor
    covariance: Tensor

    @classmethod
    def of(cls, at: Linearization, columns: Tensor, covariance: Tensor) -> Projection:
        """``M mu + c``, its derivatives, and ``M Sigma M^T``.

        Parameters
        ----------
        at : Linearization
        columns : Tensor of shape (..., K, D, r)
            Local means and, for the product activation, their time derivatives.
        covariance : Tensor of shape (..., K, D, D)
        """
        if at.matrix is not None:
            matrix = at.matrix[..., None, :, :]
            columns, covariance = matrix @ columns, matrix @ covariance @ matrix.mT
        if at.noise is not None:
            covariance = covariance + at.noise.diag_embed()[..., None, :, :]
        mean = columns[..., :1] + at.displacement[..., None, :, None]
        rates = columns[..., 1:].expand(*mean.shape[:-1], -1)
        jacobian = None if at.jacobian is None else at.jacobian[..., None, :, :]
        return cls(jacobian, torch.cat((mean, rates), -1), covariance)

    def in_joint_space(self, epsilon: float = 0.0) -> Projection:
        """Eq. (1): ``A mu + b - q_{t-1}`` and ``A Sigma A^T + epsilon I``."""
        targets, covariance = self.targets, self.covariance
        if self.jacobian is not None:
            inverse = gaussians.pseudo_inverse(self.jacobian)
            targets, covariance = inverse @ targets, inverse @ covariance @ inverse.mT
        if epsilon:
            size = covariance.shape[-1]
            identity = torch.eye(size, dtype=covariance.dtype, device=covariance.device)
            covariance = covariance + epsilon * identity
        return Projection(None, targets, covariance)
