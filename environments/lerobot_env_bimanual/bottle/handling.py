"""Common parts of the tasks with the bottle: an upper body whose hands close around it."""

from __future__ import annotations

import functools
import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import torch

from lerobot_env_bimanual.base import Array
from lerobot_env_bimanual.bottle.conditions import skill
from lerobot_env_bimanual.bottle.measures import Closing
from lerobot_env_bimanual.bottle.scene import CARRIERS, HOLDS, BottleScene
from lerobot_env_bimanual.controlled import ControlledEnv
from lerobot_env_bimanual.disturbances import Course
from lerobot_env_bimanual.robot_scene import Hold
from lerobot_env_bimanual.start import Start
from tpgmm_datasets.bottle.skill import FOOT, BottleSkill
from tpgmm_torch import Demonstration, Frame, Situation

#: The grip gives way at this force [N], without dynamics at this displacement [m].
GRIP_FORCE, GRIP_SLIP = 100.0, 0.03
#: Time steps per second of the path on which a robot is put [1/s].
PATH_RATE = 25.0


class BottleEnv(ControlledEnv):
    """A 17-joint upper body under position control, and a bottle that its hands can hold.

    Parameters
    ----------
    scene, duration, course
        As for :class:`~lerobot_env_bimanual.controlled.ControlledEnv`.
    **options
        Its options.
    """

    _scene: BottleScene
    carriers: ClassVar = {"bottle": CARRIERS["bottle"]}

    def __init__(
        self, scene: BottleScene, duration: float, course: Course, **options: Any
    ) -> None:
        super().__init__(skill().robot, scene, duration, course, **options)

    @abstractmethod
    def _draw(self, options: Mapping[str, Any]) -> Start:
        """Draw an episode, and set the scene."""

    @abstractmethod
    def _generator(self) -> BottleSkill:
        """Return the generator of the demonstrations."""

    def _slides(self) -> tuple[float, ...]:
        """Return how the bottle slides in the hands [m, rad], if it does."""
        return ()

    def _nominal(self) -> Demonstration:
        """Return the generator's path for this start posture and the objects where they are.

        Its event ``"grasp"`` says from when on the hands hold the bottle.
        """
        poses = {**self._start.poses, "bottle": self._standing()}
        frames = tuple((name, tuple(pose)) for name, pose in poses.items())
        return _path(self._generator(), tuple(self._start.joints), frames, self._slides())

    def _stands_usually(self, pose: Array) -> bool:
        return self._generator().usual(Frame(pose[:3], pose[3:]))

    def _begin(self, options: Mapping[str, Any]) -> Start:
        start = self._draw(options)
        table = float(start.poses["bottle"][2]) - FOOT
        self._scene.reset(start.poses, start.joints, table, start.mass)
        self._closing = Closing()
        self._nearest, self._contact = math.inf, (start.joints, start.poses["bottle"])
        # when the hands closed, in steps that count; joints and height at each of these
        self._grasp_step: int | None = None
        self._counted = 0
        self._motion = np.empty((self.episode_length, len(start.joints) + 1))
        self._instants = np.empty(self.episode_length)
        return start

    def grasp(self) -> tuple[float, float]:
        """Measure how far the worse hand was from its grasp pose when both closed [mm, deg].

        If they never did, when they were nearest to the bottle.
        """
        joints, bottle = (torch.from_numpy(part) for part in self._contact)
        distance, angle = skill().grasp_error(joints, Frame(bottle[:3], bottle[3:]))
        return 1e3 * float(distance), math.degrees(float(angle))

    def _act(self, stopped: bool) -> None:
        self._use_hands(stopped)
        if not stopped:  # a robot that is stopped is not judged
            self._motion[self._counted] = *self._joints, self._scene.bottle[2]
            self._instants[self._counted] = self._free
            self._counted += 1

    def _use_hands(self, stopped: bool) -> None:
        """Close the hands, or lose the bottle."""
        scene = self._scene
        if self._grasp_step is None:
            if not stopped:
                gap = max(map(scene.gap, HOLDS))
                closes = self._closing.update(self._free, gap)
                if closes or gap < self._nearest:
                    self._nearest, self._contact = gap, (scene.joints, scene.bottle)
                if closes:
                    self._close(at_once=False)
        elif scene.held:
            if self.mode == "kinematic":
                lost = scene.slip() > GRIP_SLIP
            else:
                lost = max(map(scene.pull, HOLDS)) > GRIP_FORCE
            if lost:
                self._change_hands(scene.let_go)

    def _close(self, at_once: bool) -> None:
        """Take hold of the bottle, without what happens meanwhile if ``at_once``."""
        self._grasp_step = self._counted
        self._contact = self._scene.joints, self._scene.bottle
        self._change_hands(self._scene.hold)

    def _change_hands(self, change: Callable[[Hold], None]) -> None:
        """Close or open both hands."""
        for hold in HOLDS:
            change(hold)

    def _since_grasp(self) -> Array:
        """Joints [rad] and the bottle's height [m], (T, 18), at the rate of the control."""
        first = self._counted if self._grasp_step is None else self._grasp_step
        times, motion = (part[first : self._counted] for part in (self._instants, self._motion))
        if len(times) < 2 or np.ptp(np.diff(times)) < 1e-6:
            return motion
        grid = np.arange(times[0], times[-1], 1 / self.fps)
        return np.stack([np.interp(grid, times, column) for column in motion.T], axis=1)

    def _restore(self, before: Any) -> None:
        super()._restore(before)
        if not self._scene.held:
            self._grasp_step, self._nearest, self._closing = None, math.inf, Closing()
            self._scene.taken.clear()

    def _put_on_path(self, instant: float) -> None:
        """Continue the task at an instant of its nominal path, at rest."""
        path = self._nominal()
        held_for = instant - path.events["grasp"]
        if held_for > 0 and self._grasp_step is None:
            self._scene.place(_at(path, path.events["grasp"]), 0.0)
            self._close(at_once=True)
        self._scene.place(_at(path, instant), max(0.0, held_for))
        self._hold_still()

    def _standing(self) -> Array:
        """Return the bottle's pose, or that when it was last free; shape (7,)."""
        return self._scene.bottle if self._grasp_step is None else self._contact[1]

    def _instant(self) -> float:
        """Find the nearest instant of the nominal path, within 2.5 s of the time [s]."""
        path = self._nominal()
        distance = (path.joints - torch.from_numpy(self._scene.joints)).square().sum(-1)
        distance[(path.time - self._free).abs() > 2.5] = math.inf
        return float(path.time[distance.argmin()])


def _at(path: Demonstration, instant: float) -> Array:
    """Interpolate the posture at an instant."""
    time, joints = path.time.numpy(), path.joints.numpy()
    return np.array([np.interp(instant, time, column) for column in joints.T])


@functools.lru_cache(maxsize=128)  # the conditions of a comparison begin alike
def _path(
    generator: Any,
    joints: tuple[float, ...],
    poses: tuple[tuple[str, tuple[float, ...]], ...],
    slides: tuple[float, ...],
) -> Demonstration:
    frames = {name: Frame(pose[:3], pose[3:]) for name, pose in poses}
    options = [np.array([slides])] if slides else []
    slow = replace(generator, rate=PATH_RATE)
    [path] = slow.nominal([Situation(torch.tensor(joints), frames)], *options)
    return path  # type: ignore[no-any-return]
