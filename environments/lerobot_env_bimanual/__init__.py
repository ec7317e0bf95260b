"""Simulated tasks for robots with two arms, registered with gymnasium and LeRobot.

LeRobot's commands import this module by themselves. The environments load late: importing this
package needs neither MuJoCo nor gym-aloha.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from lerobot_env_bimanual.aloha.robot import JOINTS, OBJECTS
from lerobot_env_bimanual.control_rate import rate_processors
from lerobot_env_bimanual.disturbances import NOMINAL
from lerobot_env_bimanual.metaworld.tasks import check_task
from lerobot_env_bimanual.so101 import N_JOINTS, TASKS
from lerobot_env_bimanual.suite.names import ROBOTS, UPPER_BODY, tasks_of
from tpgmm_torch.exceptions import UnknownNameError

__all__ = [
    "AlohaStateConfig", "BiSo101Config", "BimanualConfig", "BottleShakingConfig",
    "BottleTorqueConfig", "CarryAndPutConfig", "MetaworldStateConfig",
]  # fmt: skip

_PACKAGE = "lerobot_env_bimanual"
_KEYS = {ACTION: ACTION, "agent_pos": OBS_STATE, "environment_state": OBS_ENV_STATE}

_ENVIRONMENTS = {
    "BottleShaking-v0": "bottle.shaking:BottleShakingEnv",
    "BottleTorque-v0": "bottle.torque:BottleTorqueEnv",
    "CarryAndPut-v0": "bottle.carrying:CarryAndPutEnv",
    "Bimanual-v0": "suite.env:SuiteEnv",
    "BiSo101-v0": "so101.env:BiSo101Env",
    "AlohaState-v0": "aloha.state:AlohaStateEnv",
    "MetaworldState-v0": "metaworld.state:MetaworldStateEnv",
}
for _name, _place in _ENVIRONMENTS.items():
    gym.register(id=f"{_PACKAGE}/{_name}", entry_point=f"{_PACKAGE}.{_place}")


def _features(n_joints: int, n_objects: int = 1) -> dict[str, PolicyFeature]:
    return {
        ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(n_joints,)),
        "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(n_joints,)),
        "environment_state": PolicyFeature(type=FeatureType.ENV, shape=(7 * n_objects,)),
    }


@dataclass
class _StateEnvConfig(EnvConfig):
    """An environment with joints and objects as observation, which can be drawn."""

    render_mode: str = "rgb_array"
    render_width: int = 320
    render_height: int = 240
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=_KEYS.copy)

    @property
    def package_name(self) -> str:
        """Package in which gymnasium's name is registered."""
        return _PACKAGE

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Return the environment's options, without those that are left to it."""
        general = {setting.name for setting in fields(EnvConfig)} - {"fps"}
        options = {
            setting.name: getattr(self, setting.name)
            for setting in fields(self)
            if setting.name not in general
        }
        return {name: value for name, value in options.items() if value is not None}

    def get_env_processors(self) -> tuple[Any, Any]:
        """Tell the policy the rate of actions."""
        return rate_processors(self.fps)


@dataclass
class _ControlledEnvConfig(_StateEnvConfig):
    """A robot that follows joint references, and what can go wrong meanwhile."""

    fps: int = 100
    episode_length: int | None = None
    pushes: bool = False
    noise: float = 0.0
    condition: str = NOMINAL
    cameras: str = ""
    camera_width: int = 640
    camera_height: int = 480
    observe_objects: bool = True

    def __post_init__(self) -> None:
        """Make the features those of the cameras, and of what else is observed."""
        from lerobot_env_bimanual.eyes.views import chosen_views

        for name in chosen_views(self.cameras):
            shape = (self.camera_height, self.camera_width, 3)
            self.features[f"pixels/{name}"] = PolicyFeature(FeatureType.VISUAL, shape)
            self.features_map[f"pixels/{name}"] = f"{OBS_IMAGES}.{name}"
        if not self.observe_objects:
            self.features.pop("environment_state", None)


