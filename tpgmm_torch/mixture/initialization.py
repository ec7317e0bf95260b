"""Where EM starts, if nobody says it: from points assigned to components.

A start is the mixture of the Gaussians of the points that each component was given. Points are
walked through in batches; only a sample of bounded size is ever kept.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from sklearn.cluster import KMeans
from torch import Tensor

from tpgmm_torch.em.block_gaussians import Family, Parameters, Standardization
from tpgmm_torch.exceptions import DataError, ShapeError
from tpgmm_torch.large_data.processes import ALONE, Processes
from tpgmm_torch.large_data.row_batches import Rows
from tpgmm_torch.large_data.time_quantiles import TimeBins, bin_sizes

__all__ = ["StartDrawer", "check_distinct", "gaussians_of", "sample_rows"]

Floats = NDArray[np.floating]
Labels = NDArray[np.int64]
#: Gives each row of a standardised batch (n, n_features) a component; batches come in order.
Labeller = Callable[[Floats], Labels]

#: k-means, and the choice of random points, see so many points at most.
LARGEST_SAMPLE = 2**16

#: Rows at a time when moments are gathered.
PIECE = 2**14


def check_distinct(
    rows: Rows, n_rows: int, n_components: int, processes: Processes = ALONE
) -> None:
    """Refuse data with fewer different rows than components; it stops as soon as it knows.

    Parameters
    ----------
    rows : Rows
        Of this process.
    n_rows : int
        Number of rows of all processes.
    n_components : int
    processes : Processes

    Raises
    ------
    DataError
        If the data hold fewer distinct points than components.
    """
    known: Floats | None = None
    for batch in rows:
        # distinct on a random line means distinct; a sort of numbers costs less than of rows
        line = np.random.RandomState(0).standard_normal(batch.shape[1]).astype(batch.dtype)
        _, first = np.unique(batch @ line, return_index=True)
        found = batch[first[:n_components]]
        if len(first) < n_components:
            found = np.unique(batch, axis=0)
        found = found[:n_components]
        both = found if known is None else np.concatenate([known, found])
        known = both if known is None else np.unique(both, axis=0)[:n_components]
        if len(known) >= n_components:
            break
    assert known is not None
    everyone = processes.concatenate(torch.from_numpy(known).double())
    count = len(np.unique(everyone.numpy(), axis=0))
    if count < n_components:
        raise DataError(
            f"n_components={n_components}, but the data hold only {count} distinct point(s) "
            f"among n_samples = {n_rows}; use at most that many components, or more data"
        )


def sample_rows(
    rows: Rows, n_rows: int, rng: np.random.RandomState, processes: Processes = ALONE
) -> Floats:
    """At most ``LARGEST_SAMPLE`` rows of all processes, all of them where they are no more.

    Parameters
    ----------
    rows : Rows
        Of this process.
    n_rows : int
        Number of rows of all processes.
    rng : RandomState
        In the same state in all processes.
    processes : Processes

    Returns
    -------
    array of shape (n, n_features)
    """
    wanted: Labels = np.arange(n_rows)
    if n_rows > LARGEST_SAMPLE:
        # drawing without replacement would need a permutation of all rows
        wanted = np.unique(rng.randint(0, n_rows, LARGEST_SAMPLE, dtype=np.int64))
    lengths = [len(batch) for batch in rows] if processes.count > 1 else [0]
    counts = processes.concatenate(torch.tensor([sum(lengths)], dtype=torch.float64))
    start = int(counts[: processes.rank].sum())
    parts = []
    for batch in rows:
        first, last = np.searchsorted(wanted, (start, start + len(batch)))
        parts.append(np.asarray(batch[wanted[first:last] - start], dtype=np.float64))
        start += len(batch)
    return processes.concatenate(torch.from_numpy(np.concatenate(parts))).numpy()


def gaussians_of(
    rows: Rows,
    units: Standardization,
    labellers: Sequence[Labeller],
    family: Family,
    n_components: int,
    processes: Processes = ALONE,
    piece_size: int = PIECE,
) -> list[Parameters]:
    """The mixtures of the Gaussians of labelled points, in one pass for all labellings.

    Parameters
    ----------
    rows : Rows
        Of this process.
    units : Standardization
    labellers : sequence of callable
        Each gives every component at least one point of one of the processes.
    family : Family
    n_components : int
    processes : Processes
    piece_size : int
        Rows at a time.
    """
    widths = [len(shift) for shift in units.shifts]
    cuts = np.cumsum([width + 1 for width in widths])[:-1]
    ones = np.cumsum(widths)
    sums = [
        [np.zeros((n_components, width + 1, width + 1)) for width in widths] for _ in labellers
    ]
    for batch in rows:
        for start in range(0, len(batch), piece_size):
            piece = standardized(batch[start : start + piece_size], units)
            columns = np.insert(piece, ones, 1.0, axis=1)  # (x; 1), block after block
            for labeller, totals in zip(labellers, sums, strict=True):
                labels = labeller(piece)
                ordered = columns[np.argsort(labels, kind="stable")]
                ends = np.cumsum(np.bincount(labels, minlength=n_components))
                for component, own in enumerate(np.split(ordered, ends[:-1])):
                    for total, block in zip(totals, np.split(own, cuts, 1), strict=True):
                        total[component] += block.T @ block
    flat = processes.sum(*(torch.from_numpy(total) for totals in sums for total in totals))
    count = len(widths)
    return [_mixture(flat[i : i + count], family) for i in range(0, len(flat), count)]


def standardized(batch: Floats, units: Standardization) -> Floats:
    """Rows (n, n_features) in standardised units, in float64."""
    shift, scale = (torch.cat(part).cpu().numpy() for part in (units.shifts, units.scales))
    result: Floats = (np.asarray(batch, dtype=np.float64) - shift) / scale
    return result


def _mixture(sums: Sequence[Tensor], family: Family) -> Parameters:
    """Weights, means and covariances from the sums of (x; 1)(x; 1)^T, (K, D_j + 1, D_j + 1)."""
    mass = sums[0][:, -1, -1]
    weights = mass / mass.sum()
    means, covariances = [], []
    for moment, diagonal in zip(sums, family.diagonals, strict=True):
        mean = moment[:, :-1, -1] / mass[:, None]
        scatter = moment[:, :-1, :-1] / mass[:, None, None] - mean[..., None] * mean[:, None]
        restricted = family.restrict(scatter.to(diagonal), weights.to(diagonal))
        means.append(mean.to(diagonal))
        covariances.append(restricted + torch.diag(diagonal))
    return Parameters.from_covariances(weights.to(means[0]), means, covariances)


@dataclass(frozen=True)
class StartDrawer:
    """Draws starts by one of the methods.

    Parameters
    ----------
    method : {"time", "kmeans", "random"}
        Equal bins along time, bins of random sizes from the second start on; clusters of
        scikit-learn's k-means (one run); the nearest of some distinct points drawn at random.
    time_feature : int
        Column that holds time.
    n_components : int
    rows : Rows
        Of this process.
    n_rows : int
        Number of rows of all processes.
    units : Standardization
    group_size : int, default=1
        So many consecutive rows belong together.
    processes : Processes, optional

    Raises
    ------
    ShapeError
        If the first block has no such column.
    """

    method: str
    time_feature: int
    n_components: int
    rows: Rows
    n_rows: int
    units: Standardization
    group_size: int = 1
    processes: Processes = ALONE

    def __post_init__(self) -> None:
        width = len(self.units.shifts[0])
        if self.method == "time" and self.time_feature >= width:
            raise ShapeError(
                f"time_feature={self.time_feature} is no column of the first block, "
                f"which has {width}"
            )

    def draw(
        self, n_starts: int, family: Family, rng: np.random.RandomState
    ) -> list[Parameters]:
        """So many starts, not yet brought into the family; see :func:`check_distinct`."""
        if self.method == "time":
            labellers = [self._bins(rng if start else None) for start in range(n_starts)]
        else:
            sample = sample_rows(self.rows, self.n_rows, rng, self.processes)
            sample = standardized(sample, self.units)
            choose = self._clusters if self.method == "kmeans" else self._points
            labellers = [choose(sample, rng) for _ in range(n_starts)]
        piece = max(1, PIECE // self.group_size) * self.group_size
        return gaussians_of(
            self.rows, self.units, labellers, family, self.n_components, self.processes, piece
        )

    def _bins(self, rng: np.random.RandomState | None) -> Labeller:
        # groups are not parted, unless they are too few
        n_groups, size = self.n_rows // self.group_size, self.group_size
        if n_groups < self.n_components:
            n_groups, size = self.n_rows, 1
        sizes = bin_sizes(n_groups, self.n_components, rng)
        times = _Times(self.rows, self.units, self.time_feature, size)
        labels = TimeBins.of_rows(times, 0, sizes, self.processes).labeller()
        return lambda piece: labels(piece[::size, self.time_feature]).repeat(size)

    def _clusters(self, sample: Floats, rng: np.random.RandomState) -> Labeller:
        kmeans = KMeans(self.n_components, n_init=1, random_state=rng).fit(sample)
        return _nearest(kmeans.cluster_centers_)

    def _points(self, sample: Floats, rng: np.random.RandomState) -> Labeller:
        line = np.random.RandomState(0).standard_normal(sample.shape[1])
        _, distinct = np.unique(sample @ line, return_index=True)
        if len(distinct) < self.n_components:
            _, distinct = np.unique(sample, axis=0, return_index=True)
        if len(distinct) < self.n_components:
            raise DataError(
                f"a sample of {len(sample)} points holds only {len(distinct)} distinct ones, "
                f"fewer than n_components={self.n_components}; use init_params='time'"
            )
        return _nearest(sample[rng.choice(distinct, self.n_components, replace=False)])


class _Times(Rows):
    """The standardised time of each group of rows, as rows of width one."""

    def __init__(self, rows: Rows, units: Standardization, column: int, size: int) -> None:
        self.in_memory = rows.in_memory
        self._rows, self._column, self._size = rows, slice(column, column + 1), size
        shift, scale = (torch.cat(part).cpu() for part in (units.shifts, units.scales))
        self._shift, self._scale = float(shift[column]), float(scale[column])

    def batches(self) -> Iterator[Floats]:
        """One pass over the first rows of the groups."""
        for batch in self._rows.batches():
            times = np.asarray(batch[:: self._size, self._column], np.float64)
            yield (times - self._shift) / self._scale


def _nearest(centers: Floats) -> Labeller:
    # differences, not norms and products: a center is nearest to itself, rounding or not
    return lambda piece: cdist(piece, centers, "sqeuclidean").argmin(1)
