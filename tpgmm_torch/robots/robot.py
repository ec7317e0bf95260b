"""Robots described by a URDF, or by what can be written as one."""

from __future__ import annotations

import itertools
import math
import os
import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any, Self
from xml.etree import ElementTree

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.atomic import replacing
from tpgmm_torch.data.arrays import Array, as_tensor
from tpgmm_torch.data.frames import Frame, Frames
from tpgmm_torch.exceptions import DataError, PlausibilityWarning, ShapeError, UnknownNameError
from tpgmm_torch.robots.chains import chain_to_urdf
from tpgmm_torch.robots.forward_kinematics import TreeKinematics
from tpgmm_torch.robots.kinematic_tree import reduce
from tpgmm_torch.robots.kinematics import Described, RobotState, parse_dtype
from tpgmm_torch.robots.mjcf import mjcf_to_urdf
from tpgmm_torch.robots.one_posture import OnePosture
from tpgmm_torch.robots.urdf import (
    LIMITS,
    X_AXIS,
    UrdfJoint,
    UrdfModel,
    description_text,
    free_name,
    joint_element,
    parse_xml,
    read_urdf,
)

__all__ = ["Robot"]

#: A joint vector or a chain longer than this is no robot's, and Jacobians grow with its square.
MOST_JOINTS = 1000
#: No robots that work together stand further apart [m].
FARTHEST_BASES = 5.0


