"""The environments of the comparison: where demonstrations come from, what TP-GMM is told."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import torch

import lerobot_policy_tpgmm.environments  # noqa: F401  registers what gym.make finds
from lerobot_policy_tpgmm.environments.aloha.demonstrations import record_aloha
from lerobot_policy_tpgmm.environments.aloha.robot import aloha_operators, aloha_robot
from lerobot_policy_tpgmm.environments.bottle.measures import LIMITS
from lerobot_policy_tpgmm.environments.disturbances import CONDITIONS, NOMINAL
from tpgmm_datasets import save_lerobot
from tpgmm_datasets.bottle.experiment import bottle_operators
from tpgmm_datasets.bottle.skill import TASK, BottleShaking
from tpgmm_torch import Demonstration, Kinematics, Operator
from tpgmm_torch.exceptions import DataError, UnknownNameError

__all__ = ["BENCHMARKS", "Benchmark", "benchmark"]


class Benchmark(ABC):
    """What has to be known of an environment.

    Parameters
    ----------
    rate : int, optional
        Of the recorded episodes [Hz].
    options : mapping, optional
        Fields of the environment's configuration, in recording and evaluation.
    """

    #: What ``--env.type`` takes, and fields that belong to the benchmark.
    env: ClassVar[str]
    fixed: ClassVar[dict[str, Any]] = {}
    default_rate: ClassVar[int]
    #: Whether all demonstrations run on one clock from the beginning.
    synchronous: ClassVar[bool] = False
    #: The entries of ``info`` that the report shows, with heading and digits.
    figures: ClassVar[dict[str, tuple[str, int]]]
    #: Between which bounds they have to lie in a success.
    criteria: ClassVar[Mapping[str, tuple[float, float]]] = {}
    #: K of TP-GMM.
    n_components: ClassVar[int]
    #: Disturbances of the evaluation and the options that make them.
    disturbances: ClassVar[dict[str, dict[str, Any]]] = {}
    #: What its option ``condition`` is tried with; empty without that option.
    conditions: ClassVar[tuple[str, ...]] = ()
    robot: Kinematics

    def __init__(
        self, rate: int | None = None, options: Mapping[str, Any] | None = None
    ) -> None:
        self.rate = rate or self.default_rate
        self.options = {**self.fixed, **(options or {})}

    @property
    def all_conditions(self) -> tuple[str, ...]:
        """What ``--conditions all`` means."""
        return tuple(dict.fromkeys((NOMINAL, *self.conditions, *self.disturbances)))

    @abstractmethod
    def operators(self, orientation: bool) -> list[Operator]:
        """The subspaces in which TP-GMM learns.

        Parameters
        ----------
        orientation : bool
            False leaves the orientation of the hands out.
        """

    @abstractmethod
    def record(self, folder: Path, training: int, validation: int, seed: int) -> list[bool]:
        """Write episodes as the LeRobot sets ``training`` and ``validation``.

        ``observation.state`` is what was measured in the environment, ``action`` the
        reference. The first episodes for training are the same, however many there are.

        Parameters
        ----------
        training, validation : int
            How many episodes.

        Returns
        -------
        list of bool
            Which episodes for training succeed by the rules of the environment.

        Raises
        ------
        DataError
            If so many cannot be recorded.
        """


class BottleBenchmark(Benchmark):
    """Reach a bottle with both hands, grasp it, bring it, shake it."""

    env = "bottle_shaking"
    default_rate = 100
    n_components = 30
    figures: ClassVar = {
        "grasp_mm": ("grasp [mm]", 1),
        "grasp_deg": ("grasp [deg]", 1),
        "lift_mm": ("lift [mm]", 0),
        "frequency_error": ("frequency error", 2),
        "amplitude_error": ("amplitude error", 2),
        "peak_speed": ("peak speed [rad/s]", 1),
        "peak_acceleration": ("peak acceleration [rad/s²]", 0),
    }
    criteria: ClassVar = LIMITS
    disturbances: ClassVar = {"pushes": {"pushes": True}, "noise": {"noise": 1.0}}
    conditions: ClassVar = CONDITIONS
    #: Demonstrations are drawn together; the first may train, the last ones validate.
    POOL, RESERVED = 100, 10

    def __init__(
        self, rate: int | None = None, options: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__(rate, options)
        self.skill = BottleShaking(rate=self.rate, steady_rhythm=True)
        self.robot = self.skill.robot

    def operators(self, orientation: bool) -> list[Operator]:
        """Both hands seen from the bottle, and the joints."""
        return bottle_operators(orientation)

    def record(self, folder: Path, training: int, validation: int, seed: int) -> list[bool]:
        """Let the environment follow generated demonstrations."""
        if training > self.POOL or validation > self.RESERVED:
            raise DataError(
                f"{self.env} offers {self.POOL} demonstrations for training and "
                f"{self.RESERVED} for validation, {training} and {validation} are asked for"
            )
        pool = self.skill.demonstrations(self.POOL + self.RESERVED, seed)
        numbers = {
            "training": range(training),
            "validation": range(self.POOL, self.POOL + validation),
        }
        env = gym.make("lerobot_policy_tpgmm/BottleShaking-v0", fps=self.rate, **self.options)
        successes = {}
        for name, chosen in numbers.items():
            motions = [pool[number] for number in chosen]
            followed = [self._follow(env, *pair) for pair in zip(chosen, motions, strict=True)]
            save_lerobot(
                [measured for measured, _ in followed],
                folder / name,
                fps=self.rate,
                task=TASK,
                actions=[_references(motion) for motion in motions],
                robot_type="upper_body",
            )
            successes[name] = [success for _, success in followed]
        env.close()
        return successes["training"]

    def _follow(self, env: Any, seed: int, motion: Demonstration) -> tuple[Demonstration, bool]:
        """What is measured while the environment follows a motion; whether it succeeds."""
        bottle = motion.frame("bottle")
        pose = torch.cat((bottle.position, bottle.orientation)).numpy()
        start = {"joints": motion.joints[0].numpy(), "bottle": pose}
        observation, info = env.reset(seed=seed, options=start)
        measured, done = [], False
        references = _references(motion).numpy()
        for reference in references:
            if done:
                raise DataError(f"an episode of {self.env} ends before a demonstration does")
            measured.append(observation["agent_pos"])
            observation, _, terminated, truncated, info = env.step(reference)
            done = terminated or truncated
        while not done:
            *_, terminated, truncated, info = env.step(references[-1])
            done = terminated or truncated
        joints = torch.from_numpy(np.array(measured))
        names = env.unwrapped.joint_names
        frames = {"bottle": bottle}
        return Demonstration(motion.time, joints, frames, names), bool(info["is_success"])


def _references(motion: Demonstration) -> torch.Tensor:
    """The joints one step ahead."""
    return torch.cat((motion.joints[1:], motion.joints[-1:]))


class AlohaBenchmark(Benchmark):
    """gym-aloha's cube transfer, demonstrated by a scripted expert."""

    env = "aloha_state"
    fixed: ClassVar = {"task": "transfer_cube"}
    default_rate = 50
    synchronous = True
    n_components = 20
    figures: ClassVar = {"max_reward": ("stage, 0 to 4", 0), "lift_mm": ("lift [mm]", 0)}
    #: Added to the seed of the first validation episode; evaluation begins further on.
    VALIDATION = 50_000

    def __init__(
        self, rate: int | None = None, options: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__(rate, options)
        self.robot = aloha_robot()

    def operators(self, orientation: bool) -> list[Operator]:
        """Both grippers seen from the objects, and the joints."""
        return aloha_operators(self.options["task"], orientation)

    def record(self, folder: Path, training: int, validation: int, seed: int) -> list[bool]:
        """Let the expert solve the task, which it does or raises."""
        for name, first, n in (
            ("training", seed, training),
            ("validation", seed + self.VALIDATION, validation),
        ):
            record_aloha(folder / name, n, seed=first, fps=self.rate, **self.options)
        return [True] * training


class AlohaInsertionBenchmark(AlohaBenchmark):
    """gym-aloha's insertion of a peg into a socket."""

    fixed: ClassVar = {"task": "insertion"}


BENCHMARKS: dict[str, type[Benchmark]] = {
    "bottle_shaking": BottleBenchmark,
    "aloha_state": AlohaBenchmark,
    "aloha_insertion": AlohaInsertionBenchmark,
}


def benchmark(
    name: str, rate: int | None = None, options: Mapping[str, Any] | None = None
) -> Benchmark:
    """A benchmark by its name; ``rate`` and ``options`` as for :class:`Benchmark`."""
    if name not in BENCHMARKS:
        raise UnknownNameError("environment", name, "the comparison", BENCHMARKS)
    return BENCHMARKS[name](rate, options)
