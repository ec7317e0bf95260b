"""Second moments of the points under the responsibilities: what the M step needs.

For every component and block ``sum_n gamma (y; 1) (y; 1)^T`` in the whitened coordinates of
the present mixture: mass, mean and scatter together, summed in float64. There are two forms.

:class:`WhitenedStatistics` whitens the points for each component, and loses as many digits
as the components are narrower than the data. :class:`PackedStatistics` expands each point
once, for all components, into the products of its coordinates, whereupon densities and
moments are one matrix product each; it loses twice as many digits. With ten restarts or folds
it takes a third of the time; :func:`sufficient_statistics` chooses.
"""

import torch
from torch import Tensor

from tpgmm_torch.em.points import Chunk
from tpgmm_torch.em.whitening import Whitener, select

__all__ = ["PackedStatistics", "WhitenedStatistics", "sufficient_statistics"]

#: The packed form is taken below this trace of the precision of a component, in standardised
#: units: its log-densities are then off by about 1e-9 at most ...
SHARPEST = 1e7

#: ... from this number of points on: fewer gain nothing worth a digit ...
MANY_POINTS = 4096

#: ... and from this number of components of all mixtures on: fewer are sooner whitened than
#: the products written and read again.
MANY_COMPONENTS = 32

#: By how much a mean log-density may be off, relative to 1 and to itself.
ROUNDING = {torch.float64: 2e-13, torch.float32: 1e-5}

#: So many rows at a time are multiplied with those after them: more is fewer calls, but more
#: products that repeat others.
STRIDE = 4


class WhitenedStatistics:
    """Moments taken in the coordinates of a ``whitener``.

    What is summed is ``gamma (x; 1) (y; 1)^T``: the factors on the left are common to all
    components, so that one matrix product serves them all; they are whitened when all points
    have been summed.

    Attributes
    ----------
    sums : tuple of Tensor
        In float64; to be added to those of other processes.
    rounding : float
        By how much a mean log-density may be off, relative to 1 and to itself.
    """

    def __init__(self, whitener: Whitener) -> None:
        self.rounding = ROUNDING[whitener.dtype]
        self._whitener = whitener
        # (D_j + 1, S * K, D_j + 1)
        self.sums: tuple[Tensor, ...] = tuple(
            maps.new_zeros(maps.shape[1], len(maps), maps.shape[1]) for maps in whitener.maps
        )
        self._chunk: Chunk = ()
        self._whitened: Chunk = ()

    def log_joint(self, chunk: Chunk, components: Tensor | None) -> Tensor:
        """Log of ``pi_k prod_j N(x_j | mu_kj, Sigma_kj)``, shape (A, n)."""
        self._chunk = chunk
        joint, self._whitened = self._whitener.log_joint(chunk, components)
        return joint

    def add(self, responsibilities: Tensor, components: Tensor | None) -> None:
        """Add the chunk evaluated last, with responsibilities (A, n) of those components."""
        for total, y, x in zip(self.sums, self._whitened, self._chunk, strict=True):
            y.mul_(responsibilities[:, None])
            part = (x @ y.flatten(0, 1).T).view(len(x), len(y), len(x))
            _add(total, part.double(), components)

    def moments(self, *sums: Tensor) -> tuple[Tensor, ...]:
        """The moments per block, shape (S * K, D_j + 1, D_j + 1), from (combined) sums."""
        moments = []
        for total, exact in zip(sums, self._whitener.maps, strict=True):
            mixed = total.permute(1, 2, 0)  # gamma (y; 1) (x; 1)^T
            if self._whitener.dtype != exact.dtype:  # y comes from maps that were rounded
                used = exact.to(self._whitener.dtype).double()
                mixed = exact @ torch.linalg.solve(used, mixed)
            moment = mixed @ exact.mT
            moments.append((moment + moment.mT) / 2)
        return tuple(moments)


