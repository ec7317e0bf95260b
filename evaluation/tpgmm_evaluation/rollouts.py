"""Evaluation through LeRobot's own rollout, and how long an action takes."""

from __future__ import annotations

import contextlib
import io
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs import make_env, preprocess_observation
from lerobot.envs.configs import EnvConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.scripts.lerobot_eval import rollout

from tpgmm_evaluation.policies.replay import NearestPolicy
from tpgmm_evaluation.policies.situated import KeyPosesPolicy, MeanPolicy

#: Policies of this package, which LeRobot does not find by the type of a configuration.
BASELINES: dict[str, Any] = {
    kind.name: kind for kind in (KeyPosesPolicy, MeanPolicy, NearestPolicy)
}
#: Environments that are stepped together.
BATCH = 50
#: Actions whose time is taken, after as many to warm up as ``WARM_UP``.
TIMED, WARM_UP = 300, 30


@dataclass
class Runner:
    """A policy with LeRobot's pipelines before and behind it, as read from its directory."""

    policy: Any
    preprocessor: Any
    postprocessor: Any

    @classmethod
    def load(cls, directory: Path, overrides: Sequence[str] = ()) -> Runner:
        """Read a pretrained directory as LeRobot does, with ``--field=value`` on top."""
        config = PreTrainedConfig.from_pretrained(directory, cli_overrides=list(overrides))
        with contextlib.redirect_stdout(io.StringIO()):  # it says that it loads
            kind = BASELINES.get(config.type) or get_policy_class(config.type)
            policy = kind.from_pretrained(directory, config=config)
        return cls(policy, *make_pre_post_processors(config, pretrained_path=str(directory)))

    def reset(self) -> None:
        """Begin an episode."""
        for part in (self.policy, self.preprocessor, self.postprocessor):
            part.reset()

    @torch.inference_mode()
    def act(self, observation: dict[str, Any]) -> Any:
        """Return the action for an observation that LeRobot preprocessed."""
        return self.postprocessor(self.policy.select_action(self.preprocessor(observation)))


class _Outcomes:
    """A vector environment that keeps what ``info`` says when its episodes end first.

    LeRobot's rollout does not return it.
    """

    def __init__(self, env: gym.vector.VectorEnv) -> None:
        self._env = env
        self.outcomes: list[dict[str, float] | None] = [None] * env.num_envs

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def step(self, actions: Any) -> Any:
        transition = self._env.step(actions)
        _, _, terminated, truncated, info = transition
        for index in np.flatnonzero(terminated | truncated):
            if self.outcomes[index] is None:
                self.outcomes[index] = _figures(info["final_info"], index)
        return transition


def _figures(info: Mapping[str, Any], index: int) -> dict[str, float]:
    """Return the scalar figures of one environment, which gymnasium collects in arrays."""
    return {
        key: float(values[index])
        for key, values in info.items()
        if isinstance(values, np.ndarray)
        and values.dtype.kind in "bfiu"
        and values.ndim == 1
        and not key.startswith("_")
        and info[f"_{key}"][index]
    }


def _environments(config: EnvConfig, n: int) -> contextlib.closing[gym.vector.VectorEnv]:
    """Make ``n`` environments of one task, as LeRobot does."""
    [tasks] = make_env(config, n_envs=n).values()
    [vector] = tasks.values()
    return contextlib.closing(vector)


def evaluate(runner: Runner, config: EnvConfig, seeds: Sequence[int]) -> list[dict[str, float]]:
    """Roll a policy out once for each seed.

    Parameters
    ----------
    seeds : sequence of int
        Of the episodes.

    Returns
    -------
    list of dict
        For each seed: ``seed``, ``success`` and all figures that ``info`` has at the end.
    """
    rows: list[dict[str, float]] = []
    size = min(BATCH, len(seeds))
    with _environments(config, size) as vector:
        for start in range(0, len(seeds), size):
            # the last batch is filled up with episodes that do not count
            chosen = list(seeds[start : start + size])
            filled = chosen + [chosen[-1]] * (size - len(chosen))
            env = _Outcomes(vector)
            torch.manual_seed(chosen[0])  # noise of diffusion
            runner.reset()
            with contextlib.redirect_stderr(io.StringIO()):  # a progress bar of its own
                done = rollout(
                    env,
                    runner.policy,
                    *config.get_env_processors(),
                    runner.preprocessor,
                    runner.postprocessor,
                    seeds=filled,
                )
            successes = done["success"].any(dim=1)
            for index, seed in enumerate(chosen):
                figures = dict(env.outcomes[index] or {})
                figures.pop("is_success", None)
                rows.append({"seed": seed, "success": bool(successes[index]), **figures})
    return rows


def latency(runner: Runner, config: EnvConfig) -> dict[str, float]:
    """Measure how long an action takes for one robot, from the raw observation on.

    Returns
    -------
    dict
        Median and 99th percentile in milliseconds over all steps (``step_...``), and over
        the steps at which a policy that predicts chunks computes one (``chunk_...``); and
        ``chunk_size``, the steps from one to the next.
    """
    with _environments(config, 1) as vector:
        observation, _ = vector.reset(seed=0)
        seen = preprocess_observation(observation)
    size = getattr(runner.policy.config, "n_action_steps", 1)
    seconds = []
    runner.reset()
    # all chunks whole, so that every step of a chunk counts equally
    for _ in range(WARM_UP + math.ceil(TIMED / size) * size):
        began = time.perf_counter()
        runner.act(dict(seen))
        seconds.append(time.perf_counter() - began)
    steps = 1e3 * np.array(seconds)
    computed = np.arange(len(steps)) % size == 0
    timed = np.arange(len(steps)) >= WARM_UP
    figures = {"chunk_size": float(size)}
    for name, chosen in (("step", steps[timed]), ("chunk", steps[timed & computed])):
        figures[f"{name}_median_ms"] = float(np.median(chosen))
        figures[f"{name}_p99_ms"] = float(np.percentile(chosen, 99))
    return figures
