"""The tasks of the suite as gymnasium environments."""

from __future__ import annotations

import copy
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from lerobot_env_bimanual.base import Array, Observation
from lerobot_env_bimanual.bottle.measures import Closing, successful
from lerobot_env_bimanual.controlled import ControlledEnv
from lerobot_env_bimanual.disturbances import (
    CONDITIONS,
    NOMINAL,
    Course,
    Displaced,
    Disturbance,
    Spoilt,
    StartedMidway,
    parse_condition,
)
from lerobot_env_bimanual.robot_scene import Hold, RobotScene, add_table
from lerobot_env_bimanual.start import Start
from lerobot_env_bimanual.suite.names import UPPER_BODY
from lerobot_env_bimanual.suite.tasks import suite_task
from tpgmm_datasets.bottle.skill import HANDS
from tpgmm_torch.exceptions import DataError

__all__ = ["SuiteEnv"]

#: A grip gives way at this force [N].
GRIP_FORCE = 100.0
#: A palm that is so near to what it shall hold, and comes no nearer, takes hold of it [m].
REACH = 0.015
#: Observed wrenches and their hands, what sensors measure at most, and the standard deviations
#: of their noise at ``noise=1`` [N, N m].
WRENCHES = {f"wrench.{hand}": hand for hand in HANDS}
FORCES = np.array([300.0] * 3 + [30.0] * 3)
NOISE_WRENCH = np.array([0.15] * 3 + [0.0075] * 3)
#: How high a thing is lifted when it slips out of a hand [m].
SLIPS = 0.02


def _skips(part: Disturbance) -> bool:
    """Check whether a part of the task would not be done."""
    return isinstance(part, StartedMidway) or (isinstance(part, Displaced) and part.seconds > 0)


#: What a comparison runs through.
SUITE_CONDITIONS = tuple(
    name for name in CONDITIONS if not any(map(_skips, parse_condition(name)))
)


