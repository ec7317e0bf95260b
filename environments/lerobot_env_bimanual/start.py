"""What differs between episodes of a robot that follows joint references."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tpgmm_torch import Robot
from tpgmm_torch.exceptions import DataError

__all__ = ["Start", "check_start"]

#: From a reference to the motors [ms]: a field bus and the cycles of some controllers.
DELAY = (1, 8)
#: A push's beginning, in a skill of 13 s, and length [s], and its torque [N m], which stays
#: below what the motors can give (50). It is meant for one of the strong joints of the arms.
PUSH_START, PUSH_LENGTH, PUSH_TORQUE = (0.5, 13.0), (0.1, 0.3), (40.0, 50.0)
PUSHED = ("shoulder_pitch", "shoulder_yaw", "arm_waist", "arm_shoulder", "elbow")


@dataclass(frozen=True)
class Start:
    """What an episode draws from its seed: always all of it, in the same order.

    Parameters
    ----------
    joints : ndarray of shape (n_joints,)
        Start posture [rad].
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
    """

    joints: NDArray[np.float64]
    delay: int
    pushed: int
    push_start: float
    push_length: float
    push_torque: float
    misperception: NDArray[np.float64]

    @staticmethod
    def drawn(rng: np.random.Generator, robot: Robot, objects: int = 1) -> dict[str, Any]:
        """All but the posture."""
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

    def torques(self, start: int, steps: int) -> NDArray[np.float64]:
        """The push, as torques (steps, n_joints) [N m], one for each millisecond."""
        torques = np.zeros((steps, len(self.joints)))
        first = round(1000 * self.push_start) - start
        last = first + round(1000 * self.push_length)
        torques[max(first, 0) : max(last, 0), self.pushed] = self.push_torque
        return torques


def check_start(name: str, values: NDArray[np.float64], robot: Robot) -> None:
    """Refuse a pose without a unit quaternion, and joints out of their ranges.

    Parameters
    ----------
    name : str
        ``"joints"``, or an object's.
    values : ndarray
        Shape (n_joints,) [rad], or (7,).

    Raises
    ------
    DataError
    """
    if name == "joints":
        beyond = np.maximum(robot.lower.numpy() - values, values - robot.upper.numpy())
        if beyond.max() > 1e-6:
            joint = robot.joint_names[int(beyond.argmax())]
            raise DataError(f"{joint} is out of its range by {beyond.max():.3g} rad")
    elif abs(np.linalg.norm(values[3:]) - 1) > 1e-3:
        raise DataError(
            f"{name} is x, y, z and a unit quaternion w, x, y, z; got {values.tolist()}"
        )
