"""Second moments of the points under the responsibilities, in two formulations.

Both hold, for every component and block, ``sum_n gamma (y; 1) (y; 1)^T`` in the whitened
coordinates of the present mixture: mass, mean and scatter together, summed in float64.

:class:`WhitenedStatistics` whitens the points for each component, and loses as many digits
as the components are narrower than the data. :class:`PackedStatistics` expands each point
once, for all components, into the products of its coordinates, whereupon densities and
moments are one matrix product each; it loses twice as many.
"""

import math
from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from tpgmm_torch.em.block_gaussians import Chunk, Whitener

__all__ = ["PackedStatistics", "Statistics", "WhitenedStatistics", "packs"]

#: The packed form is taken below this trace of the precision of a component, in standardised
#: units: its log-densities are then off by about 1e-9 at most ...
SHARPEST = 1e7

#: ... and from this number of points on: fewer gain nothing worth a digit.
MANY_POINTS = 4096

#: ... and where the products are kept, or from this number of components on: fewer are sooner
#: whitened than the products written and read again, for which no cache near the core has room.
MANY_COMPONENTS = 32

#: By how much a mean log-density may be off, relative to 1 and to itself.
ROUNDING = {torch.float64: 2e-13, torch.float32: 1e-5}


#: Up to so many numbers, products of coordinates are kept from pass to pass.
MOST_KEPT = 2**23

#: So many rows at a time are multiplied with those after them: more is fewer calls, but more
#: products that repeat others.
STRIDE = 4


class Statistics(Protocol):
    """Chunk by chunk: the joint log-density first, then what its responsibilities gather.

    Attributes
    ----------
    rounding : float
        By how much a mean log-density may be off, relative to 1 and to itself.
    sums : tuple of Tensor
        What was gathered, in float64; to be added to those of other processes.
    """

    rounding: float
    sums: tuple[Tensor, ...]

    def load(self, index: int, chunk: Chunk) -> None:
        """Turn to the chunk with this number."""

    def joint(self, components: Tensor | None) -> Tensor:
        """Log of ``pi_k prod_j N(x_j | mu_kj, Sigma_kj)``, shape (A, n).

        Of the given components (A,), or of all where they are None.
        """

    def gather(self, responsibilities: Tensor, components: Tensor | None) -> None:
        """Add the chunk, with the responsibilities (A, n) of the components given last."""

    def moments(self, *sums: Tensor) -> tuple[Tensor, ...]:
        """The moments per block, shape (K, D_j + 1, D_j + 1), from (combined) sums."""


