"""The rate at which an environment takes actions, in each of its observations.

LeRobot does not pass it on: a policy made for 100 Hz would run at half its speed in an
environment of 50 Hz.
"""

from __future__ import annotations

from typing import Any

import torch
from lerobot.processor import ObservationProcessorStep, PolicyProcessorPipeline

#: Key of the rate in an observation [1/s].
CONTROL_RATE = "observation.control_fps"


class _AddRate(ObservationProcessorStep):  # type: ignore[misc]
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
    """Processors for ``get_env_processors`` of an environment's configuration.

    Parameters
    ----------
    fps : float
        Actions per second.
    """
    return PolicyProcessorPipeline(steps=[_AddRate(fps)]), PolicyProcessorPipeline(steps=[])
