"""Demonstrations on another clock, and the base class of all alignments in time."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
import torch
from sklearn.base import TransformerMixin
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.alignment.features import quaternion_columns
from tpgmm_torch.constraints import DemonstrationEstimator, check_parameters
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import (
    Demonstration,
    Situation,
    check_demonstrations,
    check_robot,
)
from tpgmm_torch.exceptions import DataError


def retime(
    demonstration: Demonstration,
    path: Array,
    time: Tensor,
    quaternion_blocks: Sequence[Sequence[int]] = (),
) -> Demonstration:
    """Play a demonstration on another clock.

    Parameters
    ----------
    demonstration : Demonstration
        Of at least two time steps.
    path : ndarray of shape (N,)
        Strictly increasing instants of the demonstration [s].
    time : Tensor of shape (N,)
        When they are reached [s].
    quaternion_blocks : sequence of four columns each, optional
        Where the joints hold unit quaternions.

    Returns
    -------
    Demonstration
        Quaternions are interpolated by slerp, everything else linearly; constant frames are
        the same. Holds stay with the motion; an event after the end of the path is left out.
    """
    recorded, joints = as_array(demonstration.time), demonstration.joints
    steps = np.arange(len(recorded))
    at = np.interp(path, recorded, steps)
    place = torch.from_numpy(at)
    lower = place.floor().long().clamp(0, len(demonstration) - 2)
    fraction = place - lower
    moved = _interpolate_joints(joints, lower, fraction, quaternion_blocks)
    frames = {
        name: frame.between(lower, fraction) if frame.batch_shape else frame
        for name, frame in demonstration.frames.items()
    }
    grid = as_array(time)

    def clock(instant: float) -> float:
        return float(np.interp(np.interp(instant, recorded, steps), at, grid))

    end_of_path = at[-1] + 1e-9
    events = {
        name: clock(instant)
        for name, instant in demonstration.events.items()
        if np.interp(instant, recorded, steps) <= end_of_path
    }
    holds = demonstration.holds
    if holds is not None:  # those outside the path shrink to an instant, and are left out
        holds = tuple(h.retime(clock) for h in holds if clock(h.begin) < clock(h.end))
    time = time.to(demonstration.time)
    names = demonstration.joint_names
    wrenches = {
        link: torch.lerp(wrench[lower], wrench[lower + 1], fraction.to(wrench)[:, None])
        for link, wrench in demonstration.wrenches.items()
    }
    commands = demonstration.commands
    if commands is not None:
        commands = _interpolate_joints(commands, lower, fraction, quaternion_blocks)
    return Demonstration(time, moved, frames, names, events, holds, wrenches, commands)


def _interpolate_joints(
    joints: Tensor, lower: Tensor, fraction: Tensor, quaternion_blocks: Sequence[Sequence[int]]
) -> Tensor:
    """Interpolate between time steps and the next ones, quaternions by slerp."""
    lower, weight = lower.to(joints.device), fraction.to(joints)
    start, end = joints[lower], joints[lower + 1]
    moved = torch.lerp(start, end, weight[:, None])
    for block in map(list, quaternion_blocks):
        before, after = (quaternions.normalize(values[:, block]) for values in (start, end))
        moved[:, block] = quaternions.slerp(before, after, weight)
    return moved


class Alignment(TransformerMixin, DemonstrationEstimator, abc.ABC):
    """Transformer of demonstrations onto one time grid; a subclass finds the paths.

    Attributes
    ----------
    time_ : Tensor of shape (T,)
        The grid [s].
    paths_ : list of ndarray of shape (T,)
        For each demonstration of ``fit``, its own instant at each time of the grid [s].
    joint_names_ : tuple of str or None
        Order of the joints.
    """

    robot: Any
    time_: Tensor
    paths_: list[Array]
    joint_names_: tuple[str, ...] | None

    def fit_transform(
        self, X: Sequence[Demonstration], y: object = None
    ) -> list[Demonstration]:
        """Fit, and align the same demonstrations without warping them again."""
        X = check_demonstrations(X)
        self.fit(X, y)
        return list(map(self._retime, self._check(X), self.paths_))

    def transform(self, X: Sequence[Any]) -> list[Any]:
        """Align demonstrations onto the time grid learned by ``fit``.

        Parameters
        ----------
        X : sequence of Demonstration
            Or of :class:`Situation`, which pass unchanged: thus a pipeline of alignment and
            model predicts.

        Returns
        -------
        list of Demonstration
            All with the time ``time_``. Events keep the instant of the motion they belong to.

        Raises
        ------
        NotFittedError
            Before ``fit``.
        DataError, ShapeError, UnknownNameError
            If the demonstrations are not like those of ``fit``.
        """
        self._check_fitted("time_")
        if isinstance(X, Sequence) and X and all(isinstance(item, Situation) for item in X):
            return list(X)
        return [self._retime(one, self._path(one)) for one in self._check(X)]

    @abc.abstractmethod
    def fit(self, X: Sequence[Demonstration], y: object = None) -> Self:
        """Learn ``time_``, ``paths_`` and ``joint_names_``."""

    @abc.abstractmethod
    def _path(self, demonstration: Demonstration) -> Array:
        """Compute instants of a demonstration at each time of the grid [s]."""

    def _start(self, X: Any) -> list[Demonstration]:
        """Check parameters and demonstrations, as each ``fit`` does first."""
        check_parameters(self)
        check_robot(self.robot)
        demonstrations = check_demonstrations(X)
        self.joint_names_ = demonstrations[0].joint_names
        return self._check(demonstrations)

    def _check(self, X: Any) -> list[Demonstration]:
        """Check demonstrations and bring their joints into the order of the first fitted."""
        demonstrations = check_demonstrations(X)
        for index, one in enumerate(demonstrations):
            if len(one) < 2:
                raise DataError(
                    f"demonstration {index} has one time step: there is nothing to align"
                )
        names = self.joint_names_
        return demonstrations if names is None else [d.reorder(names) for d in demonstrations]

    def _retime(self, demonstration: Demonstration, path: Array) -> Demonstration:
        blocks = quaternion_columns(demonstration, self.robot)
        return retime(demonstration, path, self.time_, blocks)
