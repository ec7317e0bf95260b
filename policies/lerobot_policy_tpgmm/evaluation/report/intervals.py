"""How sure a success rate is."""

from __future__ import annotations

import math
from statistics import NormalDist

from tpgmm_torch.exceptions import DataError

__all__ = ["wilson"]


def wilson(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Score interval of a proportion (Wilson, JASA 22, 1927).

    Unlike the normal approximation it stays within [0, 1] and is not empty where all trials
    succeed or none.

    Parameters
    ----------
    successes, trials : int
    confidence : float, default=0.95

    Returns
    -------
    lower, upper : float

    Raises
    ------
    DataError
        If there are no trials, or more successes than trials.
    """
    if not 0 <= successes <= trials or trials == 0:
        raise DataError(f"{successes} successes of {trials} trials are no proportion")
    z = NormalDist().inv_cdf((1 + confidence) / 2)
    rate = successes / trials
    centre = rate + z * z / (2 * trials)
    spread = z * math.sqrt(rate * (1 - rate) / trials + (z / (2 * trials)) ** 2)
    scale = 1 + z * z / trials
    return max((centre - spread) / scale, 0.0), min((centre + spread) / scale, 1.0)
