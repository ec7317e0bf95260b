"""The environments of the comparison: where demonstrations come from, and operators."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import torch

import lerobot_env_bimanual  # noqa: F401  registers what gym.make finds
from lerobot_env_bimanual.aloha.demonstrations import record_aloha
from lerobot_env_bimanual.aloha.robot import aloha_operators, aloha_robot
from lerobot_env_bimanual.bottle.carry_and_put import TASK as CARRY
from lerobot_env_bimanual.bottle.carry_and_put import CarryAndPut, slid
from lerobot_env_bimanual.bottle.measures import FIGURES, PUT_FIGURES, Figure
from lerobot_env_bimanual.disturbances import CONDITIONS, NOMINAL
from lerobot_env_bimanual.suite.env import SUITE_CONDITIONS
from lerobot_env_bimanual.suite.names import ROBOTS, SUITE, UPPER_BODY
from lerobot_env_bimanual.suite.tasks import suite_task
from tpgmm_datasets import save_lerobot
from tpgmm_datasets.bottle.skill import HANDS, TASK, BottleShaking, bottle_operators
from tpgmm_torch import (
    Canonical,
    Demonstration,
    Frame,
    RelativeOrientation,
    RelativePosition,
    Stack,
)
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.operators import Operator
from tpgmm_torch.robots import Kinematics

#: How hard the robot moved, as the report shows it.
PEAKS = {
    "peak_speed": Figure("peak speed [rad/s]", 1),
    "peak_acceleration": Figure("peak acceleration [rad/s²]"),
}


class Benchmark(ABC):
    """Description of an environment.

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
    #: The entries of ``info`` that the report shows.
    figures: Mapping[str, Figure]
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
    def criteria(self) -> dict[str, Figure]:
        """The figures on which a success depends."""
        return {name: figure for name, figure in self.figures.items() if figure.has_limit}

    @property
    def all_conditions(self) -> tuple[str, ...]:
        """Conditions of ``--conditions all``."""
        return tuple(dict.fromkeys((NOMINAL, *self.conditions, *self.disturbances)))

    @abstractmethod
    def operators(self, orientation: bool, held: bool = True) -> list[Operator]:
        """Return the subspaces in which TP-GMM learns.

        Parameters
        ----------
        orientation : bool
            False leaves the orientation of the hands out.
        held : bool, default=True
            False leaves out what is carried as a thing of its own.
        """

    @abstractmethod
    def record(self, folder: Path, training: int, validation: int, seed: int) -> list[bool]:
        """Write episodes as the LeRobot sets ``training`` and ``validation``.

        ``observation.state`` is what was measured in the environment, ``action`` the
        reference. The first episodes for training are the same, however many there are. What
        does not succeed by the rules of the environment is not kept, as people do not keep it.

        Parameters
        ----------
        training, validation : int
            How many episodes.
        seed : int
            Of the draw. Those of two seeds have no episode in common.

        Returns
        -------
        list of bool
            Which attempts at episodes for training succeed: these are the episodes.

        Raises
        ------
        DataError
            If fewer can be recorded.
        """


