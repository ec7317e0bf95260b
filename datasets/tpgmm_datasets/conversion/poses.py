"""Frames: in the columns of a set, measured apart from it, or a robot's link at an event."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import pi
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch

from tpgmm_datasets.errors import DatasetError
from tpgmm_datasets.lerobot.layout import Feature
from tpgmm_datasets.tables import numbers, read_table
from tpgmm_torch import quaternions
from tpgmm_torch.checks.report import shorten_list
from tpgmm_torch.checks.training import FAR
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.pose_names import pose_groups
from tpgmm_torch.exceptions import DataError, UnknownNameError

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["FramePose", "LinkPose"]

#: Number of values of each way to write a rotation.
ROTATIONS = {"wxyz": 4, "xyzw": 4, "rotvec": 3, "euler": 3, "yaw": 1, None: 0}
#: How the rotation is written in a table, by the parts of a pose that it has.
WRITTEN = {
    "x y z": None,
    "x y z yaw": "yaw",
    "x y z roll pitch yaw": "euler",
    "x y z qw qx qy qz": "wxyz",
}
#: A column of it: the object's name, the part, its unit. What ROS says in between is left out.
COLUMN = r"(?:(.+?)[._/])??(\w+?)(?:_index|stamp)?(?:_(mm|cm|m|deg|rad))?"
PLACE = r"(?<![a-z])(field|pose|transform|position|translation)[._/]"
TURN = r"(?<![a-z])(orientation|rotation)[._/]"
UNITS = {"mm": 1e-3, "cm": 1e-2, "deg": pi / 180}
#: The object is not further from the link that holds it [m].
REACH = 1.0
#: Poses over more than so many times the length of an episode are on another clock.
LONGEST = 10.0

#: Of episodes.
Indices = Collection[int]


@dataclass(frozen=True)
class FramePose:
    """A frame whose pose is stored in a feature.

    Parameters
    ----------
    feature : str
        Name of the feature.
    columns : sequence of int or str, or slice, optional
        Values of the feature: the position's three, then the rotation's, by place or by name.
        By default those that are called ``<frame>.x``, ...; all where none are so called.
    rotation : {"wxyz", "xyzw", "rotvec", "euler", "yaw", None}, default="wxyz"
        How the orientation is written: a quaternion, w first or last; a rotation vector;
        roll, pitch and yaw about the fixed x, y and z axes (as in URDF); yaw only; None for
        no rotation.
    constant : bool or None, default=True
        Whether the first frame of the episode holds for all of it, as in the paper, or each
        step has its own pose. None: constant if it never changes.
    degrees : bool, default=False
        Whether angles are stored in degrees.
    scale : float, default=1.0
        Metres per stored unit of length.

    Examples
    --------
    A tracker that writes millimetres, and quaternions with w last:

    >>> FramePose("observation.tracker", rotation="xyzw", scale=0.001).rotation
    'xyzw'
    """

    feature: str
    columns: Sequence[int | str] | slice | None = None
    rotation: str | None = "wxyz"
    constant: bool | None = True
    degrees: bool = False
    scale: float = 1.0

    def __post_init__(self) -> None:
        if self.rotation not in ROTATIONS:
            raise DatasetError(f"rotation {self.rotation!r} is not known; {[*ROTATIONS]} are")

    def select(self, name: str, feature: Feature) -> list[int]:
        """Select the positions of the values that make frame ``name``, checked for number."""
        needed = 3 + ROTATIONS[self.rotation]
        places = list(range(feature.width))
        if isinstance(self.columns, slice):
            places = places[self.columns]
        elif self.columns is not None:
            places = [self._place(column, feature) for column in self.columns]
        elif self.rotation == "wxyz" and (stored := pose_groups(feature.names)):
            if name not in stored:
                message = (
                    f"frame {name!r} is not stored there, {sorted(stored)} are. For another "
                    "name, FramePose(..., columns=[...]) (--frame NAME=FEATURE[7:14])"
                )
                raise DatasetError(message, column=self.feature)
            places = list(stored[name])
        if len(places) != needed:
            message = (
                f"frame {name!r} needs {needed} values (position, rotation as "
                f"{self.rotation!r}), the selection has {len(places)} of the feature's "
                f"{feature.width}, called {feature.names}. Give FramePose(..., columns=[...])"
            )
            raise DatasetError(message, column=self.feature)
        return places

    def _place(self, column: int | str, feature: Feature) -> int:
        names = feature.names or ()
        if isinstance(column, str) and column in names:
            return names.index(column)
        if isinstance(column, int) and -feature.width <= column < feature.width:
            return column % feature.width
        among = f"its {feature.width}, called {feature.names}"
        raise DatasetError(f"there is no value {column!r} among {among}", column=self.feature)

    def frame(self, values: Array, places: list[int], **where: Any) -> Frame:
        """Make the frame of the values at ``places`` of a feature's (T, width).

        Raises
        ------
        DatasetError
            If a quaternion is not of unit norm.
        """
        rows = values[: 1 if self.constant else None, places].astype(np.float64)
        still = self.constant or (self.constant is None and bool((rows == rows[:1]).all()))
        tensor = torch.from_numpy(rows[0] if still else rows)
        position, rotation = tensor[..., :3] * self.scale, tensor[..., 3:]
        if self.rotation in ("wxyz", "xyzw"):
            off = (torch.linalg.vector_norm(rotation, dim=-1) - 1).abs().max()
            if off > 2 * quaternions.DIGITS:
                message = (
                    f"the norm of a quaternion is off by {float(off):.3g}, read as "
                    f"{self.rotation!r}: are the columns and their order right?"
                )
                raise DatasetError(message, check="poses", column=self.feature, **where)
        return Frame(position, self._orientation(rotation))

    def _orientation(self, rotation: torch.Tensor) -> torch.Tensor | None:
        if self.rotation is None:
            return None
        if self.rotation == "wxyz":
            return rotation
        if self.rotation == "xyzw":
            return rotation.roll(1, dims=-1)
        angles = rotation.deg2rad() if self.degrees else rotation
        if self.rotation == "rotvec":
            return quaternions.exp(angles)
        axes = torch.eye(3, dtype=rotation.dtype)
        if self.rotation == "yaw":
            return quaternions.exp(angles * axes[2])
        roll, pitch, yaw = (quaternions.exp(angles[..., [i]] * axes[i]) for i in range(3))
        return quaternions.product(yaw, quaternions.product(pitch, roll))


@dataclass(frozen=True)
class MeasuredPoses:
    """A frame whose poses were measured apart from the data set.

    Parameters
    ----------
    poses : mapping of int to Frame
        By the episode's index in the set: one pose, one for each of its steps, or at ``times``.
    times : mapping of int to Tensor of shape (T,)
        When those that move were measured, from the start of the episode [s].
    feature : str
        Where they are from, in place of a feature of the set.
    """

    poses: Mapping[int, Frame]
    times: Mapping[int, torch.Tensor] = field(default_factory=dict)
    feature: str = "the frames that were given"

    @classmethod
    def read(cls, name: str, path: str | Path, wanted: Indices, known: Indices) -> Self:
        """Read a table (.csv or .parquet) with a row for each episode, or for each instant.

        Its columns are ``episode`` (the index in the set), ``x``, ``y``, ``z`` [m], and the
        rotation: ``yaw`` [rad], or ``roll``, ``pitch`` and ``yaw``, or ``qw``, ``qx``, ``qy``,
        ``qz``, or none. For objects that move there is ``time`` too, in seconds from the start
        of the episode. ``x_mm`` or ``yaw_deg`` is in another unit, ``cup.x`` the object's of
        several, and ``pose.orientation.w`` as ROS says it.

        Parameters
        ----------
        name : str
            Name of the frame, and of its columns where a table has several.
        path : str or Path
            The table's file.
        wanted, known : sequence of int
            Episodes that are to be read, and all of the set.

        Raises
        ------
        DatasetError
            If columns are missing, unknown or twice there; an episode has no pose, or two at a
            time; or a number is missing or cannot be in its unit.
        """
        where: dict[str, Any] = {"file": path}
        try:
            table = read_table(path)
            used = _find_pose_columns(name, table.columns)
            if table.empty:
                raise DataError("the table has no rows")
            episodes = numbers(table, [used.pop("episode")[0]])[:, 0]
            _check_episodes(episodes, known)
            time = used.pop("time", ("", 1.0))[0]
            poses, times = dict[int, Frame](), dict[int, torch.Tensor]()
            for episode in wanted:
                where = {"file": path, "episode": episode}
                rows = table[episodes == episode]
                if len(rows) != 1 and not (time and len(rows)):
                    raise DataError(
                        f"the table has {len(rows)} rows for this episode, and needs one; more "
                        "where an object moves, with a column 'time' [s]. Episodes without a "
                        "pose can be left out (episodes=, --episodes)"
                    )
                poses[episode] = _read_poses(rows, used)
                if poses[episode].batch_shape:
                    times[episode] = torch.from_numpy(numbers(rows, [time])[:, 0])
                    if bool((times[episode].diff() <= 0).any()):
                        raise DataError("time does not increase: two rows are for one instant")
        except (DataError, UnknownNameError) as error:
            raise DatasetError(f"frame {name!r}: {error}", **where) from error
        return cls(poses, times, str(path))

    @classmethod
    def take(cls, name: str, frames: Any, wanted: Indices, known: Indices) -> Self:
        """Take frames by episode, or one for each that is read; the rest as :meth:`read`.

        Raises
        ------
        DatasetError
            If there are others, or more or less of them.
        """
        given = frames if isinstance(frames, Mapping | Sequence) else ()
        by_index = isinstance(given, Mapping)
        several = dict(given if by_index else zip(wanted, given, strict=False))
        fits = len(several) == len(given) and {*wanted} <= {*several} <= {*known}
        if not fits or not all(isinstance(frame, Frame) for frame in several.values()):
            kinds = {type(frame).__name__ for frame in several.values()}
            raise DatasetError(
                f"frame {name!r} is a feature's name, a table of poses, LINK@EVENT, FramePose, "
                "LinkPose, a Frame for all, or one for each of the episodes that are read, "
                f"{shorten_list([*map(str, wanted)])}, in a list or {{episode: Frame}}; got "
                f"{type(frames).__name__} of {len(given)} {', '.join(sorted(kinds))}"
            )
        return cls(several)

    def frame(self, name: str, time: Array, **where: Any) -> Frame:
        """Return the frame in an episode whose steps are at ``time`` [s].

        Raises
        ------
        DatasetError
            If there are other times, or not as many poses as steps.
        """
        pose, measured = self.poses[where["episode"]], self.times.get(where["episode"])
        if measured is not None:
            begin, end, length = float(measured[0]), float(measured[-1]), float(time[-1])
            if end <= 0 or begin > length or end - begin > LONGEST * length:
                message = (
                    f"frame {name!r} was measured from {begin:.6g} to {end:.6g}, the "
                    f"episode takes {length:.4g} s: times in {self.feature} are in seconds, "
                    "from the start of each"
                )
                raise DatasetError(message, **where)
            pose = pose.resample(measured, torch.from_numpy(time))
        if pose.batch_shape not in ((), (len(time),)):
            counts = f"{len(pose.position)} poses, the episode {len(time)} steps"
            raise DatasetError(f"frame {name!r} has {counts}", **where)
        return pose


def _check_episodes(episodes: Array, known: Collection[int]) -> None:
    if strange := [f"{index:g}" for index in np.unique(episodes) if index not in known]:
        there = f"{min(known)} to {max(known)}, as 'tpgmm dataset info' counts"
        raise DataError(f"rows are for episodes {shorten_list(strange)}, the set has {there}")


def _read_poses(rows: pd.DataFrame, used: Mapping[str, tuple[str, float]]) -> Frame:
    """Read the pose in one row, or one for each of several, from columns by its parts."""
    columns, factors = zip(*used.values(), strict=True)
    values = numbers(rows, columns) * factors
    _check_units(values, list(used))
    pose = FramePose(" ".join(columns), None, WRITTEN[" ".join(used)], None)
    return pose.frame(values, list(range(len(columns))))


def _parse_column(column: Any) -> tuple[str, str, float]:
    """Parse a column into the object's name, the part of its pose and a factor."""
    text = re.sub(PLACE, "", str(column).strip(" /").lower())
    match = re.fullmatch(COLUMN, re.sub(TURN, "q", text))
    thing, part, unit = match.groups() if match else ("", "", "")
    return thing or "", part, UNITS.get(unit, 1.0)