class _TaskEnvConfig(_StateEnvConfig):
    """One environment of gymnasium's that has several tasks."""

    environment: ClassVar[str]

    @property
    def gym_id(self) -> str:
        """The environment, whatever the task."""
        return f"{_PACKAGE}/{self.environment}"

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Return the environment's options, without those that are left to it."""
        return {"task": self.task, **super().gym_kwargs}

    def _observe(self, objects: Mapping[str, Sequence[str]], n_joints: int) -> None:
        """Check the task, and make the features those of its objects."""
        if self.task not in objects:
            raise UnknownNameError("task", str(self.task), self.type, objects)
        if not self.features:
            self.features = _features(n_joints, len(objects[self.task]))


@EnvConfig.register_subclass("bottle_shaking")
@dataclass
class BottleShakingConfig(_ControlledEnvConfig):
    """``--env.type=bottle_shaking``.

    Parameters
    ----------
    task, features, features_map, max_parallel_tasks, disable_env_checker
        As in every configuration of LeRobot.
    fps, mode, episode_length, pushes, noise, track, condition, cameras, camera_width, \
    camera_height, observe_objects, frequency, amplitude
        Options of
        :class:`~lerobot_env_bimanual.bottle.shaking.BottleShakingEnv`; its own
        defaults where None.
    render_mode, render_width, render_height
        Of the videos.
    """

    task: str | None = "BottleShaking-v0"
    mode: str = "dynamic"
    track: bool = False
    frequency: float | None = None
    amplitude: float | None = None
    features: dict[str, PolicyFeature] = field(default_factory=lambda: _features(17))


@EnvConfig.register_subclass("bottle_torque")
@dataclass
class BottleTorqueConfig(BottleShakingConfig):
    """``--env.type=bottle_torque``: torque motors, gravity, and something in the way.

    Parameters
    ----------
    task, features, features_map, max_parallel_tasks, disable_env_checker, fps, mode, \
    episode_length, pushes, noise, track, condition, cameras, camera_width, camera_height, \
    observe_objects, frequency, amplitude, render_mode, render_width, render_height
        As of :class:`BottleShakingConfig`.
    control, obstacle
        Options of
        :class:`~lerobot_env_bimanual.bottle.torque.BottleTorqueEnv`; here, actions
        are references by default, as those of most policies.
    """

    task: str | None = "BottleTorque-v0"
    control: str = "reference"
    obstacle: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.control == "impedance":
            self.features[ACTION] = PolicyFeature(type=FeatureType.ACTION, shape=(51,))


@EnvConfig.register_subclass("carry_and_put")
@dataclass
class CarryAndPutConfig(_ControlledEnvConfig):
    """``--env.type=carry_and_put``.

    Parameters
    ----------
    task, features, features_map, max_parallel_tasks, disable_env_checker
        As in every configuration of LeRobot.
    fps, mode, episode_length, pushes, noise, condition, cameras, camera_width, \
    camera_height, observe_objects
        Options of
        :class:`~lerobot_env_bimanual.bottle.carrying.CarryAndPutEnv`; its own
        defaults where None.
    render_mode, render_width, render_height
        Of the videos.
    """

    task: str | None = "CarryAndPut-v0"
    mode: str = "dynamic"
    features: dict[str, PolicyFeature] = field(default_factory=lambda: _features(17, 2))


