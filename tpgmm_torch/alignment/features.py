"""What demonstrations are compared by when they are aligned in time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray

from tpgmm_torch import quaternions
from tpgmm_torch.alignment.warping_paths import moving_average, resample
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError

__all__ = ["AlignmentFeatures", "quaternion_columns"]

#: Half the length of the kernel that smooths joints before they are differentiated [s].
VELOCITY_SMOOTHING = 0.1
#: Below this fraction of a demonstration's root mean square speed the direction fades out.
STANDSTILL = 0.3
#: Weights where those of the postures together have 1: postures differ between demonstrations
#: at equal phase, by start and goal, and would shift a rhythm.
SPEED_WEIGHT, DIRECTIONS_WEIGHT = 5.0, 4.5
#: Columns that vary by less than this, relative to their size, count as constant.
CONSTANT = 1e-9


def quaternion_columns(demonstration: Demonstration, robot: Any) -> list[list[int]]:
    """Where the joints hold unit quaternions, which is so for recorded poses.

    Returns
    -------
    list of list of int
        Four columns of ``demonstration.joints`` for each quaternion of the ``robot``.

    Raises
    ------
    ShapeError, UnknownNameError
        If the demonstration does not have the robot's joints.
    """
    starts = getattr(robot, "quaternion_starts", ())
    if not starts:
        return []
    if demonstration.joint_names is None and demonstration.n_joints != robot.n_joints:
        raise ShapeError(
            f"the demonstration has {demonstration.n_joints} joints without names, the "
            f"robot has {robot.n_joints}: {robot.joint_names}"
        )
    demonstration.reordered(robot.joint_names)  # names a joint that is missing
    names = list(demonstration.joint_names or robot.joint_names)
    columns = [names.index(name) for name in robot.joint_names]
    return [columns[start : start + 4] for start in starts]


@dataclass(frozen=True, eq=False)
class AlignmentFeatures:
    """Groups of features, each scaled to unit variance over the demonstrations of ``fit``.

    The groups are ``"joints"``, ``"speed"`` (of each link, without a robot of all joints
    together, over its root mean square along the demonstration), ``"directions"`` (in which the
    joints move: their velocity over its norm, which does not depend on the speed and fades out
    at standstill), and with a robot its link positions by link, ``"left_hand"``, and the same
    seen from each frame, ``"left_hand in bottle"``. Quaternions among the joints count as
    rotation matrices, which do not depend on their sign.

    Parameters
    ----------
    names : tuple of str
        The groups in use.
    robot : Kinematics or None
        Gives the link positions.
    columns : mapping of str to ndarray of bool
        Which columns of each group are not constant.
    scales : mapping of str to float
        What each group is multiplied by.
    """

    names: tuple[str, ...]
    robot: Any
    columns: Mapping[str, NDArray[np.bool_]]
    scales: Mapping[str, float]

    @classmethod
    def fit(
        cls,
        demonstrations: Sequence[Demonstration],
        robot: Any = None,
        names: Sequence[str] | None = None,
        weights: Mapping[str, float] | None = None,
    ) -> Self:
        """Choose and scale the groups.

        A group's variance is the sum over its columns of the variance along each
        demonstration; it becomes the group's squared weight.

        Parameters
        ----------
        demonstrations, robot : sequence of Demonstration, Kinematics or None
            What to compare.
        names, weights : sequence of str, mapping of str to float, optional
            As ``features`` and ``weights`` of :class:`DynamicTimeWarping`. Directions are no
            default: two demonstrations that reach for objects on either side move against each
            other, and the matching would rather skip the way. Neither are features seen from
            a frame: away from the object that the motion is about, they differ between
            demonstrations at equal phase.

        Raises
        ------
        UnknownNameError
            If a group does not exist.
        DataError
            If a weight is negative, or no feature changes.
        """
        raw = [_groups(one, robot) for one in demonstrations]
        if names is None:
            names = ("speed", "joints", *getattr(robot, "links", ()))
        _check_names(names, raw[0], "feature")
        weights = dict(weights or {})
        _check_names(weights, names, "weight")
        usual = max(1, len(set(names) - {"speed", "directions"})) ** -0.5
        defaults = dict.fromkeys(names, usual) | {
            "speed": SPEED_WEIGHT,
            "directions": DIRECTIONS_WEIGHT,
        }
        columns: dict[str, NDArray[np.bool_]] = {}
        scales: dict[str, float] = {}
        for name in dict.fromkeys(names):
            weight = float(weights[name] if name in weights else defaults[name])
            if not 0 <= weight < np.inf:
                raise DataError(f"the weight of {name!r} is a number >= 0, got {weight}")
            sizes = [len(groups[name]) for groups in raw]
            within = np.stack([groups[name].var(axis=0) for groups in raw])
            variance = np.average(within, axis=0, weights=sizes)
            size = np.max([np.abs(groups[name]).max(axis=0) for groups in raw], axis=0)
            varying = np.sqrt(variance) > CONSTANT * size
            if weight and varying.any():
                columns[name] = varying
                scales[name] = weight / float(np.sqrt(variance[varying].sum()))
        if not columns:
            raise DataError(
                f"none of the features {list(names)} changes in the demonstrations: "
                "there is nothing to align by"
            )
        return cls(tuple(columns), robot, columns, scales)

    @classmethod
    def others(cls, demonstrations: Sequence[Demonstration], used: Self) -> Self | None:
        """What the features in use leave out: postures, speed, directions; None if nothing.

        Whether a matching by some features is right shows in others.
        """
        names = ("speed", "joints", "directions", *getattr(used.robot, "links", ()))
        rest = [name for name in names if name not in used.names]
        try:
            return cls.fit(demonstrations, used.robot, rest) if rest else None
        except DataError:  # nothing of it changes
            return None

    def __call__(self, demonstration: Demonstration) -> Array:
        """The features of a demonstration, shape (T, D)."""
        groups = _groups(demonstration, self.robot)
        for name in self.names:
            if name not in groups:
                raise UnknownNameError("feature", name, "the demonstration", groups)
        return np.concatenate(
            [groups[name][:, self.columns[name]] * self.scales[name] for name in self.names],
            axis=1,
        )


def _check_names(names: Iterable[str], available: Iterable[str], kind: str) -> None:
    for name in names:
        if name not in available:
            raise UnknownNameError(kind, name, "the features", available)


def _groups(demonstration: Demonstration, robot: Any) -> dict[str, Array]:
    """All feature groups that a demonstration has, unscaled, each of shape (T, d)."""
    joints = demonstration.joints
    quaternion = quaternion_columns(demonstration, robot)
    inside = {column for block in quaternion for column in block}
    others = [column for column in range(demonstration.n_joints) if column not in inside]
    turns = [quaternions.to_matrix(joints[:, block]).flatten(1) for block in quaternion]
    values = as_array(torch.cat((joints[:, others], *turns), dim=1))
    velocity = _velocity(values, demonstration)
    groups = {"joints": values, "directions": _directions(velocity)}
    if robot is None or not robot.links:
        groups["speed"] = _speed(velocity)
        return groups
    names = getattr(robot, "joint_names", None)
    ordered = demonstration if names is None else demonstration.reordered(names)
    state = robot.state(ordered.joints.detach())
    speeds = []
    for link in robot.links:
        position = state.position(link)
        groups[link] = as_array(position)
        speeds.append(_speed(_velocity(groups[link], demonstration)))
        for name, frame in demonstration.frames.items():
            groups[f"{link} in {name}"] = as_array(
                frame.to(position).inverse_transform(position)
            )
    groups["speed"] = np.concatenate(speeds, axis=1)
    return groups


def _velocity(values: Array, demonstration: Demonstration) -> Array:
    """Smoothed rates of change, zero for what does not change, shape (T, d)."""
    time = as_array(demonstration.time)
    even = np.linspace(time[0], time[-1], len(time))
    step = demonstration.duration / (len(time) - 1)
    smooth = moving_average(resample(values, time, even), round(VELOCITY_SMOOTHING / step))
    rates = resample(np.gradient(smooth, step, axis=0), even, time)
    return np.where(values.std(axis=0) > CONSTANT * np.abs(values).max(axis=0), rates, 0.0)


def _speed(velocity: Array) -> Array:
    """Over its root mean square, which may be zero, shape (T, 1)."""
    speed = np.linalg.norm(velocity, axis=1, keepdims=True)
    usual = np.sqrt((speed**2).mean())
    return speed / usual if usual > 0 else speed


def _directions(velocity: Array) -> Array:
    squared = (velocity**2).sum(axis=1, keepdims=True)
    norm = np.sqrt(squared + STANDSTILL**2 * squared.mean())
    # a demonstration that stands still has no direction
    return np.divide(velocity, norm, out=np.zeros_like(velocity), where=norm > 0)
