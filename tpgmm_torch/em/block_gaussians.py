"""Gaussian mixtures with block-diagonal covariance, and the points they are evaluated at.

A point is made of P blocks of columns, independent given the component (section II-B of
the paper). Points are standardised, and cut into chunks so that the memory needed does not
grow with their number. Densities are evaluated in the components' own whitened coordinates
``y = L^-1 (x - mu)``, ``Sigma = L L^T``, where no digits are lost however narrow a component
is; appending a 1 to ``x`` and ``y`` makes that one matrix product per block for all
components at once.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch.exceptions import DataError, ShapeError

__all__ = [
    "Chunk",
    "Family",
    "Parameters",
    "Standardization",
    "Whitener",
    "check_blocks",
]

#: Numbers in float64 that a chunk of points is expanded to, in float32 twice as many: what a
#: processor's cache can keep, and what a GPU is busy with.
CHUNK_SIZE = {"cpu": 3 * 2**17, "gpu": 2**25}

#: Least regularisation, as a share of the variance, that survives rounding.
SMALLEST_SHARE = {torch.float64: 1e-12, torch.float32: 2e-6}

#: One chunk of points: for each block the columns (x; 1), shape (D_j + 1, n), a point after
#: the other in memory.
Chunk = tuple[Tensor, ...]


def check_blocks(blocks: Sequence[int] | None, n_features: int) -> tuple[int, ...]:
    """Widths of the blocks, once they are known to fit the data; None is one block.

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
    """A mixture in float64: weights (K,), and per block means (K, D_j), factors (K, D_j, D_j).

    The factors are the lower Cholesky factors of the covariances.
    """

    weights: Tensor
    means: tuple[Tensor, ...]
    factors: tuple[Tensor, ...]

    @classmethod
    def from_covariances(
        cls, weights: Tensor, means: Sequence[Tensor], covariances: Sequence[Tensor]
    ) -> "Parameters":
        """Factorise covariances of shape (K, D_j, D_j).

        Raises
        ------
        DataError
            If one of them is not positive definite; the message says which.
        """
        factors = []
        for block, covariance in enumerate(covariances):
            factor, info = torch.linalg.cholesky_ex(covariance)
            if bool(info.any()):
                component = int(info.nonzero()[0])
                raise DataError(
                    f"the covariance of component {component}, block {block} is not positive "
                    "definite; raise reg_covar, or use dtype='float64'"
                )
            factors.append(factor)
        return cls(weights, tuple(means), tuple(factors))

    @classmethod
    def standard(
        cls, n_components: int, widths: Sequence[int], device: torch.device | str = "cpu"
    ) -> "Parameters":
        """All components the standard normal: whitening with them changes nothing."""
        unit = torch.ones((), dtype=torch.float64, device=device)
        eyes = (torch.diag(unit.expand(width)).expand(n_components, -1, -1) for width in widths)
        means = (unit.new_zeros(n_components, width) for width in widths)
        weights = unit.expand(n_components) / n_components
        return cls(weights, tuple(means), tuple(eyes))

    @classmethod
    def joined(cls, mixtures: Sequence["Parameters"]) -> "Parameters":
        """The components of all mixtures, one after the other, with their weights as they are.

        Parameters
        ----------
        mixtures : sequence of Parameters
            At least one.
        """
        if len(mixtures) == 1:
            return mixtures[0]
        weights = torch.cat([mixture.weights for mixture in mixtures])
        means = zip(*(mixture.means for mixture in mixtures), strict=True)
        factors = zip(*(mixture.factors for mixture in mixtures), strict=True)
        return cls(weights, tuple(map(torch.cat, means)), tuple(map(torch.cat, factors)))

    @property
    def covariances(self) -> tuple[Tensor, ...]:
        """Covariances per block, shape (K, D_j, D_j)."""
        return tuple(factor @ factor.mT for factor in self.factors)

    def sample(
        self, n_samples: int, rng: np.random.RandomState
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Points (n_samples, sum D_j) and their components, in ascending order."""
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
        """Mean and standard deviation of the mixture's own density."""
        weights = parameters.weights[:, None]
        shifts, scales = [], []
        for mean, factor in zip(parameters.means, parameters.factors, strict=True):
            shift = (weights * mean).sum(0)
            within = factor.square().sum(-1)
            scales.append((weights * (within + (mean - shift) ** 2)).sum(0).sqrt())
            shifts.append(shift)
        return cls(tuple(shifts), tuple(scales))

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

    def chunks(
        self,
        points: NDArray[np.floating],
        n_components: int,
        dtype: torch.dtype,
        group_size: int = 1,
        order: NDArray[np.intp] | None = None,
    ) -> list[Chunk]:
        """Standardise points (n_samples, n_features) in float64; cut between groups.

        With ``order`` (n,) those rows, in that order.
        """
        widths = [len(shift) + 1 for shift in self.shifts]
        packed = sum(width * (width + 1) // 2 for width in widths)
        whole = CHUNK_SIZE["cpu" if self.shifts[0].device.type == "cpu" else "gpu"]
        whole = whole * 8 // dtype.itemsize
        size = whole // min(n_components * sum(widths), packed) // group_size + 1
        size *= group_size
        shift, scale = torch.cat(self.shifts), torch.cat(self.scales)
        # few long operations, which leave Python to other threads
        rows = _rows(points, order).to(shift.device, torch.float64)
        standard = torch.sub(rows, shift).div_(scale)
        blocks = []
        for width, inner in zip(
            widths, standard.split([w - 1 for w in widths], 1), strict=True
        ):
            # one piece of memory for all chunks of a block: many small ones would scatter
            block = shift.new_ones(len(rows), width, dtype=dtype)
            block[:, :-1] = inner
            blocks.append(block)
        return [
            tuple(block[start : start + size].T for block in blocks)
            for start in range(0, len(rows), size)
        ]

    def standardize(self, parameters: Parameters) -> Parameters:
        """A mixture in units of the data, brought to standardised units."""
        scales = [1 / scale for scale in self.scales]
        offsets = [-s * shift for s, shift in zip(scales, self.shifts, strict=True)]
        return parameters.affine(scales, offsets)

    def restore(self, parameters: Parameters) -> Parameters:
        """A mixture in standardised units, brought to units of the data."""
        return parameters.affine(self.scales, self.shifts)


def _rows(points: NDArray[np.floating], order: NDArray[np.intp] | None) -> Tensor:
    """Rows (n, D), or some of them in another order, stored as they are."""
    rows = torch.from_numpy(np.require(points, requirements="W"))  # torch warns of any other
    if order is None:
        return rows
    chosen = torch.from_numpy(order)
    if points.flags.f_contiguous:
        return rows.T.index_select(1, chosen).T
    return rows.index_select(0, chosen)


@dataclass(frozen=True)
class Family:
    """The family of covariances, and the regularisation that keeps them away from zero.

    Parameters
    ----------
    covariance_type : {"full", "tied", "diag", "spherical"}
    diagonals : tuple of Tensor of shape (D_j,)
        Per block the diagonal matrix ``Lambda`` that regularises.
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
    ) -> "Family":
        """The family in standardised units.

        Parameters
        ----------
        covariance_type : {"full", "tied", "diag", "spherical"}
        units : Standardization
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
        widths = [len(scale) for scale in units.scales]
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

    def rescaled(self, old: Standardization, new: Standardization) -> "Family":
        """The same in other units."""
        shares = zip(self.diagonals, old.scales, new.scales, strict=True)
        return Family(
            self.covariance_type, tuple(share * (a / b) ** 2 for share, a, b in shares)
        )

    def restrict(self, covariance: Tensor, weights: Tensor) -> Tensor:
        """The member of the family that the M step wants instead of ``covariance``."""
        match self.covariance_type:
            case "tied":
                pooled = torch.einsum("k,kij->ij", weights, covariance)
                return pooled.expand_as(covariance)
            case "diag":
                return torch.diag_embed(covariance.diagonal(dim1=-2, dim2=-1))
            case "spherical":
                variance = covariance.diagonal(dim1=-2, dim2=-1).mean(-1)
                eye = torch.eye(covariance.shape[-1]).to(covariance)
                return variance[:, None, None] * eye
        return covariance

    @staticmethod
    def floor(covariance: Tensor, diagonal: Tensor) -> Tensor:
        """Raise to ``Lambda`` what is below it: the most likely one with Sigma - Lambda >= 0.

        ``-log|Sigma| - tr(Sigma^-1 S)`` under that constraint is largest where the
        eigenvalues of ``Lambda^-1/2 S Lambda^-1/2`` below 1 are replaced by 1.
        """
        root = diagonal.sqrt()
        outer = root[:, None] * root
        values, vectors = torch.linalg.eigh(covariance / outer)
        floored: Tensor = (vectors * values.clamp(min=1.0)[..., None, :]) @ vectors.mT * outer
        return floored

    def admit(self, parameters: Parameters) -> Parameters:
        """Bring any mixture into the family and above the regularisation."""
        covariances = [
            self.floor(self.restrict(covariance, parameters.weights), diagonal)
            for covariance, diagonal in zip(parameters.covariances, self.diagonals, strict=True)
        ]
        return Parameters.from_covariances(parameters.weights, parameters.means, covariances)


class Whitener:
    """Evaluates the log-density of a mixture in the components' whitened coordinates.

    Parameters
    ----------
    parameters : Parameters
    dtype : torch.dtype
        Precision of the points.

    Attributes
    ----------
    maps : list of Tensor of shape (K, D_j + 1, D_j + 1)
        Per block, in float64, what takes (x; 1) to (y; 1).
    constant : Tensor of shape (K,)
        In float64, what the log-density is at (y; 1) = 0.
    peaks : Tensor of shape (K,)
        In float64, what it is at the means, where (y; 1) = (0; 1).
    """

    def __init__(self, parameters: Parameters, dtype: torch.dtype) -> None:
        self.maps: list[Tensor] = []
        self.constant = parameters.weights.log()
        for mean, factor in zip(parameters.means, parameters.factors, strict=True):
            count, width = mean.shape
            eye = torch.eye(width).to(mean).expand_as(factor)
            inverse = torch.linalg.solve_triangular(factor, eye, upper=False)
            homogeneous = torch.zeros(count, width + 1, width + 1).to(mean)
            homogeneous[:, :width, :width] = inverse
            homogeneous[:, :width, width] = -(inverse @ mean[..., None])[..., 0]
            homogeneous[:, width, width] = 1.0
            self.maps.append(homogeneous)
            log_determinant = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
            # the appended 1 adds 1/2 to half the squared norm of (y; 1)
            normalizer = log_determinant + (width * math.log(2 * math.pi) - 1) / 2
            self.constant = self.constant - normalizer
        self.peaks = self.constant - len(self.maps) / 2
        self._flat = [whitener.flatten(0, 1).to(dtype) for whitener in self.maps]
        self._column = self.constant.to(dtype)[:, None]

    def __call__(self, chunk: Chunk) -> tuple[Tensor, Chunk]:
        """Log of ``pi_k prod_j N(x_j | mu_kj, Sigma_kj)``, shape (K, n).

        Second comes (y; 1), per block of shape (K, D_j + 1, n), which the caller may change.
        """
        whitened = tuple(
            (whitener @ x).view(len(self._column), len(x), -1)
            for whitener, x in zip(self._flat, chunk, strict=True)
        )
        norms = sum(y.square().sum(1) for y in whitened)
        return self._column - norms / 2, whitened
