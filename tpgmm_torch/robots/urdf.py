"""Reader and writer of URDF robot descriptions: the links, and the joints between them.

Only kinematics is read: meshes, inertia, transmissions and plugins are passed over. What
the `URDF specification <https://wiki.ros.org/urdf/XML>`_ leaves out of a joint has its
default there (axis ``1 0 0``, no offset). Numbers stay float64.
"""

import math
import os
import re
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from tpgmm_torch.atomic import read_whole
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.exceptions import DataError, TPGMMError, UnknownNameError

#: Limits of a joint, in the order in which they are tabulated.
LIMITS = ("lower", "upper", "velocity", "acceleration", "jerk")
#: Degrees of freedom by type of joint. Joints of several are read, but move no :class:`Robot`.
SINGLE = dict.fromkeys(("revolute", "continuous", "prismatic"), 1)
FREEDOMS = {"fixed": 0, **SINGLE, "planar": 3, "floating": 6}
XACRO = "the URDF holds xacro macros: expand them first (xacro FILE > ROBOT.urdf)"
#: What readers of URDF pass over, and expat does not: comments with ``--`` in them,
#: instructions and declarations anywhere, control characters. What has no end is the rest.
PASSED_OVER = re.compile(
    r"<!--.*?(?:-->|\Z)|<\?.*?(?:\?>|\Z)|[\0-\x08\x0b\x0c\x0e-\x1f]", re.DOTALL
)
UNEXPANDED = re.compile(r"\$[{(]|<xacro:")
#: An ampersand that begins none of XML's own references.
AMPERSAND = re.compile(r"&(?!(?:amp|lt|gt|quot|apos|#\d+|#x[\da-fA-F]+);)")
#: What may stand before the first element of a text: a byte order mark, and space.
BEFORE_XML = "\ufeff \t\r\n"
#: The axis of a joint that names none.
X_AXIS = np.array([1.0, 0.0, 0.0])


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
    doubts : tuple of str
        Limits that cannot be, as they are written; they count as none.
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
    doubts: tuple[str, ...] = ()

    @property
    def lacks_limits(self) -> bool:
        """Lacks a limit of position or speed that it should have."""
        endless = self.type != "continuous" and math.isinf(self.upper)
        return endless or math.isinf(self.velocity)

    @property
    def movable(self) -> bool:
        """Has one degree of freedom."""
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
    doubts : tuple of str
        What was passed over, as it cannot be meant: macros left over, mimicry of nothing.
    """

    name: str
    text: str
    root: str
    links: tuple[str, ...]
    joints: tuple[UrdfJoint, ...]
    doubts: tuple[str, ...] = ()

    @cached_property
    def joint(self) -> dict[str, UrdfJoint]:
        """The joints by name."""
        return {joint.name: joint for joint in self.joints}

    @cached_property
    def movable(self) -> dict[str, UrdfJoint]:
        """The joints of one degree of freedom by name, in document order."""
        return {joint.name: joint for joint in self.joints if joint.movable}

    @cached_property
    def actuated_joints(self) -> tuple[str, ...]:
        """Names of those that follow no other joint."""
        return tuple(name for name, joint in self.movable.items() if joint.mimic is None)

    def leader(self, name: str) -> Mimic:
        """Find the actuated joint on which a movable joint depends, and how.

        Parameters
        ----------
        name : str
            A movable joint; one that mimics no other leads itself.
        """
        multiplier, offset = 1.0, 0.0
        while (mimic := self.joint[name].mimic) is not None:
            offset += multiplier * mimic.offset
            multiplier *= mimic.multiplier
            name = mimic.joint
        return Mimic(name, multiplier, offset)


def is_text(source: str | bytes | os.PathLike[str]) -> bool:
    """Check whether a description, ``source``, is text, and not the path of a file."""
    return isinstance(source, str) and source.lstrip(BEFORE_XML).startswith("<")


def description_text(source: str | bytes | os.PathLike[str]) -> str:
    """Read the text of a robot's description, in UTF-8 or else Latin-1.

    Parameters
    ----------
    source : str, bytes or path
        A path, or the text itself (bytes, or a string that begins with ``<``).

    Raises
    ------
    DataError
        If the file cannot be read, or is no text in one of these.
    """
    if is_text(source):
        return str(source).lstrip(BEFORE_XML)
    try:
        content = source if isinstance(source, bytes) else read_whole(Path(source))
        return content.decode("utf-8-sig").lstrip(BEFORE_XML)
    except UnicodeDecodeError as error:
        if is_text(text := content.removeprefix(b"\xef\xbb\xbf").decode("latin-1")):
            return text.lstrip(BEFORE_XML)
        raise DataError(
            f"the robot's description is not UTF-8 text, convert it: {error}"
        ) from error
    except (OSError, ValueError) as error:
        raise DataError(f"the robot's description cannot be read: {error}") from error


def parse_xml(text: str) -> ElementTree.Element:
    """Parse a description; prefixes, namespaces and comments mean nothing.

    Parameters
    ----------
    text : str
        Of a URDF or an MJCF.

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
        parser.Parse(AMPERSAND.sub("&amp;", PASSED_OVER.sub("", text)).lstrip(), True)
        return builder.close()
    except (expat.ExpatError, UnicodeError) as error:
        raise DataError(f"the description is not well-formed XML: {error}") from error


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
        hint = ": that is an MJCF, Robot.from_mjcf reads it" if root.tag == "mujoco" else ""
        raise DataError(f"a URDF has the root element <robot>, got <{root.tag}>{hint}")
    try:
        links, _ = _names(root, "link"), _names(root, "joint")
        joints = tuple(map(_joint, root.findall("joint")))
        base = _root_link(links, joints)
    except TPGMMError as error:
        if UNEXPANDED.search(text):
            raise DataError(f"{XACRO}; {error}") from error
        raise
    doubts = _find_macros(root)
    if lost := _lost_mimicry(joints):
        joints = tuple(replace(j, mimic=None) if j.name in lost else j for j in joints)
        doubts.append(f"mimicry of what does not move, or in a circle, by {', '.join(lost)}")
    return UrdfModel(root.get("name", ""), text, base, links, joints, tuple(doubts))


