"""Going from one value to another as smoothly as can be."""

from torch import Tensor


def minimum_jerk(fraction: Tensor) -> Tensor:
    """Compute a minimum-jerk step from 0 at fraction 0 to 1 at fraction 1, flat at both ends.

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
