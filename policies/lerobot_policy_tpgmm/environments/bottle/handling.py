"""What the tasks with the bottle share: an upper body whose hands close around it."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from lerobot_policy_tpgmm.environments.base import Observation, StateEnv
from lerobot_policy_tpgmm.environments.bottle.conditions import Conditions, skill
from lerobot_policy_tpgmm.environments.bottle.measures import Closing
from lerobot_policy_tpgmm.environments.bottle.scene import CAMERA, BottleScene, Snapshot
from lerobot_policy_tpgmm.environments.disturbances import (
    Course,
    Disturbance,
    displaced,
    generators,
    parse_condition,
)
from tpgmm_torch import Demonstration, Frame
from tpgmm_torch.exceptions import DataError, ShapeError

__all__ = ["BottleEnv"]

#: Standard deviations of the sensors at ``noise=1``: joints [rad], the objects' positions [m]
#: and orientations [rad].
NOISE_JOINTS = 2e-3
NOISE_POSE = np.array([1e-3] * 3 + [math.radians(0.5)] * 3)
#: The grip gives way at this force [N], without dynamics at this displacement [m].
GRIP_FORCE, GRIP_SLIP = 100.0, 0.03
#: The range in which an object is observed: position [m] and quaternion.
RANGE = np.array([5.0] * 3 + [1.0] * 4)


class BottleEnv(StateEnv):
    """A 17-joint upper body under position control, and a bottle that its hands can hold.

    Actions, the hands' rule, what is observed and what can go wrong are the same in all tasks;
    a task adds how an episode begins, what its path is and how it is judged.

    Parameters
    ----------
    duration : float
        Of an episode that nothing delays [s].
    course : Course
        When what happens in the task.
    fps, mode, episode_length, pushes, noise, track, condition, render_mode, render_width, \
    render_height
        As for :class:`~lerobot_policy_tpgmm.environments.bottle.shaking.BottleShakingEnv`.
    """

    _joints: NDArray[np.float64]
    _velocity: NDArray[np.float64]
    _reference: NDArray[np.float64]
    _queue: NDArray[np.float64]  # references that have not reached the motors yet

    def __init__(
        self,
        scene: BottleScene,
        duration: float,
        course: Course,
        *,
        fps: int,
        mode: str,
        episode_length: int | None,
        pushes: bool,
        noise: float,
        track: bool,
        condition: str | Sequence[Disturbance],
        render_mode: str | None,
        render_width: int,
        render_height: int,
    ) -> None:
        self.disturbances = parse_condition(condition)
        delay = sum(disturbance.delay for disturbance in self.disturbances)
        steps = round((duration + delay) * fps) if episode_length is None else episode_length
        super().__init__(fps, steps, CAMERA, render_mode, (render_width, render_height))
        self.mode, self.pushes, self.noise, self.track = mode, pushes, noise, track
        self.condition, self._course, self._scene = condition, course, scene
        self._check_options()
        robot = skill().robot
        self.joint_names = robot.joint_names
        self._lower, self._upper = robot.lower.numpy(), robot.upper.numpy()
        self._stride = robot.velocity.numpy() / fps
        self.action_space = spaces.Box(
            self._lower.astype(np.float32), self._upper.astype(np.float32), dtype=np.float32
        )
        # pushes and noise can lead a little beyond the joints' ranges
        joints = spaces.Box(self._lower - 0.5, self._upper + 0.5, dtype=np.float64)
        reach = np.tile(RANGE, len(scene.objects))
        self.observation_space = spaces.Dict(
            agent_pos=joints,
            environment_state=spaces.Box(-reach, reach, dtype=np.float64),
            timestamp=spaces.Box(0.0, 3 * steps / fps, (1,), dtype=np.float64),
        )
        self._live = track or any(part.live for part in self.disturbances)
        self._steps = steps  # no episode is going on

    def _check_options(self) -> None:
        if self.fps not in range(10, 1001) or 1000 % self.fps:
            raise DataError(f"fps has to divide 1000 and be at least 10, got {self.fps!r}")
        if self.mode not in ("dynamic", "kinematic"):
            raise DataError(f"mode is 'dynamic' or 'kinematic', got {self.mode!r}")
        if self.mode == "kinematic" and self.pushes:
            raise DataError("pushes are torques: they need mode='dynamic'")
        if self.episode_length < 1:
            raise DataError(f"episode_length is at least 1, got {self.episode_length!r}")
        if not 0 <= self.noise < math.inf:
            raise DataError(f"noise is finite and not below 0, got {self.noise!r}")

    @abstractmethod
    def figures(self) -> dict[str, float]:
        """How well the episode goes, so far; the class says what each figure is."""

    @abstractmethod
    def _successful(self, figures: Mapping[str, float]) -> bool:
        """Whether the figures at the end are those of a success."""

    @abstractmethod
    def _begin(self, options: Mapping[str, Any]) -> Conditions:
        """Draw an episode, and set the scene."""

    @abstractmethod
    def _nominal(self) -> Demonstration:
        """The generator's path for this start posture and the objects where they are.

        Its event ``"grasp"`` says from when on the hands hold the bottle.
        """

    @abstractmethod
    def _usual(self, bottle: NDArray[np.float64]) -> bool:
        """Whether the task is meant for a bottle there."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode.

        Parameters
        ----------
        options : dict, optional
            Initial poses of objects, shape (7,), by their names; ``"joints"``: the start
            posture, shape (17,). Other keys are for others, and ignored.

        Raises
        ------
        DataError
            If an option has another shape, is not finite, or is out of the joints' ranges.
        """
        super().reset(seed=seed)
        self._start = start = self._begin(options or {})
        self._closing = Closing()
        self._nearest, self._contact = math.inf, (start.joints, start.bottle)
        # when the hands closed, in steps that count; joints and height at each of these
        self._grasp_step: int | None = None
        self._counted = 0
        self._motion = np.empty((self.episode_length, len(start.joints) + 1))
        self._instants = np.empty(self.episode_length)
        self._picture, self._steps = None, 0
        self._time = self._free = 0.0  # [s], and without stops
        self._peaks: NDArray[np.float64] = np.zeros(2)
        self._rngs = generators(self.disturbances, self.np_random)
        self._drawn = tuple(
            part.drawn(
                rng, self._course, lambda step: self._usual(displaced(start.bottle, step))
            )
            for part, rng in zip(self.disturbances, self._rngs, strict=True)
        )
        self._returns = any(part.shove(-math.inf, math.inf) < 0 for part in self._drawn)
        self._past: list[tuple[float, Snapshot]] = []
        errors = start.misperception.reshape(-1, 6)
        poses = zip(self._scene.objects, errors, strict=True)
        self._seen = np.concatenate([self._perceived(*pair) for pair in poses])
        self._shown = self._seen
        for part in self._drawn:
            if part.start():
                self._put_on_path(part.start())
        self._hold_still()
        return self._observation(), {"is_success": False}

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move for one period of the control.

        Parameters
        ----------
        action : array-like of shape (17,)
            References of the joints in the order of ``joint_names`` [rad].

        Returns
        -------
        observation : dict
        reward : float
            1 at the end of a successful episode, else 0.
        terminated, truncated : bool
            False, and whether the episode has its full length.
        info : dict

        Raises
        ------
        ShapeError
            If the action has another shape.
        DataError
            If it is not finite, no episode is going on, or the simulation diverges.
        """
        wanted = self._checked(action)
        stopped = any(part.stops(self._time) for part in self._drawn)
        goal = self._reference if stopped else self._limited(wanted)
        clipped = float(np.abs(wanted - goal).max())
        seconds = self._move(goal)
        # in whole milliseconds, so that no sum is rounded
        began, self._time = self._time, round(self._time + seconds, 3)
        self._free = round(self._free + (0.0 if stopped else seconds), 3)
        self._use_hands(stopped)
        self._record(seconds, stopped)
        self._steps += 1
        self._interfere(began)
        info: dict[str, Any] = {"is_success": False, "clipped_rad": clipped}
        over = self._steps == self.episode_length
        if over:
            speed, acceleration = self._peaks.tolist()
            info |= self.figures()
            info |= {"peak_speed": speed, "peak_acceleration": acceleration}
            info["is_success"] = self._successful(info)
        return self._observation(), float(info["is_success"]), False, over, info

    def grasp(self) -> tuple[float, float]:
        """How far the worse hand was from its grasp pose when the hands closed [mm, deg].

        If they never did, when they were nearest to the bottle.
        """
        joints, bottle = (torch.from_numpy(part) for part in self._contact)
        distance, angle = skill().grasp_error(joints, Frame(bottle[:3], bottle[3:]))
        return 1e3 * float(distance), math.degrees(float(angle))

    def _checked(self, action: ArrayLike) -> NDArray[np.float64]:
        if self._steps >= self.episode_length:
            raise DataError("no episode is going on: call reset first")
        wanted = np.asarray(action, dtype=np.float64)
        if wanted.shape != self._reference.shape:
            raise ShapeError(
                f"the action has shape {wanted.shape}; this robot has "
                f"{len(self.joint_names)} joints: {list(self.joint_names)}"
            )
        finite = np.isfinite(wanted)
        if not finite.all():
            names = [self.joint_names[i] for i in np.flatnonzero(~finite)]
            raise DataError(f"the action is not finite for {names} at step {self._steps}")
        return wanted

    def _limited(self, wanted: NDArray[np.float64]) -> NDArray[np.float64]:
        """A reference within the joints' ranges, and in reach at their speed."""
        last = self._reference
        allowed = np.minimum(np.maximum(wanted, self._lower), self._upper)
        return last + np.minimum(np.maximum(allowed - last, -self._stride), self._stride)

    def _move(self, goal: NDArray[np.float64]) -> float:
        """Go towards a reference until the next tick; return how long that takes [s]."""
        last, usual, share = self._reference, 1000 // self.fps, 1.0
        for part, rng in zip(self._drawn, self._rngs, strict=True):
            share *= part.period(rng)
        n = max(1, round(usual * share))
        way = last + (goal - last) * np.minimum(np.arange(1, n + 1) / usual, 1.0)[:, None]
        self._reference = way[-1]
        if self.mode == "kinematic":
            self._scene.place(self._reference, n / 1000)
            return n / 1000
        self._queue = np.concatenate((self._queue, way))
        torques = self._start.torques(round(1000 * self._time), n) if self.pushes else None
        self._scene.follow(self._queue[: n + 1], torques)
        self._queue = self._queue[n:]
        return n / 1000

    def _use_hands(self, stopped: bool) -> None:
        """Close the hands, or lose the bottle."""
        scene = self._scene
        if self._grasp_step is None:
            if not stopped:
                gap = scene.gap()
                closes = self._closing.update(self._free, gap)
                if closes or gap < self._nearest:
                    self._nearest, self._contact = gap, (scene.joints, scene.bottle)
                if closes:
                    self._close(at_once=False)
        elif scene.held:
            kinematic = self.mode == "kinematic"
            if scene.slip() > GRIP_SLIP if kinematic else scene.pull() > GRIP_FORCE:
                scene.let_go()

    def _close(self, at_once: bool) -> None:
        """Take hold of the bottle, without what happens meanwhile if ``at_once``."""
        self._grasp_step = self._counted
        self._contact = self._scene.joints, self._scene.bottle
        self._scene.hold()

    def _record(self, seconds: float, stopped: bool) -> None:
        """What the judge looks at; a robot that is stopped is not judged."""
        joints = self._scene.joints
        velocity = (joints - self._joints) / seconds
        if not stopped:
            change = (velocity - self._velocity) / seconds
            peaks = np.abs(velocity).max(), np.abs(change).max()
            self._peaks = np.maximum(self._peaks, peaks)  # [rad/s, rad/s^2]
            self._motion[self._counted] = *joints, self._scene.bottle[2]
            self._instants[self._counted] = self._free
            self._counted += 1
        self._joints, self._velocity = joints, velocity

    def _since_grasp(self) -> NDArray[np.float64]:
        """Joints [rad] and the bottle's height [m], (T, 18), at the rate of the control."""
        first = self._counted if self._grasp_step is None else self._grasp_step
        times, motion = (part[first : self._counted] for part in (self._instants, self._motion))
        if len(times) < 2 or np.ptp(np.diff(times)) < 1e-6:
            return motion
        grid = np.arange(times[0], times[-1], 1 / self.fps)
        return np.stack([np.interp(grid, times, column) for column in motion.T], axis=1)

    def _interfere(self, began: float) -> None:
        """Let others move the bottle, and shove the robot."""
        for part in self._drawn:
            step = part.displacement(self._time)
            if step is not None and self._grasp_step is None:
                self._scene.put_bottle(displaced(self._start.bottle, step))
            seconds = part.shove(began, self._time)
            if seconds < 0:
                self._put_back(self._time + seconds)
            elif seconds > 0:
                self._put_on_path(self._instant() + seconds)
        if self._returns:
            self._past.append((self._time, self._scene.snapshot()))

    def _put_back(self, time: float) -> None:
        """Restore what the world was, at rest."""
        _, before = min(self._past, key=lambda entry: abs(entry[0] - time))
        self._scene.restore(before)
        if not before.held:
            self._grasp_step, self._nearest, self._closing = None, math.inf, Closing()
        self._hold_still()

    def _put_on_path(self, instant: float) -> None:
        """Continue the task at an instant of its nominal path, at rest."""
        path = self._nominal()
        held_for = instant - path.events["grasp"]
        if held_for > 0 and self._grasp_step is None:
            self._scene.place(_at(path, path.events["grasp"]), 0.0)
            self._close(at_once=True)
        self._scene.place(_at(path, instant), max(0.0, held_for))
        self._hold_still()

    def _standing(self) -> NDArray[np.float64]:
        """The bottle's pose, or what it was when it was last free; shape (7,)."""
        return self._scene.bottle if self._grasp_step is None else self._contact[1]

    def _instant(self) -> float:
        """Where on the nominal path the robot is, not further off than a path can be [s]."""
        path = self._nominal()
        distance = (path.joints - torch.from_numpy(self._scene.joints)).square().sum(-1)
        distance[(path.time - self._free).abs() > 2.5] = math.inf
        return float(path.time[distance.argmin()])

    def _hold_still(self) -> None:
        """Be at rest, with references where the joints are."""
        self._scene.rest()
        joints = self._scene.joints
        self._joints = joints
        self._velocity = np.zeros_like(joints)
        self._reference = joints
        self._queue = np.tile(joints, (self._start.delay + 1, 1))

    def _observation(self) -> Observation:
        joints, draw = self._scene.joints, self.np_random.standard_normal
        if self.noise:
            joints += self.noise * NOISE_JOINTS * draw(len(joints))
        if self._live:
            errors = [draw(6) if self.noise else np.zeros(6) for _ in self._scene.objects]
            poses = zip(self._scene.objects, errors, strict=True)
            self._seen = np.concatenate([self._perceived(*pair) for pair in poses])
        shown = self._seen
        for part, rng in zip(self._drawn, self._rngs, strict=True):
            shown = part.seen(shown, self._shown, self._time, rng)
        self._shown = shown
        return {
            "agent_pos": joints,
            "environment_state": shown.copy(),
            "timestamp": np.array([self._time]),
        }

    def _perceived(
        self, pose: NDArray[np.float64], errors: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """A pose with errors given in standard deviations."""
        if not self.noise:
            return pose
        return np.clip(displaced(pose, self.noise * NOISE_POSE * errors), -RANGE, RANGE)

    def _simulation(self) -> tuple[Any, Any]:
        return self._scene.model, self._scene.data


def _at(path: Demonstration, instant: float) -> NDArray[np.float64]:
    """The posture at an instant, between time steps."""
    time, joints = path.time.numpy(), path.joints.numpy()
    return np.array([np.interp(instant, time, column) for column in joints.T])
