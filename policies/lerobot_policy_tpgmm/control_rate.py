"""Check that an environment takes actions at the rate of the policy.

LeRobot itself does not: a policy made for 100 Hz would run at half its speed in an environment
of 50 Hz. The environments of ``lerobot_env_bimanual`` add their rate to each observation.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tpgmm_torch.exceptions import DataError

__all__ = ["CONTROL_RATE", "check_rate"]

#: Key of the rate in an observation [1/s].
CONTROL_RATE = "observation.control_fps"


def check_rate(batch: Mapping[str, Any], rate: float) -> None:
    """Whether observations come at the rate of the policy, if they tell.

    Parameters
    ----------
    batch : mapping of str to Tensor
        Observations.
    rate : float
        Of the policy [1/s].
    """
    if CONTROL_RATE not in batch:
        return
    told = float(batch[CONTROL_RATE].flatten()[0])
    if abs(told - rate) > 1e-3 * rate:
        raise DataError(
            f"the environment takes {told:g} actions per second, the policy gives {rate:g}: "
            f"--policy.control_fps={told:g} makes its time pass accordingly, "
            f"--env.fps={rate:g} changes the environment"
        )
