"""Task-parameterised Gaussian mixtures as a LeRobot policy.

LeRobot's commands import this module by themselves; doing so registers the policy ``tpgmm``.
"""

from lerobot_policy_tpgmm.configuration_tpgmm import TPGMMConfig

__all__ = ["TPGMMConfig"]
