"""Who shows how to put a cup on a saucer: a person who teleoperates both arms.

The person sees where hands and things truly are, and corrects what servos, play and offsets
make of it. What a robot records is not that: what its encoders measured, what was commanded.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import mujoco
import numpy as np
import torch

from lerobot_env_bimanual.base import Array
from lerobot_env_bimanual.so101.env import OPEN, BiSo101Env
from lerobot_env_bimanual.so101.kinematics import ARM, Reach
from lerobot_env_bimanual.so101.scene import (
    GRIP,
    RIGHT_UP,
    SAUCER_TOP,
    STEM,
    BiSo101Scene,
)
from tpgmm_torch.motion.minimum_jerk import minimum_jerk

#: Nominal seconds of the phases, which differ by up to a share.
PHASES = {
    "reach": 2.2, "approach": 1.2, "close": 1.4, "lift": 1.0, "bring": 2.2, "hover": 0.4,
    "lower": 1.6, "open": 1.4, "leave": 1.2, "rest": 0.8,
}  # fmt: skip
STRETCH = 0.2
#: While the right hand does these, the left one brings the saucer.
BRINGING = ("approach", "close", "lift")
#: Where it brings it, and by how much that differs [m].
MEETING, MEETING_SPREAD = (0.245, 0.0, 0.085), (0.015, 0.02, 0.015)
#: How far behind the stem the right hand waits, how high the cup is lifted, and how high above
#: the saucer it is brought [m].
BEHIND, LIFT, ABOVE = 0.06, 0.09, 0.05
#: How far from the stem the fixed jaw is brought, before it is moved beside it [m].
CLEAR = 0.01
#: Standard deviation of how far ways through free space bend aside [m].
BOW = 0.01
#: How much of what a joint is off its place is corrected in a second, and at most [rad].
INTEGRAL, LARGEST = 3.0, math.radians(8.0)


def teleoperate(env: BiSo101Env, rng: np.random.Generator) -> Iterator[Array]:
    """Give the actions of one demonstration.

    Parameters
    ----------
    env : BiSo101Env
        In which an episode has begun, and which takes each action before the next is asked for.
    rng : Generator
        Of what differs between demonstrations.

    Yields
    ------
    ndarray of shape (12,)
        In the units of the environment.
    """
    scene = env.scene
    lengths = rng.uniform(1 - STRETCH, 1 + STRETCH, len(PHASES)) * list(PHASES.values())
    meeting = MEETING + rng.uniform(-1, 1, 3) * MEETING_SPREAD
    bow = BOW * rng.standard_normal((2, 3))
    left, right = _Arm(scene, "left"), _Arm(scene, "right")
    carried, brought = left.point(scene.pose("saucer")), scene.pose("saucer")[:3]
    bringing = dict(zip(PHASES, lengths, strict=True))
    total, spent = sum(bringing[phase] for phase in BRINGING), 0.0
    gripper = OPEN
    for phase, seconds in bringing.items():
        ticks = max(1, round(seconds * env.fps))
        stem = _above(scene.pose("cup"), STEM)
        heading = right.heading(stem)
        point = (np.array(GRIP), np.array(RIGHT_UP))
        if phase in ("lift", "bring", "hover", "lower"):
            point = right.point(scene.pose("cup"))
        begin = right.place(point[0])
        aside = CLEAR * np.cross(heading, (0.0, 0.0, 1.0))
        for tick in range(1, ticks + 1):
            share = tick / ticks
            saucer = scene.pose("saucer")[:3]
            goal = {
                "reach": stem - BEHIND * heading + aside,
                "approach": stem + aside,
                "close": stem,
                "lift": _above(begin, LIFT),
                "bring": _above(saucer, ABOVE),
                "hover": _above(saucer, ABOVE),
                "lower": _above(saucer, SAUCER_TOP),
                "open": begin + aside,
                "leave": begin - BEHIND * heading,
            }.get(phase)
            # beside the stem before the jaws close, away from it when they have opened
            first, second = min(1.0, 2 * share), max(0.0, 2 * share - 1)
            if goal is not None:
                done = {"close": first, "open": second}.get(phase, share)
                way = begin + _jerk(done) * (goal - begin)
                if phase in ("reach", "bring"):
                    way += bow[int(phase == "bring")] * math.sin(math.pi * _jerk(share)) ** 2
                right.move(way, *point)
            if phase in ("close", "open"):
                gripper = OPEN * (_jerk(first) if phase == "open" else 1 - _jerk(second))
            if phase in BRINGING:
                spent += 1 / env.fps
                done = _jerk(min(1.0, spent / total))
                left.move(brought + done * (meeting - brought), *carried)
            joints = np.concatenate((left.command(env), [0.0], right.command(env), [0.0]))
            action = env.in_stored_units(joints)
            action[ARM], action[-1] = 0.0, gripper
            yield action


def _above(pose: Array, height: float) -> Array:
    """Return a place (3,) so far above that of a pose."""
    return np.asarray(pose[:3] + np.array((0.0, 0.0, height)))


def _jerk(share: float) -> float:
    """Minimum jerk from 0 to 1."""
    return float(minimum_jerk(torch.tensor(share, dtype=torch.float64)))


class _Arm:
    """One arm, its gripper left out, as the person sees and moves it."""

    def __init__(self, scene: BiSo101Scene, side: str) -> None:
        self._scene, self._reach = scene, Reach(scene, side)
        first = 0 if side == "left" else ARM + 1
        self._rows = slice(first, first + ARM)
        self._wanted = scene.angles[self._rows]  # where the links should be
        self._correction = scene.data.ctrl[self._rows] - self._wanted

    def place(self, point: Array) -> Array:
        """Return where a point of the hand should be now."""
        position, axes = self._reach.pose(self._wanted)
        return np.asarray(position + axes @ point)

    def point(self, pose: Array) -> tuple[Array, Array]:
        """Origin and z axis, in the hand as it is, of a thing that it holds, (7,)."""
        position, axes = self._reach.pose(self._scene.angles[self._rows])
        upright = np.zeros(3)
        mujoco.mju_rotVecQuat(upright, np.array((0.0, 0.0, 1.0)), pose[3:])
        return axes.T @ (pose[:3] - position), axes.T @ upright

    def heading(self, target: Array) -> Array:
        """Find the level direction in which the hand points when it grips at a target."""
        joints = self._reach(self._wanted, target, GRIP, RIGHT_UP)
        ahead = self._reach.pose(joints)[1][:, 2] * (1.0, 1.0, 0.0)
        return np.asarray(ahead / np.linalg.norm(ahead))

    def move(self, target: Array, point: Array, up: Array) -> None:
        """Want a point of the hand at a target, and an axis of it vertical."""
        self._wanted = self._reach(self._wanted, target, point, up)

    def command(self, env: BiSo101Env) -> Array:
        """References that bring the links to where they should be [rad]."""
        off = self._wanted - self._scene.angles[self._rows]
        corrected = self._correction + INTEGRAL / env.fps * off
        self._correction = np.clip(corrected, -LARGEST, LARGEST)
        return self._wanted + self._correction
