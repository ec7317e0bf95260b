"""Where EM starts: from points assigned to components, or from what the user gives.

A drawn start is a vector of labels in which every component has at least one point.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.cluster import KMeans
from torch import Tensor

from tpgmm_torch.block_gaussians import Chunk, Family, Parameters, Standardization
from tpgmm_torch.exceptions import DataError, ShapeError
from tpgmm_torch.expectation_maximization import expect, maximize
from tpgmm_torch.frames import as_tensor

__all__ = [
    "GivenStart",
    "StartDrawer",
    "distinct_rows",
    "kmeans_labels",
    "random_labels",
    "time_labels",
]

Floats = NDArray[np.floating]
Labels = NDArray[np.int64]


def distinct_rows(points: Floats, n_components: int) -> Labels:
    """Indices of the first occurrence of each distinct point.

    Parameters
    ----------
    points : array of shape (n_samples, n_features)
    n_components : int
        How many are needed at least.

    Raises
    ------
    DataError
        If the data hold fewer distinct points than components.
    """
    # distinct on a random line means distinct; a sort of numbers costs less than one of rows
    line = np.random.RandomState(0).standard_normal(points.shape[1]).astype(points.dtype)
    _, first = np.unique(points @ line, return_index=True)
    if len(first) < n_components:
        _, first = np.unique(points, axis=0, return_index=True)
    if len(first) < n_components:
        raise DataError(
            f"n_components={n_components}, but the data hold only {len(first)} distinct "
            f"point(s) among n_samples = {len(points)}; use at most that many components, "
            "or more data"
        )
    return first


def time_labels(times: Floats, n_components: int, rng: np.random.RandomState | None) -> Labels:
    """Bins along time, with equal numbers of points.

    Parameters
    ----------
    times : array of shape (n_samples,)
    n_components : int
        At most n_samples.
    rng : RandomState or None
        Where given, the bins differ in size at random, by about a third.
    """
    n_samples = len(times)
    if rng is None:
        sizes = np.diff(np.arange(n_components + 1) * n_samples // n_components)
    else:
        shares = rng.dirichlet(np.full(n_components, 10.0))
        sizes = 1 + rng.multinomial(n_samples - n_components, shares)
    labels = np.empty(n_samples, dtype=np.int64)
    labels[np.argsort(times, kind="stable")] = np.repeat(np.arange(n_components), sizes)
    return labels


def kmeans_labels(points: Floats, n_components: int, rng: np.random.RandomState) -> Labels:
    """Clusters of scikit-learn's k-means (one run).

    Parameters
    ----------
    points : array of shape (n_samples, n_features)
        Standardised.
    n_components : int
    rng : RandomState
    """
    kmeans = KMeans(n_components, n_init=1, random_state=rng)
    return np.asarray(kmeans.fit(points).labels_, dtype=np.int64)


def random_labels(
    points: Floats, distinct: Labels, n_components: int, rng: np.random.RandomState
) -> Labels:
    """The nearest of some distinct points drawn at random.

    Parameters
    ----------
    points : array of shape (n_samples, n_features)
        Standardised.
    distinct : array of int
        Indices of the points to draw from.
    n_components : int
        How many are drawn.
    rng : RandomState
    """
    chosen = rng.choice(distinct, n_components, replace=False)
    centers = points[chosen]
    # the squared distance less the point's own norm, which no comparison needs
    labels: Labels = ((centers**2).sum(1) - 2 * points @ centers.T).argmin(1)
    labels[chosen] = np.arange(n_components)
    return labels


@dataclass(frozen=True)
class StartDrawer:
    """Draws starts by one of the methods.

    Parameters
    ----------
    method : {"time", "kmeans", "random"}
    time_feature : int
        Column that holds time.
    n_components : int
    chunks : list of tuple of Tensor of shape (D_j + 1, n)
        The standardised points.

    Raises
    ------
    ShapeError
        If the first block has no such column.
    DataError
        If there are fewer distinct points than components.
    """

    method: str
    time_feature: int
    n_components: int
    chunks: list[Chunk]
    points: Floats = field(init=False)
    distinct: Labels = field(init=False)

    def __post_init__(self) -> None:
        width = len(self.chunks[0][0]) - 1
        if self.method == "time" and self.time_feature >= width:
            raise ShapeError(
                f"time_feature={self.time_feature} is no column of the first block, "
                f"which has {width}"
            )
        columns = [torch.cat([block[:-1] for block in chunk]) for chunk in self.chunks]
        points = torch.cat(columns, 1).T.cpu().numpy()
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "distinct", distinct_rows(points, self.n_components))

    def labels(self, attempt: int, rng: np.random.RandomState) -> Labels:
        """A component for each point, for the start number ``attempt`` (0 is the first)."""
        match self.method:
            case "time":
                times = self.points[:, self.time_feature]
                return time_labels(times, self.n_components, rng if attempt else None)
            case "kmeans":
                return kmeans_labels(self.points, self.n_components, rng)
        return random_labels(self.points, self.distinct, self.n_components, rng)

    def draw(self, attempt: int, family: Family, rng: np.random.RandomState) -> Parameters:
        """The mixture of the Gaussians of the labelled points."""
        device = self.chunks[0][0].device
        labels = torch.from_numpy(self.labels(attempt, rng)).to(device)
        widths = [len(block) - 1 for block in self.chunks[0]]
        standard = Parameters.standard(self.n_components, widths, device)
        # in float64 throughout: these coordinates are not yet those of the components
        chunks = [tuple(block.double() for block in chunk) for chunk in self.chunks]
        return maximize(expect(standard, chunks, labels), family, floored=False)


@dataclass(frozen=True)
class GivenStart:
    """What is known of the start, in place of what would be drawn; None is unknown.

    Parameters
    ----------
    weights : Tensor of shape (K,) or None
    means : tuple of Tensor of shape (K, D_j) or None
        One per block.
    covariances : tuple of Tensor of shape (K, D_j, D_j) or None
        One per block.
    """

    weights: Tensor | None
    means: tuple[Tensor, ...] | None
    covariances: tuple[Tensor, ...] | None

    @property
    def complete(self) -> bool:
        """Whether nothing has to be drawn."""
        return not (self.weights is None or self.means is None or self.covariances is None)

    @classmethod
    def checked(
        cls,
        weights: Any,
        means: Any,
        covariances: Any,
        n_components: int,
        widths: Sequence[int],
    ) -> "GivenStart":
        """Convert array-likes to float64 and check them.

        Raises
        ------
        ShapeError
            If one has another shape than the number of components and the blocks ask for.
        DataError
            If weights are negative or do not add up to 1, or a value is not finite.
        """
        first = [(n_components, width) for width in widths]
        second = [(n_components, width, width) for width in widths]
        given = None if weights is None else _tensor(weights, (n_components,), "weights")
        if given is not None and (
            bool((given < 0).any()) or abs(float(given.sum()) - 1) > 1e-3
        ):
            raise DataError(f"weights must be positive and add up to 1, got {weights!r}")
        return cls(
            None if given is None else given / given.sum(),
            _tensors(means, first, "means"),
            _tensors(covariances, second, "covariances"),
        )

    def standardize(self, units: Standardization) -> "GivenStart":
        """The same in standardised units, on their device."""
        means, covariances = self.means, self.covariances
        parts = list(zip(units.shifts, units.scales, strict=True))
        if means is not None:
            means = tuple(
                (m.to(shift) - shift) / scale
                for m, (shift, scale) in zip(means, parts, strict=True)
            )
        if covariances is not None:
            covariances = tuple(
                c.to(scale) / (scale[:, None] * scale)
                for c, (_, scale) in zip(covariances, parts, strict=True)
            )
        weights = None if self.weights is None else self.weights.to(units.shifts[0])
        return GivenStart(weights, means, covariances)

    def over(self, drawn: Parameters) -> Parameters:
        """The drawn start with what is given in its place."""
        return Parameters.from_covariances(
            drawn.weights if self.weights is None else self.weights,
            drawn.means if self.means is None else self.means,
            drawn.covariances if self.covariances is None else self.covariances,
        )


def _tensor(values: Any, shape: tuple[int, ...], name: str) -> Tensor:
    tensor = as_tensor(values, name).detach().double()
    if tensor.shape != shape:
        raise ShapeError(f"{name} must have shape {shape}, got {tuple(tensor.shape)}")
    return tensor


def _tensors(
    values: Any, shapes: Sequence[tuple[int, ...]], name: str
) -> tuple[Tensor, ...] | None:
    if values is None:
        return None
    if len(values) != len(shapes):
        raise ShapeError(
            f"{name} must hold one array per block, {len(shapes)}; it holds {len(values)}"
        )
    return tuple(
        _tensor(value, shape, f"{name}[{block}]")
        for block, (value, shape) in enumerate(zip(values, shapes, strict=True))
    )
