"""Behaviour cloning at its plainest: a multilayer perceptron from states to actions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.optim import AdamConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor, nn

from tpgmm_evaluation.policies.planned import ChunkedConfig, ChunkedPolicy

__all__ = ["PerceptronConfig", "PerceptronPolicy"]


@PreTrainedConfig.register_subclass("perceptron")
@dataclass
class PerceptronConfig(ChunkedConfig):
    """Configuration of :class:`PerceptronPolicy`.

    Parameters
    ----------
    width, depth : int
        Of the hidden layers.
    optimizer_lr, optimizer_weight_decay : float
        Of Adam.
    """

    width: int = 256
    depth: int = 2
    optimizer_lr: float = 1e-3
    optimizer_weight_decay: float = 0.0

    def get_optimizer_preset(self) -> AdamConfig:
        """Adam."""
        return AdamConfig(lr=self.optimizer_lr, weight_decay=self.optimizer_weight_decay)


class PerceptronPolicy(ChunkedPolicy):
    """Predicts the next actions from the present state and environment state.

    Parameters
    ----------
    config : PerceptronConfig
    **unused
        What else LeRobot passes.
    """

    config_class = PerceptronConfig
    config: PerceptronConfig
    name = "perceptron"

    def __init__(self, config: PerceptronConfig, **unused: Any) -> None:
        super().__init__(config)
        [self._actions] = config.action_feature.shape
        width = sum(feature.shape[0] for feature in config.input_features.values())
        layers: list[nn.Module] = []
        for _ in range(config.depth):
            layers += [nn.Linear(width, config.width), nn.GELU()]
            width = config.width
        layers.append(nn.Linear(width, config.n_action_steps * self._actions))
        self.network = nn.Sequential(*layers)

    def predict_action_chunk(self, batch: dict[str, Tensor], **_unused: Any) -> Tensor:
        """The next actions, shape (B, n_action_steps, n_action)."""
        keys = [key for key in (OBS_STATE, OBS_ENV_STATE) if key in self.config.input_features]
        predicted: Tensor = self.network(torch.cat([batch[key] for key in keys], dim=-1))
        return predicted.unflatten(-1, (self.config.n_action_steps, self._actions))

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, Any]]:
        """Mean absolute error of the actions that there are."""
        errors = (self.predict_action_chunk(batch) - batch[ACTION]).abs().mean(-1)
        valid = ~batch["action_is_pad"]
        return (errors * valid).sum() / valid.sum().clamp(min=1), {}

    def get_optim_params(self) -> Any:
        """All."""
        return self.parameters()
