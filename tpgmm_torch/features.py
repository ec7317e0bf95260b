"""What demonstrations are compared by when they are aligned in time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.demonstrations import Demonstration
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError
from tpgmm_torch.warping import moving_average, resample

__all__ = ["AlignmentFeatures", "quaternion_columns"]

Array = NDArray[np.floating[Any]]

#: Half the length of the kernel that smooths joints before they are differentiated [s].
VELOCITY_SMOOTHING = 0.1
#: Columns that vary by less than this, relative to their size, count as constant.
CONSTANT = 1e-9


def quaternion_columns(demonstration: Demonstration, robot: Any) -> list[list[int]]:
    """Where the joints hold unit quaternions, which is so for recorded poses.

    Parameters
    ----------
    demonstration : Demonstration
    robot : Kinematics or None

    Returns
    -------
    list of list of int
        Four columns of ``demonstration.joints`` for each quaternion.

    Raises
    ------
    ShapeError, UnknownNameError
        If the demonstration does not have the robot's joints.
    """
    blocks = [range(start, start + 4) for start in getattr(robot, "quaternion_starts", ())]
    names = demonstration.joint_names
    if not blocks:
        return []
    if names is None:
        if demonstration.n_joints != robot.n_joints:
            raise ShapeError(
                f"the demonstration has {demonstration.n_joints} joints without names, the "
                f"robot has {robot.n_joints}: {robot.joint_names}"
            )
        return [list(block) for block in blocks]
    demonstration.reordered(robot.joint_names)  # names a joint that is missing
    return [[names.index(robot.joint_names[k]) for k in block] for block in blocks]


@dataclass(frozen=True, eq=False)
class AlignmentFeatures:
    """Groups of features, each scaled to unit variance over the demonstrations of ``fit``.

    The groups are ``"joints"``, ``"velocities"`` (of the joints, per phase or per second) and
    with a robot its link positions by link, ``"left_hand"``, and the same seen from each
    frame, ``"left_hand in bottle"``. Quaternions among the joints count as rotation matrices,
    which do not depend on their sign.

    Parameters
    ----------
    names : tuple of str
        The groups in use.
    robot : Kinematics or None
    per_phase : bool
        Whether velocities are divided by the duration.
    columns : mapping of str to ndarray of bool
        Which columns of each group are not constant.
    scales : mapping of str to float
        What each group is multiplied by.
    """

    names: tuple[str, ...]
    robot: Any
    per_phase: bool
    columns: Mapping[str, NDArray[np.bool_]]
    scales: Mapping[str, float]

    @classmethod
    def fit(
        cls,
        demonstrations: Sequence[Demonstration],
        robot: Any = None,
        names: Sequence[str] | None = None,
        weights: Mapping[str, float] | None = None,
        per_phase: bool = True,
    ) -> Self:
        """Choose and scale the groups.

        A group's variance is the sum over its columns of the variance along each
        demonstration; it becomes the group's squared weight.

        Parameters
        ----------
        demonstrations : sequence of Demonstration
        robot : Kinematics, optional
        names : sequence of str, optional
            By default all that there are.
        weights : mapping of str to float, optional
            1 for groups that are not named; 0 leaves a group out.
        per_phase : bool, default=True

        Returns
        -------
        AlignmentFeatures

        Raises
        ------
        UnknownNameError
            If a group does not exist.
        DataError
            If a weight is negative, or no feature changes.
        """
        raw = [_groups(one, robot, per_phase) for one in demonstrations]
        wanted = _checked_names(names, raw[0], "feature")
        weights = dict(weights or {})
        _checked_names(list(weights), dict.fromkeys(wanted), "weight")
        columns: dict[str, NDArray[np.bool_]] = {}
        scales: dict[str, float] = {}
        for name in wanted:
            weight = float(weights.get(name, 1.0))
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
                f"none of the features {list(wanted)} changes in the demonstrations: "
                "there is nothing to align by"
            )
        return cls(tuple(columns), robot, per_phase, columns, scales)

    def __call__(self, demonstration: Demonstration) -> Array:
        """The features of a demonstration, shape (T, D)."""
        groups = _groups(demonstration, self.robot, self.per_phase)
        for name in self.names:
            if name not in groups:
                raise UnknownNameError("feature", name, "the demonstration", groups)
        return np.concatenate(
            [groups[name][:, self.columns[name]] * self.scales[name] for name in self.names],
            axis=1,
        )


def _checked_names(
    names: Sequence[str] | None, available: Mapping[str, Any], kind: str
) -> tuple[str, ...]:
    for name in names or ():
        if name not in available:
            raise UnknownNameError(kind, name, "the features", available)
    return tuple(dict.fromkeys(available if names is None else names))


def _groups(demonstration: Demonstration, robot: Any, per_phase: bool) -> dict[str, Array]:
    """All feature groups that a demonstration has, unscaled, each of shape (T, d)."""
    joints = demonstration.joints
    quaternion = quaternion_columns(demonstration, robot)
    inside = {column for block in quaternion for column in block}
    others = [column for column in range(demonstration.n_joints) if column not in inside]
    turns = [quaternions.to_matrix(joints[:, block]).flatten(1) for block in quaternion]
    values = _numpy(torch.cat((joints[:, others], *turns), dim=1))
    groups = {"joints": values, "velocities": _velocities(values, demonstration, per_phase)}
    if robot is None:
        return groups
    names = getattr(robot, "joint_names", None)
    ordered = demonstration if names is None else demonstration.reordered(names)
    state = robot.state(ordered.joints.detach())
    for link in robot.links:
        position = state.position(link)
        groups[link] = _numpy(position)
        for name, frame in demonstration.frames.items():
            groups[f"{link} in {name}"] = _numpy(frame.to(position).inverse_transform(position))
    return groups


def _velocities(values: Array, demonstration: Demonstration, per_phase: bool) -> Array:
    time = _numpy(demonstration.time)
    even = np.linspace(time[0], time[-1], len(time))
    step = demonstration.duration / (len(time) - 1)
    smooth = moving_average(resample(values, time, even), round(VELOCITY_SMOOTHING / step))
    rates = resample(np.gradient(smooth, step, axis=0), even, time)
    speed = np.sqrt((rates**2).sum(axis=1, keepdims=True))
    import os
    still = float(os.environ.get('STILL','0.1')) * np.sqrt((speed**2).mean())
    return np.asarray(rates / np.sqrt(speed**2 + still**2))


def _numpy(tensor: Tensor) -> Array:
    return tensor.detach().cpu().double().numpy()
