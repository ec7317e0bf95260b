"""A hand on three slides that wipes a board: demonstrations with wrenches, and a spring."""

from collections.abc import Sequence

import numpy as np

from tpgmm_torch import (
    Canonical,
    Demonstration,
    Frame,
    RelativePosition,
    Robot,
    TaskParameterizedGMM,
)
from tpgmm_torch.operators import Wrench

#: Press [N], friction, stiffness of the board [N/m], and when it is touched [s].
PRESS, FRICTION, STIFFNESS, TOUCH, LEAVE, END = 8.0, 0.3, 4000.0, 1.5, 4.5, 6.0


def slides() -> Robot:
    """x, y and z, with a hand at their end."""
    joints, parent = "", "base"
    for axis, way in zip("xyz", ("1 0 0", "0 1 0", "0 0 1"), strict=True):
        child = "hand" if axis == "z" else f"at_{axis}"
        joints += (
            f'<link name="{child}"/><joint name="{axis}" type="prismatic">'
            f'<parent link="{parent}"/><child link="{child}"/><axis xyz="{way}"/>'
            '<limit lower="-2" upper="2" velocity="2" effort="100"/></joint>'
        )
        parent = child
    return Robot.from_urdf(
        f'<robot name="slides"><link name="base"/>{joints}</robot>', ["hand"]
    )


def board(height: float = 0.3, x: float = 0.4) -> Frame:
    """Half a turn about z, so that its x axis is opposite to that of the base."""
    return Frame([x, 0.0, height], [0.0, 0.0, 0.0, 1.0])


def wipe(height: float, x: float, rate: int = 50) -> Demonstration:
    """Down onto the board, along it by 0.2 m, and up again; force along z without work."""
    time = np.arange(0, END, 1 / rate)
    along = 0.2 * np.clip((time - TOUCH) / (LEAVE - TOUCH), 0, 1)
    above = 0.1 * np.clip(np.maximum(TOUCH - time, time - LEAVE) / TOUCH, 0, 1)
    touches = (time >= TOUCH) & (time < LEAVE)
    joints = np.stack((x - along, 0.01 * np.sin(time), height + above), -1)
    wrench = np.zeros((len(time), 6))
    wrench[touches, 0], wrench[touches, 2] = -FRICTION * PRESS, -PRESS
    return Demonstration(
        time, joints, {"board": board(height, x)}, "xyz", wrenches={"hand": wrench}
    )


def wipes() -> list[Demonstration]:
    """Three, on boards at other heights."""
    return [wipe(height, x) for height, x in ((0.3, 0.4), (0.35, 0.45), (0.25, 0.5))]


def wiping(operators: Sequence[Wrench] = (Wrench("hand", "board"),)) -> TaskParameterizedGMM:
    """A model of them, of joints, the hand on the board, and forces."""
    own = Canonical(tolerance=0.05), RelativePosition("hand", "board")
    model = TaskParameterizedGMM(
        15, [*own, *operators], slides(), random_state=0, reg_covar=1e-4
    )
    return model.fit(wipes())
