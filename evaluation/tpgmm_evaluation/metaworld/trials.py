"""An actor in situations that it has not seen."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_env_bimanual.metaworld.hand import FPS
from lerobot_env_bimanual.metaworld.state import MetaworldStateEnv
from tpgmm_evaluation.metaworld.learners import Actor

#: Where neither hand nor objects move by more than this [m] for so many steps, nothing will
#: happen any more: the rest of the episode is not simulated.
STILL, STILL_STEPS = 1e-4, FPS // 2


def try_out(env: MetaworldStateEnv, actor: Actor, seeds: Sequence[int]) -> list[dict[str, Any]]:
    """Play an episode in each situation, each until success, rest, or its end.

    Parameters
    ----------
    env : MetaworldStateEnv
        Its ``control`` becomes the actor's.
    actor : Actor
        What was learned.
    seeds : sequence of int
        Of the situations.

    Returns
    -------
    list of dict
        ``seed``, ``success``, ``steps``, and ``acting_seconds`` of the processor, with the
        share of what ``begin`` took for all.
    """
    env.control = actor.control
    first = np.array([_row(env.reset(seed=seed)[0]) for seed in seeds])
    began = time.process_time()
    actor.begin(first)
    beginning = (time.process_time() - began) / len(seeds)
    episodes = []
    for episode, seed in enumerate(seeds):
        observed = _row(env.reset(seed=seed)[0])
        before, steps, done, info = observed, 0, False, {"is_success": False}
        acting = beginning
        while not done:
            began = time.process_time()
            action = actor.act(episode, steps, observed)
            acting += time.process_time() - began
            observation, _, ended, cut, info = env.step(action)
            observed, steps = _row(observation), steps + 1
            done = ended or cut
            if steps % STILL_STEPS == 0:
                done |= bool(np.abs(observed - before).max() < STILL)
                before = observed
        episodes.append(
            {
                "seed": seed,
                "success": bool(info["is_success"]),
                "steps": steps,
                "acting_seconds": acting,
            }
        )
    return episodes


def _row(observation: dict[str, NDArray[np.float64]]) -> NDArray[np.float64]:
    return np.concatenate([observation["agent_pos"], observation["environment_state"]])