class Robot(Described):
    """A robot described by a URDF; made by :meth:`from_urdf`, or from what becomes one.

    Arms which share a waist share its columns in the stacked Jacobian. Two robots are equal if
    their descriptions and settings are; the device does not count.
    """

    @classmethod
    def from_urdf(
        cls,
        urdf: str | bytes | os.PathLike[str],
        links: Sequence[str],
        *,
        joints: str | Sequence[str] | None = None,
        locked: Mapping[str, float] | None = None,
        coordinates: Sequence[str] = (),
        base: str | None = None,
        tools: Mapping[str, Sequence[Any]] | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> Self:
        """Build the kinematics of some links of a URDF.

        Parameters
        ----------
        urdf : path, str or bytes
            A file, or the text itself (bytes, or a string that begins with ``<``).
        links : sequence of str
            Names of the links (or ``tools``) whose poses are wanted.
        joints : str or sequence of str, optional
            Names and order of the joint vector. A pattern, ``"left_*"``, stands for all that
            fit it (``fnmatch``) and are not named beside it, in document order. The default
            is every movable joint that is neither locked nor mimics another, in document
            order. The others stand still.
        locked : mapping of str to float, optional
            Where joints stand that are not in the joint vector [rad or m], 0 by default. A
            pattern stands for those that are neither named beside it nor in ``joints``.
        coordinates : sequence of str, default=()
            Members of the joint vector without kinematics, like a gripper's opening, in a
            unit of their own and without limits. They follow the joints unless ``joints``
            names them, or they are joints of the URDF, which may move none of the links.
        base : str, optional
            The link in whose frame everything is expressed; it may itself be moved by
            joints. The default is the root.
        tools : mapping of str to (str, Frame), optional
            New links by name, each with its parent link and its pose there; also
            ``(parent, position, quaternion)``.
        dtype, device : torch.dtype, torch.device or str
            Of the states; float64 (or float32) on the CPU by default.

        Raises
        ------
        DataError
            If the description cannot be read, or the settings contradict it or one another.
        UnknownNameError
            If a link or a joint is not in the URDF.

        Warns
        -----
        PlausibilityWarning
            If limits of the joints cannot be, or what else the URDF says is passed over.

        Examples
        --------
        >>> urdf = '''<robot name="lift"><link name="base"/><link name="hand"/>
        ... <joint name="lift" type="prismatic"><parent link="base"/><child link="hand"/>
        ... <axis xyz="0 0 1"/><limit lower="0" upper="1" velocity="1" effort="1"/></joint>
        ... </robot>'''
        >>> robot = Robot.from_urdf(urdf, links=["hand"])
        >>> robot.state([0.3]).position("hand").tolist()
        [0.0, 0.0, 0.3]
        """
        model = read_urdf(urdf)
        extra = _names("coordinates", coordinates)
        chosen = [joints] if isinstance(joints, str) else joints
        columns, fixed = _joint_vector(model, chosen, extra, locked or {})
        config = {
            "urdf": model.text,
            "links": list(_names("links", links)),
            "joints": columns,
            "locked": fixed,
            "coordinates": list(extra),
            "base": model.root if base is None else base,
            "tools": {name: _tool(name, tool) for name, tool in dict(tools or {}).items()},
            "dtype": str(dtype).removeprefix("torch."),
        }
        return cls(model, config, device)._warn_of_doubts()

    @classmethod
    def from_mjcf(
        cls, mjcf: str | os.PathLike[str], links: Sequence[str], **settings: Any
    ) -> Self:
        """Build the kinematics of some bodies and sites of an MJCF, MuJoCo's own format.

        MuJoCo compiles it, with its includes, default classes and meshes; what comes out is
        kept as a URDF (:func:`~tpgmm_torch.robots.mjcf.mjcf_to_urdf`), so that neither the
        robot nor a model that is saved with it needs MuJoCo again.

        Parameters
        ----------
        mjcf : path or str
            A file, or the text itself (a string that begins with ``<``).
        links : sequence of str
            Names of the bodies, sites (or ``tools``) whose poses are wanted.
        **settings
            As for :meth:`from_urdf`. Everything is seen from ``world`` unless ``base`` is
            given, which a robot that floats needs: the body that carries its free joint, or
            one below.

        Raises
        ------
        DependencyError
            Without MuJoCo, of the extra ``simulation``.
        DataError, UnknownNameError
            If MuJoCo cannot compile it, or as for :meth:`from_urdf`.

        Examples
        --------
        >>> mjcf = '''<mujoco><worldbody><body name="arm" pos="0 0 1"><geom size="0.1"/>
        ... <joint name="lift" type="slide" axis="0 0 1" range="0 2" limited="true"/>
        ... <site name="tip" pos="0.5 0 0"/></body></worldbody></mujoco>'''
        >>> robot = Robot.from_mjcf(mjcf, links=["tip"])
        >>> robot.state([0.3]).position("tip").tolist(), robot.upper.tolist()
        ([0.5, 0.0, 1.3], [2.0])
        """
        return cls.from_urdf(mjcf_to_urdf(mjcf), links, **settings)

    @classmethod
    def from_chain(cls, chain: Any, links: Sequence[str], **settings: Any) -> Self:
        """Build the kinematics of some frames of a ``pytorch_kinematics.Chain``.

        That library reads SDF, too. It reads in single precision: its poses are 1e-8 to 1e-7 m
        and rad away from those of the file, here as there, and what mimics another joint
        moves freely. Of a URDF and an MJCF :meth:`from_urdf` and :meth:`from_mjcf` keep every
        digit. A chain that was built in float64 keeps its digits here.

        Parameters
        ----------
        chain : pytorch_kinematics.Chain
            Or what is derived from it; it is not kept.
        links : sequence of str
            Names of the frames (or ``tools``) whose poses are wanted.
        **settings
            As for :meth:`from_urdf`. Everything is seen from where the chain begins,
            ``world``, unless ``base`` is given.

        Raises
        ------
        DataError, UnknownNameError
            If it is no chain, or as for :meth:`from_urdf`.
        """
        return cls.from_urdf(chain_to_urdf(chain), links, **settings)

    @classmethod
    def from_file(
        cls, description: str | os.PathLike[str], links: Sequence[str], **settings: Any
    ) -> Self:
        """Read a URDF or an MJCF, whichever the outermost element says it is.

        Parameters
        ----------
        description : path or str
            A file, or the text itself (a string that begins with ``<``).
        links : sequence of str
            Names of the links (or ``tools``) whose poses are wanted.
        **settings
            As for :meth:`from_urdf`.
        """
        is_mjcf = parse_xml(description_text(description)).tag == "mujoco"
        return (cls.from_mjcf if is_mjcf else cls.from_urdf)(description, links, **settings)

    @classmethod
    def combine(
        cls,
        poses: Mapping[str, Any] | None = None,
        *,
        fixed: Mapping[str, Any] | None = None,
        base: str = "world",
        **robots: Robot,
    ) -> Self:
        """Combine robots side by side: two arms on a table are one bimanual robot.

        Parameters
        ----------
        poses : mapping of str to Frame, optional
            Where the base of each robot is in the common frame, ``world``; there by default.
            Also three numbers, a position [m], or seven, with a quaternion (w, x, y, z).
        fixed : mapping of str to Frame, optional
            Links that stand still in the common frame, like a table between the robots;
            written likewise.
        base : str, default="world"
            The link in whose frame everything is expressed: ``world``, one of ``fixed``, or
            any other.
        **robots : Robot
            By name: ``left=arm`` puts ``left_`` before the names of the arm's joints, links,
            coordinates and tools. Joint vectors and links follow one another. The dtype and
            the device are those of the first.

        Raises
        ------
        DataError
            If there is no robot, one was not made by this class, its base is moved by its own
            joints, names collide, or a pose is not seven finite numbers.
        UnknownNameError
            If ``poses`` names no robot, or ``base`` no link.

        Warns
        -----
        PlausibilityWarning
            If bases are more than 5 m apart.

        Examples
        --------
        >>> urdf = '''<robot name="lift"><link name="base"/><link name="hand"/>
        ... <joint name="lift" type="prismatic"><parent link="base"/><child link="hand"/>
        ... <axis xyz="0 0 1"/><limit lower="0" upper="1" velocity="1" effort="1"/></joint>
        ... </robot>'''
        >>> arm = Robot.from_urdf(urdf, links=["hand"])
        >>> both = Robot.combine(left=arm, right=arm, poses={"left": [0.0, 0.5, 0.0]})
        >>> both.joint_names, both.links
        (('left_lift', 'right_lift'), ('left_hand', 'right_hand'))
        >>> both.state([0.1, 0.2]).positions.tolist()
        [[0.0, 0.5, 0.1], [0.0, 0.0, 0.2]]
        """
        if not robots or not all(isinstance(robot, Robot) for robot in robots.values()):
            raise DataError(f"combine takes robots by name, left=Robot..., got {robots!r}")
        poses, fixed = dict(poses or {}), dict(fixed or {})
        for name in set(poses) - set(robots):
            raise UnknownNameError("robot", name, "the robots to combine", robots)
        roots, places = _poses(fixed, fixed), _poses(poses, robots)
        _check_bases(places)
        for name, robot in robots.items():
            roots[f"{name}_{robot.model.root}"] = places[name].compose(robot._root())
        options: dict[str, Any] = _side_by_side(robots)
        first = next(iter(robots.values())).lower
        options |= {"base": base, "dtype": first.dtype, "device": first.device}
        with warnings.catch_warnings():  # each has told its own doubts
            warnings.simplefilter("ignore", PlausibilityWarning)
            return cls.from_urdf(_merge_urdfs(robots, roots, fixed), **options)

    def __init__(
        self, model: UrdfModel, config: dict[str, Any], device: torch.device | str
    ) -> None:
        self._config = config
        #: The description of which it was made.
        self.model = model
        self.joint_names = tuple(config["joints"])
        self.links = tuple(config["links"])
        moving = model.joint.keys() - config["coordinates"]
        column = {name: i for i, name in enumerate(self.joint_names) if name in moving}
        self.lengths = tuple(
            i for name, i in column.items() if model.joint[name].type == "prismatic"
        )
        self.angles = tuple(i for i in column.values() if i not in self.lengths)
        #: Bodies that move the links with respect to the base, these last; see ``reduce``.
        self.tree = reduce(model, *_select_links(model, config), column, config["locked"])
        between = len(self.tree) - len(self.links) - 1
        if max(self.n_joints, between) > MOST_JOINTS:
            raise DataError(
                f"the robot has {self.n_joints} joints, {between} of them between its base and "
                f"links; more than {MOST_JOINTS} are not supported: choose some, "
                "joints=[...], or lock some, locked={...}"
            )
        options: dict[str, Any] = {"dtype": parse_dtype(config["dtype"]), "device": device}
        # a robot made while inference mode is on must serve where gradients are wanted, and
        # the library puts some of its constants on the default device
        with torch.inference_mode(False), torch.device("cpu"):
            limits, self.without_limits = _limits(model, self.joint_names, column)
            self.doubtful = tuple(n for n in self.without_limits if model.joint[n].doubts)
            self.lower, self.upper, self.velocity, self.acceleration, self.jerk = limits.to(
                **options
            )
            self.forward_kinematics = TreeKinematics(
                self.tree, len(self.links), self.n_joints, **options
            )

    def _warn_of_doubts(self) -> Self:
        """Warn once of all that was passed over and concerns the joints; returns the robot."""
        joints = (self.model.joint.get(name) for name in self.joint_names)
        said = {j.name: f"{j.name!r}: {' '.join(j.doubts)}" for j in joints if j and j.doubts}
        if found := [*said.values(), *self.model.doubts]:
            bounds = {"velocity": dict.fromkeys(said, 1.0)}
            remedy = (
                f", or give bounds where it moves: Controller(..., {bounds=}), in a policy "
            )
            remedy += "--policy.control.velocity"
            warnings.warn(
                f"the URDF of {self.model.name!r} says what cannot be, and it is passed over: "
                f"{'; '.join(found)}. Correct the URDF{remedy if said else ''}",
                PlausibilityWarning,
                stacklevel=3,
            )
        return self

    def state(self, joints: Any) -> RobotState:
        """Compute poses and Jacobians of all links at ``joints`` (..., n_joints).

        Raises
        ------
        ShapeError, DataError
            If there are more or fewer joints than ``joint_names``, or a value is not finite.
        """
        joints = self.joint_tensor(joints)
        if (one := self._state_of_one(joints)) is not None:
            return one
        batch = joints.shape[:-1]
        rows = joints.reshape(batch.numel(), self.n_joints)
        parts: Iterable[Tensor] = self.forward_kinematics(rows)
        if not batch:
            parts = tuple(part.squeeze(0) for part in parts)
        elif len(batch) > 1:
            parts = tuple(part.unflatten(0, batch) for part in parts)
        positions, orientations, jacobians = parts
        return RobotState(
            joints, self.links, positions, orientations, jacobians, (), self.joint_names
        )

    @cached_property
    def one_posture(self) -> OnePosture | None:
        """Kinematics of a single posture in numpy; None but in float64 on a processor."""
        plain = self.lower.dtype == torch.float64 and self.lower.is_cpu
        if not plain or type(self).state is not Robot.state:
            return None
        return OnePosture(self.tree, len(self.links), self.n_joints)

    def _state_of_one(self, joints: Tensor) -> RobotState | None:
        """Compute the state of a single posture in numpy; None where that does not serve."""
        if joints.ndim > 1 or self.one_posture is None or torch.compiler.is_compiling():
            return None
        try:
            numbers = joints.numpy()
        except RuntimeError:  # a tensor of which something is differentiated has no numbers
            return None
        positions, turns, rows = map(torch.from_numpy, self.one_posture(numbers))
        jacobians = rows[:-1].view(len(self.links), 6, self.n_joints)
        parts = positions, turns, jacobians, (), self.joint_names
        return RobotState(joints, self.links, *parts)

    def to(
        self, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> Self:
        """Convert to another dtype or device; itself if nothing changes."""
        name = str(dtype or self.lower.dtype).removeprefix("torch.")
        device = self.lower.device if device is None else torch.device(device)
        if name == self._config["dtype"] and device == self.lower.device:
            return self
        return type(self)(self.model, {**self._config, "dtype": name}, device)

    @classmethod
    def from_config(cls, config: Mapping[str, Any], device: torch.device | str = "cpu") -> Self:
        """Make the robot that gave this ``config``."""
        places = "urdf", "links", "base", "tools"
        cls._check_keys(config, *places, "joints", "locked", "coordinates", "dtype")
        if not isinstance(config["urdf"], str) or not config["urdf"].startswith("<"):
            raise DataError("a robot's configuration holds the text of its URDF, not a path")
        dtype = parse_dtype(config["dtype"])
        return cls.from_urdf(**{**config, "dtype": dtype, "device": device})

    def drop_limits(self, names: Collection[str]) -> Self:
        """Make coordinates of some joints: without limits, in any unit ("raw").

        Parameters
        ----------
        names : collection of str
            Of a gripper's joint, for example. Joints that move a link stay what they are.
        """
        moving = self.state(torch.zeros(self.n_joints)).jacobians.flatten(0, 1).any(0).tolist()
        named = zip(self.joint_names, moving, strict=True)
        more = {name for name, moves in named if name in names and not moves}
        both = dict.fromkeys((*self._config["coordinates"], *sorted(more)))
        return self.from_config({**self._config, "coordinates": [*both]}, self.lower.device)

    def save(self, path: str | Path) -> None:
        """Write the description as a URDF, tools as links of it.

        Which links, joints and base are wanted is not in it; files of shapes are named as they
        were.

        Parameters
        ----------
        path : path or str
            The file, ``"both.urdf"``.

        Raises
        ------
        OSError
            If it cannot be written.
        """
        urdf = parse_xml(self.model.text)
        for name, (parent, *pose) in self._config["tools"].items():
            ElementTree.SubElement(urdf, "link", name=name)
            _mount(urdf, parent, name, Frame(*pose))
        with replacing(path) as file:
            ElementTree.ElementTree(urdf).write(file, "utf-8", xml_declaration=True)

    def _root(self) -> Frame:
        """Locate the root of the description in the frame of the base, which it must hold."""
        config = self._config | {"links": [self.model.root], "dtype": "float64"}
        state = type(self)(self.model, config, "cpu").state(torch.zeros(self.n_joints))
        if state.jacobians.any():
            raise DataError(
                f"the base {config['base']!r} of a robot is moved by its joints: give it one "
                f"that stands still to combine it, base={self.model.root!r}"
            )
        return state.pose(self.model.root)

    def __repr__(self) -> str:
        dtype = "" if self._config["dtype"] == "float64" else f", {self._config['dtype']}"
        return (
            f"Robot({self.model.name!r}, n_joints={self.n_joints}, links={self.links}, "
            f"base={self._config['base']!r}{dtype})"
        )


def _names(argument: str, names: Sequence[str]) -> tuple[str, ...]:
    listed = () if isinstance(names, str) else tuple(names)
    if isinstance(names, str) or not all(isinstance(name, str) for name in listed):
        raise DataError(f"{argument} is a sequence of names, got {names!r}")
    if len(set(listed)) < len(listed):
        raise DataError(f"{argument} names something twice: {list(listed)}")
    return listed


def _joint_vector(
    model: UrdfModel,
    joints: Sequence[str] | None,
    coordinates: tuple[str, ...],
    locked: Mapping[str, float],
) -> tuple[list[str], dict[str, float]]:
    """Choose the names of the joint vector, and where all other actuated joints stand."""
    columns = [*_match_names(model, _names("joints", joints or ()), coordinates)]
    fixed = _locked_positions(model, locked, columns)
    if joints is None:
        columns = [name for name in model.actuated_joints if name not in fixed]
    columns = [*dict.fromkeys((*columns, *coordinates))]
    for name in fixed.keys() & {*columns}:
        raise DataError(f"joint {name!r} is both in the joint vector and locked")
    still = (name for name in model.actuated_joints if name not in columns)
    return columns, {name: fixed.get(name, 0.0) for name in still}


def _locked_positions(
    model: UrdfModel, locked: Mapping[str, float], columns: Collection[str]
) -> dict[str, float]:
    """Read where joints stand that are named, or fit a pattern and are not in ``columns``."""
    matches = _match_names(model, locked).items()
    fixed = {
        name: float(locked[key]) for name, key in matches if name == key or name not in columns
    }
    if not all(map(math.isfinite, fixed.values())):
        raise DataError(f"joints are locked at finite numbers, got {dict(locked)}")
    return fixed


def _match_names(
    model: UrdfModel, names: Collection[str], coordinates: Sequence[str] = ()
) -> dict[str, str]:
    """Find the joints or coordinates of names and patterns, each with what it is named by."""
    found: dict[str, str] = {}
    for name in names:
        fits = _match_name(model, name, coordinates)
        found |= {fit: name for fit in fits if fit == name or fit not in {*names, *found}}
    return found


def _match_name(model: UrdfModel, name: str, coordinates: Sequence[str]) -> list[str]:
    """Find the joint or coordinate of a name, or the actuated joints that fit a pattern."""
    joint = model.movable.get(name)
    if joint is not None and joint.mimic is not None:
        raise DataError(
            f"joint {name!r} mimics {joint.mimic.joint!r} and cannot be chosen or locked: "
            f"choose or lock {model.leader(name).joint!r}"
        )
    if joint is not None or name in coordinates:
        return [name]
    fits = [joint for joint in model.actuated_joints if fnmatchcase(joint, name)]
    if not fits:
        where = "the movable joints of the URDF (a coordinate without kinematics, like a "
        where += "gripper, is named in coordinates)"
        raise UnknownNameError("joint", name, where, model.actuated_joints)
    return fits


def _tool(name: str, tool: Sequence[Any]) -> list[Any]:
    """Describe a tool by plain numbers: parent link, position, quaternion."""
    if isinstance(tool, str) or not 2 <= len(tool) <= 3:
        raise DataError(
            f"tool {name!r} is (parent link, Frame) or (parent link, position, quaternion), "
            f"got {tool!r}"
        )
    parent, *pose = tool
    frame = pose[0] if isinstance(pose[0], Frame) else Frame(*pose)
    if frame.batch_shape != ():
        raise ShapeError(
            f"tool {name!r} has one constant pose in its parent link, got poses of the leading "
            f"shape {tuple(frame.batch_shape)}"
        )
    # digits as given: norms are divided out when the robot is built, and only then
    orientation = as_tensor(pose[1], name) if len(pose) > 1 else frame.orientation
    return [parent, frame.position.tolist(), orientation.tolist()]


def _pose(name: str, given: Any) -> Frame:
    """Read a pose as it is given to ``combine``."""
    if isinstance(given, Frame):
        return given.to(torch.float64)
    values = as_tensor(given, f"the pose of {name!r}").to(torch.float64)
    if tuple(values.shape) not in ((3,), (7,)):
        allowed = "a Frame, x y z in metres, or x y z qw qx qy qz"
        raise DataError(f"the pose of {name!r} is {allowed}; got {given!r}")
    return Frame(values[:3], values[3:] if len(values) > 3 else None)


def _poses(given: Mapping[str, Any], names: Iterable[str]) -> dict[str, Frame]:
    return {name: _pose(name, given.get(name, [0, 0, 0])) for name in names}


def _check_bases(places: Frames) -> None:
    """Warn of bases that no robots have which work together."""
    at = torch.stack([place.position for place in places.values()])
    if (apart := float(torch.cdist(at, at).max())) > FARTHEST_BASES:
        told = f"bases of {[*places]} are {apart:.4g} m apart: are poses in metres, or in "
        warnings.warn(f"{told}centimetres?", PlausibilityWarning, stacklevel=3)


def _select_links(
    model: UrdfModel, config: Mapping[str, Any]
) -> tuple[str, list[tuple[str, Array]]]:
    """Select the base, and for each link one of the URDF and the pose in it."""
    here = np.eye(4)
    places = {link: (link, here) for link in model.links}
    if config["base"] not in places:
        raise UnknownNameError("base link", config["base"], "the URDF", model.links)
    for name, (parent, position, orientation) in config["tools"].items():
        if name in model.links:
            raise DataError(f"tool {name!r} has the name of a link of the URDF")
        if parent not in model.links:
            raise UnknownNameError("link", parent, f"the URDF (tool {name!r})", model.links)
        places[name] = parent, _matrix(Frame(position, orientation))
    for link in config["links"]:
        if link not in places:
            raise UnknownNameError("link", link, "the URDF and the tools", places)
    return config["base"], [places[link] for link in config["links"]]


def _merge_urdfs(robots: Mapping[str, Robot], roots: Frames, fixed: Iterable[str]) -> str:
    """Merge robots and fixed links, whose roots are somewhere in a world."""
    urdf = ElementTree.Element("robot", name=" and ".join(robots))
    urdf.extend(ElementTree.Element("link", name=link) for link in ("world", *fixed))
    for name, robot in robots.items():
        urdf.extend(_prefix_names(name, robot))
    for link, frame in roots.items():
        _mount(urdf, "world", link, frame)
    return ElementTree.tostring(urdf, encoding="unicode")


def _mount(urdf: ElementTree.Element, parent: str, link: str, pose: Frame) -> None:
    """Fix a link to another one."""
    name = free_name(f"{link}_mount", [part.get("name", "") for part in urdf])
    urdf.append(joint_element(UrdfJoint(name, "fixed", parent, link, _matrix(pose), X_AXIS)))


def _prefix_names(prefix: str, robot: Robot) -> list[ElementTree.Element]:
    """Put a prefix before all names of links, joints and materials of a robot."""
    urdf = parse_xml(robot.model.text)
    parts = [part for part in urdf if part.tag in ("link", "joint", "material")]
    for element in itertools.chain.from_iterable(part.iter() for part in parts):
        for key in ("name", "link", "joint"):
            if element.get(key):
                element.set(key, f"{prefix}_{element.get(key)}")
    return parts


def _side_by_side(robots: Mapping[str, Robot]) -> dict[str, Any]:
    """Join the settings of robots by name, which stands before their names."""
    settings: dict[str, Any] = {"links": [], "joints": [], "coordinates": []}
    settings |= {"locked": {}, "tools": {}}
    for prefix, robot in robots.items():
        config = robot._config
        for key in ("links", "joints", "coordinates"):
            settings[key] += [f"{prefix}_{name}" for name in config[key]]
        settings["locked"] |= {f"{prefix}_{name}": at for name, at in config["locked"].items()}
        for tool, (parent, *pose) in config["tools"].items():
            settings["tools"][f"{prefix}_{tool}"] = f"{prefix}_{parent}", *pose
    return settings


def _matrix(pose: Frame) -> Array:
    """Convert a constant pose to a homogeneous matrix."""
    if pose.batch_shape != ():
        raise ShapeError(f"expected one constant pose, got {tuple(pose.batch_shape)} of them")
    matrix = np.eye(4)
    matrix[:3, :3] = quaternions.to_matrix(pose.orientation).cpu().numpy()
    matrix[:3, 3] = pose.position.cpu().numpy()
    return matrix


def _limits(
    model: UrdfModel, names: Sequence[str], moving: Collection[str]
) -> tuple[Tensor, tuple[str, ...]]:
    """Tabulate lower, upper, velocity, acceleration, jerk; list joints that lack a limit.

    Joints that mimic another limit it too. Coordinates without kinematics have no limits, and
    lack none.
    """
    rows = {name: [-math.inf, *[math.inf] * 4] for name in names}
    rows |= {name: [getattr(model.joint[name], key) for key in LIMITS] for name in moving}
    without = {name for name in moving if model.joint[name].lacks_limits}
    followers = [joint for joint in model.movable.values() if joint.mimic is not None]
    for joint in followers:
        if not _limit_leader(model, joint, rows, moving):
            without.add(model.leader(joint.name).joint)
    limits = torch.tensor(list(rows.values()), dtype=torch.float64)
    return limits.reshape(-1, 5).T, tuple(sorted(without, key=names.index))


def _limit_leader(
    model: UrdfModel, joint: UrdfJoint, rows: Mapping[str, list[float]], moving: Collection[str]
) -> bool:
    """Apply the limits of a joint that mimics another to that other, which moves with it.

    Limits that leave it a single point, as where a sign was forgotten, do not count: the
    answer is False.
    """
    leader = model.leader(joint.name)
    if leader.joint not in moving or leader.multiplier == 0:
        return True
    row, factor = rows[leader.joint], leader.multiplier
    rates = joint.velocity, joint.acceleration, joint.jerk
    row[2:] = [min(old, new / abs(factor)) for old, new in zip(row[2:], rates, strict=True)]
    ends = sorted((end - leader.offset) / factor for end in (joint.lower, joint.upper))
    low, high = max(row[0], ends[0]), min(row[1], ends[1])
    if high - low < 1e-9 < row[1] - row[0]:
        return False
    row[:2] = low, high
    return True
