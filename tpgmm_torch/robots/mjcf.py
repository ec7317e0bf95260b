"""Read MJCF, MuJoCo's description of robots, with MuJoCo's own compiler.

Includes, default classes, frames, replicas and units are the compiler's business; what it has
made of them is written as a URDF, which is what a :class:`~tpgmm_torch.Robot` keeps. Bodies and
named sites become links. Where a joint of MJCF is not at the origin of its body, or a body has
several joints, links are put in between; reference angles go into the origins.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from typing import Any
from xml.etree import ElementTree

import numpy as np

from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import Array, as_tensor
from tpgmm_torch.exceptions import DataError, DependencyError
from tpgmm_torch.robots.kinematic_tree import motion
from tpgmm_torch.robots.urdf import (
    X_AXIS,
    Mimic,
    UrdfJoint,
    description_text,
    is_text,
    parse_xml,
)
from tpgmm_torch.robots.urdf_writer import free_name, numbers, origin, write_urdf

__all__ = ["mjcf_to_urdf"]

HOW_TO_INSTALL = "pip install 'tpgmm-torch[simulation]'"
#: Geoms of these groups are shown by MuJoCo unless asked; those of others collide.
SHOWN_GROUPS = 3


def mjcf_to_urdf(mjcf: str | os.PathLike[str]) -> str:
    """The text of a URDF that moves as an MJCF does.

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
    try:
        import mujoco
    except ImportError as error:
        raise DependencyError(f"reading MJCF needs MuJoCo: {HOW_TO_INSTALL}") from error
    if (tag := parse_xml(description_text(mjcf)).tag) != "mujoco":
        raise DataError(f"an MJCF has the root element <mujoco>, got <{tag}>")
    try:
        if is_text(mjcf):
            model = mujoco.MjModel.from_xml_string(description_text(mjcf).rstrip())
        else:
            model = mujoco.MjModel.from_xml_path(os.fspath(mjcf))
    except (ValueError, mujoco.FatalError) as error:
        raise DataError(f"MuJoCo cannot compile the MJCF: {error}") from error
    return _Translation(model).text()


