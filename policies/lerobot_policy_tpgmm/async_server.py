"""LeRobot's asynchronous inference server, with this policy among those that it takes.

``python -m lerobot_policy_tpgmm.async_server --host=127.0.0.1 --port=8080 --fps=25``
"""

from __future__ import annotations

from lerobot.async_inference.constants import SUPPORTED_POLICIES
from lerobot.async_inference.policy_server import serve

from lerobot_policy_tpgmm.configuration_tpgmm import TPGMMConfig

__all__ = ["serve"]

# LeRobot asks a list of its own, which plugins are not put into
if TPGMMConfig.get_choice_name(TPGMMConfig) not in SUPPORTED_POLICIES:
    SUPPORTED_POLICIES.append(TPGMMConfig.get_choice_name(TPGMMConfig))

if __name__ == "__main__":
    serve()
