"""Task-parameterised Gaussian mixtures for LeRobot: a policy, environments, and a comparison.

LeRobot's commands import this module by themselves; doing so registers the policy ``tpgmm`` and
the environments ``bottle_shaking`` and ``aloha_state``.
"""

from lerobot_policy_tpgmm import environments
from lerobot_policy_tpgmm.configuration_tpgmm import TPGMMConfig

__all__ = ["TPGMMConfig", "environments"]
