"""LeRobot's asynchronous inference server, with this policy among those that it takes.

``python -m lerobot_policy_tpgmm.async_server --host=127.0.0.1 --port=8080 --fps=25``

LeRobot's protocol unpickles what it receives, so whoever can connect runs code here. Addresses
that other machines can reach are refused without ``--allow-remote``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import draccus
from lerobot.async_inference import helpers
from lerobot.async_inference.configs import PolicyServerConfig
from lerobot.async_inference.constants import SUPPORTED_POLICIES
from lerobot.async_inference.policy_server import serve

from lerobot_policy_tpgmm.configuration_tpgmm import TPGMMConfig
from tpgmm_torch.exceptions import DataError

#: Addresses that this machine alone can reach.
LOOPBACK = ("localhost", "127.0.0.1", "[::1]")

# LeRobot asks a list of its own, which plugins are not put into
if TPGMMConfig.get_choice_name(TPGMMConfig) not in SUPPORTED_POLICIES:
    SUPPORTED_POLICIES.append(TPGMMConfig.get_choice_name(TPGMMConfig))


_resized = helpers.resize_robot_observation_image


def _as_it_is(image: Any, wanted: Sequence[int]) -> Any:
    """A picture (3, height, width) of the size that its camera was calibrated for."""
    if tuple(image.shape[:2]) != tuple(wanted[1:]):
        raise DataError(
            f"a camera gives pictures of {image.shape[1]} x {image.shape[0]}, it was "
            f"calibrated for {wanted[2]} x {wanted[1]} in the policy's cell: set it to that"
        )
    return _resized(image, wanted)


helpers.resize_robot_observation_image = _as_it_is


def main(arguments: Sequence[str]) -> None:
    """Serve until interrupted.

    Parameters
    ----------
    arguments : sequence of str
        Of the command line.

    Raises
    ------
    SystemExit
        If other machines could connect, and are not allowed to.
    """
    others = [one for one in arguments if one != "--allow-remote"]
    config = draccus.parse(PolicyServerConfig, args=others)
    if config.host not in LOOPBACK and "--allow-remote" not in arguments:
        raise SystemExit(
            f"--host={config.host}: other machines could connect, and whoever connects can run "
            "code here, as LeRobot's protocol unpickles what it receives. Give "
            "--host=127.0.0.1 (with a tunnel, ssh -L, if the client is elsewhere), or "
            "--allow-remote in a network in which you trust everyone"
        )
    serve(config)


if __name__ == "__main__":
    main(sys.argv[1:])
