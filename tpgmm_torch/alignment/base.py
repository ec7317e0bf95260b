"""Demonstrations on another clock, and what all alignments in time have in common."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from sklearn.base import BaseEstimator, TransformerMixin
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.alignment.features import quaternion_columns
from tpgmm_torch.constraints import check_parameters
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import (
    Demonstration,
    Situation,
    check_demonstrations,
    check_robot,
)
from tpgmm_torch.exceptions import DataError, NotFittedError

__all__ = ["Alignment", "retime", "seconds", "steps_at"]


def seconds(demonstration: Demonstration) -> Array:
    """The time of a demonstration as an array of shape (T,)."""
    return as_array(demonstration.time)


def steps_at(demonstration: Demonstration, instants: Array) -> Tensor:
    """The fractional time steps at which a demonstration reaches ``instants`` [s]."""
    time = seconds(demonstration)
    return torch.from_numpy(np.interp(instants, time, np.arange(len(time))))


def retime(
    demonstration: Demonstration,
    path: Tensor,
    time: Tensor,
    quaternion_blocks: Sequence[Sequence[int]] = (),
    interpolation: str = "linear",
) -> Demonstration:
    """Play a demonstration on another clock.

    Parameters
    ----------
    demonstration : Demonstration
        Of at least two time steps.
    path : Tensor of shape (N,)
        Strictly increasing fractional time steps of the demonstration.
    time : Tensor of shape (N,)
        When they are reached [s].
    quaternion_blocks : sequence of four columns each, optional
        Where the joints hold unit quaternions.
    interpolation : {"linear", "cubic"}, default="linear"
        Of the joints.

    Returns
    -------
    Demonstration
        Quaternions are interpolated by slerp, constant frames are the same. An event at a
        step that the path does not reach is left out.
    """
    lower = path.floor().long().clamp(0, len(demonstration) - 2)
    fraction = path - lower
    if interpolation == "cubic":
        before = seconds(demonstration)
        spline = CubicSpline(before, as_array(demonstration.joints))
        instants = np.interp(path.numpy(), np.arange(len(before)), before)
        joints = torch.from_numpy(spline(instants)).to(demonstration.joints)
    else:
        joints = _lerp(demonstration.joints, lower, fraction)
    for block in quaternion_blocks:
        turn = quaternions.normalize(demonstration.joints[:, list(block)])
        joints[:, list(block)] = _slerp(turn, lower, fraction)
    frames = {
        name: frame.between(lower, fraction) if frame.batch_shape else frame
        for name, frame in demonstration.frames.items()
    }
    steps = steps_at(demonstration, np.array(list(demonstration.events.values()))).tolist()
    events = {
        name: float(np.interp(step, path.numpy(), time.numpy()))
        for name, step in zip(demonstration.events, steps, strict=True)
        if step <= path[-1] + 1e-9
    }
    time = time.to(demonstration.time)
    return Demonstration(time, joints, frames, demonstration.joint_names, events)


def _lerp(values: Tensor, lower: Tensor, fraction: Tensor) -> Tensor:
    lower = lower.to(values.device)
    return torch.lerp(values[lower], values[lower + 1], fraction.to(values)[:, None])


def _slerp(values: Tensor, lower: Tensor, fraction: Tensor) -> Tensor:
    lower = lower.to(values.device)
    return quaternions.slerp(values[lower], values[lower + 1], fraction.to(values))


class Alignment(TransformerMixin, BaseEstimator, abc.ABC):  # type: ignore[misc]
    """Transformer of demonstrations onto one time grid; a subclass says how to find the paths.

    Attributes
    ----------
    time_ : Tensor of shape (T,)
        The grid [s].
    paths_ : list of Tensor of shape (T,)
        For each demonstration of ``fit``, its fractional time step at each time of the grid.
    joint_names_ : tuple of str or None
        Order of the joints.
    """

    interpolation: str
    robot: Any
    time_: Tensor
    paths_: list[Tensor]
    joint_names_: tuple[str, ...] | None

    def fit_transform(
        self, X: Sequence[Demonstration], y: object = None
    ) -> list[Demonstration]:
        """Fit, and align the same demonstrations without warping them again."""
        X = check_demonstrations(X)
        self.fit(X, y)
        pairs = zip(self._checked(X), self.paths_, strict=True)
        return [self._warped(demonstration, path) for demonstration, path in pairs]

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
            All with the time ``time_``. Events keep the instant of the motion they belong
            to; those after the end of an open-ended match are left out.

        Raises
        ------
        NotFittedError
            Before ``fit``.
        DataError, ShapeError, UnknownNameError
            If the demonstrations are not like those of ``fit``.
        """
        if not hasattr(self, "time_"):
            name = type(self).__name__
            raise NotFittedError(f"this {name} is not fitted: call fit(demonstrations) first")
        if isinstance(X, Sequence) and X and all(isinstance(item, Situation) for item in X):
            return list(X)
        return [self._warped(one, self._path(one)) for one in self._checked(X)]

    @abc.abstractmethod
    def fit(self, X: Sequence[Demonstration], y: object = None) -> Self:
        """Learn ``time_``, ``paths_`` and ``joint_names_``."""

    @abc.abstractmethod
    def _path(self, demonstration: Demonstration) -> Tensor:
        """Fractional time steps of a demonstration at each time of the grid."""

    def _start(self, X: Any) -> list[Demonstration]:
        """What each ``fit`` begins with: check parameters and demonstrations."""
        check_parameters(self)
        check_robot(self.robot)
        demonstrations = check_demonstrations(X)
        self.joint_names_ = demonstrations[0].joint_names
        return self._checked(demonstrations)

    def _checked(self, X: Any) -> list[Demonstration]:
        """Check demonstrations and bring their joints into the order of the first fitted."""
        demonstrations = check_demonstrations(X)
        for index, one in enumerate(demonstrations):
            if len(one) < 2:
                raise DataError(
                    f"demonstration {index} has one time step: there is nothing to align"
                )
        names = self.joint_names_
        return demonstrations if names is None else [d.reordered(names) for d in demonstrations]

    def _warped(self, demonstration: Demonstration, path: Tensor) -> Demonstration:
        blocks = quaternion_columns(demonstration, self.robot)
        return retime(demonstration, path, self.time_, blocks, self.interpolation)

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.two_d_array = False  # X is a list of demonstrations
        return tags
