"""Time as an observation."""

import math

import pytest
import torch
from lerobot.configs import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE

from tpgmm_evaluation.policies.elapsed_time import ElapsedTimeStep, time_features


def test_the_elapsed_time_joins_the_environment_and_begins_anew():
    step = ElapsedTimeStep(fps=10)
    observation = {OBS_ENV_STATE: torch.zeros(2, 7), OBS_STATE: torch.zeros(2, 3)}
    seen = [step.observation(dict(observation))[OBS_ENV_STATE] for _ in range(3)]
    assert [float(x[1, 7]) for x in seen] == pytest.approx([0.0, 0.1, 0.2])
    torch.testing.assert_close(seen[2][0, 7:], time_features(torch.tensor(0.2)))
    assert float(time_features(torch.tensor(4.0))[1]) == pytest.approx(math.sin(math.pi / 2))
    step.reset()
    assert float(step.observation(dict(observation))[OBS_ENV_STATE][0, 7]) == 0.0
    assert ElapsedTimeStep(**step.get_config()) == ElapsedTimeStep(fps=10)
    features = {
        PipelineFeatureType.OBSERVATION: {OBS_ENV_STATE: PolicyFeature(FeatureType.ENV, (7,))}
    }
    grown = step.transform_features(features)[PipelineFeatureType.OBSERVATION]
    assert grown[OBS_ENV_STATE].shape == seen[0].shape[1:]
