"""Reader of URDF robot descriptions: the links, and the joints that hold them together.

Only kinematics is read: meshes, inertia, transmissions and plugins are passed over. What
the `URDF specification <https://wiki.ros.org/urdf/XML>`_ leaves out of a joint has its
default there (axis ``1 0 0``, no offset). Numbers stay float64.
"""

import math
import os
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from tpgmm_torch.atomic import read_whole
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.exceptions import DataError, UnknownNameError

__all__ = [
    "Mimic",
    "UrdfJoint",
    "UrdfModel",
    "description_text",
    "is_text",
    "placement",
    "read_urdf",
]

MOVABLE_TYPES = ("revolute", "continuous", "prismatic")
#: Joints of more than one degree of freedom: read, but no :class:`Robot` can be moved by them.
MULTIPLE_TYPES = ("floating", "planar")
XACRO = "the URDF holds xacro macros: expand them first (xacro FILE > ROBOT.urdf)"
#: What may stand before the first element of a text: a byte order mark, and space.
BEFORE_XML = "\ufeff \t\r\n"
#: What to do with a description that begins with another element.
OTHER_FORMATS = {
    "mujoco": ": that is an MJCF, Robot.from_mjcf reads it",
    "sdf": ": that is an SDF; pytorch_kinematics reads it, Robot.from_chain takes its chain",
}
#: Lengths [m] and factors beyond this are mistakes, and their products would not be finite.
LARGEST = 1e9


@dataclass(frozen=True)
class Mimic:
    """A joint that follows another: ``multiplier * q[joint] + offset``."""

    joint: str
    multiplier: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True, eq=False)
class UrdfJoint:
    """One joint of the description.

    Attributes
    ----------
    name, type, parent, child : str
        The names of the joint and of the links on its two sides.
    origin : ndarray of shape (4, 4)
        Pose of the joint in its parent link.
    axis : ndarray of shape (3,)
        Unit vector in the frame of the joint.
    lower, upper, velocity, acceleration, jerk : float
        Limits [rad or m, per s, s^2, s^3]; infinite where the description has none. That of
        the deceleration is one of the acceleration too.
    mimic : Mimic or None
        What it follows.
    """

    name: str
    type: str
    parent: str
    child: str
    origin: Array
    axis: Array
    lower: float = -math.inf
    upper: float = math.inf
    velocity: float = math.inf
    acceleration: float = math.inf
    jerk: float = math.inf
    mimic: Mimic | None = None

    @property
    def movable(self) -> bool:
        """Whether it has one degree of freedom."""
        return self.type in MOVABLE_TYPES


@dataclass(frozen=True, eq=False)
class UrdfModel:
    """A checked description: one tree of links.

    Attributes
    ----------
    name : str
        Name of the robot.
    text : str
        The URDF itself.
    root : str
        The link without a parent.
    links : tuple of str
        All links, in document order.
    joints : tuple of UrdfJoint
        All joints, in document order.
    """

    name: str
    text: str
    root: str
    links: tuple[str, ...]
    joints: tuple[UrdfJoint, ...]

    @cached_property
    def joint(self) -> dict[str, UrdfJoint]:
        """The joints by name."""
        return {joint.name: joint for joint in self.joints}

    @cached_property
    def movable(self) -> dict[str, UrdfJoint]:
        """The joints of one degree of freedom by name, in document order."""
        return {joint.name: joint for joint in self.joints if joint.movable}

    @cached_property
    def actuated(self) -> tuple[str, ...]:
        """Names of those that follow no other joint."""
        return tuple(name for name, joint in self.movable.items() if joint.mimic is None)

    def leader(self, name: str) -> Mimic:
        """The actuated joint on which a movable joint depends, and how.

        Parameters
        ----------
        name : str
            A movable joint; one that mimics no other leads itself.

        Raises
        ------
        UnknownNameError
            If it mimics a joint that is not movable or not there.
        DataError
            If joints mimic one another in a circle.
        """
        multiplier, offset, at = 1.0, 0.0, name
        for _ in self.movable:
            mimic = self.joint[at].mimic
            if mimic is None:
                return Mimic(at, multiplier, offset)
            if mimic.joint not in self.movable:
                where = f"the movable joints of the URDF (joint {at!r} mimics it)"
                raise UnknownNameError("joint", mimic.joint, where, self.movable)
            offset += multiplier * mimic.offset
            multiplier *= mimic.multiplier
            at = mimic.joint
        raise DataError(f"joint {name!r} follows joints that mimic one another in a circle")