@EnvConfig.register_subclass("bimanual")
@dataclass
class BimanualConfig(_ControlledEnvConfig, _TaskEnvConfig):
    """``--env.type=bimanual``: the tasks of the suite.

    Parameters
    ----------
    task : str, default="handover"
        One of :data:`~lerobot_env_bimanual.suite.names.SUITE`, ``pick_place`` or, by the
        upper body, ``shelf``.
    robot : str, default="upper_body"
        One of :data:`~lerobot_env_bimanual.suite.names.ROBOTS`.
    force : bool, default=False
        Whether wrenches of both hands are observed, ``observation.wrench.l_hand`` and
        ``observation.wrench.r_hand``.
    features, features_map, max_parallel_tasks, disable_env_checker
        As in every configuration of LeRobot; the features follow from task and robot.
    fps, episode_length, pushes, noise, condition, cameras, camera_width, camera_height, \
    observe_objects
        Options of :class:`~lerobot_env_bimanual.suite.env.SuiteEnv`; its own
        defaults where None.
    render_mode, render_width, render_height
        Of the videos.
    """

    environment: ClassVar[str] = "Bimanual-v0"

    task: str | None = "handover"
    robot: str = UPPER_BODY
    force: bool = False

    def __post_init__(self) -> None:
        if self.robot not in ROBOTS:
            raise UnknownNameError("robot", self.robot, "bimanual", ROBOTS)
        self._observe(tasks_of(self.robot), ROBOTS[self.robot])
        super().__post_init__()


@EnvConfig.register_subclass("bi_so101")
@dataclass
class BiSo101Config(_ControlledEnvConfig, _TaskEnvConfig):
    """``--env.type=bi_so101``: two SO-101 arms, in the units of LeRobot's ``bi_so_follower``.

    Parameters
    ----------
    task : str, default="cup_on_saucer"
    specimen : int, default=0
        Which pair of arms: the seed of the joints' offsets.
    features, features_map, max_parallel_tasks, disable_env_checker
        As in every configuration of LeRobot.
    fps, episode_length, pushes, noise, condition, cameras, camera_width, camera_height, \
    observe_objects
        Options of :class:`~lerobot_env_bimanual.so101.env.BiSo101Env`; its own defaults where
        None.
    render_mode, render_width, render_height
        Of the videos.
    """

    environment: ClassVar[str] = "BiSo101-v0"

    task: str | None = "cup_on_saucer"
    specimen: int = 0
    fps: int = 25

    def __post_init__(self) -> None:
        self._observe(TASKS, N_JOINTS)
        super().__post_init__()


@EnvConfig.register_subclass("aloha_state")
@dataclass
class AlohaStateConfig(_TaskEnvConfig):
    """``--env.type=aloha_state``.

    Parameters
    ----------
    task : {"transfer_cube", "insertion"}, default="transfer_cube"
    features, features_map, max_parallel_tasks, disable_env_checker
        As in every configuration of LeRobot; the features follow from the task.
    fps, episode_length, yaw_range, track, stop_at_success
        Options of
        :class:`~lerobot_env_bimanual.aloha.state.AlohaStateEnv`; its own
        defaults where None.
    render_mode, render_width, render_height
        Of the videos.
    """

    environment: ClassVar[str] = "AlohaState-v0"

    task: str | None = "transfer_cube"
    fps: int = 50
    episode_length: int | None = None
    yaw_range: float | None = None
    track: bool = False
    stop_at_success: bool = True

    def __post_init__(self) -> None:
        self._observe(OBJECTS, len(JOINTS))


@EnvConfig.register_subclass("metaworld_state")
@dataclass
class MetaworldStateConfig(_TaskEnvConfig):
    """``--env.type=metaworld_state``: Meta-World's tasks, with states as observations.

    Parameters
    ----------
    task : str, default="reach-v3"
        One of :data:`~lerobot_env_bimanual.metaworld.tasks.TASKS`.
    features, features_map, max_parallel_tasks, disable_env_checker
        As in every configuration of LeRobot.
    fps, episode_length, control, stop_at_success
        Options of
        :class:`~lerobot_env_bimanual.metaworld.state.MetaworldStateEnv`; its own
        defaults where None.
    render_mode, render_width, render_height
        Of the videos.
    """

    environment: ClassVar[str] = "MetaworldState-v0"

    task: str | None = "reach-v3"
    fps: int = 80
    episode_length: int | None = None
    control: str = "reference"
    stop_at_success: bool = True
    features: dict[str, PolicyFeature] = field(default_factory=lambda: _features(4, 3))

    def __post_init__(self) -> None:
        check_task(str(self.task))
