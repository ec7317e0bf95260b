"""The simulated upper body, its lifting table and the bottle, in MuJoCo.

Palms and bottle are so dimensioned that the palms just touch the bottle at the grasp poses of
:mod:`tpgmm_datasets.bottle.skill`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import mujoco
import numpy as np

from lerobot_env_bimanual.base import Array
from lerobot_env_bimanual.eyes.carriers import CUBE_ROOM, cube_at, flat_at
from lerobot_env_bimanual.robot_scene import (
    BOX,
    CYLINDER,
    PALM,
    TABLE,
    TIMESTEP,
    Hold,
    RobotScene,
    add_geom,
    add_table,
    add_thing,
    robot_spec,
)
from tpgmm_datasets.bottle.skill import FOOT, GRASP_POINT, HANDS

#: Height of the cap's top above the bottle's origin [m], on which a cube of tags stands; a tag
#: lies before the tray.
CAP = FOOT + 0.062
CARRIERS = {"bottle": cube_at(10, z=CAP + CUBE_ROOM), "tray": flat_at(20, 0.13, 0.001)}
#: Where the table stands once it has sunk [m], and how fast it sinks [m/s]: the chest, to which
#: the bottle is brought, is lower than some of the places where it stood.
TABLE_LOW, TABLE_SPEED = -0.08, 0.2
#: Both hands hold it.
HOLDS = tuple(Hold(hand, "bottle", "bottle") for hand in HANDS)


def bottle_spec(tray: bool = False) -> mujoco.MjSpec:
    """Specification of the model.

    Parameters
    ----------
    tray : bool, default=False
        Whether there is a flat tray, a body ``tray``, that nothing collides with.

    Returns
    -------
    mujoco.MjSpec
        The robot's joints in the URDF's order with a position actuator each, then the bottle's
        free joint; bodies ``bottle`` and ``table``; geoms ``bottle``, ``l_palm`` and
        ``r_palm``.
    """
    spec = robot_spec()
    add_table(spec, 0.6)
    _add_bottle(spec, abs(GRASP_POINT[HANDS[0]][1]) - float(spec.geom("l_palm").size[1]))
    if tray:
        add_geom(
            add_thing(spec, "tray", free=False),
            BOX,
            (0.09, 0.09, 0.001),
            rgba=(0.2, 0.6, 0.3, 1),
        )
    return spec


def _add_bottle(spec: Any, radius: float) -> None:
    bottle = add_thing(spec, "bottle")
    bottle.add_geom(
        name="bottle", type=CYLINDER, size=(radius, FOOT, 0), mass=1.0, contype=0,
        rgba=(0.3, 0.6, 0.9, 1),
    )  # fmt: skip
    for size, height in (((0.025, 0.02, 0), FOOT + 0.02), ((0.03, 0.012, 0), FOOT + 0.05)):
        add_geom(bottle, CYLINDER, size, mass=0, pos=(0, 0, height))


class BottleScene(RobotScene):
    """The state of the simulated world, and what can happen in it.

    Parameters
    ----------
    spec : mujoco.MjSpec, optional
        That of :func:`bottle_spec`, with more in it.
    names : sequence of str
        What is observed.
    """

    softness: ClassVar = (0.02, 1.0)

    def __init__(
        self, spec: mujoco.MjSpec | None = None, names: Sequence[str] = ("bottle",)
    ) -> None:
        super().__init__(bottle_spec() if spec is None else spec, names, HOLDS)
        model = self.model
        self._bottle, self._table = model.body("bottle").id, model.body("table").id
        self._surface = model.geom("bottle").id
        self._unit_inertia = model.body_inertia[self._bottle].copy()  # of 1 kg

    @property
    def bottle(self) -> Array:
        """The bottle's position [m] and orientation, a unit quaternion; shape (7,)."""
        return self.data.qpos[self._n :].copy()

    @property
    def objects(self) -> list[Array]:
        """The poses of what is observed, shape (7,) each."""
        return [self.bottle, *map(self.pose, self.names[1:])]

    def reset(
        self, poses: Mapping[str, Array], joints: Array, table: float, mass: float = 1.0
    ) -> None:
        """Stand still, the bottle of a mass [kg] on the table."""
        self.model.body_mass[self._bottle] = mass
        self.model.body_inertia[self._bottle] = mass * self._unit_inertia
        mujoco.mj_setConst(self.model, self.data)
        self.model.geom_conaffinity[self._surface] = TABLE | PALM
        super().reset(poses, joints, table)

    def follow(self, references: Array, torques: Array | None = None) -> None:
        """Simulate position control, as :meth:`RobotScene.follow` says; the table sinks."""
        super().follow(references, torques)
        if self.held:
            self._sink((len(references) - 1) * TIMESTEP)

    def place(self, joints: Array, seconds: float) -> None:
        """Put the joints somewhere without dynamics.

        The bottle follows both hands that hold it, half each, or stands on the table.
        """
        super().place(joints, seconds)
        data, n = self.data, self._n
        if self.held:
            (left, turn), (right, other) = map(self._pose_in_hand, HOLDS)
            data.qpos[n : n + 3] = (left + right) / 2
            data.qpos[n + 3 :] = turn + math.copysign(1, turn @ other) * other
            mujoco.mj_normalizeQuat(self.model, data.qpos)
            mujoco.mj_kinematics(self.model, data)
            self._sink(seconds)
        else:  # so it stands
            data.qpos[n + 2] = self.table + FOOT

    def restore(self, snapshot: tuple[Any, ...]) -> None:
        """Bring everything to where it was."""
        super().restore(snapshot)
        self.model.geom_conaffinity[self._surface] = TABLE | (0 if self.held else PALM)

    def hold(self, hold: Hold) -> None:
        """Attach the bottle to a hand as it lies in it; from then on the table sinks."""
        super().hold(hold)
        self.model.geom_conaffinity[self._surface] = TABLE

    def slip(self) -> float:
        """Measure how far the hands are from where they took hold of the bottle [m]."""
        left, right = (self._pose_in_hand(hold)[0] for hold in HOLDS)
        return float(np.linalg.norm(left - right) / 2)

    def _pose_in_hand(self, hold: Hold) -> tuple[Array, Array]:
        """Position and orientation of the bottle, were it rigidly attached to one hand."""
        weld, hand = self.model.eq_data[self._welds[hold]], self.data.body(hold.hand)
        turn, moved = np.empty(4), np.empty(3)
        mujoco.mju_mulQuat(turn, hand.xquat, weld[6:10])
        mujoco.mju_rotVecQuat(moved, weld[:3], turn)
        return hand.xpos - moved, turn

    def _sink(self, seconds: float) -> None:
        height = self.table - TABLE_SPEED * seconds
        self.model.body_pos[self._table, 2] = max(height, TABLE_LOW)


class TrayScene(BottleScene):
    """The same with a tray on the table, which does not sink."""

    def __init__(self) -> None:
        super().__init__(bottle_spec(tray=True), ("bottle", "tray"))

    def _sink(self, seconds: float) -> None:
        """It stands."""
