"""Inverse kinematics of arms with five joints: where a point is, and what stays upright."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from lerobot_env_bimanual.base import Array
from lerobot_env_bimanual.so101.robot import hand_of
from lerobot_env_bimanual.so101.scene import BiSo101Scene
from tpgmm_torch.exceptions import DataError

#: Steps of Gauss and Newton, their damping, and where they end: [m] and radians alike.
STEPS, DAMPING, CLOSE = 60, 1e-4, 1e-5
#: A step turns no joint further [rad].
STRIDE = 0.2
#: Joints of an arm without its gripper.
ARM = 5


class Reach:
    """Postures of one arm, without play.

    Parameters
    ----------
    scene : BiSo101Scene
        Whose model is used, and whose state is not changed.
    side : {"left", "right"}
    """

    def __init__(self, scene: BiSo101Scene, side: str) -> None:
        self._model, self._data = scene.model, mujoco.MjData(scene.model)
        self._hand = scene.model.body(hand_of(side)).id
        joints = [scene.model.joint(i) for i in scene.model.actuator_trnid[:, 0]]
        chosen = [joint for joint in joints if joint.name.startswith(side)][:ARM]
        self._places = np.array([joint.qposadr[0] for joint in chosen])
        self._dofs = np.array([joint.dofadr[0] for joint in chosen])
        self._low, self._high = np.array([joint.range for joint in chosen]).T

    def pose(self, joints: ArrayLike) -> tuple[Array, Array]:
        """Position (3,) and axes (3, 3) of the hand, for joints (5,)."""
        self._data.qpos[self._places] = joints
        mujoco.mj_kinematics(self._model, self._data)
        hand = self._data.body(self._hand)
        return hand.xpos.copy(), hand.xmat.reshape(3, 3).copy()

    def __call__(
        self, joints: ArrayLike, target: ArrayLike, point: ArrayLike, up: ArrayLike
    ) -> Array:
        """Find the posture, near another one, in which a point of the hand is at a target.

        Parameters
        ----------
        joints : array-like of shape (5,)
            [rad]
        target : array-like of shape (3,)
            In the base frame [m].
        point : array-like of shape (3,)
            In the frame of the hand [m].
        up : array-like of shape (3,)
            The axis of the hand that is vertical then; which way the hand points is free.

        Raises
        ------
        DataError
            If it does not exist.
        """
        model, data = self._model, self._data
        goal, tool, upwards = (np.array(one, dtype=float) for one in (target, point, up))
        found, moved, turned = np.array(joints, dtype=float), *np.zeros((2, 3, model.nv))
        for _ in range(STEPS):
            position, axes = self.pose(found)
            mujoco.mj_comPos(model, data)
            place, axis = position + axes @ tool, axes @ upwards
            error = np.concatenate((goal - place, -axis[:2]))
            if np.abs(error).max() < CLOSE:
                return found
            mujoco.mj_jac(model, data, moved, turned, place, self._hand)
            tilt = np.cross(turned[:, self._dofs], axis, axis=0)
            rows = np.concatenate((moved[:, self._dofs], tilt[:2]))
            normal = rows.T @ rows + DAMPING * 1e-2 * np.eye(ARM)
            step = np.linalg.solve(normal, rows.T @ error)
            found = found + step * min(1.0, STRIDE / max(np.abs(step).max(), 1e-9))
            found = np.clip(found, self._low, self._high)
        raise DataError(
            f"the arm does not reach {goal.round(3).tolist()}: it misses by "
            f"{1e3 * np.linalg.norm(error[:3]):.1f} mm and {np.linalg.norm(error[3:]):.3f} rad"
        )