class _PlainTree(ElementTree.TreeBuilder):
    """Refuse document types: with them entities could be declared that expand without bound."""

    def doctype(self, name: str, *_: Any) -> None:
        raise DataError(f"the URDF declares a document type ({name!r}): remove <!DOCTYPE ...>")


def read_urdf(source: str | bytes | os.PathLike[str]) -> UrdfModel:
    """Read and check a URDF.

    Parameters
    ----------
    source : str, bytes or path
        A path, or the text itself (bytes, or a string that begins with ``<``).

    Raises
    ------
    DataError
        If the file is missing, is not XML, or does not describe one tree of links.
    """
    text = description_text(source)
    try:
        parser = ElementTree.XMLParser(target=_PlainTree())
        root = ElementTree.fromstring(text, parser)
    except ElementTree.ParseError as error:
        reason = XACRO if "<xacro:" in text else f"the URDF is not well-formed XML: {error}"
        raise DataError(reason) from error
    if root.tag != "robot":
        other = OTHER_FORMATS.get(root.tag, "")
        raise DataError(f"a URDF has the root element <robot>, got <{root.tag}>{other}")
    if any("xacro" in tag for tag in {element.tag for element in root.iter()}):
        raise DataError(XACRO)
    links = tuple(_names(root, "link"))
    if not links:
        raise DataError("the URDF has no link")
    names = _names(root, "joint")
    joints = tuple(map(_joint, names, root.findall("joint")))
    return UrdfModel(root.get("name", ""), text, _root_link(links, joints), links, joints)


def is_text(source: str | bytes | os.PathLike[str]) -> bool:
    """Whether a robot's description is given as text, and not as the path of a file.

    Parameters
    ----------
    source : str, bytes or path
    """
    return isinstance(source, str) and source.lstrip(BEFORE_XML).startswith("<")


def description_text(source: str | bytes | os.PathLike[str]) -> str:
    """The text of a robot's description, in the encoding that it declares.

    Parameters
    ----------
    source : str, bytes or path
        A path, or the text itself (bytes, or a string that begins with ``<``).

    Raises
    ------
    DataError
        If the file cannot be read, or is no text in that encoding.
    """
    if is_text(source):
        return str(source).lstrip(BEFORE_XML)
    if not isinstance(source, bytes):
        try:
            source = read_whole(Path(source))
        except (OSError, ValueError) as error:
            raise DataError(f"the robot's description cannot be read: {error}") from error
    declared = re.match(rb"""\s*<\?xml[^>]*\bencoding\s*=\s*["']([\w.-]+)""", source)
    encoding = declared[1].decode() if declared else "utf-8-sig"
    try:
        return source.decode(encoding).lstrip()
    except (LookupError, UnicodeDecodeError) as error:
        raise DataError(
            f"the robot's description is not text in the encoding {encoding}: {error}"
        ) from error


def _names(root: ElementTree.Element, tag: str) -> list[str]:
    names: dict[str, None] = {}
    for index, element in enumerate(root.findall(tag)):
        name = element.get("name")
        if not name:
            raise DataError(f"<{tag}> number {index + 1} of the URDF has no name")
        if name in names:
            raise DataError(f"the URDF has two {tag}s named {name!r}")
        names[name] = None
    return list(names)


def _joint(name: str, element: ElementTree.Element) -> UrdfJoint:
    kind = element.get("type")
    if kind not in (*MOVABLE_TYPES, *MULTIPLE_TYPES, "fixed"):
        raise DataError(
            f"joint {name!r} has type {kind!r}; URDF knows "
            f"{sorted((*MOVABLE_TYPES, *MULTIPLE_TYPES, 'fixed'))}"
        )
    parent, child = (_end(element, name, side) for side in ("parent", "child"))
    origin = placement(
        _numbers(element, name, "origin", "xyz", (0.0, 0.0, 0.0)),
        _numbers(element, name, "origin", "rpy", (0.0, 0.0, 0.0)),
    )
    axis = _numbers(element, name, "axis", "xyz", (1.0, 0.0, 0.0))
    if kind not in MOVABLE_TYPES:
        return UrdfJoint(name, kind, parent, child, origin, axis)
    largest = np.abs(axis).max()
    if largest == 0:
        raise DataError(f"joint {name!r} has the axis 0 0 0: it needs a direction")
    axis = axis / largest  # a direction alone: the square of a length may overflow
    axis = axis / np.linalg.norm(axis)
    limits, mimic = _limits(element, name, kind), _mimic(element, name)
    return UrdfJoint(name, kind, parent, child, origin, axis, *limits, mimic)


def _end(element: ElementTree.Element, name: str, side: str) -> str:
    end = element.find(side)
    link = None if end is None else end.get("link")
    if not link:
        raise DataError(f"joint {name!r} has no {side} link")
    return link


