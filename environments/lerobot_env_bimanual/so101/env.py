"""Cup on saucer: two SO-101 arms as a gymnasium environment, in LeRobot's units."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from lerobot_env_bimanual.base import Array, Observation
from lerobot_env_bimanual.bottle.measures import Figure, successful
from lerobot_env_bimanual.controlled import ControlledEnv
from lerobot_env_bimanual.disturbances import Course
from lerobot_env_bimanual.eyes.carriers import Carrier, cube_at
from lerobot_env_bimanual.eyes.views import around
from lerobot_env_bimanual.so101 import N_JOINTS, TASKS
from lerobot_env_bimanual.so101.kinematics import Reach
from lerobot_env_bimanual.so101.robot import SIDES, hand_of
from lerobot_env_bimanual.so101.scene import (
    CARRIERS,
    CUBE,
    GRIP,
    LEFT,
    LEFT_UP,
    RIGHT,
    RIGHT_UP,
    TAG,
    BiSo101Scene,
    in_left_hand,
)
from lerobot_env_bimanual.start import Start
from lerobot_env_bimanual.suite.task import Box
from tpgmm_datasets.robots import bi_so101_urdf, parse_robot
from tpgmm_torch.exceptions import UnknownNameError

#: What a success needs.
FIGURES = {
    "place_mm": Figure("from the saucer's middle [mm]", 1, high=15.0),
    "lean_deg": Figure("lean [deg]", 1, high=10.0),
    "standing": Figure("stands on it", 0, 1.0, 1.0),
    "away_mm": Figure("right hand from the stem [mm]", low=20.0),
}
#: Standard deviation of the joints' offsets [rad].
OFFSET = math.radians(1.0)
#: Where the cup stands, and where the saucer is held at first [m, deg].
CUP_BOX = Box((0.26, -0.15, 0.0), (0.31, -0.08, 0.0), 30.0)
SAUCER_BOX = Box((0.24, 0.09, 0.12), (0.29, 0.14, 0.15), 0.0)
#: Where the right hand waits: the place of the grip [m].
RIGHT_BOX = Box((0.19, -0.22, 0.14), (0.23, -0.16, 0.18), 0.0)
#: How the saucer lies in the left hand differs by so much [m, rad].
HELD_ASIDE, HELD_TURN = 0.004, math.radians(5.0)
#: Postures from which inverse kinematics begins [rad]: the elbow is up.
SEEDS = {"left": (0.3, 0.0, 0.6, 0.0, 0.0), "right": (-0.3, 0.0, 0.6, 0.3, 1.57)}
#: Where the grippers are among the joints.
GRIPPERS = [5, 11]
#: An open gripper, of 100.
OPEN = 40.0
#: How long an episode takes [s], and when what happens in it.
DURATION, COURSE = 17.0, Course(grasp=4.0, latest=9.0, end=11.5)
#: Cameras at the distance at which a person sets them up before such arms, and a cube of tags
#: beside the left arm, by which one that was moved is noticed.
CENTRE = (0.20, 0.0, 0.11)
VIEWS = {"front": around(CENTRE, 0.7, 0.0, 40.0), "side": around(CENTRE, 0.7, -50.0, 40.0)}
CHECKS = {"world": cube_at(0, 0.08, 0.35, 0.05)}

#: The first number of the cube of tags in each gripper, and where cup and saucer are put
#: meanwhile [m].
IN_HAND = {"left": 30, "right": 40}
AWAY = {"cup": (0.5, 0.45, 0.0), "saucer": (0.5, -0.45, 0.03)}


class BiSo101Env(ControlledEnv):
    """Two SO-101 arms that put a cup on a saucer.

    The left gripper holds a saucer from the beginning, and brings it before the robot; the
    right one takes the cup by its stem and puts it on the saucer. Joints are observed and
    commanded as LeRobot's ``bi_so_follower`` does: arms in degrees, grippers from 0 to 100.

    The servos are those of a hobby robot. Gravity bends them: up to 2 degrees in each joint of
    a stretched arm. Behind each motor there are 0.4 degrees of play, which its encoder does
    not measure. What it measures is off by an offset of 1 degree (standard deviation), which
    belongs to the pair of arms and not to the episode.

    At the end of an episode ``info`` holds ``place_mm``, how far the cup is from the middle of
    the saucer; ``lean_deg``, its angle with the vertical; ``standing``, whether it is free and
    touches the saucer; ``away_mm``, how far the open right gripper has left the stem; and
    ``is_success``: at most 15 mm and 10 degrees, standing, at least 20 mm away.

    Parameters
    ----------
    task : str, default="cup_on_saucer"
    specimen : int, default=0
        Which pair of arms: the seed of the joints' offsets.
    **options
        Those of :class:`~lerobot_env_bimanual.controlled.ControlledEnv`, but for ``mode`` and
        ``track``. Cameras are ``"front"`` and ``"side"``, at 0.7 m.

    Attributes
    ----------
    offsets : ndarray of shape (12,)
        Added to measured joints they are those of the robot's description [rad].

    Raises
    ------
    DataError, UnknownNameError
        If an option is not one of the above.
    """

    views: ClassVar = VIEWS
    checks: ClassVar = CHECKS
    carriers: ClassVar = CARRIERS
    units: ClassVar = ()
    suffix: ClassVar = ".pos"
    robot_type: ClassVar = "bi_so_follower"
    _scene: BiSo101Scene

    def __init__(
        self, task: str = "cup_on_saucer", *, specimen: int = 0, fps: int = 25, **options: Any
    ) -> None:
        if task not in TASKS:
            raise UnknownNameError("task", task, "the SO-101 arms", TASKS)
        self.model = parse_robot(bi_so101_urdf())
        self.offsets = OFFSET * np.random.default_rng(specimen).standard_normal(N_JOINTS)
        self.offsets[GRIPPERS] = 0.0
        low, high = self.model.lower.numpy(), self.model.upper.numpy()
        # radians = factor * stored + zero
        self._factor, self._zero = np.full(N_JOINTS, math.pi / 180), self.offsets.copy()
        self._factor[GRIPPERS] = (high - low)[GRIPPERS] / 100
        self._zero[GRIPPERS] = low[GRIPPERS]
        super().__init__(
            self.model, BiSo101Scene(), DURATION, COURSE, fps=fps, track=True, **options
        )
        self.task, self.task_description = task, "put the cup on the saucer"
        self._reach = {side: Reach(self._scene, side) for side in SIDES}
        bounds = self.in_stored_units(low), self.in_stored_units(high)
        self.action_space = spaces.Box(
            *(b.astype(np.float32) for b in bounds), dtype=np.float32
        )
        self.observation_space["agent_pos"] = spaces.Box(
            bounds[0] - 30.0, bounds[1] + 30.0, dtype=np.float64
        )

    @property
    def scene(self) -> BiSo101Scene:
        """The simulated world, which an expert sees."""
        return self._scene

    def take_cubes(self) -> dict[str, Carrier]:
        """Put cup and saucer away, and take a cube of tags in each gripper.

        Returns
        -------
        dict of str to Carrier
            The cubes by the links that they are at.
        """
        self._scene.let_go(LEFT)
        for name, place in AWAY.items():
            self._scene.put(name, np.array((*place, 1.0, 0.0, 0.0, 0.0)))
        return {hand_of(side): cube_at(IN_HAND[side], z=CUBE, size=TAG) for side in SIDES}

    def in_stored_units(self, joints: Array) -> Array:
        """In LeRobot's units, as encoders measure them, what are true joints [rad]."""
        return np.asarray((joints - self._zero) / self._factor)

    def cell_of_joints(self) -> dict[str, Any]:
        """Joints' entry of a cell file, with the true offsets."""
        pairs = zip(self.joint_names, self.offsets.tolist(), strict=True)
        offsets = {name: offset for name, offset in pairs if offset}
        return {**super().cell_of_joints(), "joint_offsets": offsets}

    def figures(self) -> dict[str, float]:
        """Measure how well the episode goes, so far."""
        scene = self._scene
        saucer, cup = scene.data.body("saucer"), scene.data.body("cup")
        away = saucer.xmat.reshape(3, 3).T @ (cup.xpos - saucer.xpos)
        lean = math.degrees(math.acos(min(1.0, max(-1.0, float(cup.xmat[8])))))
        touches = bool(np.abs(scene.force("saucer", "cup")).max() > 0)
        return {
            "place_mm": 1e3 * math.hypot(away[0], away[1]),
            "lean_deg": lean,
            "standing": float(touches and RIGHT not in scene.held),
            "away_mm": 1e3 * max(scene.gap(RIGHT), 0.0),
        }

    def _successful(self, figures: Mapping[str, float]) -> bool:
        return successful(figures, FIGURES)

    def _begin(self, options: Mapping[str, Any]) -> Start:
        rng = self.np_random
        cup, saucer, grip = (box.draw(rng) for box in (CUP_BOX, SAUCER_BOX, RIGHT_BOX))
        held = in_left_hand(*rng.uniform(-1, 1, 2) * (HELD_ASIDE, HELD_TURN))
        left = self._reach["left"](SEEDS["left"], saucer[:3], held[:3], LEFT_UP)
        right = self._reach["right"](SEEDS["right"], grip[:3], GRIP, RIGHT_UP)
        joints = np.concatenate((left, [0.0], right, [0.0]))
        joints[GRIPPERS] = self._zero[GRIPPERS] + self._factor[GRIPPERS] * (0.0, OPEN)
        drawn = Start.drawn(rng, self.model, 2)
        start = Start(joints=joints, poses={"cup": cup}, **drawn).given(options, self.model)
        self._scene.reset({**start.poses, "saucer": held}, start.joints)
        return start

    def _hold_still(self) -> None:
        """Be at rest, with references that hold the arms up where they are."""
        super()._hold_still()
        self._reference = np.array(self._scene.data.ctrl)
        self._queue = np.tile(self._reference, (self._start.delay + 1, 1))

    def _read_action(self, action: ArrayLike) -> Array:
        return super()._read_action(action) * self._factor + self._zero

    def _observation(self) -> Observation:
        observation = super()._observation()
        return {**observation, "agent_pos": self.in_stored_units(observation["agent_pos"])}

    def _act(self, stopped: bool) -> None:
        self._scene.grip()

    def _stands_usually(self, pose: Array) -> bool:
        return CUP_BOX.contains(pose)
