"""The k nearest neighbours among all demonstrated states say what is done next."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from sklearn.neighbors import KNeighborsRegressor
from torch import Tensor

from lerobot_policy_tpgmm.configuration_tpgmm import state_features
from tpgmm_evaluation.policies.episodes import Episodes, Windows, policy_stride
from tpgmm_evaluation.policies.planned import ChunkedConfig, ChunkedPolicy
from tpgmm_torch.exceptions import DataError

__all__ = ["NeighboursConfig", "NeighboursPolicy"]

#: A column that varies less than this says nothing [rad, m].
CONSTANT = 1e-4


@PreTrainedConfig.register_subclass("nearest_neighbours")
@dataclass
class NeighboursConfig(ChunkedConfig):
    """Configuration of :class:`NeighboursPolicy`.

    Parameters
    ----------
    n_neighbours : int
        k, whose actions are weighted by the inverse of the distance.
    time_weight : float
        How many standard deviations of a joint a second counts as; 0 where the time is not
        given.
    environment_weight : float
        What a standard deviation of the objects counts as beside one of the joints.
    n_rows : int
        How many states are kept.
    """

    n_neighbours: int = 5
    time_weight: float = 0.0
    environment_weight: float = 1.0
    n_rows: int = 1


class NeighboursPolicy(ChunkedPolicy):
    """scikit-learn's nearest-neighbour regression from states to the next actions.

    Parameters
    ----------
    config : NeighboursConfig
    **unused
        What else LeRobot passes.
    """

    config_class = NeighboursConfig
    config: NeighboursConfig
    name = "nearest_neighbours"
    scale: Tensor
    states: Tensor
    actions: Tensor

    def __init__(self, config: NeighboursConfig, **unused: Any) -> None:
        super().__init__(config)
        [n_action] = config.action_feature.shape
        width = sum(feature.shape[0] for feature in config.input_features.values())
        self.register_buffer("scale", torch.ones(width))
        self.register_buffer("states", torch.zeros(config.n_rows, width))
        self.register_buffer(
            "actions", torch.zeros(config.n_rows, config.n_action_steps, n_action)
        )

    @classmethod
    def fit(cls, episodes: Episodes, rate: int, timed: int = 0, **fields: Any) -> Self:
        """Keep every row of the episodes.

        Parameters
        ----------
        episodes : Episodes
        rate : int
            Actions per second.
        timed : int, default=0
            How many of the last entries of the environment state tell the time, the first of
            them in seconds.
        **fields
            Of the configuration.

        Raises
        ------
        DataError
            If there are fewer rows than neighbours, or the episodes' rate is no multiple of
            ``rate``.
        """
        settings: dict[str, Any] = {**state_features(*episodes.widths), **fields}
        config = NeighboursConfig(
            n_rows=episodes.bounds[-1], device="cpu", push_to_hub=False, **settings
        )
        n_state = episodes.widths[0]
        if config.n_rows < config.n_neighbours:
            raise DataError(
                f"{config.n_neighbours} neighbours are asked for, of {config.n_rows} rows"
            )
        policy = cls(config)
        windows = Windows(
            episodes.columns,
            episodes.bounds,
            policy_stride(episodes.fps, rate),
            None,
            config.action_delta_indices,
        )
        rows = windows.at(torch.arange(len(windows)))
        states = torch.cat((rows[OBS_STATE], rows[OBS_ENV_STATE]), dim=1)
        spread = states.std(0) if len(states) > 1 else torch.zeros(states.shape[1])
        scale = torch.where(spread < CONSTANT, 0.0, 1 / spread.clamp(min=CONSTANT))
        scale[n_state:] *= config.environment_weight
        if timed:
            scale[-timed:] = 0.0
            scale[-timed] = config.time_weight
        policy.scale[:], policy.states[:] = scale, states * scale
        policy.actions[:] = rows[ACTION]
        return policy.eval()

    @cached_property
    def _regression(self) -> KNeighborsRegressor:
        regression = KNeighborsRegressor(self.config.n_neighbours, weights="distance")
        return regression.fit(self.states.numpy(), self.actions.flatten(1).numpy())

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **_unused: Any) -> Tensor:
        """The next actions, shape (B, n_action_steps, n_action)."""
        keys = [key for key in (OBS_STATE, OBS_ENV_STATE) if key in self.config.input_features]
        seen = torch.cat([batch[key] for key in keys], dim=-1).float()
        found = self._regression.predict((seen * self.scale).numpy()).astype(np.float32)
        return torch.from_numpy(found).unflatten(1, self.actions.shape[1:])
