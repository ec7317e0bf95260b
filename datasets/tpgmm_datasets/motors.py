"""Signs and offsets from motors to joints of the URDF, from postures with known poses."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from tpgmm_datasets.errors import DatasetError
from tpgmm_datasets.least_squares import levenberg_marquardt
from tpgmm_datasets.names import match_names
from tpgmm_datasets.units import Scale, Unit, as_scale
from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import as_tensor
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["MotorMap", "estimate_motor_map"]

#: All signs of this many motors are tried.
MOST_MOTORS = 8
#: First guesses of the offsets for each choice of signs, and steps: with all, with the best.
GUESSES, ROUGH, FINE = 12, 12, 40
#: Where a wrong sign fits less than this much worse (in units of log-likelihood), or an offset
#: is less certain than this [rad], the postures do not tell.
LEAST_EVIDENCE, LEAST_CERTAINTY = 10.0, math.radians(5)
#: Poses this many times further from the robot than they are said to be accurate contradict it.
MOST_MISFIT = 4.0


@dataclass(frozen=True)
class MotorMap:
    """Signs and offsets of motors: ``joint = sign * angle + offset``.

    Parameters
    ----------
    units : dict of str to Scale
        By recorded name, as :func:`load_lerobot` takes them: motors whose map was not
        estimated have the unit that was given.
    signs : dict of str to int
        1, or -1 where the motor turns the other way than the joint, of those estimated.
    offsets : dict of str to float
        The joint where the motor says 0, in (-pi, pi] [rad].
    uncertainty : dict of str to float
        Standard errors of the offsets [rad].
    position_error, orientation_error : float
        What is left between the robot's poses and the known ones, root mean square
        [m and rad]; that of orientations is NaN if they were not used.
    """

    units: dict[str, Scale]
    signs: dict[str, int]
    offsets: dict[str, float]
    uncertainty: dict[str, float]
    position_error: float
    orientation_error: float

    def __str__(self) -> str:
        width = max(len(name) for name in self.signs)
        lines = [
            f"{name:{width}}  {sign:+d}  {math.degrees(self.offsets[name]):8.2f} deg "
            f"+- {math.degrees(self.uncertainty[name]):.2f}"
            for name, sign in self.signs.items()
        ]
        left = f"{1e3 * self.position_error:.1f} mm"
        if not math.isnan(self.orientation_error):
            left += f", {math.degrees(self.orientation_error):.1f} deg"
        return "\n".join([*lines, f"left of the poses: {left} (root mean square)"])


def estimate_motor_map(
    robot: Kinematics,
    link: str,
    values: Any,
    poses: Frame,
    *,
    names: Sequence[str] | None = None,
    units: Unit | Mapping[str, Unit] = "rad",
    known: Collection[str] = (),
    orientations: bool = True,
    position_std: float = 0.002,
    orientation_std: float = math.radians(1),
) -> MotorMap:
    """Estimate which way motors turn, and where they are at 0, from postures with known poses.

    All choices of signs are tried, each from several offsets, by damped least squares on the
    poses of one link. Postures differ in all joints at once; ten are enough.

    Parameters
    ----------
    robot : Kinematics
        Its joints have the wanted signs and zeros.
    link : str
        The link whose poses are known.
    values : array-like of shape (n_postures, n_motors)
        What the motors said.
    poses : Frame
        Where the link was, n_postures poses in the robot's base frame: tracked, or known since
        the link was put there.
    names : sequence of str, optional
        Names of the motors as they are recorded, ``shoulder_pan.pos`` for the joint
        ``shoulder_pan``; the default is the robot's names in its order.
    units : str, Scale, or mapping of name to these, default="rad"
        What makes angles of the values, up to the sign and the zero: "deg", a
        calibration's scale.
    known : collection of str, default=()
        Motors whose ``units`` hold as they are. So do those that do not move the link.
    orientations : bool, default=True
        False for poses of which the position alone is known.
    position_std, orientation_std : float
        How accurate the poses are [m and rad].

    Returns
    -------
    MotorMap

    Raises
    ------
    DatasetError
        If the postures do not tell a sign or an offset, the best map does not explain the
        poses, or more than eight motors move the link.

    Examples
    --------
    >>> from tpgmm_datasets.robots import so101_urdf
    >>> from tpgmm_torch import Robot
    >>> arm = Robot.from_urdf(so101_urdf(), ["gripper_frame_link"])
    >>> generator = torch.Generator().manual_seed(0)
    >>> joints = torch.randn(10, 6, generator=generator, dtype=torch.float64)
    >>> poses = arm.state(joints).pose("gripper_frame_link")
    >>> motors = torch.rad2deg(joints * torch.tensor([1, -1, 1, 1, -1, 1])) + 20
    >>> found = estimate_motor_map(arm, "gripper_frame_link", motors, poses, units="deg")
    >>> found.signs["shoulder_lift"], round(math.degrees(found.offsets["shoulder_lift"]), 3)
    (-1, 20.0)
    """
    names = tuple(robot.joint_names if names is None else names)
    matched = match_names(robot.joint_names, names, "")
    motors = sorted(matched, key=lambda name: robot.joint_names.index(matched[name]))
    table = as_tensor(values, "values").to(robot.lower)
    _check_postures(table, poses, len(names))
    if wrong := sorted({*known} - {*motors}):
        raise DatasetError(f"known motors {wrong} are not among {motors}")
    given = units if isinstance(units, Mapping) else dict.fromkeys(names, units)
    scales = {motor: as_scale(given.get(motor, "rad"), motor) for motor in motors}
    angles = _scale_values(table, names, scales)
    chosen = [i for i in _find_moving_joints(robot, link, angles) if motors[i] not in known]
    if not 0 < len(chosen) <= MOST_MOTORS:
        raise DatasetError(
            f"{len(chosen)} motors move the link {link!r}; the map of 1 to {MOST_MOTORS} can "
            "be estimated at once: take one arm, or say which are known, known=[...]"
        )
    turn_std = orientation_std if orientations else math.inf
    problem = _Problem(robot, link, angles, chosen, poses.to(table), position_std, turn_std)
    return _map_motors([motors[i] for i in chosen], scales, problem)


def _scale_values(values: Tensor, names: Sequence[str], scales: Mapping[str, Scale]) -> Tensor:
    columns = [
        values[:, names.index(motor)] * scale.factor + scale.offset
        for motor, scale in scales.items()
    ]
    return torch.stack(columns, 1)


def _find_moving_joints(robot: Kinematics, link: str, joints: Tensor) -> list[int]:
    jacobians = robot.state(joints).jacobians[:, robot.links.index(link)]
    moving: list[int] = torch.nonzero(jacobians.abs().amax((0, 1)) > 1e-9).flatten().tolist()
    return moving


def _check_postures(table: Tensor, poses: Frame, motors: int) -> None:
    n = len(poses.position) if poses.batch_shape else 0
    if table.shape != (n, motors) or not n:
        got = f"values {tuple(table.shape)}, poses {tuple(poses.batch_shape)}"
        wanted = f"have the shape (n, {motors}), and there are n poses; got {got}"
        raise DatasetError(f"values of {motors} motors at n postures {wanted}")


def _map_motors(
    labels: Sequence[str], scales: Mapping[str, Scale], problem: _Problem
) -> MotorMap:
    """Solve the problem for the labelled motors; the others keep their scales."""
    signs, offsets, cost = problem.solve()
    best = int(cost.argmin())
    errors = problem.errors(signs[best], offsets[best])
    _check_evidence(labels, signs, cost, best, errors, problem.rows)
    # a half turn to either side is the same angle
    wrapped = math.pi - torch.remainder(math.pi - offsets[best], math.tau)
    turns, shifts, uncertainty = (
        dict(zip(labels, column.tolist(), strict=True))
        for column in (signs[best].int(), wrapped, errors)
    )
    units = dict(scales)
    for motor, turn in turns.items():
        factor, offset = scales[motor].factor, scales[motor].offset
        units[motor] = Scale(turn * factor, turn * offset + shifts[motor])
    left = problem.misfit(signs[best], offsets[best])
    return MotorMap(units, turns, shifts, uncertainty, *left)


def _check_evidence(
    labels: Sequence[str], signs: Tensor, cost: Tensor, best: int, errors: Tensor, rows: int
) -> None:
    """Check that the robot explains the poses, and the postures each sign and offset."""
    misfit = math.sqrt(2 * float(cost[best]) / rows)
    if misfit > MOST_MISFIT:
        raise DatasetError(
            f"the best map leaves the poses {misfit:.0f} times further from the robot than "
            "position_std and orientation_std say they are: is it this link, the robot's base "
            "frame, and do units make angles of the values?"
        )
    for i, name in enumerate(labels):
        wrong = cost[signs[:, i] != signs[best, i]].min() - cost[best]
        if not wrong > LEAST_EVIDENCE or not errors[i] < LEAST_CERTAINTY:
            raise DatasetError(
                f"the poses do not tell the sign and the offset of motor {name!r} (a wrong "
                f"sign fits {float(wrong):.1f} worse in log-likelihood, the offset is known to "
                f"{math.degrees(errors[i]):.1f} deg): take more postures, in which it moves "
                "further and the others differ, give orientations, or say that it is known, "
                f"known=[{name!r}]"
            )


@dataclass
class _Problem:
    """Poses of a link to be met by signs and offsets of some joints, each shape (S, m)."""

    robot: Kinematics
    link: str
    angles: Tensor
    chosen: list[int]
    poses: Frame
    position_std: float
    orientation_std: float

    @property
    def rows(self) -> int:
        """Number of known values."""
        return len(self.angles) * (3 if math.isinf(self.orientation_std) else 6)

    def solve(self) -> tuple[Tensor, Tensor, Tensor]:
        """Find the best offsets for each choice of signs, and half the sum of squares there."""
        m = len(self.chosen)
        choices = self.angles.new_tensor(list(itertools.product((1.0, -1.0), repeat=m)))
        generator = torch.Generator().manual_seed(0)
        guesses = torch.rand(GUESSES, m, generator=generator, dtype=torch.float64)
        guesses = (2 * guesses.to(self.angles) - 1) * math.pi
        signs = choices.repeat_interleave(GUESSES, 0)
        descend, tried = levenberg_marquardt, guesses.repeat(len(choices), 1)
        offsets, cost = descend(lambda one: self._residual(signs, one), tried, ROUGH)
        first = cost.reshape(-1, GUESSES).argmin(-1, keepdim=True)
        offsets = offsets.reshape(-1, GUESSES, m).take_along_dim(first[..., None], 1)[:, 0]
        return choices, *descend(lambda one: self._residual(choices, one), offsets, FINE)

    def errors(self, signs: Tensor, offsets: Tensor) -> Tensor:
        """Estimate standard errors (m,): by the given accuracy, or what is left if more."""
        [residual], [jacobian] = self._residual(signs[None], offsets[None])
        excess = residual.square().sum() / max(self.rows - len(self.chosen), 1)
        covariance = torch.linalg.pinv(jacobian.mT @ jacobian, hermitian=True)
        return (covariance.diagonal() * excess.clamp_min(1)).clamp_min(0).sqrt()

    def misfit(self, signs: Tensor, offsets: Tensor) -> tuple[float, float]:
        """Compute root mean square distances and angles that are left [m, rad]."""
        parts = self._residual(signs[None], offsets[None])[0].reshape(len(self.angles), 2, 3)
        position, turn = parts.square().sum(-1).mean(0).sqrt().tolist()
        known = not math.isinf(self.orientation_std)
        return position * self.position_std, turn * self.orientation_std if known else math.nan

    def _residual(self, signs: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
        """Compute residuals (S, 6 n) in units of their accuracy, and their Jacobian."""
        joints = self.angles.expand(len(signs), *self.angles.shape).clone()
        joints[..., self.chosen] *= signs[:, None]
        joints[..., self.chosen] += offsets[:, None]
        state = self.robot.state(joints)
        back = quaternions.conjugate(state.orientation(self.link))
        turn = quaternions.log(quaternions.product(self.poses.orientation, back))
        away = self.poses.position - state.position(self.link)
        weight = away.new_tensor([1 / self.position_std, 1 / self.orientation_std])
        weight = weight.repeat_interleave(3)
        jacobian = state.jacobians[..., self.robot.links.index(self.link), :, :]
        residual = torch.cat((away, turn), -1) * weight
        weighted = jacobian[..., self.chosen] * weight[:, None]
        return residual.flatten(1), weighted.flatten(1, 2)
