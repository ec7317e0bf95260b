"""How good a reproduction is: errors against demonstrations, rhythm, smoothness.

Errors of poses are in millimetres and degrees, so that they can be read; those of joints in
radians. None depends on the signs of quaternions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.pipeline import Pipeline
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import as_tensor
from tpgmm_torch.data.demonstrations import Demonstration, Situation, check_demonstrations
from tpgmm_torch.data.pose_names import quaternion_groups
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

__all__ = [
    "Instants",
    "PoseErrors",
    "PoseScorer",
    "Sinusoid",
    "joint_rmse",
    "largest_acceleration",
    "largest_velocity",
    "make_scorer",
    "pose_errors",
    "reproduction_scorer",
    "sinusoid",
]


#: An event's name, an instant or several [s], or what finds them in a demonstration.
Instants = str | float | Sequence[float] | Tensor | Callable[[Demonstration], Any]


def joint_rmse(trajectory: Trajectory, demonstration: Demonstration) -> float:
    """Root mean square joint difference over equal time grids [rad].

    The joints of the ``demonstration`` may have another order than those of the
    ``trajectory``, if they are named. Quaternions among them, known by their names
    ``hand.qw`` to ``hand.qz``, are compared on one side: q and -q are one rotation.

    Raises
    ------
    ShapeError
        If the time grids or the joints differ.
    """
    wanted = demonstration.reordered(trajectory.joint_names).joints
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
    """How far a link is from where it was shown.

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
    *,
    reproduced_at: float | Sequence[float] | Tensor | None = None,
) -> PoseErrors:
    """Errors of a link's pose: along the path, at instants, or at an event.

    Parameters
    ----------
    trajectory : Trajectory
        What was reproduced.
    demonstration : Demonstration
        What was shown in that situation.
    robot : Kinematics
        ``model.kinematics_``.
    link : str
        Of the robot.
    at : str, float, array-like or callable, optional
        When, on the demonstration's clock: an event's name, an instant or several [s], or a
        function of the demonstration that returns them. By default each of its time steps.
    reproduced_at : float or array-like, optional
        The same instants on the trajectory's clock, if that is another [s]. Between time steps
        the joints are interpolated; before and after a motion they stand still.

    Returns
    -------
    PoseErrors

    Raises
    ------
    UnknownNameError
        If there is no such link or event.
    DataError, ShapeError
        If an instant is no number, lies outside the demonstration, or there are more or fewer
        on one clock than on the other.

    Examples
    --------
    >>> from tpgmm_torch import Poses
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
    elsewhere = instants
    if reproduced_at is not None:
        elsewhere = as_tensor(reproduced_at, "reproduced_at").reshape(-1)
        if elsewhere.shape != instants.shape:
            raise ShapeError(
                f"there are {len(instants)} instants in the demonstration, and "
                f"{len(elsewhere)} in reproduced_at"
            )
    shown = demonstration.reordered(robot.joint_names)
    found = _state_at(trajectory.time, trajectory.joints, elsewhere, robot)
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
    elif callable(at):
        at = at(demonstration)
    instants = as_tensor(at, "an instant").to(time).reshape(-1)
    outside = (instants < time[0]) | (instants > time[-1])
    if bool(outside.any()) or not len(instants):
        raise DataError(
            f"instants {instants[outside].tolist()} s lie outside the demonstration, "
            f"{float(time[0]):.6g} to {float(time[-1]):.6g} s"
        )
    return instants


def _state_at(time: Tensor, joints: Tensor, instants: Tensor, robot: Kinematics) -> RobotState:
    """The robot between time steps."""
    like = robot.lower
    time, joints, instants = time.to(like), joints.to(like), instants.to(like)
    last = len(time) - 1
    right = torch.searchsorted(time, instants).clamp(min(1, last), last)
    left = (right - 1).clamp(min=0)
    width = (time[right] - time[left]).clamp(min=torch.finfo(time.dtype).tiny)
    fraction = ((instants - time[left]) / width).clamp(0, 1).unsqueeze(-1)
    start, end = joints[left], joints[right].clone()
    for place in robot.quaternion_starts:
        block = slice(place, place + 4)
        end[:, block] = quaternions.match_hemisphere(end[:, block], start[:, block])
    return robot.state(robot.retract(torch.lerp(start, end, fraction)))


@dataclass(frozen=True)
class PoseScorer:
    """What :func:`make_scorer` makes: minus a mean pose error, for scikit-learn.

    Parameters
    ----------
    link, event, quantity, robot
        As given to :func:`make_scorer`.
    """

    link: str | None = None
    event: Instants | None = None
    quantity: str = "position"
    robot: Kinematics | None = None

    def __call__(self, estimator: Any, X: Sequence[Demonstration], y: object = None) -> float:
        """Minus the mean over demonstrations and links; higher is better.

        Parameters
        ----------
        estimator : TaskParameterizedGMM
            Fitted.
        X : sequence of Demonstration
            Held out.
        y : ignored
            Here for scikit-learn.
        """
        model, demonstrations = _held_out(estimator, X)
        trajectories = _reproductions(model, demonstrations)
        robot = model.kinematics_ if self.robot is None else self.robot
        links = robot.links if self.link is None else (self.link,)
        if not links:
            raise DataError(
                "the model has no links whose pose could be compared: give it a robot"
            )
        instants: list[Any] = [self.event] * len(demonstrations)
        if not (
            self.event is None or isinstance(self.event, str | float | int)
        ) and not callable(self.event):
            instants = list(self.event)
            if len(instants) != len(demonstrations):
                raise ShapeError(
                    f"there are {len(instants)} instants for {len(demonstrations)} "
                    "demonstrations: for folds, name an event of the demonstrations"
                )
        errors = [
            getattr(pose_errors(found, shown, robot, link, at), self.quantity).mean()
            for found, shown, at in zip(trajectories, demonstrations, instants, strict=True)
            for link in links
        ]
        return -float(torch.stack(errors).mean())


def make_scorer(
    link: str | None = None,
    event: Instants | None = None,
    quantity: str = "position",
    robot: Kinematics | None = None,
) -> PoseScorer:
    """A scorer of what a skill is for: where a link is when it matters.

    For ``scoring=`` of :func:`tpgmm_torch.model_selection.cross_validate`, ``cross_val_score``
    and ``GridSearchCV``. Held-out demonstrations are reproduced on their own clock; those of a
    pipeline of alignment and model are aligned first, by what the alignment learned.

    Parameters
    ----------
    link : str, optional
        Of the robot; the mean over all its links by default.
    event : str, float, callable or sequence of float, optional
        When: the name of an event of the demonstrations, an instant of all of them [s], a
        function of a demonstration that returns one, or one for each of the demonstrations
        that are scored. By default the whole path.
    quantity : {"position", "angle"}, default="position"
        In millimetres, or in degrees.
    robot : Kinematics, optional
        By default the model's own.

    Returns
    -------
    PoseScorer
        ``scorer(model, demonstrations)`` is minus the mean error.

    Raises
    ------
    DataError
        If ``quantity`` is another.

    Examples
    --------
    >>> make_scorer("hand", event="close").quantity
    'position'
    """
    if quantity not in ("position", "angle"):
        raise DataError(f"quantity is 'position' [mm] or 'angle' [deg], got {quantity!r}")
    return PoseScorer(link, event, quantity, robot)


def _held_out(
    estimator: Any, X: Sequence[Demonstration]
) -> tuple[Any, Sequence[Demonstration]]:
    """The model and the demonstrations, brought onto its clock by the steps before it."""
    demonstrations = check_demonstrations(X)
    if not isinstance(estimator, Pipeline):
        return estimator, demonstrations
    before, model = estimator[:-1], estimator[-1]
    return model, before.transform(demonstrations) if len(before) else demonstrations


def _reproductions(model: Any, demonstrations: Sequence[Demonstration]) -> list[Trajectory]:
    """What a model does in the situations of demonstrations, at their time steps."""
    situations = [Situation.of(one, one.time) for one in demonstrations]
    return model.predict(situations, candidates=False)


def reproduction_scorer(estimator: Any, X: Sequence[Demonstration], y: object = None) -> float:
    """Minus the joint RMSE of reproductions in the situations of held-out demonstrations [rad].

    For ``cross_val_score(..., scoring=reproduction_scorer)`` and ``GridSearchCV``; unlike the
    likelihood it compares models with different operators. Where a pose matters rather than
    joints, :func:`make_scorer` asks for it.

    Parameters
    ----------
    estimator : TaskParameterizedGMM
        Fitted.
    X : sequence of Demonstration
        Held out.
    y : ignored
        Here for scikit-learn.
    """
    model, demonstrations = _held_out(estimator, X)
    errors = map(joint_rmse, _reproductions(model, demonstrations), demonstrations)
    return -float(np.mean(list(errors)))


def largest_velocity(motion: Trajectory | Demonstration) -> float:
    """Largest joint speed of a ``motion`` by first differences [rad/s].

    Examples
    --------
    >>> largest_velocity(Demonstration([0.0, 0.5, 1.0], [[0.0], [1.0], [1.5]]))
    2.0
    """
    speed = motion.joints.diff(dim=0) / motion.time.diff()[:, None]
    return float(speed.abs().max())


def largest_acceleration(motion: Trajectory | Demonstration) -> float:
    """Largest joint acceleration of a ``motion`` by second differences [rad/s^2].

    Examples
    --------
    >>> largest_acceleration(Demonstration([0.0, 0.5, 1.0], [[0.0], [1.0], [1.5]]))
    2.0
    """
    steps = motion.time.diff()
    speed = motion.joints.diff(dim=0) / steps[:, None]
    middle = (steps[1:] + steps[:-1]) / 2
    return float((speed.diff(dim=0) / middle[:, None]).abs().max())


@dataclass(frozen=True)
class Sinusoid:
    """``offset + amplitude sin(2 pi frequency t + phase)``, and what it leaves unexplained.

    Parameters
    ----------
    frequency : float
        In hertz.
    amplitude, offset : float
        In the signal's unit.
    phase : float
        At time 0 [rad].
    residual : float
        Root mean square of the rest.
    """

    frequency: float
    amplitude: float
    offset: float
    phase: float
    residual: float


def sinusoid(time: ArrayLike, signal: ArrayLike) -> Sinusoid:
    """The sinusoid of least squares through a signal.

    The frequency is searched between one period in the window and the Nyquist frequency,
    coarsely by steps of a fifth of a period in the window, then by golden sections.

    Parameters
    ----------
    time, signal : array-like of shape (T,)
        In seconds, and in any unit.

    Raises
    ------
    ShapeError
        If there are fewer than eight points, or the shapes differ.

    Examples
    --------
    >>> time = np.linspace(0, 3, 100)
    >>> fit = sinusoid(time, 0.2 + 0.5 * np.sin(2 * np.pi * 1.5 * time))
    >>> round(fit.frequency, 6), round(fit.amplitude, 6), round(fit.offset, 6)
    (1.5, 0.5, 0.2)
    """
    t = np.asarray(torch.as_tensor(time), dtype=np.float64)
    y = np.asarray(torch.as_tensor(signal), dtype=np.float64)
    if t.shape != y.shape or t.ndim != 1 or len(t) < 8:
        raise ShapeError(
            f"sinusoid needs two equal vectors of 8 or more, got {t.shape}, {y.shape}"
        )

    def fit(frequency: float) -> tuple[float, NDArray[np.float64]]:
        angle = 2 * np.pi * frequency * t
        basis = np.stack((np.sin(angle), np.cos(angle), np.ones_like(t)), axis=1)
        coefficients = np.linalg.lstsq(basis, y, rcond=None)[0]
        return float(np.sqrt(np.mean((y - basis @ coefficients) ** 2))), coefficients

    window = t[-1] - t[0]
    grid = np.arange(1, len(t) / 2, 0.2) / window
    best = int(np.argmin([fit(frequency)[0] for frequency in grid]))
    low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    golden = (np.sqrt(5) - 1) / 2
    for _ in range(40):
        left, right = high - golden * (high - low), low + golden * (high - low)
        low, high = (low, right) if fit(left)[0] < fit(right)[0] else (left, high)
    frequency = float((low + high) / 2)
    residual, (sine, cosine, offset) = fit(frequency)
    amplitude, phase = float(np.hypot(sine, cosine)), float(np.arctan2(cosine, sine))
    return Sinusoid(frequency, amplitude, float(offset), phase, residual)