class _HandlingBenchmark(Benchmark):
    """A task with the bottle, demonstrated by a generator that the environment follows."""

    default_rate = 100
    n_components = 30
    disturbances: ClassVar = {"pushes": {"pushes": True}, "noise": {"noise": 1.0}}
    conditions: ClassVar = CONDITIONS
    #: The environment's name, what its data sets call the task, and what is observed.
    gym_id: ClassVar[str]
    task: str
    objects: tuple[str, ...]
    #: What its data sets call the robot.
    robot_type: str = UPPER_BODY
    #: Options of the environment in recording alone.
    recording: ClassVar[Mapping[str, Any]] = {}
    #: Demonstrations are drawn together; the first may train, the last ones validate.
    POOL, RESERVED = 100, 10

    @abstractmethod
    def motions(self, numbers: Sequence[int], seed: int) -> list[Demonstration]:
        """Return the demonstrations of the pool with these numbers."""

    def record(self, folder: Path, training: int, validation: int, seed: int) -> list[bool]:
        """Let the environment follow generated demonstrations, and keep what succeeds."""
        if training > self.POOL or validation > self.RESERVED:
            raise DataError(
                f"{self.env} offers {self.POOL} demonstrations for training and "
                f"{self.RESERVED} for validation, {training} and {validation} are asked for"
            )
        env = gym.make(
            f"lerobot_env_bimanual/{self.gym_id}",
            fps=self.rate,
            **{**self.options, **self.recording},
        )
        tried = self._keep(env, folder / "training", range(self.POOL), training, seed)
        left = range(self.POOL - 1, len(tried) - 1, -1)  # in place of reserved ones that fail
        reserved = [*range(self.POOL, self.POOL + self.RESERVED), *left]
        self._keep(env, folder / "validation", reserved, validation, seed)
        env.close()
        return tried

    def _keep(
        self, env: Any, folder: Path, numbers: Iterable[int], n: int, seed: int
    ) -> list[bool]:
        """Save the first ``n`` demonstrations that succeed; return which of the tried ones."""
        tried: list[bool] = []
        kept: list[tuple[Demonstration, torch.Tensor]] = []
        waiting = iter(numbers)
        while len(kept) < n:
            chosen = list(islice(waiting, n - len(kept)))
            if not chosen:
                raise DataError(
                    f"of {len(tried)} demonstrations of {self.env} {len(kept)} succeed, "
                    f"{n} are asked for"
                )
            for number, motion in zip(chosen, self.motions(chosen, seed), strict=True):
                measured, success = self.follow(env, number, motion)
                tried.append(success)
                if success:
                    kept.append((measured, _references(motion)))
        save_lerobot(
            [measured for measured, _ in kept],
            folder,
            fps=self.rate,
            task=self.task,
            actions=[actions for _, actions in kept],
            robot_type=self.robot_type,
        )
        return tried

    def _start(self, motion: Demonstration) -> dict[str, Any]:
        """Return the options with which an episode begins as a demonstration does."""
        start = {"joints": motion.joints[0].numpy()}
        for name in self.objects:
            pose = motion.frame(name)
            pose = pose[0] if pose.batch_shape else pose
            start[name] = torch.cat((pose.position, pose.orientation)).numpy()
        return start

    def follow(self, env: Any, seed: int, motion: Demonstration) -> tuple[Demonstration, bool]:
        """Let the environment follow a motion; return what it measures, and its success."""
        observation, info = env.reset(seed=seed, options=self._start(motion))
        measured, seen, done = [], [], False
        references = _references(motion).numpy()
        for reference in references:
            if done:
                raise DataError(f"an episode of {self.env} ends before a demonstration does")
            measured.append(observation["agent_pos"])
            seen.append(observation["environment_state"])
            observation, _, terminated, truncated, info = env.step(reference)
            done = terminated or truncated
        while not done:
            *_, terminated, truncated, info = env.step(references[-1])
            done = terminated or truncated
        joints, poses = (torch.from_numpy(np.array(values)) for values in (measured, seen))
        names = env.unwrapped.joint_names
        frames = {
            name: Frame(pose[:, :3], pose[:, 3:])
            for name, pose in zip(self.objects, poses.split(7, dim=1), strict=True)
        }
        return Demonstration(motion.time, joints, frames, names), bool(info["is_success"])