class PackedStatistics:
    """Moments taken in the products of coordinates ``phi(x)``, of all points at once.

    ``log(pi_k N_k(x)) = theta_k . phi(x)``, and ``sum_n gamma phi(x)`` holds the moments.

    Parameters
    ----------
    whitener : Whitener
        In float64.

    Attributes
    ----------
    sums, rounding
        As in :class:`WhitenedStatistics`.
    """

    def __init__(self, whitener: Whitener) -> None:
        self.rounding = max(ROUNDING[torch.float64], 1e-16 * float(sharpness(whitener).max()))
        self._maps = whitener.maps
        self._pairs = [_pairs(len(maps[0])) for maps in self._maps]
        coefficients = []
        for maps, (row, column) in zip(self._maps, self._pairs, strict=True):
            precision = maps.mT @ maps
            # half of it on the diagonal; what is below repeats what is above
            times = (row <= column).to(precision) * (1 - (row == column) / 2)
            coefficients.append(-precision[:, row, column] * times)
        # the product of the last block's appended 1 with itself is the constant's
        coefficients[-1][:, -1] += whitener.constant
        self._theta = torch.cat(coefficients, 1)  # (S * K, F)
        # features first: with components first the product below would copy the features
        self.sums: tuple[Tensor, ...] = (self._theta.new_zeros(self._theta.shape[::-1]),)
        self._chunk: Chunk = ()
        self._phi = self._theta.new_empty(self._theta.shape[1], 0)

    def log_joint(self, chunk: Chunk, components: Tensor | None) -> Tensor:
        """Log of ``pi_k prod_j N(x_j | mu_kj, Sigma_kj)``, shape (A, n)."""
        if chunk is not self._chunk:
            self._chunk = chunk
            self._expand()
        return select(self._theta, components) @ self._phi

    def _expand(self) -> None:
        """Products of the coordinates of the chunk, shape (F, n)."""
        n_points = self._chunk[0].shape[1]
        if self._phi.shape[1] != n_points:  # so much memory anew would leave the cache
            self._phi = self._phi.new_empty(len(self._phi), n_points)
        start = 0
        for x in self._chunk:
            for first in range(0, len(x), STRIDE):
                few, many = x[first : first + STRIDE, None], x[None, first:]
                end = start + len(few) * many.shape[1]
                torch.mul(few, many, out=self._phi[start:end].view(len(few), -1, n_points))
                start = end

    def add(self, responsibilities: Tensor, components: Tensor | None) -> None:
        """Add the chunk evaluated last, with responsibilities (A, n) of those components."""
        _add(self.sums[0], self._phi @ responsibilities.T, components)

    def moments(self, *sums: Tensor) -> tuple[Tensor, ...]:
        """The moments per block, shape (S * K, D_j + 1, D_j + 1), from (combined) sums."""
        products = sums[0].T.split([pairs.shape[1] for pairs in self._pairs], dim=1)
        moments = []
        for maps, (row, column), own in zip(self._maps, self._pairs, products, strict=True):
            plain = torch.zeros_like(maps)
            plain[:, row, column] = own
            plain[:, column, row] = own
            moments.append(maps @ plain @ maps.mT)
        return tuple(moments)


def sufficient_statistics(
    whitener: Whitener, n_points: int
) -> WhitenedStatistics | PackedStatistics:
    """The form that is accurate enough, and takes less time.

    Parameters
    ----------
    whitener : Whitener
    n_points : int
        Of all processes, which have to agree.
    """
    many = len(whitener.constant) >= MANY_COMPONENTS and n_points >= MANY_POINTS
    if many and whitener.dtype == torch.float64 and float(sharpness(whitener).max()) < SHARPEST:
        return PackedStatistics(whitener)
    return WhitenedStatistics(whitener)


def sharpness(whitener: Whitener) -> Tensor:
    """The trace of each component's precision matrix, shape (S * K,), of a whitener."""
    traces = [maps[:, :-1, :-1].square().sum((1, 2)) for maps in whitener.maps]
    return torch.stack(traces).sum(0)


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


def _add(total: Tensor, part: Tensor, components: Tensor | None) -> None:
    """Add to the sums of some components, the second dimension, or of all."""
    if components is None:
        total.add_(part)
    else:
        total.index_add_(1, components, part)
