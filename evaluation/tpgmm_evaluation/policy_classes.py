"""Which policy a saved configuration belongs to; LeRobot finds its own and plugins' alone."""

from __future__ import annotations

from lerobot.configs import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy
from lerobot.policies.factory import get_policy_class

from tpgmm_evaluation.policies.neighbours import NeighboursPolicy
from tpgmm_evaluation.policies.perceptron import PerceptronPolicy
from tpgmm_evaluation.policies.primitives import DMPPolicy, ProMPPolicy
from tpgmm_evaluation.policies.replay import NearestPolicy
from tpgmm_evaluation.policies.situated import KeyPosesPolicy, MeanPolicy

__all__ = ["policy_class"]

OWN: dict[type[PreTrainedConfig], type[PreTrainedPolicy]] = {
    kind.config_class: kind
    for kind in (
        DMPPolicy,
        KeyPosesPolicy,
        MeanPolicy,
        NearestPolicy,
        NeighboursPolicy,
        PerceptronPolicy,
        ProMPPolicy,
    )
}


def policy_class(config: PreTrainedConfig) -> type[PreTrainedPolicy]:
    """The policy of a configuration: one of the baselines, or what LeRobot knows."""
    return OWN.get(type(config)) or get_policy_class(config.type)