def _find_macros(root: ElementTree.Element) -> list[str]:
    """List the doubt that macros are left over, if there are any."""
    macros = sorted({part.tag for part in root.iter() if part.tag.startswith("xacro:")})
    return [f"{', '.join(macros)} left over (xacro expands them)"] if macros else []


def _lost_mimicry(joints: Iterable[UrdfJoint]) -> list[str]:
    """Find joints that mimic none that moves, or in the end themselves."""
    mimicry = {j.name: j.mimic.joint if j.mimic else "" for j in joints if j.movable}
    lost = []
    for name, leader in mimicry.items():
        way = [leader]
        while way[-1] in mimicry and len(way) <= len(mimicry):
            way.append(mimicry[way[-1]])
        if leader and (name in way or leader not in mimicry):
            lost.append(name)
    return lost


def _names(root: ElementTree.Element, tag: str) -> tuple[str, ...]:
    names = [element.get("name", "") for element in root.findall(tag)]
    if not all(names):
        raise DataError(f"<{tag}> number {names.index('') + 1} of the URDF has no name")
    name, count = Counter(names).most_common(1)[0] if names else ("", 0)
    if count > 1:
        raise DataError(f"the URDF has two {tag}s named {name!r}")
    return tuple(names)


def _root_link(links: Sequence[str], joints: Sequence[UrdfJoint]) -> str:
    """Find the one link from which all others hang."""
    known, above, below = set(links), set[str](), defaultdict[str, list[str]](list)
    for joint in joints:
        for link in {joint.parent, joint.child} - known:
            raise UnknownNameError("link", link, f"the URDF (joint {joint.name!r})", links)
        if joint.child in above:
            raise DataError(f"link {joint.child!r} is the child of two joints: not a tree")
        above.add(joint.child)
        below[joint.parent].append(joint.child)
    roots = [link for link in links if link not in above]
    reached = list(roots)
    for link in reached:  # which grows
        reached += below[link]
    if len(roots) > 1 or not links:
        raise DataError(f"the URDF has {len(roots)} links without a parent, not one: {roots}")
    if cycle := known - set(reached):
        raise DataError(f"the joints of the URDF form a cycle of the links {sorted(cycle)}")
    return roots[0]


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
    axis = np.array(_numbers(element, "axis", "xyz", *X_AXIS))
    if not axis.any():
        raise DataError(f"joint {name!r} has the axis 0 0 0: it needs a direction")
    axis /= np.abs(axis).max()  # a direction alone: the square of a length may overflow
    axis /= np.linalg.norm(axis)
    return replace(joint, axis=axis, mimic=_mimic(element), **_limits(element))


