"""Starts of episodes of a robot that follows joint references."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np

from lerobot_env_bimanual.base import Array, finite_vector
from tpgmm_torch import Robot
from tpgmm_torch.exceptions import DataError

#: From a reference to the motors [ms]: a field bus and the cycles of some controllers.
DELAY = (1, 8)
#: A push's beginning, in a skill of 13 s, and length [s], and its torque [N m], which stays
#: below what the motors can give (50). It is meant for one of the strong joints of the arms.
PUSH_START, PUSH_LENGTH, PUSH_TORQUE = (0.5, 13.0), (0.1, 0.3), (40.0, 50.0)
PUSHED = ("shoulder_pitch", "shoulder_yaw", "arm_waist", "arm_shoulder", "elbow")


@dataclass(frozen=True)
class Start:
    """Start of an episode, drawn from its seed: always all of it, in the same order.

    Parameters
    ----------
    joints : ndarray of shape (n_joints,)
        Start posture [rad].
    poses : mapping of str to ndarray of shape (7,)
        The objects' initial positions [m] and orientations, unit quaternions.
    delay : int
        From a reference to the motors [ms].
    pushed : int
        The joint that is pushed.
    push_start, push_length : float
        [s]
    push_torque : float
        [N m]
    misperception : ndarray of shape (6 * n_objects,)
        Of the objects' initial positions and orientations, in standard deviations.
    mass : float
        Of the bottle [kg].
    slide : ndarray of shape (2,)
        How far the bottle slides [m] and turns [rad] in the hands while they close.
    """

    joints: Array
    poses: Mapping[str, Array]
    delay: int
    pushed: int
    push_start: float
    push_length: float
    push_torque: float
    misperception: Array
    mass: float = 1.0
    slide: Array = field(default_factory=lambda: np.zeros(2))

    @staticmethod
    def drawn(rng: np.random.Generator, robot: Robot, objects: int = 1) -> dict[str, Any]:
        """Delay, push and misperception, as fields."""
        names = robot.joint_names
        strong = [i for i, name in enumerate(names) if any(part in name for part in PUSHED)]
        return dict(
            delay=int(rng.integers(*DELAY, endpoint=True)),
            pushed=int(rng.choice(strong)),
            push_start=rng.uniform(*PUSH_START),
            push_length=rng.uniform(*PUSH_LENGTH),
            push_torque=float(rng.uniform(*PUSH_TORQUE) * rng.choice((-1, 1))),
            misperception=rng.standard_normal(6 * objects),
        )

    def given(self, options: Mapping[str, Any], robot: Robot) -> Self:
        """With the objects' poses, the posture or the slide that options name.

        Raises
        ------
        DataError
            If a value has another shape, is not finite, is no unit quaternion, or is out of the
            joints' ranges.
        """
        usual = {"joints": self.joints, "slide": self.slide, **self.poses}
        chosen = usual | {
            name: finite_vector(name, options[name], len(value))
            for name, value in usual.items()
            if name in options
        }
        joints, slide = chosen.pop("joints"), chosen.pop("slide")
        beyond = np.maximum(robot.lower.numpy() - joints, joints - robot.upper.numpy())
        if beyond.max() > 1e-6:
            joint = robot.joint_names[int(beyond.argmax())]
            raise DataError(f"{joint} is out of its range by {beyond.max():.3g} rad")
        for name, pose in chosen.items():
            if abs(np.linalg.norm(pose[3:]) - 1) > 1e-3:
                raise DataError(
                    f"{name} is x, y, z and a unit quaternion w, x, y, z; got {pose.tolist()}"
                )
        return replace(self, joints=joints, poses=chosen, slide=slide)

    def torques(self, start: int, steps: int) -> Array:
        """Return the push as torques (steps, n_joints) [N m], one for each millisecond."""
        torques = np.zeros((steps, len(self.joints)))
        first = round(1000 * self.push_start) - start
        last = first + round(1000 * self.push_length)
        torques[max(first, 0) : max(last, 0), self.pushed] = self.push_torque
        return torques
