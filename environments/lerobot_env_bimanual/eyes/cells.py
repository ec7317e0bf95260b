"""Cell files of simulated scenes."""

from __future__ import annotations

from typing import Any

from tpgmm_torch.exceptions import DataError


def cell_of(env: Any) -> dict[str, Any]:
    """Return the true content of the cell file of an environment with cameras.

    Parameters
    ----------
    env : gymnasium.Env
        Made with ``cameras``, wrapped or not.

    Raises
    ------
    DataError
        If it has no cameras.
    """
    env = env.unwrapped
    if env.eyes is None:
        raise DataError("the environment has no cameras: make it with cameras='front'")
    return {**env.eyes.content(), **env.cell_of_joints()}
