"""Pick, place, home: skills of a tracked hand, each from five demonstrations of its own."""

from functools import cache
from itertools import pairwise

import numpy as np
import torch

from tpgmm_control import Controller
from tpgmm_torch import (
    Canonical,
    Demonstration,
    Frame,
    Hold,
    RelativePosition,
    TaskParameterizedGMM,
)
from tpgmm_torch.robots import Poses
from tpgmm_torch.skills.skill import Skill

HAND = Poses(["hand"], orientation=False)
FPS, LIFT, START = 25, np.array((0.0, 0.0, 0.1)), np.array((0.0, 0.0, 0.3))
#: When the hand takes the cup, and when it lets it go.
TAKES, LEAVES = 1.3, 1.3


def way(time, *stops):
    """Through (time, place), with minimum jerk from each to the next."""
    path = np.repeat(np.array([stops[0][1]]), len(time), 0)
    for (begin, one), (end, other) in pairwise(stops):
        s = np.clip((time - begin) / (end - begin), 0, 1)[:, None]
        path = path + s**3 * (10 - 15 * s + 6 * s**2) * (np.array(other) - one)
    return path


def demonstration(name: str, rng: np.random.Generator) -> Demonstration:
    """Of one skill, on a clock that begins at 0; frames are those of its own beginning."""
    time = np.arange(0, 2.0 + 1e-9, 1 / FPS)
    near = rng.normal(0, 0.01, 3)
    cup = np.array((*rng.uniform((0.3, 0.1), (0.4, 0.2)), 0.0))
    tray = np.array((*rng.uniform((0.3, -0.2), (0.4, -0.1)), 0.0))
    stops = {
        "pick": ((0, START + near), (1.0, cup), (1.5, cup), (1.9, cup + LIFT)),
        "place": ((0, cup + LIFT), (1.0, tray), (1.4, tray), (1.9, tray + LIFT + near)),
        "home": ((0, tray + LIFT + near), (1.7, START)),
    }[name]
    path = way(time, *stops)
    held = {"pick": time >= TAKES, "place": time < LEAVES, "home": time < 0}[name]
    thing = np.where(held[:, None], path, cup if name == "pick" else tray)
    holds = {"pick": (Hold("cup", "hand", TAKES),), "place": (Hold("cup", "hand", end=LEAVES),)}
    frames = {"cup": Frame(thing), "tray": Frame(tray)}
    return Demonstration(time, path, frames, HAND.joint_names, holds=holds.get(name, ()))


@cache
def skill(name: str) -> Skill:
    rng = np.random.default_rng(["pick", "place", "home"].index(name))
    seen = {"pick": ["cup"], "place": ["cup", "tray"], "home": []}[name]
    operators = [*(RelativePosition("hand", frame) for frame in seen), Canonical()]
    shown = [demonstration(name, rng) for _ in range(5)]
    return TaskParameterizedGMM(8, operators, HAND, random_state=0).fit(shown).skill


def skills() -> dict[str, Skill]:
    return {name: skill(name) for name in ("pick", "place", "home")}


class World:
    """Cups that hands take when they are there; the first grasps of each robot may fail.

    Parameters
    ----------
    fails : sequence of int
        How many grasps of each robot fail: the cup then stays, or is pushed aside by 3 cm.
    """

    def __init__(self, sequence, fails=(0,), single=False, **options):
        rng, count = np.random.default_rng(7), len(fails)
        low, high = (0.31, 0.11, 0.0, 0.31, -0.19, 0.0), (0.39, 0.19, 0.0, 0.39, -0.11, 0.0)
        self.cup, self.tray = np.split(rng.uniform(low, high, (count, 6)), 2, axis=1)
        self.fails, self.single = list(fails), single
        self.held, self.near, self.visible = np.zeros((3, count), bool)
        self.visible |= True
        self.hand = np.repeat(START[None], count, 0)
        self.references, self.commands = [self.hand], []
        begin = self.shaped(self.hand), self.frames()
        self.controller = Controller(sequence, *begin, smoothing=None, **options)

    def shaped(self, array):
        return torch.tensor(array[0] if self.single else array)

    def frames(self):
        cup = np.where(self.visible[:, None], self.cup, np.nan)
        unit = np.tile([1.0, 0, 0, 0], (len(cup), 1))
        poses = {"cup": cup, "tray": self.tray}
        if self.visible.all():
            return {n: Frame(self.shaped(p)) for n, p in poses.items()}
        return {n: self.shaped(np.concatenate((p, unit), 1)) for n, p in poses.items()}

    def step(self, **given):
        """One tick: perfect servos."""
        command = self.controller.step(1 / FPS, self.shaped(self.hand), self.frames(), **given)
        before, self.hand = self.hand, command.reference.numpy().reshape(-1, 3)
        self.cup = self.cup + self.held[:, None] * (self.hand - before)
        low = np.linalg.norm(self.hand - self.cup, axis=1) < 0.005
        slow = np.linalg.norm(self.hand - before, axis=1) < 0.0005
        time = np.broadcast_to(command.time.numpy(), len(low))
        for row in range(len(low)):
            stands, at_tray = low[row] and slow[row], self.hand[row, 1] < 0
            if stands and not at_tray and not self.near[row]:
                self.held[row] = self.fails[row] == 0
                self.cup[row, 0] += 0.03 * (self.fails[row] > 0)
                self.fails[row] = max(self.fails[row] - 1, 0)
            # one closing of the hand for each approach
            self.near[row] = (self.near[row] or stands) and self.hand[row, 2] < 0.05
            if at_tray and self.hand[row, 2] < 0.004 and time[row] > 3:
                self.held[row] = False
        self.references.append(self.hand)
        self.commands.append(command)
        return command

    def run(self, seconds, until=lambda command: False):
        for _ in range(round(seconds * FPS)):
            if until(command := self.step()):
                break
        return command
