"""Meta-World's hand as a robot: it moves along three axes, and opens.

Meta-World moves a hand in space and hides the arm behind it. Its "joints" are therefore the
place of the hand [m] and its opening: a gantry, on which everything runs that runs on robots.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpgmm_torch import Canonical, RelativePosition, Robot
from tpgmm_torch.operators import Operator
from tpgmm_torch.robots.urdf import UrdfJoint, write_urdf

#: Actions per second: five steps of 2.5 ms each.
FPS = 80
#: How far an action of 1 moves the hand's target [m].
ACTION_SCALE = 0.01
#: The order of ``agent_pos`` and of actions: where the hand is [m], and 0 closed to 1 open.
JOINTS = ("x", "y", "z", "gripper")
#: Where Meta-World's hand can be, in any task [m].
LOWER, UPPER = (-0.525, 0.348, -0.0525), (0.525, 1.025, 0.7)
#: The order of the poses in ``environment_state``.
FRAMES = ("object_1", "object_2", "goal")


def metaworld_robot() -> Robot:
    """Three prismatic joints that carry the link ``hand``, and the gripper beside them.

    Positions have the limits of all tasks: each has tighter ones, which the
    environment applies.
    """
    links = ("base", "along_x", "along_y", "hand")
    joints = [
        UrdfJoint(
            name, "prismatic", links[i], links[i + 1], np.eye(4), np.eye(3)[i],
            lower=LOWER[i], upper=UPPER[i], velocity=FPS * ACTION_SCALE,
        )
        for i, name in enumerate(JOINTS[:3])
    ]  # fmt: skip
    text = write_urdf("metaworld", links[0], joints)
    return Robot.from_urdf(text, ["hand"], joints=JOINTS, coordinates=JOINTS[3:])


def metaworld_operators(frames: Sequence[str] = FRAMES) -> list[Operator]:
    """List the hand as seen from each frame, and from the world with the gripper."""
    return [Canonical(), *(RelativePosition("hand", frame) for frame in frames)]


def displacement(
    reference: ArrayLike, target: ArrayLike, scale: float = ACTION_SCALE
) -> NDArray[np.float64]:
    """Compute the action that brings the hand's target to a reference, up to one step.

    Parameters
    ----------
    reference, target : array-like of shape (3,)
        Where the target shall be, and where it is [m].
    scale : float
        How far an action of 1 moves it [m].

    Returns
    -------
    ndarray of shape (3,)
        Between -1 and 1.
    """
    return np.clip((np.asarray(reference) - np.asarray(target)) / scale, -1.0, 1.0)


def effort(opening: float) -> float:
    """Meta-World's effort of the fingers, -1 (open) to 1 (closed), of a wanted opening."""
    return float(np.clip(1.0 - 2.0 * opening, -1.0, 1.0))


def opening(effort: float) -> float:
    """Invert :func:`effort`, 0 closed to 1 open."""
    return float((1.0 - np.clip(effort, -1.0, 1.0)) / 2.0)
