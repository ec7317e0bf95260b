"""Small skills on three arms and on the upper body, fitted once in a process."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tpgmm_control.loop.controller import Controller
from tpgmm_datasets.bottle.skill import BottleShaking, bottle_operators
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_torch import Canonical, Demonstration, Frame, RelativePosition, Robot
from tpgmm_torch import TaskParameterizedGMM as Model
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.skills.skill import Skill

Array = NDArray[np.float64]
#: Of the undisturbed references [Hz].
PATH_RATE = 50


@dataclass(frozen=True, eq=False)
class Scenario:
    """A skill, and where it begins.

    Parameters
    ----------
    skill : Skill
        What is played.
    joints : ndarray of shape (n_joints,)
        Where the robot begins.
    frames : mapping of str to Frame
        Poses of the objects.
    path : ndarray of shape (n_ticks, n_joints)
        Undisturbed references at 50 Hz.
    """

    skill: Skill
    joints: Array
    frames: Mapping[str, Frame]
    path: Array

    @property
    def limits(self) -> tuple[Array, ...]:
        """Limits of lower and upper positions, speed, acceleration and jerk, (n_joints,)."""
        bounds = self.skill.motion_bounds
        assert bounds is not None
        names = ("lower", "upper", "velocity", "acceleration", "jerk")
        return tuple(getattr(bounds, name).numpy() for name in names)


def _rise(share: Any) -> Any:
    """Rise from 0 to 1 at minimum jerk, as a column."""
    u = np.clip(share, 0, 1)
    return (u**3 * (10 - 15 * u + 6 * u * u))[:, None]


def _arm(
    axes: str, gripper: bool = False, sag: float = 0.0
) -> tuple[Model, Sequence[Demonstration]]:
    """Let joints about these axes reach a cup, rest while a gripper closes, and leave.

    With ``sag`` [rad], demonstrations hold commands of drives that sag, and are 0.1 s late.
    """
    text = ['<robot name="arm"><link name="base"/>']
    links = ["base", *range(1, len(axes)), "hand"]
    for number, axis in enumerate(axes, 1):
        way = " ".join("1" if axis == name else "0" for name in "xyz")
        text.append(
            f'<link name="{links[number]}"/><joint name="joint{number}" type="revolute">'
            f'<parent link="{links[number - 1]}"/><child link="{links[number]}"/><origin '
            f'xyz="0.2 0 0"/><axis xyz="{way}"/><limit lower="-2.5" upper="2.5" velocity="2" '
            'effort="1"/></joint>'
        )
    coordinates = ("gripper",) if gripper else ()
    robot = Robot.from_urdf("".join(text) + "</robot>", ["hand"], coordinates=coordinates)
    rng, n, time = np.random.default_rng(0), len(axes), 0.045 * np.arange(101.0)
    home, reach, leave = (rng.choice([-1, 1], n) * rng.uniform(0.2, 0.7, n) for _ in range(3))
    shown = []
    for _ in range(6):
        start, there = np.stack((home, home + reach)) + 0.1 * rng.standard_normal((2, n))
        joints: Any = (
            start + _rise(time / 2) * (there - start) + _rise((time - 3) / 1.5) * leave
        )
        joints += 1e-3 * rng.standard_normal(joints.shape)
        if gripper:
            joints = np.hstack((joints, 2 * _rise((time - 2.1) / 0.8) - 1))
        at_cup = np.append(there, np.zeros(len(coordinates)))
        cup = Frame(robot.state(torch.from_numpy(at_cup)).position("hand"))
        sags = sag * (-0.5) ** np.arange(joints.shape[1])
        commands = joints + 0.1 * np.gradient(joints, time, axis=0) + sags
        shown.append(
            Demonstration(
                torch.from_numpy(time), joints, {"cup": cup}, robot.joint_names,
                commands=commands if sag else None,
            )
        )  # fmt: skip
    operators = [RelativePosition("hand", "cup"), Canonical()]
    return Model(8, operators, robot).fit(shown), shown


def _upper_body() -> tuple[Model, Sequence[Demonstration]]:
    """Learn the paper's skill from four demonstrations."""
    robot = Robot.from_urdf(upper_body_urdf(), links=("l_hand", "r_hand"))
    recorded = BottleShaking(rate=10, robot=robot).demonstrations(4, seed=0)
    shown = DynamicTimeWarping(robot=robot).fit_transform(recorded)
    return Model(8, bottle_operators(), robot, tol=1e-2).fit(shown), shown


ROBOTS: Mapping[str, Callable[[], tuple[Model, Sequence[Demonstration]]]] = {
    "four joints": partial(_arm, "zzzx"),
    "seven joints": partial(_arm, "zyxyxyx"),
    "gripper": partial(_arm, "yy", gripper=True),
    "sagging": partial(_arm, "zzzx", sag=0.08),
    "upper body": _upper_body,
}


@cache
def situations(robot: str) -> Sequence[Scenario]:
    """Return the situations of the demonstrations of a robot, with undisturbed paths."""
    (model, shown), found = ROBOTS[robot](), []
    skill = model.skill
    for demonstration in shown:
        start, path = demonstration.joints[0], [demonstration.joints[0]]
        controller = Controller(skill, start, demonstration.frames)
        for _ in range(round(skill.end * PATH_RATE)):
            path.append(controller.step(1 / PATH_RATE).reference)
        frames = demonstration.frames
        found.append(Scenario(skill, start.numpy(), frames, torch.stack(path).numpy()))
    return found
