"""Features by which demonstrations are compared when they are aligned in time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray

from tpgmm_torch import quaternions
from tpgmm_torch.alignment.warping_paths import moving_average, resample
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import SMOOTHING, Demonstration
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError

__all__ = ["AlignmentFeatures"]

#: Below this fraction of a demonstration's root mean square speed the direction fades out.
STANDSTILL = 0.3
#: Weights of groups; the n others have ``n ** -0.5`` each. Postures differ between
#: demonstrations at equal phase, by start and goal, and would shift a rhythm.
WEIGHTS = {"speed": 5.0, "directions": 4.5}


def quaternion_columns(demonstration: Demonstration, robot: Any) -> list[list[int]]:
    """Locate unit quaternions among the joints, as those of recorded poses.

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
    demonstration.reorder(robot.joint_names)  # names a joint that is missing
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
    robot : Kinematics or None
        Gives the link positions.
    columns : mapping of str to ndarray of bool
        Which columns of each group in use are not constant.
    scales : mapping of str to float
        By which each group is multiplied.
    """

    robot: Any
    columns: Mapping[str, NDArray[np.bool_]]
    scales: Mapping[str, float]

    @classmethod
    def fit(
        cls,
        demonstrations: Sequence[Demonstration],
        robot: Any = None,
        names: Sequence[str] | None = None,
    ) -> Self:
        """Choose and scale the groups.

        A group's variance is the sum over its columns of the variance along each
        demonstration; it becomes the group's squared weight.

        Parameters
        ----------
        demonstrations, robot : sequence of Demonstration, Kinematics or None
            To be compared.
        names : sequence of str, optional
            As ``features`` of :class:`DynamicTimeWarping`. Directions are no
            default: two demonstrations that reach for objects on either side move against each
            other, and the matching would rather skip the way. Neither are features seen from
            a frame: away from the object that the motion is about, they differ between
            demonstrations at equal phase.

        Raises
        ------
        UnknownNameError
            If a group does not exist.
        DataError
            If no feature changes.
        """
        raw = [_groups(one, robot) for one in demonstrations]
        names = tuple(dict.fromkeys(names or ("speed", "joints", *getattr(robot, "links", ()))))
        usual = max(1, len(set(names) - set(WEIGHTS))) ** -0.5
        columns: dict[str, NDArray[np.bool_]] = {}
        scales: dict[str, float] = {}
        for name in names:
            if name not in raw[0]:
                raise UnknownNameError("feature", name, "the features", raw[0])
            groups = [one[name] for one in raw]
            within = np.stack([group.var(axis=0) for group in groups])
            variance = np.average(within, axis=0, weights=list(map(len, groups)))
            size = np.max([np.abs(group).max(axis=0) for group in groups], axis=0)
            varying = _varying(np.sqrt(variance), size)
            if varying.any():
                columns[name] = varying
                spread = float(np.sqrt(variance[varying].sum()))
                scales[name] = WEIGHTS.get(name, usual) / spread
        if not columns:
            raise DataError(
                f"none of the features {list(names)} changes in the demonstrations: "
                "there is nothing to align by"
            )
        return cls(robot, columns, scales)

    @property
    def names(self) -> tuple[str, ...]:
        """The groups in use."""
        return tuple(self.columns)

    def others(self, demonstrations: Sequence[Demonstration]) -> Self | None:
        """Fit the groups that are not in use, seen from no frame; None if none changes.

        Whether a matching by some features is right shows in others.
        """
        names = ("speed", "joints", "directions", *getattr(self.robot, "links", ()))
        rest = [name for name in names if name not in self.names]
        try:
            return type(self).fit(demonstrations, self.robot, rest) if rest else None
        except DataError:
            return None

    def __call__(self, demonstration: Demonstration) -> Array:
        """Compute the features of a demonstration, shape (T, D)."""
        groups = _groups(demonstration, self.robot)
        for name in self.names:
            if name not in groups:
                raise UnknownNameError("feature", name, "the demonstration", groups)
        return np.concatenate(
            [groups[name][:, self.columns[name]] * self.scales[name] for name in self.names],
            axis=1,
        )


def _groups(demonstration: Demonstration, robot: Any) -> dict[str, Array]:
    """Compute all feature groups of a demonstration, unscaled, each of shape (T, d)."""
    joints = demonstration.joints
    quaternion = quaternion_columns(demonstration, robot)
    others = np.setdiff1d(np.arange(demonstration.n_joints), np.ravel(quaternion))
    turns = [quaternions.to_matrix(joints[:, block]).flatten(1) for block in quaternion]
    values = as_array(torch.cat((joints[:, others], *turns), dim=1))
    velocity = _velocity(values, demonstration)
    groups = {"joints": values, "directions": _directions(velocity)}
    if robot is None or not robot.links:
        return groups | {"speed": _relative_speed(velocity)}
    names = getattr(robot, "joint_names", None)
    ordered = demonstration if names is None else demonstration.reorder(names)
    state = robot.state(ordered.joints.detach())
    speeds = []
    for link in robot.links:
        position = state.position(link)
        groups[link] = as_array(position)
        speeds.append(_relative_speed(_velocity(groups[link], demonstration)))
        for name, frame in demonstration.frames.items():
            seen = frame.to(position).inverse_transform(position)
            groups[f"{link} in {name}"] = as_array(seen)
    return groups | {"speed": np.concatenate(speeds, axis=1)}


def _velocity(values: Array, demonstration: Demonstration) -> Array:
    """Compute smoothed rates of change, zero where values are constant, shape (T, d)."""
    time = as_array(demonstration.time)
    even = np.linspace(time[0], time[-1], len(time))
    step = demonstration.duration / (len(time) - 1)
    smooth = moving_average(resample(values, time, even), round(SMOOTHING / 2 / step))
    rates = resample(np.gradient(smooth, step, axis=0), even, time)
    return np.where(_varying(values.std(axis=0), np.abs(values).max(axis=0)), rates, 0.0)


def _varying(deviation: Array, size: Array) -> NDArray[np.bool_]:
    """Check whether columns vary beyond what rounding leaves of their sizes."""
    return np.asarray(deviation > np.finfo(np.float64).eps ** 0.5 * size)


def _relative_speed(velocity: Array) -> Array:
    """Divide the speed by its root mean square, which may be zero, shape (T, 1)."""
    speed = np.linalg.norm(velocity, axis=1, keepdims=True)
    usual = np.sqrt((speed**2).mean())
    return speed / usual if usual > 0 else speed


def _directions(velocity: Array) -> Array:
    squared = (velocity**2).sum(axis=1, keepdims=True)
    norm = np.sqrt(squared + STANDSTILL**2 * squared.mean())
    # a demonstration that stands still has no direction
    return np.divide(velocity, norm, out=np.zeros_like(velocity), where=norm > 0)
