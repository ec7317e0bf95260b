"""Parameters of Gaussian mixtures with block-diagonal covariance, and the units of EM.

A point is made of P blocks of columns, independent given the component (section II-B of the
paper). Mixtures that are learned side by side, restarts or folds, are stacked along a leading
dimension S.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch.exceptions import DataError, ShapeError

__all__ = ["Parameters", "Standardization", "check_blocks"]


def check_blocks(blocks: Sequence[int] | None, n_features: int) -> tuple[int, ...]:
    """Widths of the blocks, checked against the data; None is one block.

    Raises
    ------
    ShapeError
        If they are not positive integers that add up to ``n_features``.
    """
    widths = (n_features,) if blocks is None else tuple(blocks)
    if not all(isinstance(width, Integral) and width > 0 for width in widths):
        raise ShapeError(f"blocks must be positive integers, got {blocks!r}")
    if sum(widths) != n_features:
        raise ShapeError(
            f"blocks={blocks!r} add up to {sum(widths)} columns, but the data have {n_features}"
        )
    return tuple(int(width) for width in widths)


@dataclass(frozen=True)
class Parameters:
    """A mixture in float64, or S of them.

    Parameters
    ----------
    weights : Tensor of shape ([S,] K)
    means : tuple of Tensor of shape ([S,] K, D_j)
        One per block.
    factors : tuple of Tensor of shape ([S,] K, D_j, D_j)
        Lower Cholesky factors of the covariances, one per block.
    """

    weights: Tensor
    means: tuple[Tensor, ...]
    factors: tuple[Tensor, ...]

    @classmethod
    def from_covariances(
        cls, weights: Tensor, means: Sequence[Tensor], covariances: Sequence[Tensor]
    ) -> "Parameters":
        """Factorise covariances of shape ([S,] K, D_j, D_j).

        Raises
        ------
        DataError
            If one of them is not positive definite; the message says which.
        """
        factors = []
        for block, covariance in enumerate(covariances):
            factor, info = torch.linalg.cholesky_ex(covariance)
            if bool(info.any()):
                component = int(info.nonzero()[0, -1])
                raise DataError(
                    f"the covariance of component {component}, block {block} is not positive "
                    "definite; raise reg_covar, or use dtype='float64'"
                )
            factors.append(factor)
        return cls(weights, tuple(means), tuple(factors))

    @classmethod
    def stack(cls, mixtures: Sequence["Parameters"]) -> "Parameters":
        """S mixtures of equal sizes along a leading dimension."""
        return cls(
            torch.stack([mixture.weights for mixture in mixtures]),
            tuple(map(torch.stack, zip(*(mixture.means for mixture in mixtures), strict=True))),
            tuple(
                map(torch.stack, zip(*(mixture.factors for mixture in mixtures), strict=True))
            ),
        )

    def map(self, function: Callable[..., Tensor], *others: "Parameters") -> "Parameters":
        """Apply a function to every tensor, and to those of other mixtures beside it."""

        def each(name: str) -> tuple[Tensor, ...]:
            parts = (getattr(mixture, name) for mixture in (self, *others))
            return tuple(function(*tensors) for tensors in zip(*parts, strict=True))

        weights = (mixture.weights for mixture in (self, *others))
        return Parameters(function(*weights), each("means"), each("factors"))

    def __getitem__(self, index: Any) -> "Parameters":
        """One mixture of S by its number, or some of them by a tensor of numbers."""
        return self.map(lambda tensor: tensor[index])

    @property
    def covariances(self) -> tuple[Tensor, ...]:
        """Covariances per block, shape ([S,] K, D_j, D_j)."""
        return tuple(factor @ factor.mT for factor in self.factors)

    def sample(
        self, n_samples: int, rng: np.random.RandomState
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Points (n_samples, sum D_j) of one mixture and their components, ascending."""
        weights = self.weights.cpu().numpy()
        counts = rng.multinomial(n_samples, weights / weights.sum())
        labels = np.repeat(np.arange(len(counts)), counts)
        columns = []
        for mean, factor in zip(self.means, self.factors, strict=True):
            normal = rng.standard_normal((n_samples, mean.shape[1], 1))
            spread = factor.cpu().numpy()[labels] @ normal
            columns.append(mean.cpu().numpy()[labels] + spread[..., 0])
        return np.concatenate(columns, axis=1), labels

    def affine(self, scales: Sequence[Tensor], offsets: Sequence[Tensor]) -> "Parameters":
        """The mixture of ``scale * x + offset``, with positive scales (D_j,) per block."""
        means = tuple(s * m + o for s, m, o in zip(scales, self.means, offsets, strict=True))
        factors = tuple(s[:, None] * f for s, f in zip(scales, self.factors, strict=True))
        return Parameters(self.weights, means, factors)


@dataclass(frozen=True)
class Standardization:
    """The units in which EM works: ``(x - shift) / scale``.

    Parameters
    ----------
    shifts, scales : tuple of Tensor of shape (D_j,)
        One per block.
    """

    shifts: tuple[Tensor, ...]
    scales: tuple[Tensor, ...]

    @classmethod
    def of_mixture(cls, parameters: Parameters) -> "Standardization":
        """Mean and standard deviation of the density of one mixture."""
        weights = parameters.weights[:, None]
        shifts, scales = [], []
        for mean, factor in zip(parameters.means, parameters.factors, strict=True):
            shift = (weights * mean).sum(0)
            within = factor.square().sum(-1)
            # law of total variance
            scales.append((weights * (within + (mean - shift) ** 2)).sum(0).sqrt())
            shifts.append(shift)
        return cls(tuple(shifts), tuple(scales))

    @property
    def widths(self) -> tuple[int, ...]:
        """D_j of each block."""
        return tuple(len(shift) for shift in self.shifts)

    @property
    def log_volume(self) -> float:
        """What a log-density per standardised unit exceeds one per unit of the data by."""
        return float(sum(scale.log().sum() for scale in self.scales))

    def to(self, device: torch.device) -> "Standardization":
        """The same on another device."""
        return Standardization(
            tuple(shift.to(device) for shift in self.shifts),
            tuple(scale.to(device) for scale in self.scales),
        )

    def rows(self, rows: NDArray[np.floating]) -> Tensor:
        """Rows (n, sum D_j) of the data in standardised units, in float64."""
        shift, scale = torch.cat(self.shifts), torch.cat(self.scales)
        given = torch.from_numpy(np.require(rows, requirements="W"))  # torch warns otherwise
        return torch.sub(given.to(shift), shift).div_(scale)

    def standardize(self, parameters: Parameters) -> Parameters:
        """A mixture in units of the data, brought to standardised units."""
        scales = [1 / scale for scale in self.scales]
        offsets = [-s * shift for s, shift in zip(scales, self.shifts, strict=True)]
        return parameters.affine(scales, offsets)

    def restore(self, parameters: Parameters) -> Parameters:
        """A mixture in standardised units, brought to units of the data."""
        return parameters.affine(self.scales, self.shifts)