def _numbers(
    element: ElementTree.Element,
    joint: str,
    tag: str,
    attribute: str,
    default: tuple[float, ...],
) -> Array:
    child = element.find(tag)
    text = None if child is None else child.get(attribute)
    if text is None:
        return np.array(default)
    try:  # lists, not arrays: a description has thousands of these
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != len(default) or not all(map(math.isfinite, values)):
        hint = f". {XACRO}" if "${" in text or "$(" in text else ""
        raise DataError(
            f"joint {joint!r}: <{tag} {attribute}> needs {len(default)} finite number(s), "
            f"got {_short(text)}{hint}"
        )
    if tag in ("origin", "mimic") and max(map(abs, values)) > LARGEST:
        raise DataError(
            f"joint {joint!r}: <{tag} {attribute}> is {_short(text)}, and no robot's is beyond "
            f"{LARGEST:g}"
        )
    return np.array(values)


def _short(text: str) -> str:
    return repr(text if len(text) <= 100 else f"{text[:100]} ...")


def placement(xyz: Array, rpy: Array) -> Array:
    """Homogeneous matrix of a URDF origin: rotations about the fixed x, then y, then z axis.

    Parameters
    ----------
    xyz, rpy : ndarray of shape (3,)
        Metres, radians.
    """
    (x, y, z), (roll, pitch, yaw) = xyz.tolist(), rpy.tolist()
    cr, cp, cy = math.cos(roll), math.cos(pitch), math.cos(yaw)
    sr, sp, sy = math.sin(roll), math.sin(pitch), math.sin(yaw)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, x],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, y],
            [-sp, cp * sr, cp * cr, z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _limits(
    element: ElementTree.Element, name: str, kind: str
) -> tuple[float, float, float, float, float]:
    """Lower, upper, velocity, acceleration, jerk."""
    limit = element.find("limit")
    lower, upper = -math.inf, math.inf
    # a <limit> that gives only effort and velocity says nothing about the range
    ranged = limit is not None and ("lower" in limit.attrib or "upper" in limit.attrib)
    if ranged and kind != "continuous":
        [lower] = _numbers(element, name, "limit", "lower", (0.0,)).tolist()
        [upper] = _numbers(element, name, "limit", "upper", (0.0,)).tolist()
    rates = dict.fromkeys(("velocity", "acceleration", "deceleration", "jerk"), math.inf)
    for rate in rates:
        if limit is not None and rate in limit.attrib:
            [rates[rate]] = _numbers(element, name, "limit", rate, (0.0,)).tolist()
    if lower > upper or min(rates.values()) < 0:
        raise DataError(
            f"joint {name!r} has the limits lower={lower:g}, upper={upper:g}, "
            + ", ".join(
                f"{rate}={value:g}" for rate, value in rates.items() if value < math.inf
            )
            + ": lower must not exceed upper, the others not be negative"
        )
    acceleration = min(rates["acceleration"], rates.pop("deceleration"))
    return lower, upper, rates["velocity"], acceleration, rates["jerk"]


def _mimic(element: ElementTree.Element, name: str) -> Mimic | None:
    mimic = element.find("mimic")
    if mimic is None:
        return None
    leader = mimic.get("joint")
    if not leader:
        raise DataError(f"joint {name!r}: <mimic> does not name a joint")
    [multiplier] = _numbers(element, name, "mimic", "multiplier", (1.0,)).tolist()
    [offset] = _numbers(element, name, "mimic", "offset", (0.0,)).tolist()
    return Mimic(leader, multiplier, offset)


def _root_link(links: tuple[str, ...], joints: tuple[UrdfJoint, ...]) -> str:
    """The one link from which all others hang."""
    children: dict[str, list[str]] = {}
    held: set[str] = set()
    known = set(links)
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in known:
                raise UnknownNameError("link", link, f"the URDF (joint {joint.name!r})", links)
        if joint.child in held:
            raise DataError(f"link {joint.child!r} is the child of two joints: not a tree")
        held.add(joint.child)
        children.setdefault(joint.parent, []).append(joint.child)
    roots = [link for link in links if link not in held]
    if len(roots) > 1:
        raise DataError(f"the URDF has {len(roots)} links without a parent, not one: {roots}")
    reached: set[str] = set()
    front = list(roots)
    while front:
        reached.add(link := front.pop())
        front += children.get(link, ())
    if len(reached) < len(links):
        loose = [link for link in links if link not in reached]
        raise DataError(f"the joints of the URDF form a cycle, in or above the links {loose}")
    return roots[0]
