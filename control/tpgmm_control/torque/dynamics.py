"""Inertia and bias torques of a robot: from MuJoCo, or from a function of your own."""

from __future__ import annotations

import os
from typing import Any, Protocol
from xml.etree import ElementTree

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch.data.arrays import Array
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.robots.mjcf import mujoco_module
from tpgmm_torch.robots.robot import Robot
from tpgmm_torch.robots.urdf import description_text, is_text, parse_xml

__all__ = ["MujocoDynamics"]


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

    Joints that are not in the joint vector stand where the robot has them locked; those that
    mimic another one move with it. Gravity is the model's. Friction and damping of the joints
    are not part of the bias.

    Parameters
    ----------
    robot : Robot
        Its joints are looked up by name.
    model : path or str, optional
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

    def __init__(self, robot: Robot, model: Any = None) -> None:
        self._mujoco = mujoco = mujoco_module("MujocoDynamics")
        self._model = model = _compiled(robot.model.text if model is None else model)
        self._data, names = mujoco.MjData(model), robot.joint_names
        known = [model.joint(j).name for j in range(model.njnt)]
        for name in names:
            if name not in known:
                raise UnknownNameError("joint", name, "the model of the dynamics", known)
        efforts = _efforts(model)[[known.index(name) for name in names]]
        self.effort = torch.from_numpy(efforts).to(robot.lower)
        # joints of the model are functions of the joint vector; what the robot does not know,
        # as objects, stays where it begins
        moved = [name for name in known if name in robot.model.movable]
        index, locked = [known.index(name) for name in moved], robot.config()["locked"]
        self._places, rows = model.jnt_qposadr[index], model.jnt_dofadr[index]
        self._slopes, self._start = np.zeros((len(moved), len(names))), np.zeros(len(moved))
        for at, lead in enumerate(map(robot.model.leader, moved)):
            self._start[at] = lead.offset
            if lead.joint in names:
                self._slopes[at, names.index(lead.joint)] = lead.multiplier
            else:
                self._start[at] += lead.multiplier * locked.get(lead.joint, 0.0)
        self._columns = np.zeros((model.nv, len(names)))
        self._columns[rows] = self._slopes

    def __call__(self, joints: Tensor, velocities: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Dynamics.__call__`; robots of a batch one after the other."""
        both = torch.broadcast_tensors(joints, velocities)
        shape, n = both[0].shape, joints.shape[-1]
        rows = [part.numpy(force=True).reshape(-1, n).astype(np.float64) for part in both]
        parts = [self._one(q, qd) for q, qd in zip(*rows, strict=True)]
        inertia, bias = (torch.from_numpy(np.stack(x)).to(joints) for x in zip(*parts))  # noqa: B905
        return inertia.reshape(*shape, n), bias.reshape(shape)

    def _one(self, joints: Array, velocities: Array) -> tuple[Array, Array]:
        mujoco, model, data, columns = self._mujoco, self._model, self._data, self._columns
        data.qpos[self._places] = self._start + self._slopes @ joints
        data.qvel[:] = columns @ velocities
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        moved = np.zeros(columns.T.shape)
        for row, column in zip(moved, columns.T, strict=True):
            mujoco.mj_mulM(model, data, row, np.ascontiguousarray(column))
        outside = data.qfrc_bias - data.qfrc_spring - data.qfrc_gravcomp
        return moved @ columns, outside @ columns


def _compiled(source: Any) -> Any:
    """A model of its own, without contacts."""
    mujoco, root = mujoco_module("MujocoDynamics"), parse_xml(description_text(source))
    for link in root.iter("link"):  # of a URDF, without the meshes that MuJoCo would look for
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    try:
        if root.tag == "mujoco" and not is_text(source):  # meshes are beside it
            model = mujoco.MjModel.from_xml_path(os.fspath(source))
        else:
            model = mujoco.MjModel.from_xml_string(ElementTree.tostring(root, "unicode"))
    except (ValueError, mujoco.FatalError) as error:
        raise DataError(
            f"MuJoCo cannot compile the model: {error}. A robot that was read from an MJCF "
            "keeps no masses: give MujocoDynamics(robot, model) the MJCF itself"
        ) from error
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    return model


def _efforts(model: Any) -> Array:
    """Largest torques of joints (njnt,), of their own and of the motors that drive them."""

    def largest(limited: Array, ranges: Array) -> Array:
        found: Array = np.where(limited, np.abs(ranges).min(-1), np.inf)
        return found

    limits = largest(model.jnt_actfrclimited, model.jnt_actfrcrange)
    is_motor = ~model.actuator_biasprm.any(-1) & (model.actuator_ctrllimited > 0)
    controls = largest(is_motor, model.actuator_gainprm[:, :1] * model.actuator_ctrlrange)
    forces = largest(model.actuator_forcelimited, model.actuator_forcerange)
    forces = np.minimum(forces, controls) * np.abs(model.actuator_gear[:, 0])
    drives = model.actuator_trntype == int(mujoco_module("MujocoDynamics").mjtTrn.mjTRN_JOINT)
    np.minimum.at(limits, model.actuator_trnid[drives, 0], forces[drives])
    return limits
