"""Learners of a task, and what they learned in situations that they have not seen."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lerobot_env_bimanual.metaworld.hand import FPS
from lerobot_env_bimanual.metaworld.state import MetaworldStateEnv
from tpgmm_evaluation.cells import Cell, Results
from tpgmm_evaluation.metaworld.learners import Actor, Learner, settings_of
from tpgmm_evaluation.metaworld.networks import Network
from tpgmm_evaluation.metaworld.recordings import record_expert, successes, validation

#: Whose versions are written down with each cell.
PACKAGES = ("metaworld", "mujoco", "numpy", "torch", "scikit-learn", "lerobot", "diffusers")
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


def read_episodes(
    results: Results, cell: Cell, learner: Learner, situations: Sequence[int]
) -> list[dict[str, Any]]:
    """Read episodes of a cell in the first of these situations, of the same settings."""
    found = results.read(cell)
    if found is None or found["settings"] != settings_of(learner):
        return []
    seeds = [episode["seed"] for episode in found["episodes"]]
    same = seeds[: len(situations)] == [*situations][: len(seeds)]
    return list(found["episodes"]) if same else []


def measure_cells(
    cells: Sequence[Cell],
    learners: Mapping[str, Learner],
    results: Results,
    situations: Sequence[int],
    record: int,
) -> None:
    """Learn a task, and try what was learned in the situations that are missing.

    Parameters
    ----------
    cells : sequence of Cell
        Of one task.
    learners : mapping
        By the names of policies.
    results : Results
        Beside whose folder demonstrations are kept.
    situations : sequence of int
        Seeds of the episodes.
    record : int
        Episodes of the expert at least.
    """
    torch.set_num_threads(1)
    env, folder = MetaworldStateEnv(cells[0].env), results.folder.parent / "demonstrations"
    for cell in cells:
        learner = learners[cell.policy]
        done = read_episodes(results, cell, learner, situations)
        shown = record_expert(folder, cell.env, cell.seed, cell.demonstrations, record)
        chosen = successes(shown, cell.demonstrations, cell.env)
        held_out = validation(folder, cell.env) if isinstance(learner, Network) else []
        began = time.process_time()
        actor: Actor = learner.fit(chosen, cell.seed, held_out)
        trained = time.process_time()
        episodes = [*done, *try_out(env, actor, situations[len(done) :])]
        results.write(
            cell,
            {
                "episodes": episodes,
                "settings": settings_of(learner),
                "expert": {"episodes": len(shown), "successes": sum(e.success for e in shown)},
                "demonstration_seeds": [episode.seed for episode in chosen],
                "validation_seeds": [episode.seed for episode in held_out],
                "training_seconds": trained - began,  # of the processor
                "training_outcome": actor.outcome,
                "evaluation_seconds": time.process_time() - trained,
                "versions": {name: version(name) for name in PACKAGES},
            },
        )
    env.close()
