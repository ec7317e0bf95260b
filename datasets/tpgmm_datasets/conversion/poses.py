"""Frames: in the columns of a set, measured apart from it, or a robot's link at an event."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from math import pi
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch

from tpgmm_datasets.errors import DatasetError
from tpgmm_datasets.lerobot.layout import Feature
from tpgmm_datasets.names import pose_groups
from tpgmm_datasets.tables import numbers, read_table
from tpgmm_torch import quaternions
from tpgmm_torch.checks.training import FAR
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError, UnknownNameError

__all__ = ["FramePose", "LinkPose", "MeasuredPoses"]

#: Number of values of each way to write a rotation.
ROTATIONS = {"wxyz": 4, "xyzw": 4, "rotvec": 3, "euler": 3, "yaw": 1, None: 0}
#: How a table of poses writes them, and how its columns may be called: also as ROS does, with
#: the object's name before them and the unit behind.
WRITTEN = {
    ("x", "y", "z"): None,
    ("x", "y", "z", "yaw"): "yaw",
    ("x", "y", "z", "roll", "pitch", "yaw"): "euler",
    ("x", "y", "z", "qw", "qx", "qy", "qz"): "wxyz",
}
COLUMN = re.compile(
    r"(?P<key>episode|time)(?:_index|stamp)?|"
    r"(?:(?P<object>.+?)[._/])??(?:(?:field|pose|transform)[._/])*(?:"
    r"(?:(?:position|translation)[._/])?(?P<place>[xyz])(?:_(?P<length>mm|cm|m))?|"
    r"(?:(?:orientation|rotation|q)[._/]|q)(?P<quaternion>[wxyz])|"
    r"(?P<turn>roll|pitch|yaw)(?:_(?P<angle>deg|rad))?)",
    re.IGNORECASE,
)
UNITS = {"mm": 1e-3, "cm": 1e-2, "deg": pi / 180}
#: The object is not further from the link that holds it [m].
REACH = 1.0
#: Poses over more than so many times the length of an episode are on another clock.
LONGEST = 10.0


@dataclass(frozen=True)
class FramePose:
    """A frame whose pose is stored in a feature.

    Parameters
    ----------
    feature : str
        Name of the feature.
    columns : sequence of int or str, or slice, optional
        Which of its values: the position's three, then the rotation's, by place or by name.
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
            raise DatasetError(
                f"rotation {self.rotation!r} is unknown; there are "
                f"{[name for name in ROTATIONS if name]} and None"
            )

    def select(self, name: str, feature: Feature) -> list[int]:
        """Positions of the values that make frame ``name``, checked for number."""
        needed = 3 + ROTATIONS[self.rotation]
        places = list(range(feature.width))
        if isinstance(self.columns, slice):
            places = places[self.columns]
        elif self.columns is not None:
            places = [self._place(column, feature) for column in self.columns]
        elif self.rotation == "wxyz" and (stored := pose_groups(feature.names)):
            if name not in stored:
                raise DatasetError(
                    f"frame {name!r} is not stored there, {sorted(stored)} are. To take one of "
                    "them by another name, give FramePose(..., columns=[...]) (--frame "
                    "NAME=FEATURE[7:14])",
                    column=self.feature,
                )
            places = list(stored[name])
        if len(places) != needed:
            raise DatasetError(
                f"frame {name!r} needs {needed} values (position, rotation as "
                f"{self.rotation!r}), the selection has {len(places)} of the feature's "
                f"{feature.width}, called {feature.names}. Give FramePose(..., columns=[...])",
                column=self.feature,
            )
        return places

    def _place(self, column: int | str, feature: Feature) -> int:
        names = feature.names or ()
        if isinstance(column, str) and column in names:
            return names.index(column)
        if isinstance(column, int) and -feature.width <= column < feature.width:
            return column % feature.width
        raise DatasetError(
            f"there is no value {column!r} among its {feature.width}, called {feature.names}",
            column=self.feature,
        )

    def frame(self, values: Array, places: list[int], **where: Any) -> Frame:
        """The frame of the values at ``places`` of a feature's (T, width).

        Raises
        ------
        DatasetError
            If a quaternion is not of unit norm.
        """
        rows = values if not self.constant else values[:1]
        rows = rows[:, places].astype(np.float64)
        still = self.constant or (self.constant is None and bool((rows == rows[:1]).all()))
        tensor = torch.from_numpy(rows[0] if still else rows)
        position, rotation = tensor[..., :3] * self.scale, tensor[..., 3:]
        if self.rotation in ("wxyz", "xyzw"):
            off = (torch.linalg.vector_norm(rotation, dim=-1) - 1).abs().max()
            if off > 2 * quaternions.DIGITS:
                message = (
                    f"the norm of a quaternion is off by {float(off):.3g}; are the columns "
                    f"and their order right? The rotation is read as {self.rotation!r}"
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
    def read(
        cls, name: str, path: str | Path, wanted: Sequence[int], known: Collection[int]
    ) -> Self:
        """Read a table (.csv or .parquet) with a row for each episode, or for each instant.

        Its columns are ``episode`` (the index in the set), ``x``, ``y``, ``z`` [m], and the
        rotation: ``yaw`` [rad], or ``roll``, ``pitch`` and ``yaw``, or ``qw``, ``qx``, ``qy``,
        ``qz``, or none. For objects that move there is ``time`` too, in seconds from the start
        of the episode. ``x_mm`` or ``yaw_deg`` is in another unit, ``cup.x`` the object's of
        several, and ``pose.orientation.w`` as ROS says it.

        Parameters
        ----------
        name : str
            Of the frame.
        path : str or Path
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
            table = read_table(path).rename(columns=lambda column: str(column).strip())
            used = _pose_columns(name, list(table.columns))
            if table.empty:
                raise DataError("the table has no rows")
            key = used["episode"][0]
            index = numbers(table, [key])[:, 0]
            if (index != index.round()).any():
                raise DataError(f"column {key!r} counts episodes: it holds whole numbers")
            present = {*index.astype(int).tolist()}
            if strange := present - {*known}:
                raise DataError(f"rows are for episodes {_few(strange)}; {_numbered(known)}")
            parts = [part for part in used if part not in ("episode", "time")]
            rotation = WRITTEN[tuple(parts)]
            pose = FramePose(" ".join(used[part][0] for part in parts), None, rotation, None)
            poses, times = dict[int, Frame](), dict[int, torch.Tensor]()
            for episode in wanted:
                where = {"file": path, "episode": episode}
                rows = table[index == episode]
                values = numbers(rows, [used[part][0] for part in parts])
                values *= [used[part][1] for part in parts]
                if not len(values):
                    raise DataError(
                        f"no row is for this episode, rows are for {_few(present)}; "
                        f"{_numbered(known)}. Leave episodes without a pose out (episodes=, "
                        "--episodes)"
                    )
                _check_rows(values, parts, "time" in used)
                poses[episode] = pose.frame(values, list(range(len(parts))), **where)
                if poses[episode].batch_shape:
                    times[episode] = torch.from_numpy(numbers(rows, [used["time"][0]])[:, 0])
                    if bool((times[episode].diff() <= 0).any()):
                        raise DataError("time does not increase: two rows are for one instant")
        except DatasetError:
            raise
        except (DataError, UnknownNameError) as error:
            raise DatasetError(f"frame {name!r}: {error}", **where) from error
        return cls(poses, times, str(path))

    @classmethod
    def given(
        cls, name: str, frames: Any, wanted: Sequence[int], known: Collection[int]
    ) -> Self:
        """Frames by episode, or one for each episode that is read; the rest as :meth:`read`.

        Raises
        ------
        DatasetError
            If there are others, or more or less of them.
        """
        count = len(frames)
        if not isinstance(frames, Mapping):
            frames = dict(zip(wanted, frames, strict=False))
        for one in frames.values():
            if not isinstance(one, Frame):
                raise DatasetError(
                    f"frame {name!r}: a list holds a Frame for each episode, got "
                    f"{type(one).__name__}. The pose that all have is Frame([x, y, z])"
                )
        if count != len(frames) or not {*wanted} <= frames.keys() <= {*known}:
            raise DatasetError(
                f"frame {name!r}: {count} poses are given, for episodes {_few(frames)}, and "
                f"{len(wanted)} are read, {_few(wanted)}: give a list with one for each of "
                "these, or {episode: Frame}"
            )
        return cls(frames)

    def frame(self, name: str, time: Array, *, episode: int, file: Path) -> Frame:
        """The frame in an episode whose steps are at ``time`` [s].

        Raises
        ------
        DatasetError
            If there are other times, or not as many poses as steps.
        """
        pose, measured = self.poses[episode], self.times.get(episode)
        where: dict[str, Any] = {"file": file, "episode": episode}
        if measured is not None:
            begin, end, length = float(measured[0]), float(measured[-1]), float(time[-1])
            if end <= 0 or begin >= length or end - begin > LONGEST * length:
                raise DatasetError(
                    f"frame {name!r} was measured from {begin:.6g} to {end:.6g}, the episode "
                    f"takes {length:.4g} s: times in {self.feature} are in seconds, from the "
                    "start of each episode",
                    **where,
                )
            pose = pose.resampled(measured, torch.from_numpy(time))
        if pose.batch_shape not in ((), (len(time),)):
            raise DatasetError(
                f"frame {name!r} has {len(pose.position)} poses, the episode {len(time)} steps",
                **where,
            )
        return pose


def _pose_columns(name: str, columns: Sequence[str]) -> dict[str, tuple[str, float]]:
    """Column and factor of each part of the pose of ``name``, in the order of a pose."""
    found: dict[str, tuple[str, float]] = {}
    unknown, others = [], set()
    for column in columns:
        match = COLUMN.fullmatch(column)
        if match is None:
            unknown.append(column)
            continue
        if (match["object"] or name).strip("/") != name:
            others.add(match["object"])
            continue
        quaternion = match["quaternion"] and f"q{match['quaternion']}"
        part = (match["key"] or match["place"] or quaternion or match["turn"]).lower()
        if part in found:
            raise DataError(f"columns {found[part][0]!r} and {column!r} are both {part!r}")
        unit = (match["length"] or match["angle"] or "").lower()
        found[part] = column, UNITS.get(unit, 1.0)
    ordered = next((p for p in WRITTEN if {*p} == {*found} - {"episode", "time"}), None)
    if unknown or ordered is None or "episode" not in found:
        raise DataError(
            f"the table has the columns {columns}"
            + f", of which {unknown} are unknown" * bool(unknown)
            + f", of which some are of {sorted(others)}" * bool(others)
            + "; a pose is 'episode' (and 'time', if it moves), x, y, z, and nothing, or yaw, "
            "or qw, qx, qy, qz. Name them so (x_mm, yaw_deg in other units), without others"
        )
    return {part: found[part] for part in ("episode", "time", *ordered) if part in found}


def _check_rows(values: Array, parts: Sequence[str], moves: bool) -> None:
    """Whether these rows (T, parts) can be the poses of one episode."""
    if len(values) > 1 and not moves:
        raise DataError(
            f"{len(values)} rows are for this episode: keep one, or add a column 'time' [s] if "
            "the object moves"
        )
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


def _few(items: Collection[int]) -> str:
    return f"{sorted(items)[:10]}".replace("]", ", ...]" if len(items) > 10 else "]")


def _numbered(known: Collection[int]) -> str:
    return f"the set has episodes {min(known)} to {max(known)}, as 'tpgmm dataset info' counts"


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
        tracker tells it; without an offset it is the link's.

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
        if not isinstance(self.offset, Frame | None):
            raise DatasetError(f"offset is the object's Frame in the link: {self.offset!r}")
        if self.offset is not None and float(self.offset.position.norm()) > REACH:
            raise DatasetError(
                f"the offset of an object in link {self.link!r} is in metres: "
                f"{self.offset.position.tolist()} is further away than {REACH:g} m"
            )

    @classmethod
    def parse(cls, text: str) -> Self:
        """What ``LINK@EVENT`` stands for, or ``LINK@EVENT+OFFSET``.

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
            values = np.array([[float(value) for value in offset.split(",")]])
            rotation = {3: None, 4: "yaw", 7: "wxyz"}[values.shape[1]]
            pose = FramePose(text, None, rotation).frame(values, list(range(values.shape[1])))
        except (ValueError, KeyError) as error:
            raise DatasetError(
                f"{text!r}: behind + is the object's pose in the link, x,y,z or x,y,z,yaw or "
                f"x,y,z,qw,qx,qy,qz in metres and radians ({error})"
            ) from error
        return cls(link, event, pose)

    def time(self, demonstration: Demonstration, **where: Any) -> float:
        """When the event is [s].

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
                f"{self.event}='closing:*gripper*'; leave episodes without it "
                "out by relax=['events'] or --episodes"
            )
            raise DatasetError(message, check="events", **where) from error

    def frame(self, demonstration: Demonstration, robot: Any, time: float) -> Frame:
        """The pose of the link, or of the object in it, at the step nearest to ``time``."""
        step = int((demonstration.time - time).abs().argmin())
        state = robot.state(demonstration.reordered(robot.joint_names).joints[step])
        pose = Frame(state.position(self.link), state.orientation(self.link))
        if self.offset is not None:
            return pose.compose(self.offset.to(pose.position))
        event = getattr(self.event, "__name__", self.event)
        vars(pose).update(at=f"{self.link}@{event}")
        return pose
