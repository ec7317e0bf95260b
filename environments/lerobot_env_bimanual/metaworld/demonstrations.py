"""Demonstrations by Meta-World's own scripted experts."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from lerobot_env_bimanual.metaworld.hand import FPS, FRAMES, JOINTS, opening
from lerobot_env_bimanual.metaworld.state import MetaworldStateEnv, metaworld_library
from tpgmm_torch import Demonstration, Frame
from tpgmm_torch.exceptions import DataError

#: The expert goes on for so long after its success [steps]: a motion that ends at the threshold
#: of success would end short of it as often as not.
AFTER = 20


@dataclass(frozen=True, eq=False)
class Recorded:
    """An episode of an expert.

    Parameters
    ----------
    seed : int
        Of the situation.
    observed : ndarray of shape (T, 4 + 21)
        ``agent_pos`` and ``environment_state`` before each action.
    references : ndarray of shape (T, 4)
        Where the hand's target was brought by it [m], and the wanted opening.
    actions : ndarray of shape (T, 4)
        Meta-World's own.
    success : bool
    """

    seed: int
    observed: NDArray[np.float64]
    references: NDArray[np.float64]
    actions: NDArray[np.float64]
    success: bool

    def demonstration(self) -> Demonstration:
        """Return the references, in frames as they were at the start."""
        poses = self.observed[0, len(JOINTS) :].reshape(len(FRAMES), 7)
        frames = {n: Frame(pose[:3], pose[3:]) for n, pose in zip(FRAMES, poses, strict=True)}
        time = torch.arange(len(self.references), dtype=torch.float64) / FPS
        return Demonstration(time, torch.from_numpy(self.references), frames, JOINTS)


def record_metaworld(env: MetaworldStateEnv, seeds: Sequence[int]) -> list[Recorded]:
    """Let the expert of a task solve it.

    Parameters
    ----------
    env : MetaworldStateEnv
        With ``control="displacement"`` and ``stop_at_success=False``.
    seeds : sequence of int
        Of the situations.

    Returns
    -------
    list of Recorded
        Of all seeds, whether it succeeded or not.

    Raises
    ------
    DataError
        If the environment takes other actions, or ends before its expert.
    """
    if env.control != "displacement" or env.stop_at_success:
        raise DataError(
            "experts act in MetaworldStateEnv(control='displacement', stop_at_success=False)"
        )
    metaworld_library()
    from metaworld.policies import ENV_POLICY_MAP

    expert = ENV_POLICY_MAP[env.task]()
    return [_episode(env, expert, seed) for seed in seeds]


def _episode(env: MetaworldStateEnv, expert: object, seed: int) -> Recorded:
    observation, info = env.reset(seed=seed)
    observed: list[NDArray[np.float64]] = []
    references: list[NDArray[np.float64]] = []
    actions: list[NDArray[np.float64]] = []
    left = AFTER
    while left and len(actions) < env.episode_length:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "constants may be too high": they are clipped
            action = np.clip(expert.get_action(env.raw), -1.0, 1.0)  # type: ignore[attr-defined]
        observed.append(np.concatenate(list(observation.values())))
        observation, *_, info = env.step(action)
        references.append(np.append(env.target, opening(action[3])))
        actions.append(np.asarray(action, dtype=np.float64))
        left -= bool(info["is_success"])
    states, targets, given = map(np.array, (observed, references, actions))
    return Recorded(seed, states, targets, given, bool(info["is_success"]))