def _limits(element: ElementTree.Element) -> dict[str, Any]:
    """Read range and rates; values that cannot be, as tools write -1 or 0, are no limits.

    Without a range ``<limit>`` gives effort and velocity alone.
    """
    given: dict[str, str] = getattr(element.find("limit"), "attrib", {})
    limits, doubts = _rates(given)
    if element.get("type") != "continuous" and {"lower", "upper"} & given.keys():
        ends = {key: _number(given.get(key, 0.0)) for key in ("lower", "upper")}
        # CAD programs write zeros where nobody has filled in anything
        if ends["lower"] < ends["upper"] or (ends["lower"] == ends["upper"] and not doubts):
            limits |= ends
        else:
            doubts.append(" ".join(f'{key}="{given.get(key, 0)}"' for key in ends))
    return limits | {"doubts": tuple(doubts)}


def _rates(given: Mapping[str, str]) -> tuple[dict[str, Any], list[str]]:
    """Read velocity, acceleration and jerk, and what of them cannot be."""
    keys = ("velocity", "acceleration", "deceleration", "jerk")
    rates = {key: _number(given.get(key, math.inf)) for key in keys}
    doubts = [f'{key}="{given[key][:20]}"' for key in keys if not rates[key] > 0]
    limits = {key: rate for key, rate in rates.items() if rate > 0}
    slowing = limits.pop("deceleration", math.inf)
    limits["acceleration"] = min(limits.get("acceleration", math.inf), slowing)
    return limits, doubts


def _number(text: str | float) -> float:
    """Read a number in an attribute; NaN if the text is no number."""
    try:
        return float(text)
    except ValueError:
        return math.nan


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
    """Read the finite numbers of an attribute of a joint's child, as many as ``default``."""
    child = element.find(tag)
    text = None if child is None else child.get(attribute)
    if text is None:
        return [*default]
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    # the squares of lengths and factors have to be finite in float32, too
    whole = float(np.finfo(np.float32).max) ** 0.5
    largest = whole if tag in ("origin", "mimic") else sys.float_info.max
    if len(values) != len(default) or not all(abs(value) <= largest for value in values):
        raise DataError(
            f"joint {element.get('name')!r}: <{tag} {attribute}> needs {len(default)} finite "
            f"number(s) up to {largest:.3g}, got {text[:100]!r}"
        )
    return values


def placement(xyz: Sequence[float], rpy: Sequence[float]) -> Array:
    """Compute the matrix of an origin: rotations about the fixed x, then y, then z axis.

    Parameters
    ----------
    xyz, rpy : sequence of three floats
        Metres, radians.
    """
    pose = np.eye(4)
    for axis, angle in zip(np.eye(3), rpy, strict=True):
        pose = motion("revolute", axis, angle) @ pose
    pose[:3, 3] = xyz
    return pose


