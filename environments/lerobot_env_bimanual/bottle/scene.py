"""The simulated upper body, its lifting table and the bottle, in MuJoCo.

Palms and bottle are so dimensioned that the palms just touch the bottle at the grasp poses of
:mod:`tpgmm_datasets.bottle.skill`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from lerobot_env_bimanual.base import Array
from lerobot_env_bimanual.eyes.carriers import CUBE_ROOM, cube_at, flat_at
from lerobot_env_bimanual.robot_scene import (
    BOX,
    CYLINDER,
    PALM,
    TABLE,
    TIMESTEP,
    RobotScene,
    add_geom,
    add_table,
    add_weld,
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
        ``r_palm``; a weld between each hand and the bottle, not active.
    """
    spec = robot_spec()
    add_table(spec, 0.6)
    _add_bottle(spec, abs(GRASP_POINT[HANDS[0]][1]) - float(spec.geom("l_palm").size[1]))
    for hand in HANDS:
        add_weld(spec, hand, "bottle")
    if tray:
        body = spec.worldbody.add_body(name="tray")
        add_geom(body, BOX, (0.09, 0.09, 0.001), rgba=(0.2, 0.6, 0.3, 1))
    return spec


def _add_bottle(spec: Any, radius: float) -> None:
    bottle = spec.worldbody.add_body(name="bottle")
    bottle.add_freejoint()
    bottle.add_geom(
        name="bottle", type=CYLINDER, size=(radius, FOOT, 0), mass=1.0, contype=0,
        rgba=(0.3, 0.6, 0.9, 1),
    )  # fmt: skip
    for size, height in (((0.025, 0.02, 0), FOOT + 0.02), ((0.03, 0.012, 0), FOOT + 0.05)):
        add_geom(bottle, CYLINDER, size, mass=0, pos=(0, 0, height))


@dataclass(frozen=True)
class Snapshot:
    """Where everything is at an instant.

    Parameters
    ----------
    positions : ndarray
        Of all joints of the model.
    held : bool
        Whether the bottle is attached to both hands.
    table : float
        Its height [m].
    """

    positions: Array
    held: bool
    table: float


