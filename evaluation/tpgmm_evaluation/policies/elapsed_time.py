"""Time as part of the observation: what makes a baseline phase-informed."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.processor import ObservationProcessorStep
from lerobot.utils.constants import OBS_ENV_STATE
from torch import Tensor

#: The Fourier series of an episode of this length [s], up to 1 Hz.
LONGEST = 16.0
HARMONICS = torch.arange(1, 17) / LONGEST


def time_features(seconds: Tensor) -> Tensor:
    """Return the time, and its sine and cosine at frequencies from 1/16 to 1 Hz.

    A network that is given a number alone follows a motion as quick as the shaking only after
    very long training.

    Parameters
    ----------
    seconds : Tensor of shape (...)
        Since the beginning of an episode.

    Returns
    -------
    Tensor of shape (..., 33)
    """
    angle = 2 * math.pi * seconds[..., None] * HARMONICS
    return torch.cat((seconds[..., None], angle.sin(), angle.cos()), dim=-1)


@dataclass
class ElapsedTimeStep(ObservationProcessorStep):  # type: ignore[misc]
    """Append :func:`time_features` of the elapsed time to ``observation.environment_state``.

    Time is the number of observations since ``reset``. LeRobot's own evaluation resets the
    policy before each batch of episodes, but not its pipelines: run all episodes as one batch
    there, ``--eval.batch_size`` like ``--eval.n_episodes``.

    Parameters
    ----------
    fps : float
        Observations per second.
    """

    fps: float
    _count: int = field(default=0, init=False, repr=False)

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Append the time to a batch, and count one observation."""
        environment = observation[OBS_ENV_STATE]
        features = time_features(torch.full(environment.shape[:-1], self._count / self.fps))
        observation[OBS_ENV_STATE] = torch.cat((environment, features.to(environment)), dim=-1)
        self._count += 1
        return observation

    def reset(self) -> None:
        """Begin an episode."""
        self._count = 0

    def get_config(self) -> dict[str, Any]:
        """Return its entry in ``policy_preprocessor.json``."""
        return {"fps": self.fps}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Add the time to the size of the environment state."""
        observed = dict(features[PipelineFeatureType.OBSERVATION])
        given = observed[OBS_ENV_STATE]
        size = given.shape[-1] + len(time_features(torch.zeros(())))
        observed[OBS_ENV_STATE] = PolicyFeature(type=given.type, shape=(size,))
        return {**features, PipelineFeatureType.OBSERVATION: observed}


def tell_time(preprocessor: Any, fps: float) -> None:
    """Insert the step into a pipeline of LeRobot's, where a policy wants the time."""
    # before device and normalisation, which know the time as a part of the environment
    preprocessor.steps.insert(-2, ElapsedTimeStep(fps))
