"""Demonstrations of gym-aloha's tasks by the scripted expert, as a LeRobot data set.

.. code-block:: python

    from lerobot_env_bimanual.aloha.demonstrations import record_aloha
    from lerobot_env_bimanual.aloha.robot import aloha_robot
    from tpgmm_datasets import load_lerobot

    record_aloha("out/aloha", 25)
    demonstrations = load_lerobot("out/aloha", robot=aloha_robot(), joints="action")
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lerobot_env_bimanual.aloha.expert import AlohaExpert
from lerobot_env_bimanual.aloha.robot import GRIPPERS, OBJECTS
from lerobot_env_bimanual.aloha.state import AlohaStateEnv
from tpgmm_datasets import save_lerobot
from tpgmm_torch import Demonstration, Frame
from tpgmm_torch.exceptions import DataError


def record_aloha(
    path: str | Path,
    n: int = 25,
    *,
    task: str = "transfer_cube",
    seed: int = 0,
    fps: int = 50,
    duration: float = 7.5,
    **options: Any,
) -> Path:
    """Let the scripted expert solve a task, and write what happened as a LeRobot set.

    ``observation.state`` is what was measured, ``action`` the reference,
    ``observation.environment_state`` where the objects lay at the start.

    Parameters
    ----------
    path : str or Path
        The folder; it must not exist.
    n : int, default=25
        Number of episodes.
    task : {"transfer_cube", "insertion"}, default="transfer_cube"
    seed : int, default=0
        Episode i has the seed ``seed + i`` of :class:`AlohaStateEnv`.
    fps : int, default=50
        Control rate [Hz].
    duration : float, default=7.5
        Of the demonstrations [s].
    **options
        Passed to :class:`AlohaStateEnv`, for example ``yaw_range``.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    DataError
        If the expert fails in one of the situations, or the folder exists.
    """
    expert = AlohaExpert(task, fps, duration)
    env = AlohaStateEnv(task, fps=fps, stop_at_success=False, **options)
    episodes = [_episode(env, expert, seed + i) for i in range(n)]
    return save_lerobot(
        [demonstration for demonstration, _ in episodes],
        path,
        fps=fps,
        task=env.task_description,
        actions=[references for _, references in episodes],
        robot_type="bimanual_viperx",
        units=dict.fromkeys(GRIPPERS, "raw"),
    )


def _episode(
    env: AlohaStateEnv, expert: AlohaExpert, seed: int
) -> tuple[Demonstration, NDArray[np.float64]]:
    """Measurements and references of one episode."""
    observation, _ = env.reset(seed=seed)
    poses = observation["environment_state"].reshape(-1, 7)
    frames = {
        name: Frame(pose[:3], pose[3:])
        for name, pose in zip(OBJECTS[env.task], poses, strict=True)
    }
    references = expert.plan(observation["agent_pos"], observation["environment_state"])
    measured = []
    for reference in references:
        measured.append(observation["agent_pos"])
        observation, *_, info = env.step(reference)
    if not info["is_success"]:
        raise DataError(
            f"the expert did not solve {env.task} with seed {seed}: the reward came to "
            f"{info['max_reward']:g} of 4"
        )
    time = torch.arange(len(measured), dtype=torch.float64) / env.fps
    joints = torch.from_numpy(np.array(measured))
    return Demonstration(time, joints, frames, env.joint_names), references
