"""The naive floor: replay the demonstration whose objects stood nearest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.utils.constants import OBS_ENV_STATE
from torch import Tensor

from lerobot_policy_tpgmm.configuration_tpgmm import state_features
from tpgmm_evaluation.policies.episodes import Episodes
from tpgmm_evaluation.policies.planned import PlannedConfig, PlannedPolicy

#: Metres that count as much as one radian of difference in orientation.
METRES_PER_RADIAN = 0.1
POSE = 7


@PreTrainedConfig.register_subclass("nearest_demonstration")
@dataclass
class NearestConfig(PlannedConfig):
    """Configuration of :class:`NearestPolicy`.

    Parameters
    ----------
    n_demonstrations, n_steps : int
        How many are kept, and how many steps the longest has.
    """

    n_demonstrations: int = 1
    n_steps: int = 1


class NearestPolicy(PlannedPolicy):
    """Replay, open loop, the demonstration whose object poses at the start are nearest.

    Parameters
    ----------
    **unused
        What else LeRobot passes.
    """

    config_class = NearestConfig
    name = "nearest_demonstration"

    def __init__(self, config: NearestConfig, **unused: Any) -> None:
        super().__init__(config)
        environment, action = config.env_state_feature.shape, config.action_feature.shape
        self.register_buffer("poses", torch.zeros(config.n_demonstrations, *environment))
        self.register_buffer(
            "actions", torch.zeros(config.n_demonstrations, config.n_steps, *action)
        )
        self.reset()

    @classmethod
    def fit(cls, episodes: Episodes) -> NearestPolicy:
        """Keep the episodes."""
        parts = list(episodes)
        longest = max(len(action) for _, _, action in parts)
        config = NearestConfig(
            n_demonstrations=len(parts),
            n_steps=longest,
            **state_features(*episodes.widths),
            device="cpu",
            push_to_hub=False,
        )
        policy = cls(config)
        for index, (_, environment, action) in enumerate(parts):
            policy.poses[index] = environment[0]
            policy.actions[index] = action[-1]
            policy.actions[index, : len(action)] = action
        return policy.eval()

    def plan(self, batch: dict[str, Tensor], step: int) -> Tensor:
        """Return the actions of the demonstrations that are nearest."""
        return self.actions[self._distance(batch[OBS_ENV_STATE]).argmin(dim=1)]

    def _distance(self, poses: Tensor) -> Tensor:
        """Compute distances of poses from each demonstration's, shape (B, n)."""
        given = poses[:, None].unflatten(-1, (-1, POSE))
        kept = self.poses[None].unflatten(-1, (-1, POSE))
        squares = (given[..., :3] - kept[..., :3]).square().sum(-1)
        cosine = (given[..., 3:] * kept[..., 3:]).sum(-1).abs().clamp(max=1)
        turn = METRES_PER_RADIAN * 2 * torch.arccos(cosine)
        return (squares + turn.square()).sum(-1)
