"""Tasks of a planar arm that are done in two ways: past an obstacle, and at two handles."""

import functools
from abc import ABC, abstractmethod
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from tpgmm_datasets import save_lerobot
from tpgmm_torch import (
    Canonical,
    Demonstration,
    Frame,
    RelativePosition,
    Robot,
    Situation,
    TaskParameterizedGMM,
    Trajectory,
)
from tpgmm_torch.structure.select_ways import SelectWays

LINKS = ("base", "upper_arm", "forearm", "hand", "tip")
LENGTHS = {"shoulder": 0.0, "elbow": 0.4, "wrist": 0.3, "tool": 0.2}
TIME = np.linspace(0, 3, 60)
REST = torch.tensor([-1.3, 1.0, 0.7], dtype=torch.float64)


def planar_arm() -> Robot:
    """Three joints that turn about the vertical axis; it reaches 0.9 m."""
    urdf = '<robot name="planar arm">' + "".join(f'<link name="{link}"/>' for link in LINKS)
    for place, (name, along) in enumerate(LENGTHS.items()):
        kind = "fixed" if name == "tool" else "revolute"
        urdf += f"""
        <joint name="{name}" type="{kind}">
          <parent link="{LINKS[place]}"/><child link="{LINKS[place + 1]}"/>
          <origin xyz="{along} 0 0"/><axis xyz="0 0 1"/>
          <limit lower="-2.8" upper="2.8" velocity="3" effort="10"/>
        </joint>"""
    return Robot.from_urdf(urdf + "</robot>", links=("tip",))


ARM = planar_arm()


def tip(joints: Tensor) -> Tensor:
    return ARM.state(joints).position("tip")


def turned(angle: float) -> tuple[float, float, float, float]:
    return (np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2))


def along(points: list, phases: list[float], start: Tensor) -> Tensor:
    """Joints (T, 3) of a smooth path of the tip through points at phases, minimum jerk."""
    s = TIME / TIME[-1]
    path = CubicSpline(phases, np.stack(points))(10 * s**3 - 15 * s**4 + 6 * s**5)
    rows, joints = [], start
    for point in torch.from_numpy(path):
        for _ in range(2):  # Gauss-Newton steps of inverse kinematics
            state = ARM.state(joints)
            inverse = torch.linalg.pinv(state.linear_jacobian("tip"))
            joints = joints + inverse @ (point - state.position("tip"))
        rows.append(joints)
    return torch.stack(rows)


class TwoWays(ABC):
    """What both have in common; ``sides`` are 1 and -1."""

    operators: tuple

    def demonstrations(
        self, n: int, seed: int, sides: tuple[int, ...] = (1, -1)
    ) -> tuple[list[Demonstration], np.ndarray]:
        """Demonstrations and their sides; each is shown by at least three in ten."""
        rng = np.random.default_rng(seed)
        while True:
            shown = rng.choice(sides, n)
            if min(np.sum(shown == side) for side in sides) >= 0.3 * n:
                break
        return [self.demonstrate(rng, int(side)) for side in shown], shown

    def situations(self, n: int, seed: int) -> list[Situation]:
        rng = np.random.default_rng((seed, 1))
        return [Situation(self.start(rng), self.frames(rng)) for _ in range(n)]

    def start(self, rng: np.random.Generator) -> Tensor:
        return REST + 0.05 * torch.from_numpy(rng.normal(size=3))

    def model(self) -> TaskParameterizedGMM:
        return TaskParameterizedGMM(8, self.operators, ARM, random_state=0)

    @abstractmethod
    def frames(self, rng: np.random.Generator) -> dict[str, Frame]: ...

    @abstractmethod
    def demonstrate(self, rng: np.random.Generator, side: int) -> Demonstration: ...

    @abstractmethod
    def succeeded(self, trajectory: Trajectory, situation: Situation) -> bool: ...


