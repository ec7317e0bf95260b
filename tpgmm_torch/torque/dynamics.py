"""Inertia and bias torques of a robot: from MuJoCo, or from a function of your own."""

from __future__ import annotations

import copy
import os
from typing import Any, Protocol
from xml.etree import ElementTree

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch.data.arrays import Array
from tpgmm_torch.exceptions import DataError, DependencyError, UnknownNameError
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.robots.robot import Robot
from tpgmm_torch.robots.urdf import Mimic, description_text, is_text, parse_xml

__all__ = ["Dynamics", "MujocoDynamics"]


class Dynamics(Protocol):
    """Inertia ``H(q)`` and bias ``h(q, qd)`` of ``H qdd + h = tau``; a function will do."""

    def __call__(self, joints: Tensor, velocities: Tensor) -> tuple[Tensor, Tensor]:
        """Inertia and bias torques at a state.

        Parameters
        ----------
        joints, velocities : Tensor of shape (..., n_joints)
            [rad or m], [rad/s or m/s].

        Returns
        -------
        inertia : Tensor of shape (..., n_joints, n_joints)
            Symmetric positive definite [kg m^2 or kg].
        bias : Tensor of shape (..., n_joints)
            Torques of gravity and of the motion [N m or N].
        """
        ...


class MujocoDynamics:
    """Dynamics of a robot, computed by MuJoCo.

    Joints that are not in the joint vector stand where the robot has them locked, else where
    the model begins; those that mimic another one move with it. Friction and damping of the
    joints are not part of the bias.

    Parameters
    ----------
    robot : Kinematics
        Its joints are looked up by name.
    model : mujoco.MjModel, path or str, optional
        MJCF or URDF with the masses of the robot, a file or the text itself; by default the
        URDF of the robot, if it has masses. A robot read from an MJCF keeps none of them.

    Attributes
    ----------
    effort : Tensor of shape (n_joints,)
        Largest torque of each joint [N m or N], of the joints and of the motors that drive
        them; infinite where the model has no limit.

    Raises
    ------
    DependencyError
        Without MuJoCo, of the extra ``simulation``.
    DataError
        If MuJoCo cannot compile the model, or moving links have no mass.
    UnknownNameError
        If a joint is not in the model.
    """

    def __init__(self, robot: Kinematics, model: Any = None) -> None:
        try:
            import mujoco
        except ImportError as error:
            raise DependencyError(
                "MujocoDynamics needs MuJoCo: pip install 'tpgmm-torch[simulation]'"
            ) from error
        self._mujoco = mujoco
        self._model = model = _compiled(mujoco, robot, model)
        self._data = mujoco.MjData(model)
        self._map = _JointMap(mujoco, robot, model)
        self.effort = torch.from_numpy(_efforts(mujoco, model, self._map.joints)).to(
            robot.lower
        )

    def __call__(self, joints: Tensor, velocities: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Dynamics.__call__`; robots of a batch one after the other."""
        n = joints.shape[-1]
        both = torch.broadcast_tensors(joints, velocities)
        rows = [part.numpy(force=True).reshape(-1, n).astype(np.float64) for part in both]
        parts = [self._one(q, qd) for q, qd in zip(*rows, strict=True)]
        inertia, bias = map(np.stack, zip(*parts, strict=True))
        batch = both[0].shape[:-1]
        return (
            torch.from_numpy(inertia).to(joints).reshape(*batch, n, n),
            torch.from_numpy(bias).to(joints).reshape(*batch, n),
        )

    def _one(self, joints: Array, velocities: Array) -> tuple[Array, Array]:
        mujoco, model, data, columns = self._mujoco, self._model, self._data, self._map.columns
        data.qpos[self._map.places] = self._map.positions(joints)
        data.qvel[:] = columns @ velocities
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        moved = np.zeros(columns.T.shape)
        for row, column in zip(moved, columns.T, strict=True):
            mujoco.mj_mulM(model, data, row, np.ascontiguousarray(column))
        outside = data.qfrc_bias - data.qfrc_spring - data.qfrc_gravcomp
        return moved @ columns, outside @ columns


def _compiled(mujoco: Any, robot: Kinematics, model: Any) -> Any:
    """A model of its own, without contacts."""
    if model is None:
        if not isinstance(robot, Robot):
            raise DataError(
                f"{type(robot).__name__} has no description with masses: give "
                "MujocoDynamics(robot, model) an MJCF, a URDF or an MjModel"
            )
        model = robot.model.text
    try:
        if isinstance(model, mujoco.MjModel):
            model = copy.deepcopy(model)
        elif is_text(model) or parse_xml(description_text(model)).tag != "mujoco":
            model = mujoco.MjModel.from_xml_string(_without_shapes(description_text(model)))
        else:
            model = mujoco.MjModel.from_xml_path(os.fspath(model))
    except (ValueError, mujoco.FatalError) as error:
        raise DataError(
            f"MuJoCo cannot compile the model: {error}. A robot that was read from an MJCF "
            "keeps no masses: give MujocoDynamics(robot, model) the MJCF itself"
        ) from error
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    return model


def _without_shapes(text: str) -> str:
    """A URDF without the meshes that MuJoCo would look for; an MJCF as it is."""
    root = parse_xml(text)
    if root.tag == "mujoco":
        return text.strip()
    for link in root.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    return ElementTree.tostring(root, encoding="unicode")


class _JointMap:
    """Positions and velocities of a model's joints, as functions of the joint vector."""

    def __init__(self, mujoco: Any, robot: Kinematics, model: Any) -> None:
        names, known = robot.joint_names, [model.joint(j).name for j in range(model.njnt)]
        locked = robot.config()["locked"] if isinstance(robot, Robot) else {}
        described = robot.model.movable if isinstance(robot, Robot) else {}
        for name in names:
            if name not in known:
                raise UnknownNameError("joint", name, "the model of the dynamics", known)
        kinds = [int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)]
        scalar = [j for j in range(model.njnt) if int(model.jnt_type[j]) in kinds]
        self.joints = [known.index(name) for name in names]
        self.places, self.rows = model.jnt_qposadr[scalar], model.jnt_dofadr[scalar]
        self.start = model.qpos0[self.places].copy()
        self.columns = np.zeros((model.nv, len(names)))
        for at, j in enumerate(scalar):
            name = known[j]
            lead = robot.model.leader(name) if name in described else Mimic(name)  # type: ignore[attr-defined]
            if lead.joint in names:
                self.start[at] = lead.offset
                self.columns[self.rows[at], names.index(lead.joint)] = lead.multiplier
            elif lead.joint in locked:
                self.start[at] = lead.offset + lead.multiplier * locked[lead.joint]

    def positions(self, joints: Array) -> Array:
        """Of the model's joints, at ``places``."""
        positions: Array = self.start + self.columns[self.rows] @ joints
        return positions


def _efforts(mujoco: Any, model: Any, joints: list[int]) -> Array:
    """Largest torques of joints, of their own and of the motors that drive them."""
    limits = np.full(model.njnt, np.inf)
    limited = model.jnt_actfrclimited.astype(bool)
    limits[limited] = np.abs(model.jnt_actfrcrange[limited]).min(-1)
    for motor in np.flatnonzero(model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)):
        joint, gear = model.actuator_trnid[motor, 0], abs(model.actuator_gear[motor, 0])
        if model.actuator_forcelimited[motor]:
            most = np.abs(model.actuator_forcerange[motor]).min()
        elif model.actuator_ctrllimited[motor] and not model.actuator_biasprm[motor].any():
            most = np.abs(
                model.actuator_gainprm[motor, 0] * model.actuator_ctrlrange[motor]
            ).min()
        else:
            continue
        limits[joint] = min(limits[joint], gear * most)
    return limits[joints]
