"""Which components matter when: a bound that holds over whole windows of time.

At time t component i has the weight ``h_i(t) ∝ pi_i N(t | mu_i, sigma_i)``. Those whose weight
stays below a share of the largest for all of a window are left out of it; the references move
by at most the weight left out times the distance of the components' estimates.
"""

from __future__ import annotations

import bisect
import math

import torch
from torch import Tensor

from tpgmm_torch.regression.conditionals import TimeMarginals

__all__ = ["ActiveComponents"]

#: How many windows there are to the narrowest component's standard deviation, and at most.
PER_DEVIATION, MOST = 4, 4096
#: How many standard deviations beyond the components' means the windows reach.
REACH = 6.0


class ActiveComponents:
    """The components that count, for windows of time; beyond the windows all of them do.

    Parameters
    ----------
    marginals : TimeMarginals
        Of K components.
    negligible : float
        Components with a smaller share of the largest weight all over a window are left out
        of it; 0 keeps all.
    """

    def __init__(self, marginals: TimeMarginals, negligible: float) -> None:
        marginals = TimeMarginals(
            *(x.detach().double().cpu() for x in vars(marginals).values())
        )
        means, deviations = marginals.mean, marginals.precision.rsqrt()
        low = float((means - REACH * deviations).min())
        high = float((means + REACH * deviations).max())
        wanted = PER_DEVIATION * (high - low) / float(deviations.min())
        count = max(1, min(MOST, math.ceil(wanted)))
        self._edges = torch.linspace(low, high, count + 1, dtype=torch.float64)
        start, end = self._edges[:-1, None], self._edges[1:, None]
        # the most a component can weigh in a window, and the least the heaviest one does
        most = marginals.log_activation(torch.minimum(torch.maximum(means, start), end))
        ends = marginals.log_activation(start), marginals.log_activation(end)
        least = torch.minimum(*ends).amax(1, keepdim=True)
        share = math.log(negligible) if negligible else -math.inf
        # a row for each window, and one before and behind them
        self._counts = torch.nn.functional.pad(most >= least + share, (0, 0, 1, 1), value=True)
        self._edge_list: list[float] = self._edges.tolist()
        self._sets = [tuple(row.nonzero()[:, 0].tolist()) for row in self._counts]

    @property
    def largest(self) -> int:
        """The most components that count in one window."""
        return max(map(len, self._sets[1:-1]))

    def at(self, time: float) -> tuple[int, ...]:
        """Components that count at an instant [s]."""
        return self._sets[bisect.bisect_right(self._edge_list, time)]

    def counts(self, time: Tensor) -> Tensor:
        """Whether each component counts at times of shape (...): bool of shape (..., K)."""
        instants = time.detach().double().cpu().contiguous()
        window = torch.bucketize(instants, self._edges, right=True)
        return self._counts[window].to(time.device)
