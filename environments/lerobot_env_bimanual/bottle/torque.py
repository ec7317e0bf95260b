"""The same skill with torque motors: gains that vary, gravity, something in the way."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from lerobot_env_bimanual.base import Array, Observation
from lerobot_env_bimanual.bottle.conditions import skill
from lerobot_env_bimanual.bottle.scene import BottleScene, bottle_spec
from lerobot_env_bimanual.bottle.shaking import BottleShakingEnv
from lerobot_env_bimanual.robot_scene import DAMPING, STIFFNESS, add_geom
from tpgmm_datasets.bottle.skill import HANDS
from tpgmm_torch.exceptions import DataError, ShapeError

__all__ = ["BottleTorqueEnv"]

#: What an action can be.
CONTROLS = ("impedance", "reference", "torque")
#: The largest gains that an action may ask for [N m/rad, N m s/rad].
MOST_STIFFNESS, MOST_DAMPING = 2000.0, 100.0
#: What stands in the way: its radius and height [m], how far it is from the robot at least [m],
#: and when a hand would be there [s].
RADIUS, HEIGHT, CLEARANCE, INSTANT = 0.03, 0.2, 0.03, (1.0, 2.0)
#: Where it is when it is not in the way [m].
AWAY = (0.0, 0.0, -5.0)
#: What collides with it, as bits; scene and robot have the other ones.
_OBSTACLE = 4
#: The group of the geoms that the URDF describes.
_ROBOT = 1


class TorqueScene(BottleScene):
    """The simulated world of :class:`BottleScene` without help against gravity.

    Each joint has a torque motor, limited as in the URDF, and before it an impedance controller
    that is part of each time step of the physics:
    ``stiffness (q_ref - q) + damping (qd_ref - qd) + feedforward``. The feedforward compensates
    gravity, Coriolis and centrifugal forces of the robot, without what it holds, and the
    joints' friction at the reference's speed.

    Parameters
    ----------
    obstacle : bool
        Whether there is something to be put in the way.

    Attributes
    ----------
    stiffness, damping : ndarray of shape (17,)
        [N m/rad, N m s/rad]
    torques : ndarray of shape (17,) or None
        In place of those of the impedance controllers [N m].
    force : float
        The largest force between robot and obstacle since the last reset [N].
    """

    def __init__(self, obstacle: bool = False) -> None:
        spec = bottle_spec()
        if obstacle:
            for geom in (geom for body in spec.bodies for geom in body.geoms):
                if geom.group == _ROBOT:
                    geom.conaffinity |= _OBSTACLE
            # at 0 it would be taken to stay where the world is
            look = {"name": "obstacle", "pos": AWAY, "rgba": (0.8, 0.2, 0.2, 1)}
            shape, size = mujoco.mjtGeom.mjGEOM_CAPSULE, (RADIUS, HEIGHT / 2, 0)
            contact = {"contype": _OBSTACLE, "solref": (0.005, 1.0)}
            add_geom(spec.worldbody, shape, size, **look, **contact)
        super().__init__(spec)
        model, n = self.model, self._n
        model.body_gravcomp[:] = 0
        model.actuator_gainprm[:, 0] = 1
        self._friction = model.dof_damping[:n].copy()
        self._obstacle = model.geom("obstacle").id if obstacle else -1
        self.stiffness, self.damping = np.full(n, STIFFNESS), np.full(n, DAMPING)
        self.torques: Array | None = None
        self.peak_force, self._touched = 0.0, math.inf

    @property
    def velocities(self) -> Array:
        """Velocities of the joints, shape (17,) [rad/s]."""
        return self.data.qvel[: self._n].copy()

    def dynamics(self) -> tuple[Array, Array]:
        """Inertia matrix M (17, 17) [kg m^2] and bias torques h (17,) [N m] of the robot.

        ``M qdd + h = torque``, without joint friction, contacts and what the hands hold.
        """
        model, data, n = self.model, self.data, self._n
        mujoco.mj_forward(model, data)
        inertia, unit = np.zeros((n, model.nv)), np.eye(n, model.nv)
        for row in range(n):
            mujoco.mj_mulM(model, data, inertia[row], unit[row])
        return inertia[:, :n], data.qfrc_bias[:n].copy()

    def reset(
        self, poses: Mapping[str, Array], joints: Array, table: float, mass: float = 1.0
    ) -> None:
        """As :meth:`BottleScene.reset`, with the gains of the position control."""
        super().reset(poses, joints, table, mass)
        self.torques, self.peak_force, self._touched = None, 0.0, math.inf
        self.clear()

    def block(self, position: ArrayLike) -> float:
        """Put the obstacle somewhere.

        Parameters
        ----------
        position : array-like of shape (3,)
            [m]

        Returns
        -------
        float
            Its distance from the robot, negative if it stands in it [m].
        """
        self.model.geom_pos[self._obstacle] = position
        mujoco.mj_forward(self.model, self.data)
        points = np.empty(6)
        return min(
            mujoco.mj_geomDistance(self.model, self.data, geom, self._obstacle, 1.0, points)
            for geom in np.flatnonzero(self.model.geom_group == _ROBOT)
        )

    def clear(self) -> None:
        """Take the obstacle away."""
        if self._obstacle >= 0:
            self.model.geom_pos[self._obstacle] = AWAY

    def touched_for(self) -> float:
        """Return the time since the obstacle was first touched [s]; minus infinity before."""
        return float(self.data.time) - self._touched

    def _controls(self, references: Array, speeds: Array) -> Array:
        bias = self.model.actuator_biasprm
        if self.torques is not None:
            bias[:, 1:3] = 0
            return np.broadcast_to(self.torques, references.shape)
        bias[:, 1], bias[:, 2] = -self.stiffness, -self.damping
        return self.stiffness * references + (self.damping + self._friction) * speeds

    def _step(self, control: Array) -> None:
        data = self.data
        if self.torques is None:
            control = control + data.qfrc_bias[: self._n]
        super()._step(control)
        if self._obstacle >= 0 and (force := self._obstacle_force()):
            self.peak_force = max(self.peak_force, force)
            self._touched = min(self._touched, float(data.time))

    def _obstacle_force(self) -> float:
        """Between robot and obstacle [N]."""
        total, pairs = np.zeros(3), self.data.contact.geom
        for index in np.flatnonzero((pairs == self._obstacle).any(1)):
            total += self._contact_force(index, pairs[index, 0] == self._obstacle)
        return math.sqrt(total @ total)


class BottleTorqueEnv(BottleShakingEnv):
    """Bottle shaking with torque motors, and if asked for with something in the way.

    Task, hands, observation and figures are those of :class:`BottleShakingEnv`; the joints are
    those of :class:`TorqueScene`. ``info`` also holds ``velocity``, the speeds of the joints
    (17,) [rad/s], and ``peak_contact_N``, the largest force between robot and obstacle so far.

    Parameters
    ----------
    control : {"impedance", "reference", "torque"}
        What an action is: references, stiffness and damping of the joints one after the other
        (51,) [rad, N m/rad, N m s/rad]; references alone (17,) with the gains of the position
        control; torques of the motors (17,) [N m], which act without delay and are held for one
        period.
    obstacle : float
        How long something stands in the way of a hand after the robot has touched it [s]: an
        upright post of 6 cm where the hand would be after 1 to 2 s. 0 is nothing at all,
        infinity to the end.
    **options
        Those of :class:`BottleShakingEnv`, with ``mode="dynamic"``.

    Raises
    ------
    DataError
        If an option is not one of the above.
    """

    def __init__(
        self, *, control: str = "impedance", obstacle: float = 0.0, **options: Any
    ) -> None:
        super().__init__(**options)
        if control not in CONTROLS:
            raise DataError(f"control is one of {list(CONTROLS)}, got {control!r}")
        if self.mode != "dynamic":
            raise DataError("torques need mode='dynamic'")
        if not obstacle >= 0:
            raise DataError(f"obstacle is a time from 0 to infinity [s], got {obstacle!r}")
        if control == "torque" and self.disturbances:
            raise DataError(
                "torques go to the motors as they are: nothing stops or shoves them, "
                f"condition is 'nominal' for control='torque', got {self.condition!r}"
            )
        self.control, self.obstacle = control, obstacle
        self._scene: TorqueScene = TorqueScene(obstacle > 0)
        low, high = self._lower, self._upper
        if control == "torque":
            low, high = self._scene.model.jnt_actfrcrange[: len(low)].T
        elif control == "impedance":
            one = np.ones_like(low)
            low = np.concatenate((low, 0 * one, 0 * one))
            high = np.concatenate((high, MOST_STIFFNESS * one, MOST_DAMPING * one))
        self.action_space = spaces.Box(
            low.astype(np.float32), high.astype(np.float32), dtype=np.float32
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; see :meth:`BottleShakingEnv.reset`."""
        observation, info = super().reset(seed=seed, options=options)
        if self.obstacle:
            # another generator than that of the conditions, which stay as they are without
            [rng] = self.np_random.spawn(1)
            hand = HANDS[rng.integers(len(HANDS))]
            path = self._nominal()
            first = int(np.searchsorted(path.time.numpy(), rng.uniform(*INSTANT)))
            way = skill().robot.state(path.joints[first:]).position(hand).numpy()
            next(place for place in way if self._scene.block(place) > CLEARANCE)
        return observation, {**info, **self._measurements()}

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move for one period of the control; see :meth:`BottleShakingEnv.step`."""
        observation, reward, terminated, truncated, info = super().step(action)
        if self._scene.touched_for() > self.obstacle:
            self._scene.clear()
        return observation, reward, terminated, truncated, {**info, **self._measurements()}

    def dynamics(self) -> tuple[Array, Array]:
        """See :meth:`TorqueScene.dynamics`."""
        return self._scene.dynamics()

    def _measurements(self) -> dict[str, Any]:
        return {"velocity": self._scene.velocities, "peak_contact_N": self._scene.peak_force}

    def _read_action(self, action: ArrayLike) -> Array:
        """Check the references, and give gains or torques to the scene."""
        if self.control == "reference":
            return super()._read_action(action)
        scene, values = self._scene, np.asarray(action, dtype=np.float64)
        if self.control == "torque":
            scene.torques = super()._read_action(values)
            return np.clip(scene.joints, self._lower, self._upper)
        n = len(self.joint_names)
        if values.shape != (3 * n,):
            raise ShapeError(
                f"the action has shape {values.shape}; it holds references, stiffness and "
                f"damping of {n} joints, shape ({3 * n},): {list(self.joint_names)}"
            )
        wanted, *gains = (
            super(BottleTorqueEnv, self)._read_action(v) for v in values.reshape(3, n)
        )
        if min(map(np.min, gains)) < 0:
            raise DataError(f"stiffness and damping are not below 0, got {values[n:].tolist()}")
        scene.stiffness = np.minimum(gains[0], MOST_STIFFNESS)
        scene.damping = np.minimum(gains[1], MOST_DAMPING)
        return wanted