class SuiteEnv(ControlledEnv):
    """A robot at a table, and a task for both hands.

    Control and actions are those of
    :class:`~lerobot_env_bimanual.bottle.shaking.BottleShakingEnv`.
    ``observation.environment_state`` has the present poses of the objects of the task, held or
    not. A hand takes hold of what it may hold when its palm is within 15 mm of it and comes no
    nearer for 0.2 s, as it then lies in it; whoever arrives early or late is waited for. The
    task says when hands open; a grip gives way at 100 N. At the end of an episode ``info``
    holds the figures of the task, ``peak_speed``, ``peak_acceleration`` and ``is_success``.

    Parameters
    ----------
    task : str
        ``handover``, ``lid``, ``peg_in_hole``, ``pour``, ``wipe``; ``pick_place``, of which
        the conditions ``slips`` and ``knocked`` spoil the first grasp; or ``shelf``, the same
        with a shelf between the upper body's arms.
    robot : str, default="upper_body"
        The 17-joint ``upper_body``; ``viperx``, gym-aloha's two arms of 6 joints; or ``g1``,
        waist and arms of a Unitree G1, 17 joints.
    force : bool, default=False
        Whether what hands exert by contact is observed, as ``wrench.l_hand`` and
        ``wrench.r_hand``: forces [N] and moments [N m] at their origins, in the base frame;
        with an error of 0.15 N and 7.5 mN m in multiples of ``noise``.
    **options
        Those of :class:`~lerobot_env_bimanual.controlled.ControlledEnv`, but for ``mode`` and
        ``track``; an episode takes as long as the slowest demonstration and a second by
        default. Nobody puts the robot ahead in its task.

    Raises
    ------
    DataError, UnknownNameError
        If an option is not one of the above.
    DependencyError
        Without gym-aloha, where its arms are asked for, or example-robot-data for ``g1``.
    """

    _scene: RobotScene

    def __init__(
        self, task: str, robot: str = UPPER_BODY, *, force: bool = False, **options: Any
    ) -> None:
        self.force = force
        self._task = suite_task(task, robot)
        self.carriers = self._task.carriers  # type: ignore[misc]
        condition = options.get("condition", NOMINAL)
        if any(map(_skips, parse_condition(condition))):
            raise DataError(
                f"condition {condition!r} skips a part of the task, which {task} does not "
                "offer: what its hands and its judge would have done meanwhile is not known"
            )
        spec = self._task.embodiment.spec()
        add_table(spec, 0.7)
        self._task.furnish(spec)
        ends = self._task.ends()
        *_, last, _ = ends.values()
        super().__init__(
            self._task.robot,
            RobotScene(spec, self._task.objects, self._task.holds),
            self._task.duration,
            Course(grasp=ends[self._task.grasp], latest=last, end=last),
            mode="dynamic",
            track=True,
            **options,
        )
        if force:
            every = dict.fromkeys(WRENCHES, spaces.Box(-FORCES, FORCES, dtype=np.float64))
            self.observation_space = spaces.Dict({**self.observation_space.spaces, **every})
        self.robot, self.task, self.task_description = robot, task, self._task.description

    def _observation(self) -> Observation:
        seen = super()._observation()
        for key, hand in WRENCHES.items() if self.force else ():
            error = self.noise * NOISE_WRENCH * self._felt.standard_normal(6)
            seen[key] = np.clip(self._scene.wrench(hand) + error, -FORCES, FORCES)
        return seen

    def figures(self) -> dict[str, float]:
        """Measure how well the episode goes, so far; the task describes each figure."""
        return self._judge.figures(self._scene)

    def _successful(self, figures: Mapping[str, float]) -> bool:
        return successful(figures, self._task.figures)

    def _begin(self, options: Mapping[str, Any]) -> Start:
        task, rng = self._task, self.np_random
        start = Start(
            poses=task.draw(rng),
            joints=task.start_posture(rng),
            **Start.drawn(rng, task.robot, len(task.objects)),
        ).given(options, task.robot)
        first = start.poses[task.objects[0]]
        self._scene.reset(start.poses, start.joints, float(first[2]) - task.foot)
        self._judge, self._noted, self._spoilt = task.judge(), 0.0, False
        # whether forces are observed changes no other random number
        self._felt = np.random.default_rng(zlib.crc32(start.joints.tobytes()) + 1)
        self._watch_hands()
        return start

    def _watch_hands(self) -> None:
        self._closing = {hold: Closing(reach=REACH) for hold in self._task.holds}

    def _act(self, stopped: bool) -> None:
        scene = self._scene
        if not stopped:
            for hold, closing in tuple(self._closing.items()):
                gap = scene.gap(hold)
                if closing.reach < 0 and gap > 2 * REACH:  # it has gone away after it failed
                    self._closing[hold] = Closing(reach=REACH)
                elif hold not in scene.taken and closing.update(self._free, gap):
                    scene.hold(hold)
                self._spoil(hold)
            self._judge.note(scene, self._free - self._noted)
            self._noted = self._free
            for hold in self._judge.lets_go(scene):
                scene.let_go(hold)
        for hold in tuple(scene.held):
            if scene.pull(hold) > GRIP_FORCE:
                scene.let_go(hold)

    def _spoil(self, hold: Hold) -> None:
        """Let the first grasp fail, if that goes wrong in this episode."""
        scene, first = self._scene, self._task.objects[0]
        for part in self._drawn:
            if self._spoilt or hold not in scene.held or not isinstance(part, Spoilt):
                continue
            lifted = scene.pose(first)[2] - self._first[2] > SLIPS
            if hold.thing == first and (lifted or part.step is not None):
                self._spoilt, self._closing[hold] = True, Closing(reach=-1.0)
                scene.let_go(hold)
                scene.taken.discard(hold)
                if part.step is not None:
                    self._displace(part.step)

    def _stands_usually(self, pose: Array) -> bool:
        return self._task.usual(pose)

    def _take_snapshot(self) -> Any:
        return self._scene.snapshot(), copy.deepcopy(self._judge)

    def _restore(self, before: Any) -> None:
        snapshot, judge = before
        self._scene.restore(snapshot)
        self._judge = copy.deepcopy(judge)
        self._watch_hands()
