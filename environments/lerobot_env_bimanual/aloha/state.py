"""gym-aloha's bimanual tasks, observed through joints and object poses instead of pixels.

Physics, rewards and where the objects lie are gym-aloha's. New are the observation, the
objects' yaw, and that no rendering is needed.
"""

from __future__ import annotations

import math
import threading
import warnings
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from lerobot_env_bimanual.aloha.robot import ARM_JOINTS, HOW_TO_INSTALL, JOINTS, OBJECTS, SIDES
from lerobot_env_bimanual.base import Array, Observation, StateEnv, finite_vector
from tpgmm_torch.exceptions import DataError, DependencyError, UnknownNameError

__all__ = ["AlohaStateEnv"]

DESCRIPTIONS = {
    "transfer_cube": "pick up the cube with the right arm and hand it over to the left arm",
    "insertion": "pick up the peg and the socket and insert the peg into the socket",
}
#: How long an episode takes [s].
DURATION = 8
#: The reward of a solved task, in both tasks.
SOLVED = 4
#: The one of gym-aloha's cameras that sees both arms from the front.
CAMERA = "angle"
#: gym-aloha hands the initial poses over in a global of its module.
POSE_LOCK = threading.Lock()


class AlohaStateEnv(StateEnv):
    """Transfer a cube, or insert a peg, with two ViperX arms.

    Observations are ``agent_pos``, the 14 joints in the order of ``joint_names`` (arms
    [rad], grippers 0 closed to 1 open), and ``environment_state``, for each object x y z [m]
    and a unit quaternion w x y z. An action is a reference for each joint, in the same scale.
    The reward is gym-aloha's stage, 0 to 4; an episode ends when it reaches 4.

    Parameters
    ----------
    task : {"transfer_cube", "insertion"}, default="transfer_cube"
    fps : int, default=50
        Control rate [Hz]; gym-aloha's is 50. It must divide the 500 steps of the physics.
    episode_length : int, optional
        Steps after which an episode is cut off; as many as 8 s take by default.
    yaw_range : float, default=pi / 4
        Objects are turned about the vertical by up to this, either way [rad]; pi / 4 covers
        every orientation of a cube, 0 is gym-aloha's.
    track : bool, default=False
        Whether ``environment_state`` is where the objects are now; by default it is where
        they were at the start, from where they drop 3 to 4 cm onto the table.
    stop_at_success : bool, default=True
        Whether an episode ends when the reward reaches 4, as gym-aloha's do.
    render_mode : {"rgb_array"}, optional
    render_width, render_height : int
        Of the picture.

    Attributes
    ----------
    joint_names : tuple of str
        The order of actions and of ``agent_pos``.

    Raises
    ------
    DataError, UnknownNameError
        If an option is not one of the above.
    DependencyError
        Without gym-aloha.

    Notes
    -----
    The same seed gives the same start at every ``fps``; where the objects lie is what
    gym-aloha draws for that seed. ``reset(options={"environment_state": ...})`` places the
    objects exactly, ``{"joints": ...}`` the arms.

    ``info`` has ``is_success`` (the reward was 4), ``max_reward``, ``lift_mm`` (how high the
    cube or the peg was lifted above where it came to rest), ``elapsed_s`` and ``diverged``:
    references that jump can make gym-aloha's stiff servos unstable, which ends the episode.
    """

    joint_names = JOINTS

    def __init__(
        self,
        task: str = "transfer_cube",
        *,
        fps: int = 50,
        episode_length: int | None = None,
        yaw_range: float = math.pi / 4,
        track: bool = False,
        stop_at_success: bool = True,
        **rendering: Any,
    ) -> None:
        if task not in OBJECTS:
            raise UnknownNameError("task", task, "aloha_state", OBJECTS)
        self.task, self.task_description = task, DESCRIPTIONS[task]
        self._library = library = _gym_aloha()
        model = library.constants.ASSETS_DIR / f"bimanual_viperx_{task}.xml"
        self._physics = library.mujoco.Physics.from_xml_path(str(model))
        self._rules, self._draw = {
            "transfer_cube": (library.sim.TransferCubeTask(), library.utils.sample_box_pose),
            "insertion": (library.sim.InsertionTask(), library.utils.sample_insertion_pose),
        }[task]
        rate = round(1 / self._physics.timestep())
        if fps not in range(1, rate + 1) or rate % fps:
            rates = [n for n in range(1, rate + 1) if rate % n == 0]
            raise DataError(
                f"fps={fps!r} does not divide {rate}, the steps of the physics: {rates}"
            )
        fps = int(fps)
        steps = DURATION * fps if episode_length is None else episode_length
        if not (steps >= 1 and 0 <= yaw_range <= math.pi):
            raise DataError(
                "episode_length has to be at least 1 and yaw_range between 0 and pi, got "
                f"{steps!r} and {yaw_range!r}"
            )
        super().__init__(fps, steps, CAMERA, **rendering)
        self.yaw_range, self.track, self.stop_at_success = yaw_range, track, stop_at_success
        self._substeps = rate // fps
        self.action_space = _actions(self._physics.model)
        sizes = {"agent_pos": len(JOINTS), "environment_state": 7 * len(OBJECTS[task])}
        self.observation_space = gym.spaces.Dict(
            {k: gym.spaces.Box(-1000, 1000, (n,), np.float64) for k, n in sizes.items()}
        )

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Place arms and objects.

        Parameters
        ----------
        options : mapping, optional
            ``environment_state``, the objects' poses, and ``joints``, the arms' posture.
            Others are ignored: LeRobot gives one of its own.

        Raises
        ------
        DataError
            If a pose or posture has another shape, is not finite or no unit quaternion.
        """
        super().reset(seed=seed)
        given = options or {}
        joints = given.get("joints")
        if joints is not None:
            joints = finite_vector("joints", joints, len(JOINTS))
        poses = self._sample(seed)  # also where poses are given: further draws stay the same
        if "environment_state" in given:
            poses = finite_vector("environment_state", given["environment_state"], len(poses))
            norms = np.linalg.norm(poses.reshape(-1, 7)[:, 3:], axis=1)
            if np.abs(norms - 1).max() > 1e-4:
                raise DataError(
                    "environment_state holds x y z and a unit quaternion w x y z for each of "
                    f"{OBJECTS[self.task]}; the norms are {norms}"
                )
        with POSE_LOCK:
            box_pose = self._library.sim.BOX_POSE
            box_pose[0], previous = poses, box_pose[0]
            try:
                self._rules.initialize_episode(self._physics)
            finally:
                box_pose[0] = previous
        if joints is not None:
            self._rules.before_step(joints, self._physics)
            self._physics.data.qpos[: len(self._physics.data.ctrl)] = self._physics.data.ctrl
            self._physics.forward()
        self._initial, self._steps, self._picture = poses, 0, None
        self._highest_reward, self._lift, self._diverged = 0, 0.0, False
        self._lowest = self._height()
        return self._observation(), self._info()

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Drive the joints to references for one control period.

        Parameters
        ----------
        action : array of shape (14,)
            In the order of ``joint_names``; what is out of reach is clipped.
        """
        self._rules.before_step(finite_vector("action", action, len(JOINTS)), self._physics)
        self._steps += 1
        try:
            self._physics.step(self._substeps)
        except self._library.control.PhysicsError:
            self._diverged = True
            return self._last, 0.0, True, False, self._info()
        reward = int(self._rules.get_reward(self._physics))
        self._highest_reward = max(self._highest_reward, reward)
        self._lowest = min(self._lowest, self._height())
        self._lift = max(self._lift, self._height() - self._lowest)
        solved = reward == SOLVED and self.stop_at_success
        truncated = self._steps >= self.episode_length
        return self._observation(), float(reward), solved, truncated, self._info()

    def _simulation(self) -> tuple[Any, Any]:
        return self._physics.model.ptr, self._physics.data.ptr

    def _sample(self, seed: int | None) -> Array:
        """gym-aloha's poses for a seed, turned about the vertical."""
        drawn = int(self.np_random.integers(2**32)) if seed is None else seed % 2**32
        poses = np.ravel(self._draw(drawn))
        yaw = self.np_random.uniform(-self.yaw_range, self.yaw_range, len(poses) // 7)
        quaternions = poses.reshape(-1, 7)[:, 3:]
        quaternions[:] = 0
        quaternions[:, 0], quaternions[:, 3] = np.cos(yaw / 2), np.sin(yaw / 2)
        return poses

    def _height(self) -> float:
        """Return the height of the cube or the peg [m]."""
        return float(self._rules.get_env_state(self._physics)[2])

    def _observation(self) -> Observation:
        poses = self._initial
        if self.track:
            poses = self._rules.get_env_state(self._physics)
        joints = self._rules.get_qpos(self._physics)
        self._last = {"agent_pos": joints, "environment_state": poses.copy()}
        return self._last

    def _info(self) -> dict[str, Any]:
        return {
            "is_success": self._highest_reward == SOLVED,
            "max_reward": float(self._highest_reward),
            "lift_mm": 1000 * self._lift,
            "elapsed_s": self._steps / self.fps,
            "diverged": self._diverged,
        }


def _gym_aloha() -> SimpleNamespace:
    """gym-aloha's modules, and those of dm-control that it stands on."""
    try:
        with warnings.catch_warnings():
            # dm-control looks for a display when it is imported, and warns that there is none
            warnings.filterwarnings("ignore", message=".*DISPLAY environment variable")
            from dm_control import mujoco
            from dm_control.rl import control
            from gym_aloha import constants, utils
            from gym_aloha.tasks import sim
    except ImportError as error:
        raise DependencyError(f"aloha_state needs gym-aloha: {HOW_TO_INSTALL}") from error
    return SimpleNamespace(
        mujoco=mujoco, control=control, constants=constants, utils=utils, sim=sim
    )


def _actions(model: Any) -> gym.spaces.Box:
    """Limits of the references: those of the actuators, grippers from 0 to 1."""
    limits = model.actuator_ctrlrange.reshape(len(SIDES), -1, 2)[:, : len(ARM_JOINTS)]
    gripper = np.broadcast_to((0.0, 1.0), (len(SIDES), 1, 2))
    low, high = np.concatenate((limits, gripper), axis=1).reshape(-1, 2).astype(np.float32).T
    return gym.spaces.Box(low, high, dtype=np.float32)
