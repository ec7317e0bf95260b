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
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tpgmm_torch.atomic import read_whole, replacing
from tpgmm_torch.exceptions import DataError
from tpgmm_vision.camera import Camera
from tpgmm_vision.poses import Array, angle_between, pose_matrix, pose_vector
from tpgmm_vision.targets import Target, target_from

__all__ = [
    "Cell", "CellCamera", "CellCheck", "CellObject", "cell_from", "cell_of", "read_cell",
    "write_cell",
]  # fmt: skip

#: Poses that are nearer to each other are the same: [mm], [deg].
SAME_PLACE, SAME_ANGLE = 0.1, 0.02


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

    target: Target
    pose: Array
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
    """What a workcell is to its cameras.

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
        """What is another one in another cell, in words, one for each thing."""
        told = []
        for kind in ("cameras", "objects", "checks"):
            one, two = getattr(self, kind), getattr(other, kind)
            told += [f"{name!r} of the {kind} is missing" for name in one.keys() - two]
            told += [f"{name!r} of the {kind} is new" for name in two.keys() - one]
            for name in sorted(one.keys() & two):
                before, after = (cell.content[kind][name] for cell in (self, other))
                keys = sorted({*before, *after} - {"pose", "report"})
                changed = [key for key in keys if before.get(key) != after.get(key)]
                if changed:
                    told.append(f"{name!r} of the {kind} has another {' and '.join(changed)}")
                told += _moved(f"{name!r} of the {kind}", one[name].pose, two[name].pose)
        shifts = self.shifts(other).items()
        return told + [
            f"joint {name!r} is offset by {math.degrees(shift):+.2f} deg more"
            for name, shift in shifts
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

    def placed(self) -> dict[str, CellCamera]:
        """The cameras, all of which have a pose.

        Raises
        ------
        DataError
            If one has none, or there are none.
        """
        missing = [name for name, one in self.cameras.items() if one.pose is None]
        if missing or not self.cameras:
            raise DataError(
                f"cameras {missing} of the cell have no pose: tpgmm calibrate cell finds it"
                if missing
                else "the cell has no cameras: tpgmm calibrate camera adds one"
            )
        return dict(self.cameras)


def _moved(what: str, before: Array | None, after: Array | None) -> list[str]:
    """How far something is from where it was, if it is."""
    if before is None or after is None:
        return []
    moved = 1e3 * float(np.linalg.norm(before[:3, 3] - after[:3, 3]))
    turned = math.degrees(angle_between(before, after))
    if moved < SAME_PLACE and turned < SAME_ANGLE:
        return []
    return [f"{what} was moved by {moved:.1f} mm and {turned:.2f} deg"]


def cell_of(given: Mapping[str, Any] | str | Path) -> Cell:
    """The cell of a file, or of its content."""
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
        new.write_text(_formatted(content), encoding="utf-8")
    return cell


def _formatted(content: Mapping[str, Any]) -> str:
    """JSON in which lists of numbers take one line each."""
    lists: list[str] = []

    def short(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: short(one) for key, one in value.items()}
        if isinstance(value, list | tuple | np.ndarray):
            lists.append(json.dumps(np.asarray(value).tolist()))
            return f"\0{len(lists) - 1}\0"
        return value

    text = json.dumps(short(content), indent=2)
    for number, one in enumerate(lists):
        text = text.replace(f'"\\u0000{number}\\u0000"', one)
    return text + "\n"


def cell_from(content: Any, where: str = "the cell") -> Cell:
    """A cell of the content of its file.

    Raises
    ------
    DataError
        If it is no cell; the message begins with ``where`` and names the entry.
    """
    parts: dict[str, Callable[[_Entry], Any]] = {
        "cameras": _camera,
        "objects": _object,
        "checks": _check,
        "joint_offsets": lambda entry: entry.number(),
    }
    root = _Entry(content, where)
    root.allow(*parts, "joints", "source")
    made: dict[str, Any] = {
        part: {name: make(one) for name, one in root.items(part)}
        for part, make in parts.items()
    }
    joints, source = root.get("joints"), root.get("source")
    cell = Cell(
        **made,
        joints=() if joints is None else joints.texts(),
        source="tags" if source is None else source.text(),
        content=content,
    )
    if joints is not None and (extra := cell.joint_offsets.keys() - set(cell.joints)):
        raise DataError(
            f"{where}: joint_offsets of {sorted(extra)}, which are not among joints"
        )
    _check_unique(cell, where)
    return cell


def _check_unique(cell: Cell, where: str) -> None:
    """Each tag and each picture belongs to one entry; objects that tags find have some."""
    for name, thing in cell.objects.items():
        if cell.source == "tags" and not thing.target.corners:
            raise DataError(f"{where}: objects: {name} needs 'target', the tags on it")
    targets: list[tuple[str, CellObject | CellCheck]] = list(cell.objects.items())
    targets += cell.checks.items()
    owners: dict[tuple[str, int], str] = {}
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


@dataclass
class _Entry:
    """A value of the file, and where it is."""

    value: Any
    where: str

    def allow(self, *names: str) -> None:
        """Refuse what is no object, and other names."""
        if not isinstance(self.value, Mapping):
            raise DataError(f"{self.where} is an object with {list(names)}, got {self.value!r}")
        if extra := [name for name in self.value if name not in names]:
            raise DataError(f"{self.where} has no entries {extra}; there are {list(names)}")

    def get(self, name: str) -> _Entry | None:
        """An entry of it, if there is one."""
        value = self.value.get(name)
        return None if value is None else _Entry(value, f"{self.where}: {name}")

    def need(self, name: str) -> _Entry:
        """An entry of it that must be there."""
        if (found := self.get(name)) is None:
            raise DataError(f"{self.where} needs {name!r}; it has {list(self.value)}")
        return found

    def items(self, name: str) -> list[tuple[str, _Entry]]:
        """The entries of an object in it; none where it is missing."""
        if (found := self.get(name)) is None:
            return []
        if not isinstance(found.value, Mapping):
            raise DataError(f"{found.where} is an object of named entries, got {found.value!r}")
        return [(key, _Entry(one, f"{found.where}: {key}")) for key, one in found.value.items()]

    def numbers(self, n: int) -> list[float]:
        """A list of ``n`` finite numbers."""
        values = self.value if isinstance(self.value, list | tuple) else [self.value]
        plain = all(type(one) in (int, float) for one in values)
        if not plain or len(values) != n or not all(map(math.isfinite, values)):
            wanted = f"{n} finite numbers" if n > 1 else "a finite number"
            raise DataError(f"{self.where} is {wanted}, got {self.value!r}")
        return [float(one) for one in values]

    def number(self) -> float:
        """A finite number."""
        return self.numbers(1)[0]

    def text(self) -> str:
        """A text that is not empty."""
        if not isinstance(self.value, str) or not self.value:
            raise DataError(f"{self.where} is a text, got {self.value!r}")
        return self.value

    def texts(self) -> tuple[str, ...]:
        """Texts that are not empty."""
        if not isinstance(self.value, list | tuple):
            raise DataError(f"{self.where} is a list of texts, got {self.value!r}")
        return tuple(_Entry(one, self.where).text() for one in self.value)

    def flag(self) -> bool:
        """True or false."""
        if not isinstance(self.value, bool):
            raise DataError(f"{self.where} is true or false, got {self.value!r}")
        return self.value

    def pose(self) -> Array:
        """A pose (4, 4)."""
        values = self.numbers(7)
        try:
            return pose_matrix(values)
        except DataError as error:
            raise DataError(f"{self.where}: {error}") from error


def _camera(entry: _Entry) -> CellCamera:
    numbers = {"size": 2, "focal_length": 2, "principal_point": 2}
    entry.allow("key", *numbers, "distortion", "pose", "link", "report")
    size, focal_length, principal_point = (
        entry.need(name).numbers(n) for name, n in numbers.items()
    )
    distortion = entry.get("distortion")
    lens = distortion.numbers(5) if distortion else [0.0] * 5
    try:
        camera = Camera(
            int(size[0]), int(size[1]), (focal_length[0], focal_length[1]),
            (principal_point[0], principal_point[1]), tuple(lens),
        )  # fmt: skip
    except DataError as error:
        raise DataError(f"{entry.where}: {error}") from error
    pose, link = entry.get("pose"), entry.get("link")
    return CellCamera(
        camera,
        entry.need("key").text(),
        None if pose is None else pose.pose(),
        None if link is None else link.text(),
    )


def _object(entry: _Entry) -> CellObject:
    entry.allow("target", "pose", "upright", "height")
    target, pose, upright, height = map(entry.get, ("target", "pose", "upright", "height"))
    return CellObject(
        Target({}) if target is None else _target(target),
        np.eye(4) if pose is None else pose.pose(),
        upright is not None and upright.flag(),
        None if height is None else height.number(),
    )


def _check(entry: _Entry) -> CellCheck:
    entry.allow("target", "pose")
    return CellCheck(_target(entry.need("target")), entry.need("pose").pose())


def _target(entry: _Entry) -> Target:
    if not isinstance(entry.value, Mapping):
        wanted = 'an object such as {"tag": 3, "size": 0.06}'
        raise DataError(f"{entry.where} is {wanted}, got {entry.value!r}")
    return target_from(entry.value, entry.where)


def camera_content(camera: Camera, key: str) -> dict[str, Any]:
    """What a cell file says of a camera without a pose."""
    return {
        "key": key,
        "size": [camera.width, camera.height],
        "focal_length": list(camera.focal_length),
        "principal_point": list(camera.principal_point),
        "distortion": list(camera.distortion),
    }


def pose_content(pose: Array) -> list[float]:
    """What a file says of a pose: rounded to a micrometre and a microradian."""
    return [round(float(one), 7) for one in pose_vector(pose)]
