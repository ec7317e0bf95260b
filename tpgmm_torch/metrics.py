"""Errors of reproductions against demonstrations, their speed and acceleration, and scorers.

Errors of poses are in millimetres and degrees, so that they can be read; those of joints in
radians. None depends on the signs of quaternions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from sklearn.pipeline import Pipeline
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import as_array, as_tensor
from tpgmm_torch.data.demonstrations import Demonstration, Situation, check_demonstrations
from tpgmm_torch.data.pose_names import quaternion_groups
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

__all__ = ["PoseErrors", "PoseScorer", "joint_rmse", "pose_errors", "reproduction_scorer"]


#: An event's name, or an instant or several [s].
Instants = str | float | Sequence[float] | Tensor


def joint_rmse(trajectory: Trajectory, demonstration: Demonstration) -> float:
    """Compute the root mean square joint difference over equal time grids [rad].

    The joints of the ``demonstration`` may have another order than those of the
    ``trajectory``, if they are named. Quaternions among them, known by their names
    ``hand.qw`` to ``hand.qz``, are compared on one side: q and -q are one rotation.

    Raises
    ------
    ShapeError
        If the time grids or the joints differ.
    """
    wanted = demonstration.reorder(trajectory.joint_names).joints
    if wanted.shape != trajectory.joints.shape:
        raise ShapeError(
            f"the trajectory has shape {tuple(trajectory.joints.shape)}, "
            f"the demonstration {tuple(wanted.shape)}"
        )
    found = trajectory.joints.to(wanted).clone()
    for group in map(list, quaternion_groups(trajectory.joint_names)):
        found[:, group] = quaternions.match_hemisphere(found[:, group], wanted[:, group])
    return float((found - wanted).square().mean().sqrt())


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Distance of a link from where it was shown.

    Parameters
    ----------
    time : Tensor of shape (N,)
        When, on the demonstration's clock [s].
    position : Tensor of shape (N,)
        Distances [mm].
    angle : Tensor of shape (N,)
        Angles between the orientations [deg], from 0 to 180.
    """

    time: Tensor
    position: Tensor
    angle: Tensor

    def __repr__(self) -> str:
        return (
            f"PoseErrors({len(self.time)} instants, mean {float(self.position.mean()):.3g} mm, "
            f"{float(self.angle.mean()):.3g} deg)"
        )


def pose_errors(
    trajectory: Trajectory,
    demonstration: Demonstration,
    robot: Kinematics,
    link: str,
    at: Instants | None = None,
) -> PoseErrors:
    """Compute errors of a link's pose: along the path, at instants, or at an event.

    Parameters
    ----------
    trajectory : Trajectory
        The reproduction.
    demonstration : Demonstration
        In the same situation.
    robot : Kinematics
        ``model.kinematics_``.
    link : str
        Of the robot.
    at : str, float or array-like, optional
        When, on the demonstration's clock: an event's name, or an instant or several [s]. By
        default each of its time steps.
        Between time steps the joints are interpolated; before and after a motion they stand
        still.

    Returns
    -------
    PoseErrors

    Raises
    ------
    UnknownNameError
        If there is no such link or event.
    DataError
        If an instant is no number, or lies outside the demonstration.

    Examples
    --------
    >>> from tpgmm_torch.robots import Poses
    >>> hand, time = Poses(["hand"], orientation=False), torch.tensor([0.0, 1.0])
    >>> shown = Demonstration(time, [[0.0, 0, 0], [0.5, 0, 0]], events={"close": 1.0})
    >>> reached = torch.tensor([[0.0, 0, 0], [0.5, 0.002, 0]])
    >>> found = Trajectory(time, reached, torch.zeros(2, 3, 3), (), hand.joint_names)
    >>> pose_errors(found, shown, hand, "hand", at="close")
    PoseErrors(1 instants, mean 2 mm, 0 deg)
    """
    if link not in robot.links:
        raise UnknownNameError("link", link, "the robot", robot.links)
    instants = _instants(at, demonstration)
    shown = demonstration.reorder(robot.joint_names)
    found = _state_at(trajectory.time, trajectory.joints, instants, robot)
    wanted = _state_at(shown.time, shown.joints, instants, robot)
    distance = torch.linalg.vector_norm(found.position(link) - wanted.position(link), dim=-1)
    turn = quaternions.product(
        found.orientation(link), quaternions.conjugate(wanted.orientation(link))
    )
    angle = torch.linalg.vector_norm(quaternions.log(turn), dim=-1)
    return PoseErrors(instants, 1e3 * distance, torch.rad2deg(angle))


def _instants(at: Instants | None, demonstration: Demonstration) -> Tensor:
    time = demonstration.time
    if at is None:
        return time
    if isinstance(at, str):
        at = demonstration.event(at)
    instants = as_tensor(at, "an instant").to(time).reshape(-1)
    outside = (instants < time[0]) | (instants > time[-1])
    if bool(outside.any()) or not len(instants):
        raise DataError(
            f"instants {instants[outside].tolist()} s lie outside the demonstration, "
            f"{float(time[0]):.6g} to {float(time[-1]):.6g} s"
        )
    return instants


