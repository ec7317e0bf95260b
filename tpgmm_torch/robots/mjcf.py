"""Read MJCF, MuJoCo's description of robots, with MuJoCo's own compiler.

Includes, default classes, frames, replicas and units are the compiler's business; what it has
made of them is written as a URDF, which is what a :class:`~tpgmm_torch.Robot` keeps. Bodies and
named sites become links. Where a joint of MJCF is not at the origin of its body, or a body has
several joints, links are put in between; reference angles go into the origins.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import Array, as_tensor
from tpgmm_torch.exceptions import DataError, DependencyError
from tpgmm_torch.robots.urdf import (
    X_AXIS,
    Mimic,
    UrdfJoint,
    description_text,
    free_name,
    is_text,
    motion,
    numbers,
    origin,
    parse_xml,
    write_urdf,
)

HOW_TO_INSTALL = "pip install 'tpgmm-torch[simulation]'"


def mjcf_to_urdf(mjcf: str | os.PathLike[str]) -> str:
    """Write a URDF that moves as an MJCF does.

    Parameters
    ----------
    mjcf : path or str
        A file, with its includes and meshes where it says they are, or the text itself (a
        string that begins with ``<``).

    Returns
    -------
    str
        Links have the names of bodies and named sites; a site that is called like a body is
        ``NAME_site``. The root is ``world``. Joints range over what both the joint and the
        servo that drives it allow; speeds are limited where a velocity servo limits them.
        Joints that a linear equality ties to another follow it. Free and ball joints and
        mocap bodies become floating joints.

    Raises
    ------
    DependencyError
        Without MuJoCo.
    DataError
        If MuJoCo cannot compile it.
    """
    if (tag := parse_xml(description_text(mjcf)).tag) != "mujoco":
        raise DataError(f"an MJCF has the root element <mujoco>, got <{tag}>")
    return _Translation(compile_mjcf(mjcf, "the MJCF")).text()


def mujoco_module(purpose: str) -> Any:
    """Import MuJoCo, or raise an error that names the ``purpose`` and how to install it."""
    try:
        import mujoco
    except ImportError as error:
        raise DependencyError(f"{purpose}: this needs MuJoCo, {HOW_TO_INSTALL}") from error
    return mujoco


def compile_mjcf(mjcf: str | os.PathLike[str], what: str) -> Any:
    """Compile ``mjcf``, a path or the text itself, which errors call ``what``."""
    mujoco = mujoco_module(f"compiling {what}")
    try:
        if is_text(mjcf):
            return mujoco.MjModel.from_xml_string(description_text(mjcf).rstrip())
        return mujoco.MjModel.from_xml_path(os.fspath(mjcf))
    except (ValueError, mujoco.FatalError) as error:
        raise DataError(f"MuJoCo cannot compile {what}: {error}") from error


class _Translation:
    """A compiled model, and the joints of the URDF so far."""

    def __init__(self, model: Any) -> None:
        import mujoco

        self.model, self.mujoco = model, mujoco
        self.joints: list[UrdfJoint] = []
        self.joint_names = _names(model.joint, model.njnt, "joint")
        self.links = _names(model.body, model.nbody, "body")
        self.taken, self.taken_joints = set(self.links), set(self.joint_names)

    def text(self) -> str:
        model = self.model
        mimics = self._mimics()
        for body in range(1, model.nbody):
            self._add_body(body, mimics)
        for site in map(model.site, range(model.nsite)):
            if site.name:
                name = site.name if site.name not in self.taken else f"{site.name}_site"
                pose = _pose(site.pos, site.quat)
                self._fix(self._free(name), self.links[int(site.bodyid[0])], pose)
        name = model.names[: model.names.index(b"\0")].decode()
        return write_urdf(name, self.links[0], self.joints, self._visuals())

    def _free(self, link: str) -> str:
        self.taken.add(link := free_name(link, self.taken))
        return link

    def _fix(self, link: str, parent: str, pose: Array, kind: str = "fixed") -> None:
        self.taken_joints.add(name := free_name(f"{link}_mount", self.taken_joints))
        self.joints.append(UrdfJoint(name, kind, parent, link, pose, X_AXIS))

    def _add_body(self, body: int, mimics: Mapping[int, Mimic]) -> None:
        model, link = self.model, self.links[body]
        near = self.links[int(model.body_parentid[body])]
        before = _pose(model.body_pos[body], model.body_quat[body])
        first = int(model.body_jntadr[body])
        end = first + int(model.body_jntnum[body])
        for joint in range(first, end):
            is_hinge = model.jnt_type[joint] == self.mujoco.mjtJoint.mjJNT_HINGE
            anchor = model.jnt_pos[joint] if is_hinge else np.zeros(3)
            is_last = joint == end - 1 and not anchor.any()
            far = link if is_last else self._free(f"{link}/{self.joint_names[joint]}")
            urdf_joint = self._joint(joint, near, far, before @ _pose(anchor))
            self.joints.append(replace(urdf_joint, mimic=mimics.get(joint)))
            near, before = far, _pose(-anchor)
        if near != link:
            moved_from_outside = model.body_mocapid[body] >= 0
            self._fix(link, near, before, "floating" if moved_from_outside else "fixed")

    def _joint(self, joint: int, near: str, far: str, start: Array) -> UrdfJoint:
        model, kinds, name = self.model, self.mujoco.mjtJoint, self.joint_names[joint]
        axis, kind = model.jnt_axis[joint].copy(), int(model.jnt_type[joint])
        if kind not in (kinds.mjJNT_HINGE, kinds.mjJNT_SLIDE):
            return UrdfJoint(name, "floating", near, far, start, axis)
        lower, upper, velocity = self._limits(joint)
        turns = "revolute" if math.isfinite(upper) else "continuous"
        motion_of = "prismatic" if kind == kinds.mjJNT_SLIDE else turns
        reference = float(model.qpos0[model.jnt_qposadr[joint]])
        start = start @ motion(motion_of, axis, -reference)
        return UrdfJoint(name, motion_of, near, far, start, axis, lower, upper, velocity)

    def _limits(self, joint: int) -> tuple[float, float, float]:
        """Compute lower, upper and velocity: of the joint, and of the servos that drive it.

        The force of a servo is ``gain * control + bias . (1, l, l')`` with the length ``l``,
        ``gear * q``: it is in balance where that is zero.
        """
        model = self.model
        lower, upper, velocity = -math.inf, math.inf, math.inf
        if model.jnt_limited[joint]:
            lower, upper = map(float, model.jnt_range[joint])
        for servo in self._servos(joint):
            low, high, speed = self._servo_limits(servo)
            velocity = min(velocity, speed)
            if max(low, lower) < min(high, upper):
                lower, upper = max(low, lower), min(high, upper)
        return lower, upper, velocity

    def _servos(self, joint: int) -> NDArray[np.intp]:
        """Find the actuators that drive a joint directly, against a force of its own."""
        model, mujoco = self.model, self.mujoco
        direct = [mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT]
        is_servo = np.isin(model.actuator_trntype, direct) & (model.actuator_gear[:, 0] != 0)
        is_servo &= model.actuator_trnid[:, 0] == joint
        is_servo &= model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE
        return np.flatnonzero(is_servo)

    def _servo_limits(self, servo: int) -> tuple[float, float, float]:
        """Compute lower, upper and velocity of one servo."""
        model = self.model
        low, high, velocity = -math.inf, math.inf, math.inf
        constant, stiffness, damping = map(float, model.actuator_biasprm[servo, :3])
        gain, gear = model.actuator_gainprm[servo, 0], model.actuator_gear[servo, 0]
        commands, limited = model.actuator_ctrlrange[servo], model.actuator_ctrllimited[servo]
        if model.actuator_dyntype[servo] == self.mujoco.mjtDyn.mjDYN_INTEGRATOR:
            if stiffness and limited:  # the control is the speed of what is commanded
                velocity = float(np.abs(gain * commands / (stiffness * gear)).max())
            commands, limited = model.actuator_actrange[servo], model.actuator_actlimited[servo]
        ends = -(gain * commands + constant) / gear
        if limited and stiffness:
            low, high = sorted(map(float, ends / stiffness))
        elif limited and damping:
            velocity = min(velocity, float(np.abs(ends / damping).max()))
        return low, high, velocity

    def _mimics(self) -> dict[int, Mimic]:
        """Find joints that follow others: ``q - q0 = c0 + c1 (q' - q0')`` by equalities."""
        model = self.model
        mimics: dict[int, Mimic] = {}
        is_joint = model.eq_type == self.mujoco.mjtEq.mjEQ_JOINT
        is_line = ~model.eq_data[:, 2:5].any(-1) & (model.eq_obj2id >= 0)
        for index in np.flatnonzero(is_joint & is_line & (model.eq_active0 != 0)):
            joint, leader = int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
            constant, slope = map(float, model.eq_data[index, :2])
            zero, leader_zero = (model.qpos0[model.jnt_qposadr[j]] for j in (joint, leader))
            offset = float(zero + constant - slope * leader_zero)
            mimics.setdefault(joint, Mimic(self.joint_names[leader], slope, offset))
        return mimics

    def _visuals(self) -> dict[str, list[ElementTree.Element]]:
        """Convert visual geometry of links: the solids of URDF."""
        visuals: dict[str, list[ElementTree.Element]] = {link: [] for link in self.links}
        shown_groups = self.mujoco.MjvOption().geomgroup  # MuJoCo's own; others collide
        for geom in map(self.model.geom, range(self.model.ngeom)):
            is_shown = geom.bodyid[0] and shown_groups[geom.group[0]] and geom.rgba[3]
            color, material = geom.rgba, int(geom.matid[0])
            if material >= 0 and np.allclose(color, [0.5, 0.5, 0.5, 1.0]):  # the default
                color = self.model.mat_rgba[material]
            for solid, pose in self._solids(geom) if is_shown else ():
                visual = ElementTree.Element("visual")
                visual.append(origin(pose))
                ElementTree.SubElement(visual, "geometry").append(solid)
                look = ElementTree.SubElement(visual, "material", name="")
                ElementTree.SubElement(look, "color", rgba=numbers(color))
                visuals[self.links[int(geom.bodyid[0])]].append(visual)
        return visuals

    def _solids(self, geom: Any) -> Iterator[tuple[ElementTree.Element, Array]]:
        pose = _pose(geom.pos, geom.quat)
        kinds, element = self.mujoco.mjtGeom, ElementTree.Element
        radius, length = numbers(geom.size[:1]), numbers(2 * geom.size[1:2])
        mesh, model = int(geom.dataid[0]), self.model
        match int(geom.type[0]):
            case kinds.mjGEOM_BOX:
                yield element("box", size=numbers(2 * geom.size)), pose
            case kinds.mjGEOM_SPHERE:
                yield element("sphere", radius=radius), pose
            case kinds.mjGEOM_CYLINDER:
                yield element("cylinder", radius=radius, length=length), pose
            case kinds.mjGEOM_CAPSULE:
                yield element("cylinder", radius=radius, length=length), pose
                for end in (-geom.size[1], geom.size[1]):
                    yield element("sphere", radius=radius), pose @ _pose([0, 0, end])
            case kinds.mjGEOM_MESH if model.mesh_pathadr[mesh] >= 0:
                at, scale = int(model.mesh_pathadr[mesh]), numbers(model.mesh_scale[mesh])
                file = model.paths[at : model.paths.index(b"\0", at)].decode()
                # the compiler moves a mesh to its centre and principal axes
                centred = _pose(model.mesh_pos[mesh], model.mesh_quat[mesh])
                solid = element("mesh", filename=file, scale=scale)
                yield solid, pose @ np.linalg.inv(centred)


def _names(element: Any, count: int, kind: str) -> list[str]:
    """Return the names of all bodies or joints, or their numbers."""
    given = [element(index).name for index in range(count)]
    return [name or free_name(f"{kind}{i}", given) for i, name in enumerate(given)]


def _pose(position: ArrayLike, quaternion: ArrayLike = (1.0, 0.0, 0.0, 0.0)) -> Array:
    pose = np.eye(4)
    pose[:3, :3] = quaternions.to_matrix(as_tensor(quaternion, "quaternion")).numpy()
    pose[:3, 3] = position
    return pose