def _find_pose_columns(name: str, columns: Iterable[Any]) -> dict[str, tuple[str, float]]:
    """Find column and factor of episode, time, and the parts of the pose in order."""
    found: dict[str, tuple[str, float]] = {}
    known, wrong = {"episode", "time", *" ".join(WRITTEN).split()}, []
    for column in columns:
        thing, part, factor = _parse_column(column)
        ours = thing in ("", name.lower())
        if part not in known or (ours and part in found):
            wrong.append(column)
        elif ours:
            found[part] = column, factor
    ordered = _find_form(found)
    if wrong or ordered is None:
        strange = f", and {wrong} are unknown or there twice" if wrong else ""
        raise DataError(
            f"the table has columns {list(columns)}{strange}. Name them episode, x, y, z (or "
            f"{name}.x, ...), and yaw, or qw, qx, qy, qz; time if it moves; x_mm or yaw_deg in "
            "other units. Leave others out"
        )
    parts = ("episode", "time", *ordered.split())
    return {part: found[part] for part in sorted(found, key=parts.index)}


def _find_form(parts: Collection[str]) -> str | None:
    """Find the parts in the order of a form that poses are written in."""
    forms = {frozenset(form.split()): form for form in WRITTEN}
    return forms.get(frozenset(parts) - {"episode", "time"}) if "episode" in parts else None