def _state_at(time: Tensor, joints: Tensor, instants: Tensor, robot: Kinematics) -> RobotState:
    """Interpolate the robot between time steps."""
    joints = joints.to(robot.lower, copy=True)
    for place in robot.quaternion_starts:
        block = slice(place, place + 4)
        joints[:, block] = quaternions.continuous(joints[:, block])
    columns = [
        np.interp(as_array(instants), as_array(time), column) for column in as_array(joints).T
    ]
    return robot.state(robot.retract(torch.from_numpy(np.stack(columns, 1)).to(joints)))


@dataclass(frozen=True)
class PoseScorer:
    """Scorer for scikit-learn: minus the mean pose error of links of reproductions.

    For ``scoring=`` of scikit-learn's ``cross_validate``, ``cross_val_score`` and
    ``GridSearchCV``. Held-out demonstrations are reproduced on their own clock; those of a
    pipeline of alignment and model are aligned first, by what the alignment learned.

    Parameters
    ----------
    link : str, optional
        Of the robot; the mean over all its links by default.
    event : str or float, optional
        When: the name of an event of the demonstrations, or an instant of all of them [s]. By
        default the whole path.
    quantity : {"position", "angle"}, default="position"
        In millimetres, or in degrees.

    Raises
    ------
    DataError
        If ``quantity`` is another.

    Examples
    --------
    >>> PoseScorer("hand", event="close").quantity
    'position'
    """

    link: str | None = None
    event: Instants | None = None
    quantity: str = "position"

    def __post_init__(self) -> None:
        if self.quantity not in ("position", "angle"):
            raise DataError(
                f"quantity is 'position' [mm] or 'angle' [deg], got {self.quantity!r}"
            )

    def __call__(self, estimator: Any, X: Sequence[Demonstration], y: object = None) -> float:
        """Score by minus the mean over demonstrations and links; higher is better.

        Parameters
        ----------
        estimator : TaskParameterizedGMM
            Fitted, or a pipeline that ends in one.
        X : sequence of Demonstration
            Held out.
        y : ignored
            Here for scikit-learn.
        """
        model, pairs = _reproductions(estimator, X)
        robot = model.kinematics_
        links = robot.links if self.link is None else (self.link,)
        if not links:
            raise DataError(
                "the model has no links whose pose could be compared: give it a robot"
            )
        errors = [
            getattr(pose_errors(found, shown, robot, link, self.event), self.quantity).mean()
            for found, shown in pairs
            for link in links
        ]
        return -float(torch.stack(errors).mean())


def _reproductions(
    estimator: Any, X: Sequence[Demonstration]
) -> tuple[Any, list[tuple[Trajectory, Demonstration]]]:
    """Return the model, and its reproductions beside demonstrations, aligned before."""
    model, demonstrations = estimator, check_demonstrations(X)
    if isinstance(estimator, Pipeline):
        before, model = estimator[:-1], estimator[-1]
        demonstrations = before.transform(demonstrations) if len(before) else demonstrations
    situations = [Situation.of(one, one.time) for one in demonstrations]
    found = model.predict(situations, candidates=False)
    return model, list(zip(found, demonstrations, strict=True))


def reproduction_scorer(estimator: Any, X: Sequence[Demonstration], y: object = None) -> float:
    """Score by minus the joint RMSE in situations of held-out demonstrations [rad].

    For ``cross_val_score(..., scoring=reproduction_scorer)`` and ``GridSearchCV``; unlike the
    likelihood it compares models with different operators. Where a pose matters rather than
    joints, :class:`PoseScorer` scores it.

    Parameters
    ----------
    estimator : TaskParameterizedGMM
        Fitted, or a pipeline that ends in one.
    X : sequence of Demonstration
        Held out.
    y : ignored
        Here for scikit-learn.
    """
    _, pairs = _reproductions(estimator, X)
    return -float(np.mean([joint_rmse(found, shown) for found, shown in pairs]))


def largest_velocity(motion: Trajectory | Demonstration) -> float:
    """Compute the largest joint speed of a ``motion`` by first differences [rad/s].

    Examples
    --------
    >>> largest_velocity(Demonstration([0.0, 0.5, 1.0], [[0.0], [1.0], [1.5]]))
    2.0
    """
    return float(largest_speeds(motion).max())


def largest_speeds(motion: Trajectory | Demonstration) -> Tensor:
    """Compute the largest speed (n_joints,) of each joint of a ``motion`` [rad/s].

    Examples
    --------
    >>> largest_speeds(Demonstration([0.0, 0.5, 1.0], [[0.0], [1.0], [1.5]])).tolist()
    [2.0]
    """
    return (motion.joints.diff(dim=0) / motion.time.diff()[:, None]).abs().amax(0)


def largest_acceleration(motion: Trajectory | Demonstration) -> float:
    """Compute the largest joint acceleration of a ``motion`` [rad/s^2], by second differences.

    Examples
    --------
    >>> largest_acceleration(Demonstration([0.0, 0.5, 1.0], [[0.0], [1.0], [1.5]]))
    2.0
    """
    steps = motion.time.diff()
    speed = motion.joints.diff(dim=0) / steps[:, None]
    middle = (steps[1:] + steps[:-1]) / 2
    return float((speed.diff(dim=0) / middle[:, None]).abs().max())