class _BottleTask(_HandlingBenchmark):
    """A task whose demonstrations are those of a generator of the data sets."""

    generator: Callable[..., BottleShaking | CarryAndPut]

    def __init__(
        self, rate: int | None = None, options: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__(rate, options)
        self.skill = type(self).generator(rate=self.rate)
        self.robot = self.skill.robot

    def motions(self, numbers: Sequence[int], seed: int) -> list[Demonstration]:
        """Generate them by the skill."""
        pool = self.skill.demonstrations(self.POOL + self.RESERVED, seed)
        return [pool[number] for number in numbers]


class BottleBenchmark(_BottleTask):
    """Reach a bottle with both hands, grasp it, bring it, shake it."""

    env = "bottle_shaking"
    gym_id, task, objects = "BottleShaking-v0", TASK, ("bottle",)
    figures: Mapping[str, Figure] = {**FIGURES, **PEAKS}
    generator = partial(BottleShaking, steady_rhythm=True)

    def operators(self, orientation: bool, held: bool = True) -> list[Operator]:
        """Return both hands seen from the bottle, and the joints."""
        return bottle_operators(orientation)


class CarryBenchmark(_BottleTask):
    """Reach a bottle with both hands, grasp it, put it on a tray."""

    env = "carry_and_put"
    gym_id, task, objects = "CarryAndPut-v0", CARRY, ("bottle", "tray")
    figures: Mapping[str, Figure] = {**PUT_FIGURES, **PEAKS}
    generator = CarryAndPut

    def operators(self, orientation: bool, held: bool = True) -> list[Operator]:
        """Return both hands seen from the bottle and the tray, and the joints.

        With what is held, the bottle from the tray, and one hand from the other.
        """
        grasp, put = (_poses(HANDS, name, orientation) for name in self.objects)
        if not held:
            return [grasp, put, Canonical()]
        left, right = HANDS
        together = _poses((right,), left, orientation)
        return [grasp, _poses(("bottle",), "tray", orientation), together, Canonical()]

    def _start(self, motion: Demonstration) -> dict[str, Any]:
        return {**super()._start(motion), "slide": slid(motion)}


class SuiteBenchmark(_HandlingBenchmark):
    """A task of the suite, demonstrated as people would, by sensors that are not perfect.

    Parameters
    ----------
    name, robot : str
        Of the task, and of who does it.
    rate, options
        As for :class:`Benchmark`.
    """

    env = "bimanual"
    gym_id = "Bimanual-v0"
    recording: ClassVar[Mapping[str, Any]] = {"noise": 0.5}
    conditions: ClassVar = SUITE_CONDITIONS

    def __init__(
        self,
        name: str,
        robot: str,
        rate: int | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        self.skill, self.robot_type = suite_task(name, robot), robot
        super().__init__(rate, {"task": name, "robot": robot, **(options or {})})
        self.robot, self.objects = self.skill.robot, self.skill.objects
        self.task, self.figures = self.skill.description, {**self.skill.figures, **PEAKS}

    def motions(self, numbers: Sequence[int], seed: int) -> list[Demonstration]:
        """Let the task's expert show them."""
        return self.skill.demonstrations(self.POOL + self.RESERVED, seed, self.rate, numbers)

    def operators(self, orientation: bool, held: bool = True) -> list[Operator]:
        """Return those of the task."""
        return self.skill.operators(orientation, held)


def _poses(links: Sequence[str], frame: str, orientation: bool) -> Stack:
    """Make the operators of links, or objects, seen from a frame."""
    kinds = (RelativePosition, RelativeOrientation)[: 1 + orientation]
    return Stack(*(kind(link, frame) for link in links for kind in kinds))


def _references(motion: Demonstration) -> torch.Tensor:
    """Return the joints one step ahead."""
    return torch.cat((motion.joints[1:], motion.joints[-1:]))


class AlohaBenchmark(Benchmark):
    """gym-aloha's cube transfer, demonstrated by a scripted expert."""

    env = "aloha_state"
    fixed: ClassVar = {"task": "transfer_cube"}
    default_rate = 50
    synchronous = True
    n_components = 24
    figures: Mapping[str, Figure] = {
        "max_reward": Figure("stage, 0 to 4"),
        "lift_mm": Figure("lift [mm]"),
    }
    #: Between the first episodes of two seeds, which have none in common.
    SPACING = 1_000
    #: Added to the seed of the first validation episode; evaluation begins further on.
    VALIDATION = 50_000

    def __init__(
        self, rate: int | None = None, options: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__(rate, options)
        self.robot = aloha_robot()

    def operators(self, orientation: bool, held: bool = True) -> list[Operator]:
        """Return both grippers seen from the objects, and the joints."""
        return aloha_operators(self.options["task"], orientation)

    def record(self, folder: Path, training: int, validation: int, seed: int) -> list[bool]:
        """Let the expert solve the task, which it does or raises."""
        for name, first, n in (
            ("training", self.SPACING * seed, training),
            ("validation", self.SPACING * seed + self.VALIDATION, validation),
        ):
            record_aloha(folder / name, n, seed=first, fps=self.rate, **self.options)
        return [True] * training


class AlohaInsertionBenchmark(AlohaBenchmark):
    """gym-aloha's insertion of a peg into a socket."""

    fixed: ClassVar = {"task": "insertion"}


ALOHA = ("aloha_state", "aloha_insertion")
#: The tasks of the suite on other robots than the upper body: their benchmarks' names.
OTHER_ROBOTS = {
    robot: {f"{task}-{robot}": task for task in SUITE}
    for robot in ROBOTS
    if robot != UPPER_BODY
}
BENCHMARKS: dict[str, Callable[[int | None, Mapping[str, Any] | None], Benchmark]] = {
    "bottle_shaking": BottleBenchmark,
    "carry_and_put": CarryBenchmark,
    **{name: partial(SuiteBenchmark, name, UPPER_BODY) for name in SUITE},
    "aloha_state": AlohaBenchmark,
    "aloha_insertion": AlohaInsertionBenchmark,
    **{
        name: partial(SuiteBenchmark, task, robot)
        for robot, tasks in OTHER_ROBOTS.items()
        for name, task in tasks.items()
    },
}


_OTHERS = {*ALOHA, *chain.from_iterable(OTHER_ROBOTS.values())}
#: Names that stand for several environments.
GROUPS = {
    **{f"suite-{robot}": list(tasks) for robot, tasks in OTHER_ROBOTS.items()},
    "suite": [name for name in BENCHMARKS if name not in _OTHERS],
    "all": list(BENCHMARKS),
}


def benchmark(
    name: str, rate: int | None = None, options: Mapping[str, Any] | None = None
) -> Benchmark:
    """Return a benchmark by its name; ``rate`` and ``options`` as for :class:`Benchmark`."""
    if name not in BENCHMARKS:
        raise UnknownNameError("environment", name, "the comparison", BENCHMARKS)
    return BENCHMARKS[name](rate, options)
