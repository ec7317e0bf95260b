"""Write URDF: the inverse of the reader, and several robots as one."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np

from tpgmm_torch.data.arrays import Array
from tpgmm_torch.robots.urdf import X_AXIS, UrdfJoint, UrdfModel, parse_xml

__all__ = ["Visuals", "free_name", "joined", "roll_pitch_yaw", "write_urdf"]

#: The ``<visual>`` elements of links by name.
Visuals = Mapping[str, Sequence[ElementTree.Element]]


def write_urdf(
    name: str, root: str, joints: Iterable[UrdfJoint], visuals: Visuals | None = None
) -> str:
    """The text of a description, its numbers to the last digit of float64.

    Parameters
    ----------
    name, root : str
        Of the robot, and of the link from which all others hang.
    joints : iterable of UrdfJoint
        The links are the root and their children.
    visuals : mapping of str to sequence of Element, optional
        What links look like.
    """
    robot = ElementTree.Element("robot", name=name)
    joints = list(joints)
    for link in (root, *(joint.child for joint in joints)):
        ElementTree.SubElement(robot, "link", name=link).extend((visuals or {}).get(link, ()))
    robot.extend(map(_element, joints))
    ElementTree.indent(robot, "")
    return ElementTree.tostring(robot, encoding="unicode")


def _element(joint: UrdfJoint) -> ElementTree.Element:
    element = ElementTree.Element("joint", name=joint.name, type=joint.type)
    ElementTree.SubElement(element, "parent", link=joint.parent)
    ElementTree.SubElement(element, "child", link=joint.child)
    element.append(origin(joint.origin))
    if not joint.movable:
        return element
    ElementTree.SubElement(element, "axis", xyz=numbers(joint.axis))
    rates = ("velocity", "acceleration", "jerk")
    limits = {rate: getattr(joint, rate) for rate in rates if getattr(joint, rate) < math.inf}
    if joint.upper < math.inf:
        limits |= {"lower": joint.lower, "upper": joint.upper}
    if limits:
        attributes = {limit: repr(float(value)) for limit, value in limits.items()}
        ElementTree.SubElement(element, "limit", attributes)
    if joint.mimic is not None:
        line = {k: repr(float(getattr(joint.mimic, k))) for k in ("multiplier", "offset")}
        ElementTree.SubElement(element, "mimic", line, joint=joint.mimic.joint)
    return element


def origin(pose: Array) -> ElementTree.Element:
    """The ``<origin>`` of a homogeneous matrix."""
    rpy = roll_pitch_yaw(pose[:3, :3])
    return ElementTree.Element("origin", xyz=numbers(pose[:3, 3]), rpy=numbers(rpy))


def numbers(values: Iterable[float]) -> str:
    """Numbers as an attribute, to the last digit."""
    return " ".join(repr(float(value)) for value in values)


def roll_pitch_yaw(rotation: Array) -> Array:
    """The angles of which :func:`~tpgmm_torch.robots.urdf.placement` makes a rotation again.

    With the yaw undone a rotation is ``R_y(pitch) R_x(roll)``, whatever the yaw: where the
    pitch is a right angle and leaves it open, any will do, and no digits are lost nearby.

    Parameters
    ----------
    rotation : ndarray of shape (3, 3)
    """
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    cosine, sine = math.cos(yaw), math.sin(yaw)
    back = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]]) @ rotation
    roll = math.atan2(-back[1, 2], back[1, 1])
    return np.array([roll, math.atan2(-back[2, 0], back[0, 0]), yaw])


def free_name(name: str, taken: Iterable[str]) -> str:
    """``name``, with as many underscores behind it as make it one that is not ``taken``."""
    while name in taken:
        name += "_"
    return name


def joined(
    parts: Mapping[str, tuple[UrdfModel, Array]], root: str, fixed: Mapping[str, Array]
) -> str:
    """Several robots on one root: ``prefix_`` stands before the names of each.

    Parameters
    ----------
    parts : mapping of str to (UrdfModel, ndarray of shape (4, 4))
        The robots by prefix, and where the root of each is.
    root : str
        Name of the new root link.
    fixed : mapping of str to ndarray of shape (4, 4)
        Other links that stand still on it, and where.
    """
    taken = {f"{prefix}_{name}" for prefix, (model, _) in parts.items() for name in model.joint}
    joints: list[UrdfJoint] = []

    def mount(name: str, link: str, pose: Array) -> None:
        taken.add(name := free_name(f"{name}_mount", taken))
        joints.append(UrdfJoint(name, "fixed", root, link, pose, X_AXIS))

    for name, pose in fixed.items():
        mount(name, name, pose)
    visuals: dict[str, list[ElementTree.Element]] = {}
    for prefix, (model, pose) in parts.items():
        mount(prefix, f"{prefix}_{model.root}", pose)
        for joint in model.joints:
            mimic = joint.mimic
            if mimic is not None:
                mimic = replace(mimic, joint=f"{prefix}_{mimic.joint}")
            parent, child = f"{prefix}_{joint.parent}", f"{prefix}_{joint.child}"
            name = f"{prefix}_{joint.name}"
            joints.append(replace(joint, name=name, parent=parent, child=child, mimic=mimic))
        drawn = _visuals(parse_xml(model.text))
        visuals |= {f"{prefix}_{link}": elements for link, elements in drawn.items()}
    return write_urdf(" and ".join(parts), root, joints, visuals)


def _visuals(robot: ElementTree.Element) -> dict[str, list[ElementTree.Element]]:
    """Visual elements of each link, with the materials that are described for all in place."""
    materials = {m.get("name"): m for m in robot.findall("material")}
    for material in robot.findall("link/visual/material"):
        described = materials.get(material.get("name"))
        if described is not None and material.find("color") is None:
            material.extend(described.findall("color"))
    return {link.get("name", ""): link.findall("visual") for link in robot.findall("link")}
