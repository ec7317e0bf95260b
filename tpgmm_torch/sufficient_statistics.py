"""Second moments of the points under the responsibilities, in two formulations.

Both hold, for every component and block, ``sum_n gamma (y; 1) (y; 1)^T`` in the whitened
coordinates of the present mixture: mass, mean and scatter together, summed in float64.

:class:`WhitenedStatistics` whitens the points for each component. It loses no digits however
narrow a component is. :class:`PackedStatistics` expands each point once, for all components,
into the products of its coordinates, whereupon densities and moments are one matrix product
each; its densities lose as many digits as the squared precision of a component has.
"""

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from tpgmm_torch.block_gaussians import Chunk, Parameters, Whitener

__all__ = ["PackedStatistics", "Statistics", "WhitenedStatistics", "statistics"]

#: The packed form is taken below this trace of the precision of a component, in standardised
#: units: its log-densities are then off by about 1e-8 at most ...
SHARPEST = 1e8

#: ... and from this number of points on: fewer gain nothing worth a digit.
MANY_POINTS = 4096

#: By how much a mean log-density may be off, relative to 1 and to itself.
ROUNDING = {torch.float64: 2e-13, torch.float32: 1e-5}


class Statistics(Protocol):
    """Chunk by chunk: the joint log-density first, then what its responsibilities gather.

    Attributes
    ----------
    rounding : float
        By how much a mean log-density may be off, relative to 1 and to itself.
    """

    rounding: float

    def joint(self, chunk: Chunk) -> Tensor:
        """Log of ``pi_k prod_j N(x_j | mu_kj, Sigma_kj)``, shape (K, n)."""

    def gather(self, responsibilities: Tensor) -> None:
        """Add the chunk given last, with responsibilities (K, n) that may be overwritten."""

    def moments(self) -> tuple[Tensor, ...]:
        """The sums per block, shape (K, D_j + 1, D_j + 1)."""


class WhitenedStatistics:
    """Moments taken in whitened coordinates; see the module.

    Parameters
    ----------
    whitener : Whitener
    dtype : torch.dtype
        Precision of the points.
    """

    def __init__(self, whitener: Whitener, dtype: torch.dtype) -> None:
        self.rounding = ROUNDING[dtype]
        self._whitener = whitener
        self._sums = tuple(torch.zeros_like(whitener) for whitener in whitener.maps)
        self._whitened: Chunk = ()

    def joint(self, chunk: Chunk) -> Tensor:
        """Log of ``pi_k prod_j N(x_j | mu_kj, Sigma_kj)``, shape (K, n)."""
        joint, self._whitened = self._whitener(chunk)
        return joint

    def gather(self, responsibilities: Tensor) -> None:
        """Add the chunk given last, with responsibilities (K, n), which are overwritten."""
        roots = responsibilities.sqrt_()[:, None]
        for total, y in zip(self._sums, self._whitened, strict=True):
            y.mul_(roots)
            total += torch.bmm(y, y.mT)

    def moments(self) -> tuple[Tensor, ...]:
        """The sums per block, shape (K, D_j + 1, D_j + 1)."""
        return self._sums


class PackedStatistics:
    """Moments taken in products of coordinates; see the module.

    ``log(pi_k N_k(x)) = theta_k . phi(x)``, where ``phi`` holds the products ``x_a x_b``,
    a <= b, of the coordinates of (x; 1), block by block: F numbers.

    Parameters
    ----------
    whitener : Whitener
    """

    def __init__(self, whitener: Whitener) -> None:
        self._maps = whitener.maps
        self._pairs = [
            torch.triu_indices(m.shape[-1], m.shape[-1], device=m.device) for m in self._maps
        ]
        coefficients = []
        for whitening, (row, column) in zip(self._maps, self._pairs, strict=True):
            precision = whitening.mT @ whitening
            coefficients.append(-precision[:, row, column] * (1 - (row == column) / 2))
        # the product of the last block's appended 1 with itself is the constant's
        coefficients[-1][:, -1] += whitener.constant
        self._theta = torch.cat(coefficients, 1)  # (K, F)
        self._sums = torch.zeros_like(self._theta)
        self._phi = self._theta.new_empty(0)
        self.rounding = max(ROUNDING[torch.float64], 1e-16 * sharpness(whitener))

    def joint(self, chunk: Chunk) -> Tensor:
        """Log of ``pi_k prod_j N(x_j | mu_kj, Sigma_kj)``, shape (K, n)."""
        n_points = chunk[0].shape[1]
        if self._phi.shape[-1] != n_points:
            self._phi = self._theta.new_empty(self._theta.shape[1], n_points)
        start = 0
        for x in chunk:
            for first in range(len(x)):
                end = start + len(x) - first
                torch.mul(x[first:], x[first], out=self._phi[start:end])
                start = end
        return self._theta @ self._phi

    def gather(self, responsibilities: Tensor) -> None:
        """Add the chunk given last, with responsibilities (K, n)."""
        self._sums.addmm_(responsibilities, self._phi.T)

    def moments(self) -> tuple[Tensor, ...]:
        """The sums per block, shape (K, D_j + 1, D_j + 1)."""
        widths = [pairs.shape[1] for pairs in self._pairs]
        moments = []
        for whitening, (row, column), packed in zip(
            self._maps, self._pairs, torch.split(self._sums, widths, dim=1), strict=True
        ):
            plain = torch.zeros_like(whitening)
            plain[:, row, column] = packed
            plain[:, column, row] = packed
            moments.append(whitening @ plain @ whitening.mT)
        return tuple(moments)


def sharpness(whitener: Whitener) -> float:
    """The largest trace of a precision matrix among the components."""
    traces = sum(m[:, :-1, :-1].square().sum((1, 2)) for m in whitener.maps)
    return float(torch.as_tensor(traces).max())


def statistics(parameters: Parameters, chunks: Sequence[Chunk]) -> Statistics:
    """The faster formulation where it is accurate enough, else the accurate one.

    Parameters
    ----------
    parameters : Parameters
    chunks : sequence of tuple of Tensor of shape (D_j + 1, n)
    """
    dtype = chunks[0][0].dtype
    whitener = Whitener(parameters, dtype)
    many = sum(chunk[0].shape[1] for chunk in chunks) >= MANY_POINTS
    if many and dtype == torch.float64 and sharpness(whitener) < SHARPEST:
        return PackedStatistics(whitener)
    return WhitenedStatistics(whitener, dtype)
