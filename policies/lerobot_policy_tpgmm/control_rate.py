"""How an environment tells a policy at which rate it takes actions.

LeRobot itself does not: a policy made for 100 Hz would run at half its speed in an environment
of 50 Hz. Our environments add their rate to each observation, and our policy looks at it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from lerobot.processor import ObservationProcessorStep, PolicyProcessorPipeline

from tpgmm_torch.exceptions import DataError

__all__ = ["CONTROL_RATE", "check_rate", "rate_processors"]

CONTROL_RATE = "observation.control_fps"


class _TellRate(ObservationProcessorStep):  # type: ignore[misc]
    def __init__(self, fps: float) -> None:
        self.fps = fps

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        batch = next(iter(observation.values())).shape[0]
        return {**observation, CONTROL_RATE: torch.full((batch, 1), float(self.fps))}

    def transform_features(self, features: Any) -> Any:
        return features


def rate_processors(
    fps: float,
) -> tuple[PolicyProcessorPipeline[Any, Any], PolicyProcessorPipeline[Any, Any]]:
    """What an environment's configuration returns from ``get_env_processors``.

    Parameters
    ----------
    fps : float
        Actions per second.
    """
    return PolicyProcessorPipeline(steps=[_TellRate(fps)]), PolicyProcessorPipeline(steps=[])


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