class Obstacle(TwoWays):
    """To a goal, 12 cm in front of an obstacle or behind it."""

    operators = (
        RelativePosition("tip", "obstacle"),
        RelativePosition("tip", "goal"),
        Canonical(),
    )

    def frames(self, rng):
        obstacle = (rng.uniform(0.5, 0.6), rng.uniform(-0.06, 0.06), 0)
        goal = (rng.uniform(0.35, 0.5), rng.uniform(0.35, 0.45), 0)
        return {
            "obstacle": Frame(obstacle),
            "goal": Frame(goal, turned(rng.uniform(-0.4, 0.4))),
        }

    def demonstrate(self, rng, side):
        start, frames = self.start(rng), self.frames(rng)
        beside = np.array([side * 0.12, 0, 0]) + 0.01 * rng.normal(size=3) * (1, 1, 0)
        past = frames["obstacle"].position.numpy() + beside
        points = [tip(start).numpy(), past, frames["goal"].position.numpy()]
        joints = along(points, [0, 0.5 + 0.02 * rng.normal(), 1], start)
        return Demonstration(TIME, joints, frames, ARM.joint_names)

    def succeeded(self, trajectory, situation):
        """At most 1 cm from the goal, never less than 6 cm from the obstacle's middle."""
        path = tip(trajectory.joints)
        clear = (path - situation.frames["obstacle"].position).norm(dim=-1).min()
        missed = (path[-1] - situation.frames["goal"].position).norm()
        return bool(clear > 0.06 and missed < 0.01)


class Handles(TwoWays):
    """To one of the two handles of an object, 16 cm apart."""

    operators = (RelativePosition("tip", "object"), Canonical())

    def frames(self, rng):
        place = (rng.uniform(0.45, 0.65), rng.uniform(0.1, 0.35), 0)
        return {"object": Frame(place, turned(rng.uniform(-0.5, 0.5)))}

    def demonstrate(self, rng, side):
        start, frames = self.start(rng), self.frames(rng)
        handle = np.array([0, side * 0.08, 0]) + 0.003 * rng.normal(size=3) * (1, 1, 0)
        before = handle + (-0.1, 0, 0) + 0.01 * rng.normal(size=3) * (1, 1, 0)
        there = [frames["object"].transform(torch.from_numpy(p)) for p in (before, handle)]
        points = [tip(start).numpy(), *(point.numpy() for point in there)]
        return Demonstration(TIME, along(points, [0, 0.7, 1], start), frames, ARM.joint_names)

    def succeeded(self, trajectory, situation):
        """At most 15 mm from one of the handles."""
        end, handles = tip(trajectory.joints[-1]), self.handles(situation.frames["object"])
        return bool((end - handles).norm(dim=-1).min() < 0.015)

    def handles(self, place: Frame) -> Tensor:
        """Where they are (2, 3)."""
        return place.transform(torch.tensor([[0, 0.08, 0], [0, -0.08, 0]]).double())


def reach_of_one_handle(n, seed=0, angles=(0, 0.6)) -> list[Situation]:
    """Objects so far away that the arm reaches one of the two handles only."""
    rng, found = np.random.default_rng(seed), []
    while len(found) < n:
        radius, angle = rng.uniform(0.75, 0.95), rng.uniform(*angles)
        place = (radius * np.cos(angle), radius * np.sin(angle), 0)
        frame = Frame(place, turned(rng.uniform(-0.5, 0.5)))
        far = Handles().handles(frame).norm(dim=-1)
        if far.max() > 0.93 and far.min() < 0.87:
            found.append(Situation(Handles().start(rng), {"object": frame}))
    return found


def another_handle_each() -> list[Situation]:
    """Two situations, in each of which the arm reaches another handle alone."""
    return [*reach_of_one_handle(1, angles=(-0.6, 0)), *reach_of_one_handle(1)]


def two_ways_set(path: Path) -> Path:
    """A data set of two handles, 20 steps per second, and the arm's URDF beside it."""
    demonstrations, _ = shown(Handles)
    time = torch.arange(len(TIME)) / 20
    given = [replace(one, time=time.double()) for one in demonstrations]
    save_lerobot(given, path / "set", fps=20, task="take a handle")
    (path / "arm.urdf").write_text(ARM.config()["urdf"])
    return path


@functools.cache
def shown(task: type[TwoWays], seed: int = 0, n: int = 10) -> tuple:
    """Demonstrations of a task, and their sides."""
    demonstrations, sides = task().demonstrations(n, seed)
    return tuple(demonstrations), sides


@functools.cache
def fitted(task: type[TwoWays], seed: int = 0) -> SelectWays:
    """A model of both ways."""
    return SelectWays(task().model()).fit(shown(task, seed)[0])
