"""A robot that follows joint references, tick by tick, and what can go wrong meanwhile."""

from __future__ import annotations

import math
import zlib
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from lerobot_env_bimanual.base import Array, Observation, StateEnv
from lerobot_env_bimanual.disturbances import (
    NOMINAL,
    Course,
    Disturbance,
    displace_pose,
    generators,
    parse_condition,
)
from lerobot_env_bimanual.eyes.carriers import Carrier
from lerobot_env_bimanual.eyes.lens import usual_camera
from lerobot_env_bimanual.eyes.rig import Rig, View
from lerobot_env_bimanual.eyes.views import CHECK, VIEWS, chosen_views
from lerobot_env_bimanual.robot_scene import CAMERA, RobotScene
from lerobot_env_bimanual.start import Start
from tpgmm_torch import Robot
from tpgmm_torch.exceptions import DataError, ShapeError

#: Standard deviations of the sensors at ``noise=1``: joints [rad], the objects' positions [m]
#: and orientations [rad].
NOISE_JOINTS = 2e-3
NOISE_POSE = np.array([1e-3] * 3 + [math.radians(0.5)] * 3)
#: The range in which an object is observed: position [m] and quaternion.
RANGE = np.array([5.0] * 3 + [1.0] * 4)


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of every task, as :class:`ControlledEnv` describes them."""

    fps: int = 100
    mode: str = "dynamic"
    episode_length: int | None = None
    pushes: bool = False
    noise: float = 0.0
    track: bool = False
    condition: str | Sequence[Disturbance] = NOMINAL
    cameras: str | Sequence[str] = ()
    camera_width: int = 640
    camera_height: int = 480
    observe_objects: bool = True
    render_mode: str | None = None
    render_width: int = 320
    render_height: int = 240


class ControlledEnv(StateEnv):
    """A robot under position control among objects.

    Actions, what is observed and what can go wrong are the same in all tasks; a task adds how
    an episode begins, what the hands do, what its path is and how it is judged.

    Parameters
    ----------
    robot : Robot
        Its joints are those of the scene, in that order.
    scene : RobotScene
        The simulated world.
    duration : float
        Of an episode that nothing delays [s].
    course : Course
        When what happens in the task.
    fps : int, default=100
        Actions per second; a divisor of 1000, at least 10.
    mode : {"dynamic", "kinematic"}, default="dynamic"
        ``"kinematic"`` puts the joints where the references are: no masses, no delay.
    episode_length : int, optional
        In actions; as many as ``duration`` takes by default.
    pushes : bool, default=False
        Whether a torque of 40 to 50 N m pushes a shoulder or an elbow for 0.1 to 0.3 s at a
        random moment: enough to move a free hand by 1 to 3 cm.
    noise : float, default=0
        Of the sensors, in multiples of standard deviations of 2 mrad for joints, and of 1 mm
        and 0.5 deg about each axis for the objects (once per episode, unless they are tracked).
    track : bool, default=False
        Observe the objects' present poses instead of their initial ones.
    condition : str or sequence of Disturbance, default="nominal"
        What goes wrong, as
        :func:`~lerobot_env_bimanual.disturbances.parse_condition` takes it:
        ``"stopped-3"``, ``"moved+pose-noise"``. Its moments are drawn from the seed; an episode
        becomes longer by the delay that it means.
    cameras : str or sequence of str, default=()
        Those of :data:`~lerobot_env_bimanual.eyes.views.VIEWS` whose pictures are observed, as
        ``pixels``: ``"front"``, ``"front,side"``. Objects then carry tags, of which what is
        simulated does not know.
    camera_width, camera_height : int, default=640, 480
        Of these pictures.
    observe_objects : bool, default=True
        Whether the objects' poses are observed; without them, a policy has to look.
    render_mode : {"rgb_array"}, optional
    render_width, render_height : int
        Of the picture that :meth:`render` gives.

    Attributes
    ----------
    joint_names : tuple of str
        The order of actions and of ``agent_pos``.
    eyes : Rig or None
        The cameras.

    Raises
    ------
    DataError
        If an option is not one of the above.
    """

    #: How data sets are recorded: what LeRobot calls the robot, if not as the environment does;
    #: what follows the names of joints; their units, empty to declare none.
    robot_type: ClassVar[str | None] = None
    suffix: ClassVar[str] = ""
    units: ClassVar[Sequence[str] | None] = None
    #: Where cameras are, by their names, and tags that stand still.
    views: ClassVar[Mapping[str, View]] = VIEWS
    checks: ClassVar[Mapping[str, Carrier]] = CHECK
    #: The tags of the objects, by their names.
    carriers: ClassVar[Mapping[str, Carrier]] = {}

    _start: Start
    _joints: Array
    _velocity: Array
    _reference: Array
    _queue: Array  # references that have not reached the motors yet

    def __init__(
        self,
        robot: Robot,
        scene: RobotScene,
        duration: float,
        course: Course,
        **options: Any,
    ) -> None:
        asked = Options(**options)
        self.disturbances = parse_condition(asked.condition)
        delay = sum(disturbance.delay for disturbance in self.disturbances)
        steps, fps = asked.episode_length, asked.fps
        steps = round((duration + delay) * fps) if steps is None else steps
        size = asked.render_width, asked.render_height
        super().__init__(fps, steps, CAMERA, asked.render_mode, *size)
        self.mode, self.pushes, self.noise = asked.mode, asked.pushes, asked.noise
        self.condition, self._course, self._scene = asked.condition, course, scene
        self._check_options()
        self.joint_names = robot.joint_names
        self._lower, self._upper = robot.lower.numpy(), robot.upper.numpy()
        self._stride = robot.velocity.numpy() / fps
        self.action_space = spaces.Box(
            self._lower.astype(np.float32), self._upper.astype(np.float32), dtype=np.float32
        )
        # pushes and noise can lead a little beyond the joints' ranges
        joints = spaces.Box(self._lower - 0.5, self._upper + 0.5, dtype=np.float64)
        reach = np.tile(RANGE, len(scene.objects))
        observed: dict[str, spaces.Space[Any]] = {"agent_pos": joints}
        self.observe_objects = asked.observe_objects
        if self.observe_objects:
            observed["environment_state"] = spaces.Box(-reach, reach, dtype=np.float64)
        observed["timestamp"] = spaces.Box(0.0, 3 * steps / fps, (1,), dtype=np.float64)
        self.eyes = None
        if views := chosen_views(asked.cameras):
            width, height = asked.camera_width, asked.camera_height
            picture = spaces.Box(0, 255, (height, width, 3), dtype=np.uint8)
            observed["pixels"] = spaces.Dict(dict.fromkeys(views, picture))
            self.eyes = self.rig(asked.cameras, (width, height))
        self.observation_space = spaces.Dict(observed)
        self._live = asked.track or any(part.live for part in self.disturbances)
        self._steps = steps  # no episode is going on

    @property
    def scene(self) -> RobotScene:
        """The simulated world."""
        return self._scene

    def rig(
        self, cameras: str | Sequence[str], size: tuple[int, int] = (640, 480), **options: Any
    ) -> Rig:
        """Cameras before the scene, and tags on its objects and beside the table.

        Parameters
        ----------
        cameras : str or sequence of str
            As the option.
        size : (int, int)
            Width and height of their pictures.
        **options
            Of :class:`~lerobot_env_bimanual.eyes.rig.Rig`: other ``carriers``,
            ``imperfections``.
        """
        usual: dict[str, Any] = {
            "carriers": {**self.checks, **self.carriers},
            "camera": usual_camera(*size),
        }
        views = {name: self.views[name] for name in chosen_views(cameras)}
        return Rig(self._scene, views, **usual | options)

    def cell_of_joints(self) -> dict[str, Any]:
        """Joints' entry of a cell file."""
        return {"joints": list(self.joint_names)}

    def close(self) -> None:
        """Free what the graphics library holds."""
        if self.eyes is not None:
            self.eyes.close()
        super().close()

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
        """Measure how well the episode goes, so far; the class describes each figure."""

    @abstractmethod
    def _successful(self, figures: Mapping[str, float]) -> bool:
        """Check whether the figures at the end are those of a success."""

    @abstractmethod
    def _begin(self, options: Mapping[str, Any]) -> Start:
        """Draw an episode, and set the scene."""

    @abstractmethod
    def _act(self, stopped: bool) -> None:
        """Whatever hands do by themselves, and the judge notes, after a tick."""

    @abstractmethod
    def _stands_usually(self, pose: Array) -> bool:
        """Check whether the task is meant for a first object that begins so."""

    @property
    def _first(self) -> Array:
        """Initial pose of the first object."""
        return self._start.poses[self._scene.names[0]]

    def _usual(self, step: Array) -> bool:
        """Check whether the task is meant for a first object displaced so at the start."""
        return self._stands_usually(displace_pose(self._first, step))

    def _displace(self, step: Array) -> None:
        """Put the first object where it stood at the start, displaced, unless it was taken."""
        first = self._scene.names[0]
        if not any(hold.thing == first for hold in self._scene.taken):
            self._scene.put(first, displace_pose(self._first, step))

    def _put_on_path(self, instant: float) -> None:
        """Continue the task at an instant of its nominal path, at rest."""
        raise NotImplementedError("no disturbance of this task puts the robot ahead")

    def _instant(self) -> float:
        """Return the instant of the nominal path at which the robot is [s]."""
        raise NotImplementedError("no disturbance of this task puts the robot ahead")

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode.

        Parameters
        ----------
        options : dict, optional
            Initial poses of objects, shape (7,), by their names; ``"joints"``: the start
            posture, shape (n_joints,). Other keys are for others, and ignored.

        Raises
        ------
        DataError
            If an option has another shape, is not finite, or is out of the joints' ranges.
        """
        super().reset(seed=seed)
        self._start = start = self._begin(options or {})
        self._picture, self._steps = None, 0
        self._time = self._free = 0.0  # [s], and without stops
        self._peaks: Array = np.zeros(2)
        self._rngs = generators(self.disturbances, self.np_random)
        self._drawn = tuple(
            part.draw(rng, self._course, self._usual)
            for part, rng in zip(self.disturbances, self._rngs, strict=True)
        )
        self._sag = sum(part.sag(len(self.joint_names)) for part in self._drawn)
        # of the pictures: whether there are some changes no other random number
        self._grain = np.random.default_rng(zlib.crc32(start.joints.tobytes()))
        self._returns = any(part.shove(-math.inf, math.inf) < 0 for part in self._drawn)
        self._past: list[tuple[float, Any]] = []
        self._shown = self._seen = self._perceive_objects(start.misperception.reshape(-1, 6))
        for part in self._drawn:
            if part.start():
                self._put_on_path(part.start())
        self._hold_still()
        return self._observation(), {"is_success": False}

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move for one period of the control.

        Parameters
        ----------
        action : array-like of shape (n_joints,)
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
        wanted = self._read_action(action)
        stopped = any(part.stops(self._time) for part in self._drawn)
        goal = self._reference if stopped else self._limit_reference(wanted)
        clipped = float(np.abs(wanted - goal).max())
        seconds = self._move(goal)
        # in whole milliseconds, so that no sum is rounded
        began, self._time = self._time, round(self._time + seconds, 3)
        self._free = round(self._free + (0.0 if stopped else seconds), 3)
        self._record(seconds, stopped)
        self._act(stopped)
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

    def _read_action(self, action: ArrayLike) -> Array:
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

    def _limit_reference(self, wanted: Array) -> Array:
        """Limit a reference to the joints' ranges, and to what they reach at their speed."""
        last = self._reference
        allowed = np.minimum(np.maximum(wanted, self._lower), self._upper)
        return last + np.minimum(np.maximum(allowed - last, -self._stride), self._stride)

    def _move(self, goal: Array) -> float:
        """Go towards a reference until the next tick; return how long that takes [s]."""
        last, usual, share = self._reference, 1000 // self.fps, 1.0
        for part, rng in zip(self._drawn, self._rngs, strict=True):
            share *= part.period(rng)
        n = max(1, round(usual * share))
        way = last + (goal - last) * np.minimum(np.arange(1, n + 1) / usual, 1.0)[:, None]
        self._reference = way[-1]
        if self.mode == "kinematic":
            self._scene.place(self._reference + self._sag, n / 1000)
            return n / 1000
        self._queue = np.concatenate((self._queue, way + self._sag))
        torques = self._start.torques(round(1000 * self._time), n) if self.pushes else None
        self._scene.follow(self._queue[: n + 1], torques)
        self._queue = self._queue[n:]
        return n / 1000

    def _record(self, seconds: float, stopped: bool) -> None:
        """Record how hard the robot moves; while it is stopped it is not judged."""
        joints = self._scene.joints
        velocity = (joints - self._joints) / seconds
        if not stopped:
            change = (velocity - self._velocity) / seconds
            peaks = np.abs(velocity).max(), np.abs(change).max()
            self._peaks = np.maximum(self._peaks, peaks)  # [rad/s, rad/s^2]
        self._joints, self._velocity = joints, velocity

    def _interfere(self, began: float) -> None:
        """Let others move the first object, and shove the robot."""
        for part in self._drawn:
            step = part.displacement(self._time)
            if step is not None:
                self._displace(step)
            seconds = part.shove(began, self._time)
            if seconds < 0:
                self._put_back(self._time + seconds)
            elif seconds > 0:
                self._put_on_path(self._instant() + seconds)
        if self._returns:
            self._past.append((self._time, self._take_snapshot()))

    def _take_snapshot(self) -> Any:
        """State that :meth:`_restore` needs."""
        return self._scene.snapshot()

    def _put_back(self, time: float) -> None:
        """Restore what the world was, at rest."""
        _, before = min(self._past, key=lambda entry: abs(entry[0] - time))
        self._restore(before)
        self._hold_still()

    def _restore(self, before: Any) -> None:
        """Let the world be what it was."""
        self._scene.restore(before)

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
            n = len(self._scene.objects)
            self._seen = self._perceive_objects(
                draw((n, 6)) if self.noise else np.zeros((n, 6))
            )
        shown = self._seen
        for part, rng in zip(self._drawn, self._rngs, strict=True):
            shown = part.observe(shown, self._shown, self._time, rng)
        self._shown = shown
        seen: Observation = {"agent_pos": joints, "timestamp": np.array([self._time])}
        if self.observe_objects:
            seen["environment_state"] = shown.copy()
        if self.eyes is not None:
            seen["pixels"] = self.eyes.pictures(self._grain)
        return seen

    def _perceive_objects(self, errors: Array) -> Array:
        """Observe the objects' poses with errors in standard deviations (n_objects, 6)."""
        poses = self._scene.objects
        if self.noise:
            poses = [
                np.clip(displace_pose(pose, self.noise * NOISE_POSE * error), -RANGE, RANGE)
                for pose, error in zip(poses, errors, strict=True)
            ]
        return np.concatenate(poses)

    def _simulation(self) -> tuple[Any, Any]:
        return self._scene.model, self._scene.data