class BottleScene(RobotScene):
    """The state of the simulated world, and what can happen in it.

    Parameters
    ----------
    spec : mujoco.MjSpec, optional
        That of :func:`bottle_spec`, with more in it.

    Attributes
    ----------
    held : bool
        Whether the bottle is attached to both hands.
    """

    def __init__(self, spec: mujoco.MjSpec | None = None) -> None:
        super().__init__(bottle_spec() if spec is None else spec)
        self.held, model = False, self.model
        self._hands = [model.body(hand).id for hand in HANDS]
        self._palms = [model.geom(f"{hand[0]}_palm").id for hand in HANDS]
        self._bottle, self._table = model.body("bottle").id, model.body("table").id
        self._surface = model.geom("bottle").id
        self._unit_inertia = model.body_inertia[self._bottle].copy()  # of 1 kg

    @property
    def bottle(self) -> Array:
        """The bottle's position [m] and orientation, a unit quaternion; shape (7,)."""
        return self.data.qpos[self._n :].copy()

    @property
    def table(self) -> float:
        """Height of the table [m]."""
        return float(self.model.body_pos[self._table, 2])

    @property
    def objects(self) -> list[Array]:
        """The poses of what is observed."""
        return [self.bottle]

    def reset(self, bottle: ArrayLike, joints: ArrayLike, mass: float) -> None:
        """Stand still, the bottle on the table.

        Parameters
        ----------
        bottle : array-like of shape (7,)
            Position [m] and orientation, a unit quaternion.
        joints : array-like of shape (17,)
            [rad]
        mass : float
            The bottle's [kg].
        """
        model, data = self.model, self.data
        model.body_mass[self._bottle] = mass
        model.body_inertia[self._bottle] = mass * self._unit_inertia
        mujoco.mj_setConst(model, data)
        mujoco.mj_resetData(model, data)
        model.geom_conaffinity[self._surface] = TABLE | PALM
        self.held = False
        data.ctrl[:] = data.qpos[: self._n] = joints
        data.qpos[self._n :] = bottle
        model.body_pos[self._table, 2] = data.qpos[self._n + 2] - FOOT
        mujoco.mj_forward(model, data)

    def follow(self, references: Array, torques: Array | None = None) -> None:
        """Simulate position control, as :meth:`RobotScene.follow` says; the table sinks."""
        super().follow(references, torques)
        if self.held:
            self._sink((len(references) - 1) * TIMESTEP)

    def place(self, joints: Array, seconds: float) -> None:
        """Put the joints somewhere without dynamics.

        The bottle follows both hands that hold it, half each, or stands on the table.

        Parameters
        ----------
        joints : ndarray of shape (17,)
            [rad]
        seconds : float
            Time that passes.
        """
        data, n = self.data, self._n
        data.qpos[:n] = joints
        mujoco.mj_kinematics(self.model, data)
        if self.held:
            (left, turn), (right, other) = (self._pose_in_hand(e) for e in range(2))
            data.qpos[n : n + 3] = (left + right) / 2
            data.qpos[n + 3 :] = turn + math.copysign(1, turn @ other) * other
            mujoco.mj_normalizeQuat(self.model, data.qpos)
            mujoco.mj_kinematics(self.model, data)
            self._sink(seconds)
        else:  # so it stands
            data.qpos[n + 2] = self.model.body_pos[self._table, 2] + FOOT
        data.time += seconds

    def put_bottle(self, pose: Array) -> None:
        """Put the bottle somewhere, at rest; shape (7,)."""
        data, n = self.data, self._n
        data.qpos[n:], data.qvel[n:] = pose, 0
        mujoco.mj_kinematics(self.model, data)

    def snapshot(self) -> Snapshot:
        """Return the state without velocities."""
        return Snapshot(self.data.qpos.copy(), self.held, self.table)

    def restore(self, snapshot: Snapshot) -> None:
        """Bring everything to where it was, in hands that took hold of the bottle as now."""
        self.data.qpos[:] = snapshot.positions
        self.model.body_pos[self._table, 2] = snapshot.table
        self.held = snapshot.held
        self.data.eq_active[:] = snapshot.held
        self.model.geom_conaffinity[self._surface] = TABLE | (0 if self.held else PALM)
        mujoco.mj_kinematics(self.model, self.data)

    def gap(self) -> float:
        """Distance of the farther palm from the bottle's surface, negative inside it [m]."""
        model, data, points = self.model, self.data, np.empty(6)
        return max(
            mujoco.mj_geomDistance(model, data, palm, self._surface, 1.0, points)
            for palm in self._palms
        )

    def hold(self) -> None:
        """Attach the bottle to both hands as it lies in them; from then on the table sinks."""
        self.held = True
        self.model.geom_conaffinity[self._surface] = TABLE
        for weld, hand in enumerate(self._hands):
            self._attach(weld, hand, self._bottle)

    def let_go(self) -> None:
        """Open both hands."""
        self.held = False
        self.data.eq_active[:] = False

    def pull(self) -> float:
        """Return the larger force between the bottle and a hand that holds it [N]."""
        # rows of equality constraints come first, six per weld: force, then moment
        left, _, right, _ = self.data.efc_force[:12].reshape(4, 3)
        return math.sqrt(max(left @ left, right @ right))

    def slip(self) -> float:
        """Measure how far the hands are from where they took hold of the bottle [m]."""
        left, right = (self._pose_in_hand(weld)[0] for weld in range(2))
        return float(np.linalg.norm(left - right) / 2)

    def _pose_in_hand(self, weld: int) -> tuple[Array, Array]:
        """Position and orientation of the bottle, were it rigidly attached to one hand."""
        point, relative = self.model.eq_data[weld, :3], self.model.eq_data[weld, 6:10]
        hand, turn, moved = self._hands[weld], np.empty(4), np.empty(3)
        mujoco.mju_mulQuat(turn, self.data.xquat[hand], relative)
        mujoco.mju_rotVecQuat(moved, point, turn)
        return self.data.xpos[hand] - moved, turn

    def _sink(self, seconds: float) -> None:
        height = self.model.body_pos[self._table, 2] - TABLE_SPEED * seconds
        self.model.body_pos[self._table, 2] = max(height, TABLE_LOW)


class TrayScene(BottleScene):
    """The same with a tray on the table, which does not sink."""

    def __init__(self) -> None:
        super().__init__(bottle_spec(tray=True))
        self._tray = self.model.body("tray").id

    @property
    def tray(self) -> Array:
        """Its position [m] and orientation, a unit quaternion; shape (7,)."""
        place = self.model.body_pos[self._tray], self.model.body_quat[self._tray]
        return np.concatenate(place)

    @property
    def objects(self) -> list[Array]:
        """The poses of bottle and tray."""
        return [self.bottle, self.tray]

    def put_tray(self, pose: Array) -> None:
        """Put the tray somewhere; shape (7,)."""
        self.model.body_pos[self._tray], self.model.body_quat[self._tray] = pose[:3], pose[3:]
        mujoco.mj_forward(self.model, self.data)

    def _sink(self, seconds: float) -> None:
        """It stands."""