class WhitenedStatistics:
    """Moments taken in whitened coordinates; see the module.

    What is summed is ``gamma (y; 1) (x; 1)^T``: the factors on the right are common to all
    components, so that one matrix product serves them all, and the second factor is whitened
    when all points have been summed.

    Parameters
    ----------
    whitener : Whitener
    dtype : torch.dtype
        Precision of the points.
    """

    def __init__(self, whitener: Whitener, dtype: torch.dtype) -> None:
        self.rounding = ROUNDING[dtype]
        self._whitener = whitener
        self._maps = [whitening.to(dtype) for whitening in whitener.maps]
        self._constant = whitener.constant.to(dtype)[:, None]
        self.sums: tuple[Tensor, ...] = tuple(
            torch.zeros_like(whitening) for whitening in whitener.maps
        )
        self._chunk: Chunk = ()
        self._room: list[Tensor] = []
        self._squares = torch.empty(0)
        self._whitened: list[Tensor] = []

    def load(self, index: int, chunk: Chunk) -> None:
        """Turn to the chunk with this number."""
        sizes = [len(self._constant) * x.numel() for x in chunk]
        if not self._room or len(self._room[0]) < sizes[0]:
            # taken anew for each chunk, so much memory would not stay in the cache
            self._room = [x.new_empty(size) for x, size in zip(chunk, sizes, strict=True)]
            self._squares = chunk[0].new_empty(max(sizes))
        self._chunk = chunk

    def joint(self, components: Tensor | None) -> Tensor:
        """Log of ``pi_k prod_j N(x_j | mu_kj, Sigma_kj)``, shape (A, n)."""
        joint = _chosen(self._constant, components)
        self._whitened = []
        for maps, x, room in zip(self._maps, self._chunk, self._room, strict=True):
            chosen = _chosen(maps, components)
            shape = len(chosen), len(x), x.shape[1]
            y = room[: math.prod(shape)].view(shape)
            torch.mm(chosen.view(-1, len(x)), x, out=y.view(-1, x.shape[1]))
            squares = torch.mul(y, y, out=self._squares[: y.numel()].view(shape))
            joint = torch.sub(joint, squares.sum(1), alpha=0.5)
            self._whitened.append(y)
        return joint

    def gather(self, responsibilities: Tensor, components: Tensor | None) -> None:
        """Add the chunk, with the responsibilities (A, n) of the components given last."""
        for total, y, x in zip(self.sums, self._whitened, self._chunk, strict=True):
            y.mul_(responsibilities[:, None])
            part = y.view(-1, y.shape[2]) @ x.T
            _add(total, part.view(len(y), len(x), len(x)).double(), components, dim=0)

    def moments(self, *sums: Tensor) -> tuple[Tensor, ...]:
        """The moments per block, shape (K, D_j + 1, D_j + 1), from (combined) sums."""
        moments = []
        for total, exact, used in zip(sums, self._whitener.maps, self._maps, strict=True):
            if used.dtype != exact.dtype:  # points were whitened by maps that were rounded
                total = exact @ torch.linalg.solve(used.double(), total)
            moment = total @ exact.mT
            moments.append((moment + moment.mT) / 2)
        return tuple(moments)


class Features:
    """Products ``x_a x_b`` of the coordinates of (x; 1), block by block: phi(x).

    They are kept from pass to pass where the points are few enough.

    Parameters
    ----------
    widths : sequence of int
        D_j of each block.
    n_points : int
        Number of points of this process.
    """

    def __init__(self, widths: Sequence[int], n_points: int) -> None:
        self.pairs = [_pairs(width + 1) for width in widths]
        self.count = sum(pairs.shape[1] for pairs in self.pairs)
        self._keeps = self.few(n_points)
        self._kept: dict[int, Tensor] = {}
        self._phi = torch.empty(0)
        self._points: list[Tensor] = []
        self._products: list[tuple[Tensor, Tensor, Tensor]] = []

    def few(self, n_points: int) -> bool:
        """Whether so many points are few enough."""
        return self.count * n_points <= MOST_KEPT

    def of(self, index: int, chunk: Chunk) -> Tensor:
        """Features of the chunk with this number, shape (F, n), valid until the next call."""
        if index in self._kept:
            return self._kept[index]
        n_points = chunk[0].shape[1]
        if self._keeps or self._phi.shape[-1] != n_points:
            self._prepare(chunk, n_points)
        for own, x in zip(self._points, chunk, strict=True):
            own.copy_(x)
        for few, many, product in self._products:
            torch.mul(few, many, out=product)
        if self._keeps:
            self._kept[index] = self._phi
        return self._phi

    def _prepare(self, chunk: Chunk, n_points: int) -> None:
        """Make room, and the views that need not be made again for each chunk."""
        self._phi = chunk[0].new_empty(self.count, n_points)
        self._points = [x.new_empty(x.shape) for x in chunk]
        self._products, start = [], 0
        for x in self._points:
            for first in range(0, len(x), STRIDE):
                few, many = x[first : first + STRIDE, None], x[None, first:]
                end = start + few.shape[0] * many.shape[1]
                product = self._phi[start:end].view(len(few), -1, n_points)
                self._products.append((few, many, product))
                start = end


def _pairs(width: int) -> Tensor:
    """The rows a and b of the products of one block, shape (2, F_j).

    ``STRIDE`` rows at a time are multiplied with all from the first of them on.
    """
    return torch.tensor(
        [
            (row, column)
            for first in range(0, width, STRIDE)
            for row in range(first, min(first + STRIDE, width))
            for column in range(first, width)
        ]
    ).T


