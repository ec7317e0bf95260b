"""Which components matter when: a bound that holds over whole windows of time.

At time t component i has the weight ``h_i(t) ∝ pi_i N(t | mu_i, sigma_i)``. Those whose weight
stays below a share of the largest for all of a window are left out of it; the references move
by at most the weight left out times how far apart the components' estimates are.
"""

from __future__ import annotations

import bisect
import math

import torch
from torch import Tensor

__all__ = ["Windows"]

#: How many windows there are to the narrowest component's standard deviation, and at most.
PER_DEVIATION, MOST = 4, 4096
#: How many standard deviations beyond the components' means the windows reach.
REACH = 6.0


class Windows:
    """The components that count, for windows of time.

    Parameters
    ----------
    log_weights, means, variances : Tensor of shape (K,)
        Logarithms of the mixing coefficients; the components' time marginals [s], [s^2].
    negligible : float
        Components with a smaller weight all over a window are left out of it; 0 keeps all.
    """

    def __init__(
        self, log_weights: Tensor, means: Tensor, variances: Tensor, negligible: float
    ) -> None:
        parts = (part.detach().double().cpu() for part in (log_weights, means, variances))
        log_weights, means, variances = parts
        self._everything = tuple(range(len(means)))
        deviations = variances.sqrt()
        low, high = (
            float((means - REACH * deviations).min()),
            float((means + REACH * deviations).max()),
        )
        wanted = PER_DEVIATION * (high - low) / float(deviations.min())
        count = max(1, min(MOST, math.ceil(wanted)))
        edges = torch.linspace(low, high, count + 1, dtype=torch.float64)
        self._edges: list[float] = edges.tolist()
        self._sets: list[tuple[int, ...]] = [self._everything] * count
        if negligible == 0:
            return

        def log_h(times: Tensor) -> Tensor:
            apart = (times - means).square() / variances
            return log_weights - 0.5 * (apart + variances.log())

        start, end = edges[:-1, None], edges[1:, None]
        # the most a component can weigh in a window, and the least the heaviest one does
        most = log_h(torch.minimum(torch.maximum(means, start), end))
        least = torch.minimum(log_h(start), log_h(end)).amax(1, keepdim=True)
        counts = most >= least + math.log(negligible)
        known: dict[tuple[int, ...], tuple[int, ...]] = {}
        for window, row in enumerate(counts):
            chosen = tuple(row.nonzero()[:, 0].tolist())
            self._sets[window] = known.setdefault(chosen, chosen)

    @property
    def largest(self) -> int:
        """The most components that count in one window."""
        return max(map(len, self._sets))

    def at(self, time: float) -> tuple[int, ...]:
        """Components that count at an instant [s]; beyond the windows all do."""
        place = bisect.bisect_right(self._edges, time) - 1
        return self._sets[place] if 0 <= place < len(self._sets) else self._everything

    def between(self, first: float, last: float) -> tuple[int, ...]:
        """Components that count anywhere from one instant to another."""
        start = bisect.bisect_right(self._edges, first) - 1
        end = bisect.bisect_right(self._edges, last) - 1
        if start < 0 or end >= len(self._sets):
            return self._everything
        return tuple(sorted(set().union(*self._sets[start : end + 1])))
