"""Cell files of simulated scenes: the true ones, and wrong ones to see what errors do."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np

from tpgmm_torch.exceptions import DataError
from tpgmm_vision.cell import pose_content
from tpgmm_vision.poses import pose_matrix, rigid

__all__ = ["cell_of", "perturbed"]


def cell_of(env: Any) -> dict[str, Any]:
    """The true content of the cell file of an environment with cameras.

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


def perturbed(
    content: Mapping[str, Any],
    mm: float = 0.0,
    deg: float = 0.0,
    focal: float = 0.0,
    seed: int = 0,
) -> dict[str, Any]:
    """A cell whose calibration is wrong.

    Parameters
    ----------
    content : mapping
        Of a cell file.
    mm, deg : float
        By how much each camera is elsewhere, and turned, in directions that are drawn.
    focal : float, default=0
        By which share focal lengths are too large.
    seed : int, default=0
    """
    rng, wrong = np.random.default_rng(seed), copy.deepcopy(dict(content))
    for camera in wrong["cameras"].values():
        way, axis = (one / np.linalg.norm(one) for one in rng.standard_normal((2, 3)))
        pose = pose_matrix(camera["pose"]) @ rigid(np.radians(deg) * axis, np.zeros(3))
        pose[:3, 3] += 1e-3 * mm * way
        camera["pose"] = pose_content(pose)
        camera["focal_length"] = [(1 + focal) * one for one in camera["focal_length"]]
    return wrong
