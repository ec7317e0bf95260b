"""The log-density of mixtures, in the whitened coordinates of their components.

With ``Sigma = L L^T``, ``y = L^-1 (x - mu)`` loses no digits however narrow a component is.
Appending a 1 to ``x`` and ``y`` makes that one matrix product per block, for all components of
all mixtures.
"""

import math

import torch
from torch import Tensor

from tpgmm_torch.em.parameters import Parameters
from tpgmm_torch.em.points import Chunk

__all__ = ["Whitener", "select"]


class Whitener:
    """Takes points to the whitened coordinates of the components of S mixtures.

    Parameters
    ----------
    parameters : Parameters
        One mixture, or S of them.
    dtype : torch.dtype
        Precision of the points.

    Attributes
    ----------
    maps : list of Tensor of shape (S * K, D_j + 1, D_j + 1)
        Per block, in float64, what takes (x; 1) to (y; 1).
    constant : Tensor of shape (S * K,)
        In float64, what the log-density is at (y; 1) = 0.
    """

    def __init__(self, parameters: Parameters, dtype: torch.dtype) -> None:
        self.dtype = dtype
        self.maps: list[Tensor] = []
        self.constant = parameters.weights.log().flatten()
        for mean, factor in zip(parameters.means, parameters.factors, strict=True):
            mean, factor = mean.flatten(0, -2), factor.flatten(0, -3)
            count, width = mean.shape
            shifted = torch.eye(width, width + 1).to(mean).repeat(count, 1, 1)
            shifted[:, :, width] = -mean
            homogeneous = torch.zeros(count, width + 1, width + 1).to(mean)
            homogeneous[:, width, width] = 1.0
            homogeneous[:, :width] = torch.linalg.solve_triangular(factor, shifted, upper=False)
            self.maps.append(homogeneous)
            log_determinant = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
            # the appended 1 adds 1/2 to half the squared norm of (y; 1)
            normalizer = log_determinant + (width * math.log(2 * math.pi) - 1) / 2
            self.constant = self.constant - normalizer
        self._maps = [whitening.to(dtype) for whitening in self.maps]
        self._constant = self.constant.to(dtype)[:, None]

    @property
    def peaks(self) -> Tensor:
        """Log of weight times density at the means, where (y; 1) = (0; 1), shape (S * K,)."""
        return self.constant - len(self.maps) / 2

    def log_joint(self, chunk: Chunk, components: Tensor | None = None) -> tuple[Tensor, Chunk]:
        """Log of ``pi_k prod_j N(x_j | mu_kj, Sigma_kj)``, and the whitened coordinates.

        Parameters
        ----------
        chunk : tuple of Tensor of shape (D_j + 1, n)
        components : Tensor of shape (A,), optional
            Those that are evaluated; all S * K by default.

        Returns
        -------
        Tensor of shape (A, n)
        tuple of Tensor of shape (A, D_j + 1, n)
            (y; 1) per block, which the caller may change.
        """
        joint = select(self._constant, components)
        whitened = []
        for maps, x in zip(self._maps, chunk, strict=True):
            used = select(maps, components)
            y = (used.flatten(0, 1) @ x).view(len(used), len(x), -1)
            joint = torch.sub(joint, y.square().sum(1), alpha=0.5)
            whitened.append(y)
        return joint, tuple(whitened)


def select(rows: Tensor, components: Tensor | None) -> Tensor:
    """The rows of some components, or all where they are None."""
    return rows if components is None else rows.index_select(0, components)
