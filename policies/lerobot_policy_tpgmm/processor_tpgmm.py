"""The pipelines before and behind the policy, as LeRobot wants them."""

from __future__ import annotations

from typing import Any

from lerobot.processor import PolicyProcessorPipeline, make_default_pre_post_processors

from lerobot_policy_tpgmm.configuration_tpgmm import TPGMMConfig

__all__ = ["make_tpgmm_pre_post_processors"]


def make_tpgmm_pre_post_processors(
    config: TPGMMConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[PolicyProcessorPipeline[Any, Any], PolicyProcessorPipeline[Any, Any]]:
    """Make the pipelines: names, batch dimension, device, a normalisation that does nothing.

    The policy itself brings names, order and units together. LeRobot's commands override
    steps of all these names, so all are there.

    Parameters
    ----------
    dataset_stats : dict, optional
        Not used: nothing is normalised.
    """
    pipelines: tuple[Any, Any] = make_default_pre_post_processors(config, None)
    return pipelines