class _Translation:
    """A compiled model, and the joints of the URDF so far."""

    def __init__(self, model: Any) -> None:
        import mujoco

        self.model = model
        self.kinds = mujoco.mjtJoint
        self.joints: list[UrdfJoint] = []
        self.joint_names = list(_unique(model.joint, model.njnt, "joint"))
        self.fixed_names = set(self.joint_names)
        self.links = list(_unique(model.body, model.nbody, "body"))

    def text(self) -> str:
        model = self.model
        mimics = self._mimics()
        for body in range(1, model.nbody):
            self._add_body(body, mimics)
        taken = {self.links[0], *(joint.child for joint in self.joints)}
        for index in range(model.nsite):
            site = model.site(index)
            if site.name:
                name = site.name if site.name not in taken else f"{site.name}_site"
                taken.add(name := free_name(name, taken))
                self._fix(name, self.links[int(site.bodyid[0])], _pose(site.pos, site.quat))
        name = model.names[: model.names.index(b"\0")].decode()
        return write_urdf(name, self.links[0], self.joints, self._visuals())

    def _add_body(self, body: int, mimics: dict[int, Mimic]) -> None:
        model, link = self.model, self.links[body]
        near = self.links[int(model.body_parentid[body])]
        before = _pose(model.body_pos[body], model.body_quat[body])
        first = int(model.body_jntadr[body])
        for joint in range(first, first + int(model.body_jntnum[body])):
            kind, axis = int(model.jnt_type[joint]), model.jnt_axis[joint].copy()
            name, anchor = self.joint_names[joint], np.zeros(3)
            moves = kind in (self.kinds.mjJNT_HINGE, self.kinds.mjJNT_SLIDE)
            if kind == self.kinds.mjJNT_HINGE:
                anchor = model.jnt_pos[joint]
            last = joint == first + int(model.body_jntnum[body]) - 1
            far = link if last and not anchor.any() else self._between(link, name)
            start = before @ _shift(anchor)
            if moves:
                lower, upper, velocity = self._limits(joint)
                urdf_kind = "prismatic" if kind == self.kinds.mjJNT_SLIDE else "revolute"
                reference = model.qpos0[model.jnt_qposadr[joint]]
                start = start @ motion(urdf_kind, axis, -float(reference))
                if urdf_kind == "revolute" and math.isinf(upper):
                    urdf_kind = "continuous"
                limits = {"lower": lower, "upper": upper, "velocity": velocity}
                mimic = mimics.get(joint)
                self.joints.append(
                    UrdfJoint(name, urdf_kind, near, far, start, axis, **limits, mimic=mimic)
                )
            else:
                self.joints.append(UrdfJoint(name, "floating", near, far, start, axis))
            near, before = far, _shift(-anchor)
        if near != link:
            moved_from_outside = model.body_mocapid[body] >= 0
            self._fix(link, near, before, "floating" if moved_from_outside else "fixed")

    def _between(self, link: str, joint: str) -> str:
        taken = {*self.links, *(joint.child for joint in self.joints)}
        return free_name(f"{link}/{joint}", taken)

    def _fix(self, link: str, parent: str, pose: Array, kind: str = "fixed") -> None:
        self.fixed_names.add(name := free_name(f"{link}_mount", self.fixed_names))
        self.joints.append(UrdfJoint(name, kind, parent, link, pose, X_AXIS))

    def _limits(self, joint: int) -> tuple[float, float, float]:
        """Lower, upper and velocity: of the joint, and of the servos that drive it.

        The force of a servo is ``gain * control + bias . (1, l, l')`` with the length ``l``,
        ``gear * q``: it is in balance where that is zero.
        """
        import mujoco

        lower, upper, velocity = -math.inf, math.inf, math.inf
        if self.model.jnt_limited[joint]:
            lower, upper = map(float, self.model.jnt_range[joint])
        for servo in self._servos(joint):
            gear = float(servo.gear[0])
            constant, stiffness, damping = map(float, servo.biasprm[:3])
            commands, limited = servo.ctrlrange, servo.ctrllimited[0]
            if int(servo.dyntype[0]) == mujoco.mjtDyn.mjDYN_INTEGRATOR:
                if stiffness and limited:  # the control is the speed of what is commanded
                    speeds = servo.gainprm[0] * commands / (stiffness * gear)
                    velocity = min(velocity, float(np.abs(speeds).max()))
                commands, limited = servo.actrange, servo.actlimited[0]
            if not limited or not (stiffness or damping):
                continue
            ends = np.sort(-(servo.gainprm[0] * commands + constant) / gear)
            if stiffness:
                low, high = map(float, np.sort(ends / stiffness))
                if max(low, lower) < min(high, upper):
                    lower, upper = max(low, lower), min(high, upper)
            else:
                velocity = min(velocity, float(np.abs(ends / damping).max()))
        return lower, upper, velocity

    def _servos(self, joint: int) -> Iterator[Any]:
        """The actuators with an affine bias that drive a joint directly."""
        import mujoco

        direct = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
        for servo in map(self.model.actuator, range(self.model.nu)):
            drives = int(servo.trntype[0]) in direct and servo.trnid[0] == joint
            if (
                drives
                and int(servo.biastype[0]) == mujoco.mjtBias.mjBIAS_AFFINE
                and servo.gear[0]
            ):
                yield servo

    def _mimics(self) -> dict[int, Mimic]:
        """Joints that follow others: ``q - q0 = c0 + c1 (q' - q0')`` by active equalities."""
        import mujoco

        model = self.model
        mimics: dict[int, Mimic] = {}
        for index in range(model.neq):
            joint, leader = int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
            constant, slope, *more = map(float, model.eq_data[index, :5])
            is_joint = int(model.eq_type[index]) == mujoco.mjtEq.mjEQ_JOINT
            if not is_joint or not model.eq_active0[index] or leader < 0 or any(more):
                continue
            own, other = (model.qpos0[model.jnt_qposadr[j]] for j in (joint, leader))
            offset = float(own + constant - slope * other)
            mimics.setdefault(joint, Mimic(self.joint_names[leader], slope, offset))
        return mimics

    def _visuals(self) -> dict[str, list[ElementTree.Element]]:
        visuals: dict[str, list[ElementTree.Element]] = {}
        for index in range(self.model.ngeom):
            geom = self.model.geom(index)
            body = int(geom.bodyid[0])
            if body == 0 or geom.group[0] >= SHOWN_GROUPS or not geom.rgba[3]:
                continue
            for solid, pose in self._solids(geom):
                visual = ElementTree.Element("visual")
                visual.append(origin(pose))
                ElementTree.SubElement(visual, "geometry").append(solid)
                material = ElementTree.SubElement(visual, "material", name="")
                ElementTree.SubElement(material, "color", rgba=numbers(self._color(geom)))
                visuals.setdefault(self.links[body], []).append(visual)
        return visuals

    def _color(self, geom: Any) -> Array:
        plain = np.allclose(geom.rgba, [0.5, 0.5, 0.5, 1.0])
        material = int(geom.matid[0])
        return self.model.mat_rgba[material] if plain and material >= 0 else geom.rgba

    def _solids(self, geom: Any) -> Iterator[tuple[ElementTree.Element, Array]]:
        """The solids that URDF knows; ellipsoids and planes are not among them."""
        import mujoco

        pose, kinds = _pose(geom.pos, geom.quat), mujoco.mjtGeom
        match int(geom.type[0]):
            case kinds.mjGEOM_BOX:
                yield ElementTree.Element("box", size=numbers(2 * geom.size)), pose
            case kinds.mjGEOM_SPHERE:
                yield ElementTree.Element("sphere", radius=numbers(geom.size[:1])), pose
            case kinds.mjGEOM_CYLINDER | kinds.mjGEOM_CAPSULE:
                radius, length = numbers(geom.size[:1]), numbers(2 * geom.size[1:2])
                yield ElementTree.Element("cylinder", radius=radius, length=length), pose
                if int(geom.type[0]) == kinds.mjGEOM_CAPSULE:
                    for end in (-geom.size[1], geom.size[1]):
                        ball = ElementTree.Element("sphere", radius=radius)
                        yield ball, pose @ _shift(np.array([0, 0, end]))
            case kinds.mjGEOM_MESH:
                mesh, model = int(geom.dataid[0]), self.model
                at = int(model.mesh_pathadr[mesh])
                if at >= 0:
                    file = model.paths[at : model.paths.index(b"\0", at)].decode()
                    scale = numbers(model.mesh_scale[mesh])
                    # the compiler moves a mesh to its centre and principal axes
                    centred = _pose(model.mesh_pos[mesh], model.mesh_quat[mesh])
                    solid = ElementTree.Element("mesh", filename=file, scale=scale)
                    yield solid, pose @ np.linalg.inv(centred)


def _unique(element: Any, count: int, kind: str) -> Iterator[str]:
    """The names of all bodies or joints; those without one are called by their number."""
    given = {element(index).name for index in range(count)}
    for index in range(count):
        yield element(index).name or free_name(f"{kind}{index}", given)


def _pose(position: Array, quaternion: Array) -> Array:
    pose = _shift(position)
    pose[:3, :3] = quaternions.to_matrix(as_tensor(quaternion, "quaternion")).numpy()
    return pose


def _shift(by: Array) -> Array:
    pose = np.eye(4)
    pose[:3, 3] = by
    return pose
