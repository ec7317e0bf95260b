"""Points like those of demonstrations: smooth in time, with noise; and where EM starts."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture

__all__ = ["BLOCKS", "Problem", "motions"]

#: Time and both hands' poses; time and seventeen joints.
BLOCKS = (15, 18)
DURATION, STEPS = 13.0, 1300

Floats = NDArray[np.floating]


def motions(n_points: int, blocks: tuple[int, ...] = BLOCKS, seed: int = 0) -> Floats:
    """Draw motions of at most 1300 steps, one below the other, (n_points, sum of blocks).

    The first column of every block is time, 0 to 13 s; the others are sums of three sinusoids
    and correlated noise.
    """
    rng = np.random.default_rng(seed)
    steps = min(STEPS, n_points)
    grid = np.linspace(0, DURATION, steps)
    points = np.empty((n_points, sum(blocks)))
    end = 0
    for width in blocks:
        start, end = end, end + width
        frequencies, phases = rng.uniform(0.05, 0.4, 3), rng.uniform(0, 6.28, (3, width - 1))
        waves = np.sin(6.28 * frequencies[:, None] * grid[:, None, None] + phases)
        curves = (waves * rng.normal(size=(3, width - 1))).sum(1)
        mixing = 0.1 * rng.normal(size=(width - 1, width - 1))
        for first in range(0, n_points, steps):  # in place, so that memory does not peak here
            motion = points[first : first + steps, start:end]
            motion[:, 0] = grid[: len(motion)]
            noise = rng.normal(size=(len(motion), width - 1))
            motion[:, 1:] = curves[: len(motion)] + noise @ mixing
    return points


@dataclass(frozen=True)
class Problem:
    """Points, and a mixture to start from: the Gaussians of equal bins along time.

    Parameters
    ----------
    points : array of shape (n, sum of blocks)
    weights : array of shape (K,)
    means : list of array of shape (K, D_j)
    covariances : list of array of shape (K, D_j, D_j)
    """

    points: Floats
    weights: Floats
    means: list[Floats]
    covariances: list[Floats]

    @classmethod
    def of(
        cls, points: Floats, n_components: int, blocks: tuple[int, ...] = BLOCKS
    ) -> "Problem":
        """Start from Gaussians of bins along the first column of points."""
        bins = np.minimum(
            (points[:, 0] / DURATION * n_components).astype(int), n_components - 1
        )
        means: list[Floats] = []
        covariances: list[Floats] = []
        end = 0
        for width in blocks:
            start, end = end, end + width
            members = [points[bins == k, start:end] for k in range(n_components)]
            means.append(np.stack([m.mean(0) for m in members]))
            floor = 1e-3 * np.eye(width)
            covariances.append(np.stack([np.cov(m.T) + floor for m in members]))
        weights = np.bincount(bins, minlength=n_components) / len(points)
        return cls(points, weights, means, covariances)

    @property
    def blocks(self) -> tuple[int, ...]:
        """Widths D_j."""
        return tuple(mean.shape[1] for mean in self.means)

    @property
    def start(self) -> BlockGaussianMixture:
        """The start as ``BlockGaussianMixture.fit`` takes it."""
        parameters = self.weights, self.means, self.covariances
        return BlockGaussianMixture.from_parameters(*parameters)

    def join_blocks(self, dtype: str = "float64") -> tuple[Floats, Floats, Floats]:
        """Join all blocks to one, for libraries that have no others.

        Points (n, D), means (K, D) and covariances (K, D, D). The copies of time get noise of
        20 ms: without it a full covariance would have no full rank.
        """
        points = np.array(self.points, dtype=dtype, order="C")
        width = points.shape[1]
        rng = np.random.default_rng(0)
        for column in np.cumsum(self.blocks)[:-1]:
            points[:, column] += rng.normal(scale=0.02, size=len(points)).astype(dtype)
        covariances = np.zeros((len(self.weights), width, width))
        end = 0
        for covariance in self.covariances:
            start, end = end, end + covariance.shape[-1]
            covariances[:, start:end, start:end] = covariance
        means = np.concatenate(self.means, axis=1)
        return points, means.astype(dtype), covariances.astype(dtype)

    def shuffle_times(self, seed: int = 0) -> "Problem":
        """Exchange times among the points, so that time tells nothing any more.

        Every component then spans all times, so that none can be left out for being elsewhere
        in time; the start is of the points as they were, but for time.
        """
        order = np.random.default_rng(seed).permutation(len(self.points))
        points = self.points.copy()
        times = points[order, 0]
        means, covariances = [], []
        column = 0
        for mean, covariance in zip(self.means, self.covariances, strict=True):
            points[:, column] = times
            column += mean.shape[1]
            mean, covariance = mean.copy(), covariance.copy()
            mean[:, 0] = times.mean()
            covariance[:, 0, :] = covariance[:, :, 0] = 0.0
            covariance[:, 0, 0] = times.var()
            means.append(mean)
            covariances.append(covariance)
        return Problem(points, self.weights, means, covariances)