def _check_units(values: Array, parts: Sequence[str]) -> None:
    """Refuse poses (T, parts) that cannot be in metres and radians."""
    turns = [i for i, part in enumerate(parts) if part in ("roll", "pitch", "yaw")]
    if (largest := float(np.abs(values[:, turns]).max(initial=0.0))) > 2 * pi:
        raise DataError(
            f"an angle of {largest:.4g} rad is more than a turn: is it in degrees? Then call "
            f"the columns {', '.join(f'{parts[i]}_deg' for i in turns)}"
        )
    if (distance := float(np.linalg.norm(values[:, :3], axis=1).max())) > FAR:
        raise DataError(
            f"it is {distance:.4g} m away from the base of the robot: in millimetres or "
            "centimetres? Then call the columns x_mm, y_mm, z_mm, or x_cm, ..."
        )


@dataclass(frozen=True)
class LinkPose:
    """A frame that is where a link of the robot is at an event.

    Real recordings often carry no object pose; but where the hand closes, there is the
    object. In a new situation nothing has closed yet: the pose must come from elsewhere, a
    tracker or a detector. Only the pose at the ``"start"`` is known then: a model that learned
    it computes it from the start posture.

    Parameters
    ----------
    link : str
        Name of the link.
    event : str or callable
        Name of an event of the demonstration, ``"start"`` and ``"end"`` among them, or a
        function from the demonstration to a time [s].
    offset : Frame, optional
        The object's pose in the link at that event. The frame is then the object's, as a
        tracker gives it; without an offset it is the link's.

    Examples
    --------
    >>> LinkPose.parse("right_hand@close")
    LinkPose(link='right_hand', event='close', offset=None)
    >>> LinkPose.parse("right_hand@close+0,0,0.06").offset.position.tolist()
    [0.0, 0.0, 0.06]
    """

    link: str
    event: str | Callable[[Demonstration], float]
    offset: Frame | None = None

    def __post_init__(self) -> None:
        is_frame = isinstance(self.offset, Frame)
        if self.offset is not None and not (is_frame and self.offset.position.norm() < REACH):
            raise DatasetError(
                f"an offset is the Frame of an object in link {self.link!r}, in metres and "
                f"nearer than {REACH:g} m; got {self.offset}"
            )

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse ``LINK@EVENT`` or ``LINK@EVENT+OFFSET``.

        The offset is ``x,y,z`` [m], ``x,y,z,yaw`` [rad] or ``x,y,z,qw,qx,qy,qz``.

        Raises
        ------
        DatasetError
            If it is no such text.
        """
        match = re.fullmatch(r"([^@]+)@([^@]+?)(?:\+([^@+]*,[^@]*))?", text.strip())
        if match is None:
            raise DatasetError(f"a link at an event is LINK@EVENT, got {text!r}")
        link, event, offset = match.groups()
        if offset is None:
            return cls(link, event)
        try:
            values = np.array([offset.split(",")], dtype=float)
            rotation = {3: None, 4: "yaw", 7: "wxyz"}[values.shape[1]]
            pose = FramePose(text, None, rotation).frame(values, list(range(values.shape[1])))
        except (ValueError, KeyError) as error:
            message = "the object in the link: x,y,z or x,y,z,yaw or x,y,z,qw,qx,qy,qz"
            raise DatasetError(f"{text!r}: behind + is {message} ({error})") from error
        return cls(link, event, pose)

    @property
    def at(self) -> str:
        """``LINK@EVENT``, without an offset."""
        return f"{self.link}@{getattr(self.event, '__name__', self.event)}"

    def time(self, demonstration: Demonstration, **where: Any) -> float:
        """Find when the event is [s].

        Raises
        ------
        DatasetError
            If the demonstration has no such event.
        """
        if callable(self.event):
            return float(self.event(demonstration))
        try:
            return demonstration.event(self.event)
        except UnknownNameError as error:
            message = (
                f"frame of link {self.link!r}: {error}. Say how to find it, as in "
                f"events={{{self.event!r}: 'closing:*gripper*'}} or --event "
                f"{self.event}='closing:*gripper*', or choose --episodes"
            )
            raise DatasetError(message, check="events", **where) from error

    def frame(self, demonstration: Demonstration, robot: Any, time: float) -> Frame:
        """Compute the pose of the link, or of the object in it, nearest to ``time``."""
        step = int((demonstration.time - time).abs().argmin())
        state = robot.state(demonstration.reorder(robot.joint_names).joints[step])
        pose = Frame(state.position(self.link), state.orientation(self.link))
        if self.offset is not None:
            return pose.compose(self.offset.to(pose.position))
        vars(pose).update(at=self.at)
        return pose
