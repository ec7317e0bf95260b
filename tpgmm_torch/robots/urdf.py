"""Reader of URDF robot descriptions: the links, and the joints that hold them together.

Only kinematics is read: meshes, inertia, transmissions and plugins are passed over. What
the `URDF specification <https://wiki.ros.org/urdf/XML>`_ leaves out of a joint has its
default there (axis ``1 0 0``, no offset). Numbers stay float64.
"""

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

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
    "parse_xml",
    "placement",
    "read_urdf",
]

#: Degrees of freedom by type of joint. Joints of several are read, but move no :class:`Robot`.
FREEDOMS = {
    "fixed": 0,
    "revolute": 1,
    "continuous": 1,
    "prismatic": 1,
    "planar": 3,
    "floating": 6,
}
XACRO = "the URDF holds xacro macros: expand them first (xacro FILE > ROBOT.urdf)"
#: What may stand before the first element of a text: a byte order mark, and space.
BEFORE_XML = "\ufeff \t\r\n"
#: What to do with a description that begins with another element.
OTHER_FORMATS = {
    "mujoco": ": that is an MJCF, Robot.from_mjcf reads it",
    "sdf": ": that is an SDF; pytorch_kinematics reads it, Robot.from_chain takes its chain",
}
#: The axis of a joint that names none.
X_AXIS = np.array([1.0, 0.0, 0.0])
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
        return FREEDOMS[self.type] == 1


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


def parse_xml(text: str) -> ElementTree.Element:
    """The outermost element of a description; prefixes and namespaces mean nothing.

    Parameters
    ----------
    text : str

    Raises
    ------
    DataError
        If it is not well-formed, or declares a document type: with one, entities could be
        declared that expand without bound.
    """

    def refuse(name: str, *_: Any) -> None:
        raise DataError(
            f"the description declares a document type ({name!r}): remove <!DOCTYPE ...>"
        )

    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(text, True)
        return builder.close()
    except (expat.ExpatError, ValueError) as error:
        reason = f"the description is not well-formed XML: {error}"
        raise DataError(XACRO if "<xacro:" in text else reason) from error


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
    root = parse_xml(text)
    if root.tag != "robot":
        other = OTHER_FORMATS.get(root.tag, "")
        raise DataError(f"a URDF has the root element <robot>, got <{root.tag}>{other}")
    if any(element.tag.startswith("xacro:") for element in root.iter()):
        raise DataError(XACRO)
    links = tuple(_names(root, "link"))
    if not links:
        raise DataError("the URDF has no link")
    _names(root, "joint")
    joints = tuple(map(_joint, root.findall("joint")))
    return UrdfModel(root.get("name", ""), text, _root_link(links, joints), links, joints)


def is_text(source: str | bytes | os.PathLike[str]) -> bool:
    """Whether a description, ``source``, is given as text, and not as the path of a file."""
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
    for number, element in enumerate(root.findall(tag), 1):
        name = element.get("name")
        if not name:
            raise DataError(f"<{tag}> number {number} of the URDF has no name")
        if name in names:
            raise DataError(f"the URDF has two {tag}s named {name!r}")
        names[name] = None
    return list(names)


def _joint(element: ElementTree.Element) -> UrdfJoint:
    name, kind = element.get("name", ""), element.get("type", "")
    if kind not in FREEDOMS:
        raise DataError(f"joint {name!r} has type {kind!r}; URDF knows {sorted(FREEDOMS)}")
    ends = []
    for side in ("parent", "child"):
        end = element.find(side)
        if end is None or not end.get("link"):
            raise DataError(f"joint {name!r} has no {side} link")
        ends.append(end.get("link", ""))
    xyz, rpy = (_numbers(element, "origin", key, 0.0, 0.0, 0.0) for key in ("xyz", "rpy"))
    joint = UrdfJoint(name, kind, ends[0], ends[1], placement(xyz, rpy), X_AXIS)
    if not joint.movable:
        return joint
    return replace(joint, axis=_axis(element), mimic=_mimic(element), **_limits(element))


def _axis(element: ElementTree.Element) -> Array:
    axis = np.array(_numbers(element, "axis", "xyz", *X_AXIS))
    if not axis.any():
        name = element.get("name")
        raise DataError(f"joint {name!r} has the axis 0 0 0: it needs a direction")
    axis /= np.abs(axis).max()  # a direction alone: the square of a length may overflow
    unit: Array = axis / np.linalg.norm(axis)
    return unit


