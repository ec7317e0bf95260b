"""Meta-World's tasks as a LeRobot environment: states in, references of the hand out."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from lerobot_env_bimanual.base import Array, Observation, StateEnv, finite_vector
from lerobot_env_bimanual.metaworld.hand import FPS, FRAMES, JOINTS, displacement, effort
from lerobot_env_bimanual.metaworld.tasks import check_task
from tpgmm_torch.exceptions import DataError, DependencyError

CAMERA = "corner2"
CONTROL = ("reference", "displacement")
#: Where the present hand, object 1 (with four more numbers), object 2 and the goal are among
#: Meta-World's 39.
HAND, OBJECT_1, OBJECT_2, GOAL = (slice(a, b) for a, b in ((0, 4), (4, 7), (11, 14), (36, 39)))
UNTURNED = (1.0, 0.0, 0.0, 0.0)


class MetaworldStateEnv(StateEnv):
    """One task of Meta-World, with its goal in the observation.

    Observations are ``agent_pos``, where the hand is [m] and how far it is open, 0 to 1, and
    ``environment_state``, x y z [m] and a unit quaternion w x y z for each of ``frame_names``;
    an object that a task has not is at the origin. An action is a reference for the hand's
    target, which pulls the hand by a spring, and for its opening. Meta-World itself takes the
    target's displacement, at most 1 cm a step: it is computed here, from where the target is.
    A target that is ahead of a hand that is held up pulls harder: references of the target
    say how hard, positions of the hand would not.

    Parameters
    ----------
    task : str
        Such as ``"reach-v3"``, one of
        :data:`~lerobot_env_bimanual.metaworld.tasks.TASKS`.
    fps : int, default=80
        Meta-World has no other.
    episode_length : int, default=500
        Steps after which an episode is cut off.
    control : {"reference", "displacement"}, default="reference"
        ``"displacement"`` takes Meta-World's own actions: the target's displacement in units
        of 1 cm, and the effort of the fingers, all from -1 to 1.
    stop_at_success : bool, default=True
        Whether an episode ends with its first success.
    render_mode : {"rgb_array"}, optional
    render_width, render_height : int
        Of the picture.

    Attributes
    ----------
    joint_names, frame_names : tuple of str
        The order of ``agent_pos`` and of ``environment_state``.

    Raises
    ------
    DataError, UnknownNameError
        If an option does not exist.
    DependencyError
        Without Meta-World.

    Notes
    -----
    The quaternions are all (1, 0, 0, 0): Meta-World's tasks tell orientations in one order or
    in another or not at all, and hardly any turns an object at the start.

    The same seed is the same situation. ``info`` has ``is_success``, Meta-World's own criterion
    at any step so far, and ``elapsed_s``.
    """

    joint_names, frame_names = JOINTS, FRAMES

    def __init__(
        self,
        task: str = "reach-v3",
        *,
        fps: int = FPS,
        episode_length: int = 500,
        control: str = "reference",
        stop_at_success: bool = True,
        **rendering: Any,
    ) -> None:
        if fps != FPS or not 1 <= episode_length <= 500 or control not in CONTROL:
            raise DataError(
                f"Meta-World has fps={FPS}, episode_length from 1 to 500, control one of "
                f"{list(CONTROL)}; got {fps!r}, {episode_length!r} and {control!r}"
            )
        self.task, self.task_description = check_task(task), task.removesuffix("-v3")
        library = metaworld_library()
        super().__init__(fps, episode_length, CAMERA, **rendering)
        self.control, self.stop_at_success = control, stop_at_success
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about the types of its spaces
            kind = library.ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{task}-goal-observable"]
            self._env = kind(seed=0)
        # draw where things are at each reset, from the environment's own generator
        self._env._freeze_rand_vec, self._env.seeded_rand_vec = False, True
        low, high = self._env.mocap_low, self._env.mocap_high
        limits = (np.append(low, 0.0), np.append(high, 1.0))
        if control == "displacement":
            limits = (-np.ones(4), np.ones(4))
        low, high = (limit.astype(np.float32) for limit in limits)
        self.action_space = gym.spaces.Box(low, high, dtype=np.float32)
        sizes = {"agent_pos": len(JOINTS), "environment_state": 7 * len(FRAMES)}
        self.observation_space = gym.spaces.Dict(
            {k: gym.spaces.Box(-np.inf, np.inf, (n,), np.float64) for k, n in sizes.items()}
        )

    @property
    def target(self) -> Array:
        """Present place of the hand's target [m], (3,)."""
        return np.array(self._env.data.mocap_pos[0])

    @property
    def raw(self) -> Array:
        """Meta-World's own observation, (39,): what its scripted experts look at."""
        return self._raw

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Place hand and objects; ``options`` are ignored."""
        super().reset(seed=seed)
        self._env.seed(int(self.np_random.integers(2**31)) if seed is None else seed)
        with np.errstate(all="ignore"):
            self._raw, _ = self._env.reset()
        self._steps, self._picture, self._success = 0, None, False
        return self._observation(), self._info()

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move the hand's target for one control period.

        Parameters
        ----------
        action : array of shape (4,)
            As ``control`` says; what is out of reach is clipped.
        """
        values = finite_vector("action", action, len(JOINTS))
        if self.control == "reference":
            moved = displacement(values[:3], self.target, self._env.action_scale)
            values = np.append(moved, effort(values[3]))
        values = np.clip(values, -1.0, 1.0).astype(np.float32)
        self._raw, reward, _, _, info = self._env.step(values)
        self._steps += 1
        self._success |= bool(info["success"])
        solved = self._success and self.stop_at_success
        truncated = self._steps >= self.episode_length
        return self._observation(), float(reward), solved, truncated, self._info()

    def close(self) -> None:
        """Free the simulation."""
        super().close()
        self._env.close()

    def _simulation(self) -> tuple[Any, Any]:
        return self._env.model, self._env.data

    def _observation(self) -> Observation:
        places = (self._raw[where] for where in (OBJECT_1, OBJECT_2, GOAL))
        poses = np.concatenate([np.append(place, UNTURNED) for place in places])
        return {"agent_pos": self._raw[HAND].copy(), "environment_state": poses}

    def _info(self) -> dict[str, Any]:
        return {"is_success": self._success, "elapsed_s": self._steps / self.fps}


def metaworld_library() -> Any:
    """Import the package ``metaworld``.

    Raises
    ------
    DependencyError
        If it is missing.
    """
    try:
        import metaworld
    except ImportError as error:
        raise DependencyError(
            "metaworld_state needs Meta-World, whose MuJoCo is another than this project's: "
            "make metaworld, or pip install 'lerobot_env_bimanual[metaworld]' in an "
            "environment of its own"
        ) from error
    return metaworld
