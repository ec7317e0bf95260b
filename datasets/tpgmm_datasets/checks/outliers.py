"""Outliers among a few numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tpgmm_torch.data.arrays import Array

#: Fewer numbers do not show what is usual.
FEWEST = 4
#: Outliers are so many robust standard deviations from the median.
FAR = 6.0
#: Of a normal law, the standard deviation per median absolute deviation.
CONSISTENT = 1.4826
#: Places that are set apart are so many times farther away than the farthest of the others, of
#: five places or more.
APART, FEWEST_PLACES = 4.0, 5


def outliers(values: Sequence[float] | Array, floor: float) -> list[int]:
    """Find the indices of values far from the median, the farthest first.

    A value is far if it is six times 1.4826 median absolute deviations (Hampel's identifier
    [1]_) and more than ``floor`` away.

    Parameters
    ----------
    values : sequence of float
        One per demonstration; fewer than four have no outliers.
    floor : float
        What is nearer is like the others, in the unit of the values.

    References
    ----------
    .. [1] L. Davies, U. Gather: The Identification of Multiple Outliers. Journal of the
       American Statistical Association 88 (1993).

    Examples
    --------
    >>> outliers([1.0, 1.1, 0.9, 1.0, 7.0], floor=0.5)
    [4]
    """
    if len(values) < FEWEST:
        return []
    distances = np.abs(np.asarray(values) - np.median(values))
    limit = max(floor, FAR * CONSISTENT * float(np.median(distances)))
    order = np.argsort(-distances, kind="stable")
    return [int(i) for i in order if distances[i] > limit]


def set_apart(distances: Array, floor: float) -> list[int]:
    """Find the indices of the few that are far from where all others are, by a gap.

    At most a third is set apart: by at least four times the largest distance of the others,
    and more than ``floor``. That a usual scatter, in a box or by a normal law, shows such a
    gap by chance is rare.

    Parameters
    ----------
    distances : array of shape (n,)
        From the usual place, of each demonstration; fewer than five have none set apart.
    floor : float
        What is nearer is like the others, in the unit of the distances.

    Examples
    --------
    >>> set_apart(np.array([0.1, 0.0, 3.0, 0.2, 0.1]), floor=0.5)
    [2]
    """
    order = np.argsort(-distances, kind="stable")
    most = len(distances) // 3 if len(distances) >= FEWEST_PLACES else 0
    for count in range(most, 0, -1):
        near, far = distances[order[count]], distances[order[count - 1]]
        if far > max(floor, APART * near):
            return sorted(int(i) for i in order[:count])
    return []