def motion(kind: str, axis: Array, value: float) -> Array:
    """Compute the matrix of a joint's motion (Rodrigues' formula, or a translation).

    Parameters
    ----------
    kind : str
        A type of URDF joints; "prismatic" slides, others turn.
    axis : ndarray of shape (3,)
        A unit vector.
    value : float
        Metres or radians.
    """
    matrix = np.eye(4)
    if kind == "prismatic":
        matrix[:3, 3] = value * axis
        return matrix
    cross = np.cross(axis, np.eye(3)).T
    matrix[:3, :3] += math.sin(value) * cross + (1.0 - math.cos(value)) * (cross @ cross)
    return matrix


def write_urdf(
    name: str,
    root: str,
    joints: Iterable[UrdfJoint],
    visuals: Mapping[str, Sequence[ElementTree.Element]] | None = None,
) -> str:
    """Write a description, its numbers to the last digit of float64.

    Parameters
    ----------
    name, root : str
        Of the robot, and of the link from which all others hang.
    joints : iterable of UrdfJoint
        The links are the root and their children.
    visuals : mapping of str to sequence of Element, optional
        The ``<visual>`` elements of links by name.
    """
    robot = ElementTree.Element("robot", name=name)
    joints = list(joints)
    for link in (root, *(joint.child for joint in joints)):
        ElementTree.SubElement(robot, "link", name=link).extend((visuals or {}).get(link, ()))
    robot.extend(map(joint_element, joints))
    ElementTree.indent(robot, "")
    return ElementTree.tostring(robot, encoding="unicode")


def joint_element(joint: UrdfJoint) -> ElementTree.Element:
    """Write the ``<joint>`` of a joint."""
    element = ElementTree.Element("joint", name=joint.name, type=joint.type)
    ElementTree.SubElement(element, "parent", link=joint.parent)
    ElementTree.SubElement(element, "child", link=joint.child)
    element.append(origin(joint.origin))
    if not joint.movable:
        return element
    ElementTree.SubElement(element, "axis", xyz=numbers(joint.axis))
    given = {key: getattr(joint, key) for key in LIMITS}
    limits = {key: numbers([value]) for key, value in given.items() if abs(value) < math.inf}
    if limits:
        ElementTree.SubElement(element, "limit", limits)
    if joint.mimic is not None:
        line = {k: numbers([getattr(joint.mimic, k)]) for k in ("multiplier", "offset")}
        ElementTree.SubElement(element, "mimic", line, joint=joint.mimic.joint)
    return element


def origin(pose: Array) -> ElementTree.Element:
    """Write the ``<origin>`` of a homogeneous matrix ``pose``."""
    rpy = roll_pitch_yaw(pose[:3, :3])
    return ElementTree.Element("origin", xyz=numbers(pose[:3, 3]), rpy=numbers(rpy))


def numbers(values: Iterable[float]) -> str:
    """Write the ``values`` of an attribute, to the last digit."""
    return " ".join(repr(float(value)) for value in values)


def roll_pitch_yaw(rotation: Array) -> Array:
    """Compute the angles of which :func:`placement` makes a rotation again.

    With the yaw undone a rotation is ``R_y(pitch) R_x(roll)``, whatever the yaw: where the
    pitch is a right angle and leaves it open, any will do, and no digits are lost nearby.

    Parameters
    ----------
    rotation : ndarray of shape (3, 3)
        Orthogonal, of determinant 1.
    """
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    back = motion("revolute", np.eye(3)[2], -yaw)[:3, :3] @ rotation
    roll = math.atan2(-back[1, 2], back[1, 1])
    return np.array([roll, math.atan2(-back[2, 0], back[0, 0]), yaw])


def free_name(name: str, taken: Iterable[str]) -> str:
    """Append underscores to ``name`` until it is not ``taken``."""
    while name in taken:
        name += "_"
    return name
