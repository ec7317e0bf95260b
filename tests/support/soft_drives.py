"""An arm with drives that lag, sag, rub and are noisy, what it shows, and its loop."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import torch

from tpgmm_control import Controller
from tpgmm_torch import (
    Canonical,
    Demonstration,
    Frame,
    Hold,
    RelativePosition,
    Robot,
    TaskParameterizedGMM,
)
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.motion.minimum_jerk import minimum_jerk

LENGTHS, AXES = (0.0, 0.3, 0.3, 0.15), ("0 0 1", "0 0 1", "0 0 1", "1 0 0")
NAMES = ("a", "b", "c", "d")
GRASP, TAKEN, END = 2.2, 2.5, 5.0
STEP = 0.002


@cache
def arm() -> Robot:
    """Return an arm of four joints with a hand."""
    links = ("base", "l1", "l2", "l3", "hand")
    joints = (
        f'<joint name="{name}" type="revolute"><parent link="{links[k]}"/>'
        f'<child link="{links[k + 1]}"/><origin xyz="{LENGTHS[k]} 0 0"/><axis xyz="{AXES[k]}"/>'
        '<limit lower="-2.5" upper="2.5" velocity="2" effort="1"/></joint>'
        for k, name in enumerate(NAMES)
    )
    bodies = "".join(f'<link name="{name}"/>' for name in links)
    return Robot.from_urdf(f'<robot name="arm">{bodies}{"".join(joints)}</robot>', ["hand"])


def moves(time: Array, begin: float, end: float) -> Array:
    """Return a share (T, 1) that rises smoothly from ``begin`` to ``end``."""
    share = torch.from_numpy(np.clip((time - begin) / (end - begin), 0, 1))
    return minimum_jerk(share).numpy()[:, None]


@cache
def demonstrations(holds: bool = False, sag: float | None = None) -> list[Demonstration]:
    """Show how a cup is reached and carried away; with ``sag`` [rad], with commands, too."""
    generator, shown = np.random.default_rng(3), []
    time: Any = np.linspace(0, END, 126)
    for _ in range(6):
        start, there = np.array([[0.3, 0.8, -0.4, 0.0], [0.1, 0.5, -0.3, 0.0]]) + (
            0.1 * generator.standard_normal((2, 4))
        )
        joints = start + moves(time, 0, 2) * (there - start)
        joints = joints + moves(time, TAKEN, 4.8) * [-0.7, 0.4, 0.3, 0.4]
        hand = arm().state(torch.from_numpy(joints)).position("hand").numpy()
        cup = np.where(time[:, None] < TAKEN, hand[time < TAKEN][-1], hand)
        held = (Hold("cup", "hand", GRASP, 99.0),) if holds else ()
        commands = None
        if sag is not None:
            speed = np.gradient(joints, time, axis=0)
            commands = joints + 0.1 * speed + sag * np.eye(4)[1]
        joints = joints + 1e-3 * generator.standard_normal(joints.shape)
        shown.append(
            Demonstration(
                time, joints, {"cup": Frame(cup)}, NAMES, holds=held, commands=commands
            )
        )
    return shown


@cache
def learned(holds: bool = False, sag: float | None = None) -> TaskParameterizedGMM:
    """Learn the skill."""
    operators = [RelativePosition("hand", "cup"), Canonical()]
    return TaskParameterizedGMM(8, operators, arm()).fit(demonstrations(holds, sag))


@dataclass
class Drives:
    """Drives of second order, and the controller that commands them.

    Parameters
    ----------
    controller : Controller
    lag : float
        Of the drives [s].
    sag : float
        By which the second joint hangs below its command [rad].
    noise : float
        Of encoders [rad].
    """

    controller: Controller
    lag: float = 0.08
    sag: float = 0.0
    noise: float = 0.0
    statuses: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.reference = self.joints = self.controller.reference.numpy()
        self.speed = 0.0 * self.joints
        self.generator = np.random.default_rng(1)

    def tick(self, dt: float = 0.02, stopped: bool = False, rubs: Any = None) -> Any:
        """Let the drives follow for a tick, and step; ``rubs(error, speed)`` opposes them."""
        stiffness = (2 / self.lag) ** 2
        for _ in range(max(1, round(dt / STEP))):
            error = self.reference - self.joints - self.sag * np.eye(4)[1]
            if rubs is not None:
                error = error - rubs(error, self.speed)
            self.speed = self.speed + STEP * (stiffness * error - 4 / self.lag * self.speed)
            self.speed = np.zeros_like(self.speed) if stopped else self.speed
            self.joints = self.joints + STEP * self.speed
        measured = self.joints + self.noise * self.generator.standard_normal(4)
        command = self.controller.step(dt, measured)
        self.reference = command.reference.numpy()
        self.statuses[str(command.status)] += 1
        return command


def begin(
    holds: bool = False,
    sag: float | None = None,
    sag_of_drives: float = 0.0,
    clock: str = "localizing",
    **drives: Any,
) -> Drives:
    """Begin the skill where the first demonstration did."""
    shown = demonstrations(holds, sag)[0]
    frames = {"cup": Frame(shown.frames["cup"].position[0])}
    controller = Controller(learned(holds, sag).skill, shown.joints[0], frames, clock=clock)
    return Drives(controller, sag=sag_of_drives, **drives)
