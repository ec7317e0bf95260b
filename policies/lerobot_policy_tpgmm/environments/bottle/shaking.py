"""The paper's skill as a gymnasium environment: take a bottle, lift it, shake it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from lerobot_policy_tpgmm.environments.base import Observation, StateEnv
from lerobot_policy_tpgmm.environments.bottle.conditions import Conditions, skill
from lerobot_policy_tpgmm.environments.bottle.measures import Closing, find_shaking, successful
from lerobot_policy_tpgmm.environments.bottle.scene import (
    CAMERA,
    FOOT,
    TABLE_LOW,
    BottleScene,
    displaced,
)
from tpgmm_datasets.bottle.skill import PHASES, SHOULDERS, TASK, BottleShaking
from tpgmm_torch import Frame
from tpgmm_torch.exceptions import DataError, ShapeError

__all__ = ["AMPLITUDE", "FREQUENCY", "BottleShakingEnv"]

#: Of the demonstrations with a steady rhythm [Hz, rad].
FREQUENCY = BottleShaking.cycles / PHASES["shake"]
AMPLITUDE = BottleShaking.amplitude
#: How long an episode takes [s]; the slowest demonstration takes 15.3.
DURATION = 16.0
#: Standard deviations of the sensors at ``noise=1``: joints [rad], the bottle's position [m]
#: and orientation [rad].
NOISE_JOINTS = 2e-3
NOISE_BOTTLE = np.array([1e-3] * 3 + [math.radians(0.5)] * 3)
#: The grip gives way at this force [N], without dynamics at this displacement [m].
GRIP_FORCE, GRIP_SLIP = 100.0, 0.03
#: The range in which the bottle is observed: position [m] and quaternion.
RANGE = np.array([5.0] * 3 + [1.0] * 4)


class BottleShakingEnv(StateEnv):
    """A 17-joint upper body that should take a bottle with both hands, lift and shake it.

    An action is a reference for each joint [rad]. References are limited to the joints' ranges
    and speeds (``info["clipped_rad"]`` is by how much, at most), interpolated to 1 kHz, and
    reach the joints' position control some milliseconds later.

    The bottle stands on a lifting table, and moves if it is pushed. Both hands close when both
    palms have arrived at it
    (:class:`~lerobot_policy_tpgmm.environments.bottle.measures.Closing` is the rule), once per
    episode. The bottle is then attached to them just as it lies in them, and the table sinks.
    Both hands lose it when one is pulled from it by more than 100 N, or without dynamics by
    more than 30 mm.

    An episode takes its full length, and is then judged. At its end ``info`` holds

    - ``grasp_mm``, ``grasp_deg``: how far the worse hand was from its grasp pose when the hands
      closed; if they never did, when they were nearest to the bottle;
    - ``lift_mm``: height of the bottle above the table, the least from the shaking to the end;
      0 if it is not held at the end;
    - ``frequency_hz``, ``amplitude_rad``: of the shoulders' pitch after the grasp, in the two
      periods that are most like a sinusoid; the amplitude that is farther off of both;
    - ``frequency_error``, ``amplitude_error``: relative to what is asked for; 1 if there was no
      grasp, or no time left for two periods;

    and ``is_success``: errors of at most 10 mm, 5 deg, 10 % and 20 %, and at least 50 mm.

    The seed draws the bottle's pose and the start posture (like the generator of the
    demonstrations), the bottle's mass (0.5 to 1.5 kg), the control's delay (1 to 8 ms) and what
    the options below need; the same at every ``fps`` and in every mode.

    Parameters
    ----------
    fps : int, default=100
        Actions per second; a divisor of 1000, at least 10.
    mode : {"dynamic", "kinematic"}, default="dynamic"
        ``"kinematic"`` puts the joints where the references are: no masses, no delay.
    episode_length : int, optional
        In actions; as many as 16 s take by default.
    pushes : bool, default=False
        Whether a torque of 40 to 50 N m pushes a shoulder or an elbow for 0.1 to 0.3 s at a
        random moment: enough to move a free hand by 1 to 3 cm.
    noise : float, default=0
        Of the sensors, in multiples of standard deviations of 2 mrad for joints, and of 1 mm
        and 0.5 deg about each axis for the bottle (once per episode, unless it is tracked).
    track : bool, default=False
        Observe the bottle's present pose instead of its initial one.
    frequency, amplitude : float
        What the shaking should have [Hz, rad]; by default what demonstrations with a steady
        rhythm have.
    render_mode : {"rgb_array"}, optional
    render_width, render_height : int
        Of the picture.

    Attributes
    ----------
    joint_names : tuple of str
        The order of actions and of ``agent_pos``.

    Raises
    ------
    DataError
        If an option is not one of the above.
    """

    task = TASK
    task_description = "take the bottle with both hands, lift it and shake it"

    def __init__(
        self,
        *,
        fps: int = 100,
        mode: str = "dynamic",
        episode_length: int | None = None,
        pushes: bool = False,
        noise: float = 0.0,
        track: bool = False,
        frequency: float = FREQUENCY,
        amplitude: float = AMPLITUDE,
        render_mode: str | None = None,
        render_width: int = 320,
        render_height: int = 240,
    ) -> None:
        steps = round(DURATION * fps) if episode_length is None else episode_length
        super().__init__(fps, steps, CAMERA, render_mode, (render_width, render_height))
        self.mode, self.pushes, self.noise, self.track = mode, pushes, noise, track
        self.frequency, self.amplitude = frequency, amplitude
        self._check_options()
        robot = skill().robot
        self.joint_names = robot.joint_names
        self._pitches = [self.joint_names.index(name) for name in SHOULDERS]
        self._lower, self._upper = robot.lower.numpy(), robot.upper.numpy()
        self._stride = robot.velocity.numpy() / fps
        self.action_space = spaces.Box(
            self._lower.astype(np.float32), self._upper.astype(np.float32), dtype=np.float32
        )
        # pushes and noise can lead a little beyond the joints' ranges
        joints = spaces.Box(self._lower - 0.5, self._upper + 0.5, dtype=np.float64)
        bottle = spaces.Box(-RANGE, RANGE, dtype=np.float64)
        self.observation_space = spaces.Dict(agent_pos=joints, environment_state=bottle)
        self._scene = BottleScene()
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
        for name in ("frequency", "amplitude"):
            if not 0 < getattr(self, name) < math.inf:
                raise DataError(f"{name} is finite and above 0, got {getattr(self, name)!r}")
        if not 0 <= self.noise < math.inf:
            raise DataError(f"noise is finite and not below 0, got {self.noise!r}")

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode.

        Parameters
        ----------
        options : dict, optional
            ``"bottle"``: its initial position and orientation, shape (7,); ``"joints"``: the
            start posture, shape (17,). Other keys are for others, and ignored.

        Raises
        ------
        DataError
            If an option has another shape, is not finite, or is out of the joints' ranges.
        """
        super().reset(seed=seed)
        start = Conditions.draw(self.np_random).with_start(options or {})
        self._start, self._reference = start, start.joints
        self._queue = np.tile(start.joints, (start.delay + 1, 1))
        self._scene.reset(start.bottle, start.joints, start.mass)
        self._seen = self._perceived(start.bottle, start.misperception)
        self._closing = Closing()
        self._nearest, self._contact = math.inf, (start.joints, start.bottle)
        self._grasp_step = self.episode_length
        self._shoulders = np.empty((self.episode_length, len(SHOULDERS)))
        self._heights = np.empty(self.episode_length)
        self._picture, self._steps = None, 0
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
        self._move(wanted)
        self._use_hands()
        self._shoulders[self._steps] = self._scene.joints[self._pitches]
        self._heights[self._steps] = self._scene.bottle[2]
        self._steps += 1
        clipped = float(np.abs(wanted - self._reference).max())
        info: dict[str, Any] = {"is_success": False, "clipped_rad": clipped}
        over = self._steps == self.episode_length
        if over:
            info |= self.figures()
            info["is_success"] = successful(info)
        return self._observation(), float(info["is_success"]), False, over, info

    def figures(self) -> dict[str, float]:
        """How well the episode goes, so far; the class says what each figure is."""
        joints, bottle = (torch.from_numpy(part) for part in self._contact)
        distance, angle = skill().grasp_error(joints, Frame(bottle[:3], bottle[3:]))
        since = slice(self._grasp_step, self._steps)
        shaking = find_shaking(self._shoulders[since], self.fps, self.frequency)
        worse = np.abs(shaking.amplitudes / self.amplitude - 1).argmax()
        amplitude = float(shaking.amplitudes[worse])
        lift = 0.0
        if self._scene.held:
            lift = float(self._heights[since][shaking.start :].min()) - FOOT - TABLE_LOW
        return {
            "grasp_mm": 1e3 * float(distance),
            "grasp_deg": math.degrees(float(angle)),
            "lift_mm": 1e3 * lift,
            "frequency_hz": shaking.frequency,
            "amplitude_rad": amplitude,
            "frequency_error": abs(shaking.frequency / self.frequency - 1),
            "amplitude_error": abs(amplitude / self.amplitude - 1),
        }

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

    def _move(self, wanted: NDArray[np.float64]) -> None:
        last = self._reference
        allowed = np.minimum(np.maximum(wanted, self._lower), self._upper)
        step = np.minimum(np.maximum(allowed - last, -self._stride), self._stride)
        self._reference = last + step
        if self.mode == "kinematic":
            self._scene.place(self._reference, 1 / self.fps)
            return
        n = 1000 // self.fps
        way = last + step * (np.arange(1, n + 1) / n)[:, None]
        self._queue = np.concatenate((self._queue, way))
        torques = self._start.torques(self._steps * n, n) if self.pushes else None
        self._scene.follow(self._queue[: n + 1], torques)
        self._queue = self._queue[n:]

    def _use_hands(self) -> None:
        """Close the hands, or lose the bottle."""
        scene = self._scene
        if self._grasp_step == self.episode_length:
            gap = scene.gap()
            closes = self._closing.update((self._steps + 1) / self.fps, gap)
            if closes or gap < self._nearest:
                self._nearest, self._contact = gap, (scene.joints, scene.bottle)
            if closes:
                self._grasp_step = self._steps
                scene.hold()
        elif scene.held:
            kinematic = self.mode == "kinematic"
            if scene.slip() > GRIP_SLIP if kinematic else scene.pull() > GRIP_FORCE:
                scene.let_go()

    def _observation(self) -> Observation:
        joints, draw = self._scene.joints, self.np_random.standard_normal
        if self.noise:
            joints += self.noise * NOISE_JOINTS * draw(len(joints))
        if self.track:
            errors = draw(6) if self.noise else np.zeros(6)
            self._seen = self._perceived(self._scene.bottle, errors)
        return {"agent_pos": joints, "environment_state": self._seen.copy()}

    def _perceived(
        self, bottle: NDArray[np.float64], errors: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """A pose of the bottle with errors given in standard deviations."""
        seen = displaced(bottle, self.noise * NOISE_BOTTLE * errors)
        return np.clip(seen, -RANGE, RANGE)

    def _simulation(self) -> tuple[Any, Any]:
        return self._scene.model, self._scene.data