def _limits(element: ElementTree.Element) -> dict[str, Any]:
    """Range and rates; values that cannot be, as tools write -1 or 0, are no limits.

    Without a range ``<limit>`` gives effort and velocity alone.
    """
    limit, lower, upper = element.find("limit"), -math.inf, math.inf
    given = set() if limit is None or element.get("type") == "continuous" else set(limit.keys())
    if given & {"lower", "upper"}:
        [low], [high] = (_numbers(element, "limit", key, 0.0) for key in ("lower", "upper"))
        lower, upper = (low, high) if low <= high else (lower, upper)
    velocity, acceleration, deceleration, jerk = (
        rate if rate > 0 else math.inf
        for key in ("velocity", "acceleration", "deceleration", "jerk")
        for rate in _numbers(element, "limit", key, math.inf)
    )
    limits = {"lower": lower, "upper": upper, "velocity": velocity, "jerk": jerk}
    return {**limits, "acceleration": min(acceleration, deceleration)}


def _mimic(element: ElementTree.Element) -> Mimic | None:
    follows = element.find("mimic")
    if follows is None:
        return None
    if not follows.get("joint"):
        raise DataError(f"joint {element.get('name')!r}: <mimic> does not name a joint")
    [multiplier] = _numbers(element, "mimic", "multiplier", 1.0)
    [offset] = _numbers(element, "mimic", "offset", 0.0)
    return Mimic(follows.get("joint", ""), multiplier, offset)


def _numbers(
    element: ElementTree.Element, tag: str, attribute: str, *default: float
) -> list[float]:
    """The finite numbers of an attribute of a joint's child, as many as ``default``."""
    child = element.find(tag)
    text = None if child is None else child.get(attribute)
    if text is None:
        return [*default]
    what = f"joint {element.get('name')!r}: <{tag} {attribute}>"
    shown = repr(text if len(text) <= 100 else f"{text[:100]} ...")
    values = _finite(text)
    if len(values) != len(default):
        hint = f". {XACRO}" if "${" in text or "$(" in text else ""
        raise DataError(f"{what} needs {len(default)} finite number(s), got {shown}{hint}")
    if tag in ("origin", "mimic") and max(map(abs, values)) > LARGEST:
        raise DataError(f"{what} is {shown}, and no robot's is beyond {LARGEST:g}")
    return values


def _finite(text: str) -> list[float]:
    """The numbers of a text; none if something in it is no finite number."""
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        return []
    return values if all(map(math.isfinite, values)) else []


def placement(xyz: Sequence[float], rpy: Sequence[float]) -> Array:
    """Homogeneous matrix of a URDF origin: rotations about the fixed x, then y, then z axis.

    Parameters
    ----------
    xyz, rpy : sequence of three floats
        Metres, radians.
    """
    pose = np.eye(4)
    pose[:3, 3] = xyz
    for angle, (i, j) in zip(rpy, ((1, 2), (2, 0), (0, 1)), strict=True):
        turn = np.eye(4)
        turn[[i, j], [i, j]] = math.cos(angle)
        turn[i, j], turn[j, i] = -math.sin(angle), math.sin(angle)
        pose[:3, :3] = turn[:3, :3] @ pose[:3, :3]
    return pose


def _root_link(links: tuple[str, ...], joints: tuple[UrdfJoint, ...]) -> str:
    """The one link from which all others hang."""
    above = _parents(links, joints)
    roots = [link for link in links if link not in above]
    if len(roots) > 1:
        raise DataError(f"the URDF has {len(roots)} links without a parent, not one: {roots}")
    reached = set(roots)
    for link in links:
        way = dict[str, None]()
        while link not in reached and link not in way:
            way[link] = None
            link = above[link]
        if link in way:
            raise DataError(f"the joints of the URDF form a cycle: {' < '.join([*way, link])}")
        reached.update(way)
    return roots[0]


def _parents(links: tuple[str, ...], joints: tuple[UrdfJoint, ...]) -> dict[str, str]:
    """The parent of each link that has one."""
    known, above = set(links), dict[str, str]()
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in known:
                raise UnknownNameError("link", link, f"the URDF (joint {joint.name!r})", links)
        if joint.child in above:
            raise DataError(f"link {joint.child!r} is the child of two joints: not a tree")
        above[joint.child] = joint.parent
    return above
