"""The cell file: cameras, objects with tags, tags that check, offsets of joints.

A JSON file, written by ``tpgmm calibrate`` and edited by hand. Poses are ``[x, y, z, qw, qx,
qy, qz]`` [m]; the base frame is that of the robot's description.

.. code-block:: json

    {
      "cameras": {
        "front": {
          "key": "observation.images.front",
          "size": [640, 480], "focal_length": [554.0, 554.0], "principal_point": [319.5, 239.5],
          "distortion": [0.0, 0.0, 0.0, 0.0, 0.0],
          "pose": [0.9, 0.4, 0.6, 0.35, 0.26, 0.54, 0.72]
        }
      },
      "objects": {
        "cup": {"target": {"cube": [10, 11, 12, 13, 14], "size": 0.04},
                "pose": [0.0, 0.0, -0.08, 1.0, 0.0, 0.0, 0.0], "upright": true}
      },
      "checks": {"base": {"target": {"tag": 0, "size": 0.06},
                          "pose": [0.1, 0.2, 0.0, 1.0, 0.0, 0.0, 0.0]}},
      "joints": ["shoulder_pan", "shoulder_lift"],
      "joint_offsets": {"shoulder_lift": 0.012}
    }
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tpgmm_torch.atomic import read_whole, replacing
from tpgmm_torch.data.pose_names import is_gripper
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_vision.camera import Camera
from tpgmm_vision.poses import Array, angle_between, inverse, pose_matrix, pose_vector
from tpgmm_vision.targets import Target, target_from

__all__ = ["Cell", "read_cell", "write_cell"]

#: Poses that are nearer to each other are the same: [mm], [deg].
SAME_PLACE, SAME_ANGLE = 0.1, 0.02
#: How many numbers each part of a lens has.
LENS = {"focal_length": 2, "principal_point": 2, "distortion": 5}


@dataclass(frozen=True, eq=False)
class CellCamera:
    """A camera of a cell.

    Parameters
    ----------
    camera : Camera
        Its intrinsics.
    key : str
        Its feature in data sets and observations.
    pose : ndarray of shape (4, 4), optional
        Of the camera in the base frame, or in that of ``link``; None before ``tpgmm calibrate
        cell``.
    link : str, optional
        The link that carries it.
    """

    camera: Camera
    key: str
    pose: Array | None = None
    link: str | None = None


@dataclass(frozen=True, eq=False)
class CellObject:
    """An object with tags on it.

    Parameters
    ----------
    target : Target
        Without tags where another source finds the object.
    pose : ndarray of shape (4, 4)
        Of the object's frame in that of the target, or in what the other source finds.
    upright : bool
        Whether its z axis is always vertical.
    height : float, optional
        Of its origin in the base frame, while nobody holds it [m].
    """

    target: Target = field(default_factory=lambda: Target({}))
    pose: Array = field(default_factory=lambda: np.eye(4))
    upright: bool = False
    height: float | None = None


@dataclass(frozen=True, eq=False)
class CellCheck:
    """A tag that stands still, by which a camera that was moved is noticed.

    Parameters
    ----------
    target : Target
    pose : ndarray of shape (4, 4)
        Of the target in the base frame.
    """

    target: Target
    pose: Array


@dataclass(frozen=True, eq=False)
class Cell:
    """Description of a workcell: cameras, objects, checks and offsets.

    Parameters
    ----------
    cameras, objects, checks : mapping of str to CellCamera, CellObject, CellCheck
    joint_offsets : mapping of str to float
        What is added to measured joints to make them those of the robot's description [rad].
    joints : tuple of str
        Of the robot that it was calibrated with; empty if that was none.
    source : str, default="tags"
        What finds the objects, by the name of its entry point,
        :data:`tpgmm_vision.sources.SOURCES`.
    content : mapping
        What a file says of it, from which :func:`cell_from` makes it.
    """

    cameras: Mapping[str, CellCamera] = field(default_factory=dict)
    objects: Mapping[str, CellObject] = field(default_factory=dict)
    checks: Mapping[str, CellCheck] = field(default_factory=dict)
    joint_offsets: Mapping[str, float] = field(default_factory=dict)
    joints: tuple[str, ...] = ()
    source: str = "tags"
    content: Mapping[str, Any] = field(default_factory=dict)

    def differences(self, other: Cell) -> list[str]:
        """Differences from another cell, in words, one for each thing."""
        found = []
        for kind in ("cameras", "objects", "checks"):
            before, after = getattr(self, kind), getattr(other, kind)
            for name in sorted(before.keys() | after):
                changes = [f"is {'missing' if name in before else 'new'}"]
                if name in before and name in after:
                    contents = self.content[kind][name], other.content[kind][name]
                    changes = _compare_entries(*contents)
                    changes += _compare_poses(before[name].pose, after[name].pose)
                found += [f"{name!r} of the {kind} {change}" for change in changes]
        return found + [
            f"joint {name!r} is offset by {math.degrees(shift):+.2f} deg more"
            for name, shift in self.shifts(other).items()
        ]

    def shifts(self, other: Cell) -> dict[str, float]:
        """By how much the offsets of joints are larger in another cell [rad]."""
        one, two = self.joint_offsets, other.joint_offsets
        shifts = {name: two.get(name, 0.0) - one.get(name, 0.0) for name in {**one, **two}}
        return {name: shift for name, shift in shifts.items() if shift}

    @property
    def links(self) -> tuple[str, ...]:
        """Links that carry cameras."""
        found = (one.link for one in self.cameras.values())
        return tuple(dict.fromkeys(link for link in found if link is not None))

    def require_placed_cameras(self) -> dict[str, CellCamera]:
        """Return the cameras, and refuse one without a pose.

        Raises
        ------
        DataError
            If one has no pose, or the cell has no camera.
        """
        if not self.cameras:
            raise DataError("the cell has no cameras: tpgmm calibrate camera adds one")
        if missing := [name for name, one in self.cameras.items() if one.pose is None]:
            problem = f"cameras {missing} of the cell have no pose"
            raise DataError(f"{problem}: tpgmm calibrate cell finds it")
        return dict(self.cameras)


def _compare_entries(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[str]:
    """Compare what files say of a thing, apart from its pose."""
    keys = sorted({*before, *after} - {"pose", "report"})
    changed = [key for key in keys if before.get(key) != after.get(key)]
    return [f"has another {' and '.join(changed)}"] if changed else []


def _compare_poses(before: Array | None, after: Array | None) -> list[str]:
    """Compare the poses of a thing, where both are known."""
    if before is None or after is None:
        return []
    step = inverse(before) @ after
    moved = 1e3 * float(np.linalg.norm(step[:3, 3]))
    turned = math.degrees(angle_between(np.eye(4), step))
    if moved <= SAME_PLACE and turned <= SAME_ANGLE:
        return []
    return [f"was moved by {moved:.1f} mm and {turned:.2f} deg"]


def check_robot(cell: Cell, robot: Any) -> None:
    """Refuse a cell of another robot.

    Its joints are all among the robot's, or all of the robot's among them; grippers, which move
    no hand, do not count.

    Raises
    ------
    DataError, UnknownNameError
    """
    if robot is None:
        if cell.links:
            raise DataError(f"cameras of the cell are on links {cell.links}: give the robot")
        return
    both = robot.joint_names, cell.joints
    ours, theirs = ({one for one in joints if not is_gripper(one)} for joints in both)
    if not (ours <= theirs or theirs <= ours):
        raise DataError(
            f"the cell is that of another robot, with the joints {list(cell.joints)}, this one "
            f"has {list(robot.joint_names)}: make its own by tpgmm calibrate cell"
        )
    for link in cell.links:
        if link not in robot.links:
            raise UnknownNameError("link", link, "the robot", robot.links)


def camera_poses(cell: Cell, robot: Any, joints: Mapping[str, float]) -> dict[str, Array]:
    """``base_from_camera`` (4, 4) of all cameras of a cell.

    Parameters
    ----------
    cell : Cell
    robot : Kinematics, optional
        Needed where a camera is on a link.
    joints : mapping of str to float
        Of the robot's description, offsets included [rad].

    Raises
    ------
    UnknownNameError
        If a joint is missing.
    """
    links = {}
    if cell.links:
        for name in robot.joint_names:
            if name not in joints:
                raise UnknownNameError("joint", name, "the measured joints", joints)
        values = [[joints[name] for name in robot.joint_names]]
        state = robot.state(torch.tensor(values).to(robot.lower))
        for link in cell.links:
            pose = torch.cat((state.position(link), state.orientation(link)), dim=-1)
            links[link] = pose_matrix(pose[0].double().cpu().numpy())
    placed = {}
    for name, one in cell.require_placed_cameras().items():
        assert one.pose is not None
        placed[name] = one.pose if one.link is None else links[one.link] @ one.pose
    return placed


def cell_of(given: Mapping[str, Any] | str | Path) -> Cell:
    """Return the cell of a file, or of its content."""
    return cell_from(given) if isinstance(given, Mapping) else read_cell(given)


def read_cell(path: str | Path) -> Cell:
    """Read a cell file.

    Raises
    ------
    DataError
        If it is no cell; the message names the entry.
    OSError
        If it cannot be read.
    """
    try:
        content = json.loads(read_whole(path))
    except ValueError as error:
        raise DataError(f"{path} is no JSON file: {error}") from error
    return cell_from(content, str(path))


def write_cell(content: Mapping[str, Any], path: str | Path) -> Cell:
    """Write a cell file, as a whole or not at all.

    Parameters
    ----------
    content : mapping
        As the module says.

    Raises
    ------
    DataError
        If it is no cell. Nothing is written then.
    """
    cell = cell_from(content, str(path))
    with replacing(path) as new:
        new.write_text(_format_content(content), encoding="utf-8")
    return cell


def _format_content(content: Mapping[str, Any]) -> str:
    """JSON in which lists of numbers take one line each."""
    parts = re.split(r"(\[[^][{}]*\])", json.dumps(content, indent=2) + "\n")
    parts[1::2] = [re.sub(r"\n *", "", one.replace(",\n", ", \n")) for one in parts[1::2]]
    return "".join(parts)


def cell_from(content: Any, where: str = "the cell") -> Cell:
    """Make a cell of the content of its file.

    Raises
    ------
    DataError
        If it is no cell; the message begins with ``where`` and names the entry.
    """
    made = _entries(content, where, {}, {
        "cameras": _mapping(_camera), "objects": _mapping(_object), "checks": _mapping(_check),
        "joint_offsets": _mapping(_numbers(1)), "joints": _texts, "source": _text,
    })  # fmt: skip
    cell = Cell(**made, content=content)
    if "joints" in made and (extra := cell.joint_offsets.keys() - set(cell.joints)):
        raise DataError(f"{where}: joint_offsets of {sorted(extra)}, not among the joints")
    _check_unique(cell, where)
    return cell


def _check_unique(cell: Cell, where: str) -> None:
    """Each tag and each picture belongs to one entry; objects that tags find have some."""
    for name, thing in cell.objects.items():
        if cell.source == "tags" and not thing.target.corners:
            raise DataError(f"{where}: objects: {name} needs 'target', the tags on it")
    owners: dict[tuple[str, int], str] = {}
    targets: Iterable[tuple[str, Any]] = chain(cell.objects.items(), cell.checks.items())
    for name, one in targets:
        for number in one.target.corners:
            other = owners.setdefault((one.target.family, number), name)
            if other != name:
                raise DataError(f"{where}: tag {number} belongs to {other!r} and to {name!r}")
    if both := cell.objects.keys() & cell.checks.keys():
        raise DataError(f"{where}: {sorted(both)} are objects and checks")
    keys = [one.key for one in cell.cameras.values()]
    if len(set(keys)) < len(keys):
        raise DataError(f"{where}: cameras share a key, got {keys}")


# Readers of entries: functions of a value of the file, and of where it is for errors.
_Reader = Callable[[Any, str], Any]


def _entries(
    value: Any, where: str, needed: Mapping[str, _Reader], other: Mapping[str, _Reader]
) -> dict[str, Any]:
    """Read the entries of an object."""
    readers = {**needed, **other}
    _plain(Mapping, f"an object with {list(readers)}")(value, where)
    if extra := [name for name in value if name not in readers]:
        raise DataError(f"{where} has no entries {extra}; there are {list(readers)}")
    for name in needed:
        if value.get(name) is None:
            raise DataError(f"{where} needs {name!r}; it has {list(value)}")
    there = [name for name in readers if value.get(name) is not None]
    return {name: readers[name](value[name], f"{where}: {name}") for name in there}


def _mapping(reader: _Reader) -> _Reader:
    """Make a reader of an object of named entries."""

    def read(value: Any, where: str) -> dict[str, Any]:
        entries = _plain(Mapping, "an object of named entries")(value, where)
        return {name: reader(one, f"{where}: {name}") for name, one in entries.items()}

    return read


def _numbers(n: int) -> _Reader:
    """Make a reader of ``n`` finite numbers."""

    def read(value: Any, where: str) -> Any:
        values = value if isinstance(value, list | tuple) else [value]
        plain = all(type(one) in (int, float) for one in values)
        if not plain or len(values) != n or not all(map(math.isfinite, values)):
            wanted = f"{n} finite numbers" if n > 1 else "a finite number"
            raise DataError(f"{where} is {wanted}, got {value!r}")
        return tuple(map(float, values)) if n > 1 else float(values[0])

    return read


def _plain(kind: Any, wanted: str) -> _Reader:
    """Make a reader of a value of a type that is not empty."""

    def read(value: Any, where: str) -> Any:
        if not isinstance(value, kind) or value == "":
            raise DataError(f"{where} is {wanted}, got {value!r}")
        return value

    return read


_text, _flag = _plain(str, "a text"), _plain(bool, "true or false")


def _texts(value: Any, where: str) -> tuple[str, ...]:
    kind = "a list of texts"
    return tuple(_text(one, where) for one in _plain(list | tuple, kind)(value, where))


def _pose(value: Any, where: str) -> Array:
    return _make_at(pose_matrix, where, _numbers(7)(value, where))


def _make_at(make: Callable[..., Any], where: str, *given: Any, **options: Any) -> Any:
    """Value of a function; its errors say where the entry is."""
    try:
        return make(*given, **options)
    except DataError as error:
        raise DataError(f"{where}: {error}") from error


def _target(value: Any, where: str) -> Target:
    wanted = 'an object such as {"tag": 3, "size": 0.06}'
    return target_from(_plain(Mapping, wanted)(value, where), where)


def _camera(value: Any, where: str) -> CellCamera:
    numbers = {name: _numbers(n) for name, n in LENS.items()}
    other = {"distortion": numbers.pop("distortion"), "pose": _pose}
    other |= {"link": _text, "report": _text}
    lens = _entries(value, where, {"key": _text, "size": _numbers(2), **numbers}, other)
    size, mount = lens.pop("size"), {n: lens.pop(n, None) for n in ("key", "pose", "link")}
    lens.pop("report", None)
    return CellCamera(_make_at(Camera, where, *map(int, size), **lens), **mount)


def _object(value: Any, where: str) -> CellObject:
    other = {"target": _target, "pose": _pose, "upright": _flag, "height": _numbers(1)}
    return CellObject(**_entries(value, where, {}, other))


def _check(value: Any, where: str) -> CellCheck:
    return CellCheck(**_entries(value, where, {"target": _target, "pose": _pose}, {}))


def camera_content(camera: Camera, key: str) -> dict[str, Any]:
    """Entry in a cell file of a camera without a pose."""
    lens = {name: list(getattr(camera, name)) for name in LENS}
    return {"key": key, "size": [camera.width, camera.height], **lens}


def pose_content(pose: Array) -> list[float]:
    """Entry in a file of a pose, rounded to a micrometre and a microradian."""
    return [round(float(one), 7) for one in pose_vector(pose)]
