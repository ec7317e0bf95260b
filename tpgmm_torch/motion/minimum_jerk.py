"""Going from one value to another as smoothly as can be."""

import torch
from torch import Tensor

__all__ = ["fading_time", "minimum_jerk"]

#: How fast a gap fades in the mean [rad/s or m/s], where that takes less time than a blend;
#: the least share of the blend that it takes.
FADING, SHORTEST = 0.03, 0.1


def minimum_jerk(fraction: Tensor) -> Tensor:
    """Minimum-jerk step from 0 at fraction 0 to 1 at fraction 1, flat at both ends.

    Parameters
    ----------
    fraction : Tensor
        Of any shape; beyond 0 and 1 the step is over.

    Examples
    --------
    >>> import torch
    >>> minimum_jerk(torch.tensor([-1.0, 0.5, 1.0])).tolist()
    [0.0, 0.5, 1.0]
    """
    u = fraction.clamp(0, 1)
    return u**3 * (10 - 15 * u + 6 * u**2)


def fading_time(gap: Tensor, blend: float | Tensor) -> Tensor:
    """Seconds in which the gap of robots that go on fades, shape (...).

    A robot that was held stands a few milliradians from its reference: where it presses on
    something, it should soon press again.

    Parameters
    ----------
    gap : Tensor
        From the reference, shape (..., n) [rad or m].
    blend : float or Tensor of shape (...)
        The longest that it takes [s]; a tenth of it is the shortest.
    """
    longest = torch.as_tensor(blend).to(gap)
    return (gap.abs().amax(-1) / FADING).clamp(SHORTEST * longest, longest)