class PackedStatistics:
    """Moments taken in products of coordinates; see the module.

    ``log(pi_k N_k(x)) = theta_k . phi(x)``.

    Parameters
    ----------
    whitener : Whitener
    features : Features
    """

    def __init__(self, whitener: Whitener, features: Features) -> None:
        self._maps, self._features = whitener.maps, features
        coefficients = []
        for whitening, (row, column) in zip(self._maps, features.pairs, strict=True):
            precision = whitening.mT @ whitening
            # half of it on the diagonal; what is below repeats what is above
            times = (row <= column).to(precision) * (1 - (row == column) / 2)
            coefficients.append(-precision[:, row, column] * times)
        # the product of the last block's appended 1 with itself is the constant's
        coefficients[-1][:, -1] += whitener.constant
        self._theta = torch.cat(coefficients, 1)  # (K, F)
        self._phi = self._theta.new_empty(0)
        # features first: with components first the product below would copy the features
        self.sums: tuple[Tensor, ...] = (
            torch.zeros_like(self._theta.T, memory_format=torch.contiguous_format),
        )
        self.rounding = max(ROUNDING[torch.float64], 1e-16 * float(sharpness(whitener).max()))

    def load(self, index: int, chunk: Chunk) -> None:
        """Turn to a chunk of points: expand them."""
        self._phi = self._features.of(index, chunk)

    def joint(self, components: Tensor | None) -> Tensor:
        """Log of ``pi_k prod_j N(x_j | mu_kj, Sigma_kj)``, shape (A, n)."""
        return _chosen(self._theta, components) @ self._phi

    def gather(self, responsibilities: Tensor, components: Tensor | None) -> None:
        """Add the chunk, with the responsibilities (A, n) of the components given last."""
        if components is None:
            self.sums[0].addmm_(self._phi, responsibilities.T)
        else:
            _add(self.sums[0], self._phi @ responsibilities.T, components, dim=1)

    def moments(self, *sums: Tensor) -> tuple[Tensor, ...]:
        """The moments per block, shape (K, D_j + 1, D_j + 1), from (combined) sums."""
        (packed,) = sums
        pairs = self._features.pairs
        moments = []
        for whitening, (row, column), products in zip(
            self._maps, pairs, packed.T.split([p.shape[1] for p in pairs], dim=1), strict=True
        ):
            plain = torch.zeros_like(whitening)
            plain[:, row, column] = products
            plain[:, column, row] = products
            moments.append(whitening @ plain @ whitening.mT)
        return tuple(moments)


def _chosen(rows: Tensor, components: Tensor | None) -> Tensor:
    return rows if components is None else rows.index_select(0, components)


def _add(total: Tensor, part: Tensor, components: Tensor | None, dim: int) -> None:
    if components is None:
        total.add_(part)
    else:
        total.index_add_(dim, components, part)


def sharpness(whitener: Whitener) -> Tensor:
    """The trace of each component's precision matrix, shape (K,)."""
    traces = [m[:, :-1, :-1].square().sum((1, 2)) for m in whitener.maps]
    return torch.stack(traces).sum(0)


def packs(
    whitener: Whitener, n_mixtures: int, features: Features, n_points: int, dtype: torch.dtype
) -> list[bool]:
    """For which mixtures the packed form is accurate enough, and worth it.

    Parameters
    ----------
    whitener : Whitener
        Of several mixtures of equal size, one after the other.
    n_mixtures : int
        How many they are.
    features : Features
    n_points : int
        Of all processes, which have to agree.
    dtype : torch.dtype
        Precision of the points.
    """
    worth_it = len(whitener.constant) >= MANY_COMPONENTS or features.few(n_points)
    if n_points < MANY_POINTS or dtype != torch.float64 or not worth_it:
        return [False] * n_mixtures
    fits = sharpness(whitener).view(n_mixtures, -1).amax(1) < SHARPEST
    found: list[bool] = fits.tolist()
    return found
