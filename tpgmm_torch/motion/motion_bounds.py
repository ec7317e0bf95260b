"""Bounds on a motion: position, speed, acceleration and jerk of each joint.

Limits of position and speed are the robot's; accelerations are seldom written down. What was
demonstrated can be done, so its peaks, with a margin, bound what is not.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Self

import torch
from torch import Tensor

from tpgmm_torch.data.arrays import as_tensor
from tpgmm_torch.exceptions import DataError, MissingLimitsWarning, ShapeError, UnknownNameError
from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["MotionBounds"]

#: Accelerations and jerks may be this many times those that were demonstrated.
MARGIN = 3.0
#: Seconds in which every joint may reach its speed limit, with and without demonstrations.
RISE_TIME, RISE_TIME_ALONE = 0.25, 0.1
#: Speed that an arm is taken to reach in that time at most [rad/s or m/s]. Descriptions that
#: name greater limits may mean motors without load, 37 rad/s, which is no reason to go there in
#: a quarter of a second.
BELIEVABLE_SPEED = 4.0
#: Seconds in which every joint may reach its greatest acceleration.
ONSET = 0.025
#: What rounding makes of the acceleration of a joint at constant speed [rad/s^2 or m/s^2].
ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class MotionBounds:
    """Bounds on position, speed, acceleration and jerk of each joint.

    :meth:`MotionBounds.of` makes them.

    Parameters
    ----------
    lower, upper : Tensor of shape (n_joints,)
        Positions [rad or m]; infinite where there is no limit, as in the others.
    velocity, acceleration, jerk : Tensor of shape (n_joints,)
        Greatest absolute values [rad/s, rad/s^2, rad/s^3, or m].

    Raises
    ------
    ShapeError, DataError
        If they differ in shape, contradict each other, or leave no room to move.

    Examples
    --------
    >>> from tpgmm_torch.robots.kinematics import JointSpace
    >>> bounds = MotionBounds.of(JointSpace(["a", "b"]), velocity=2.0, acceleration={"b": 8.0})
    >>> bounds.acceleration.tolist()
    [20.0, 8.0]
    """

    lower: Tensor
    upper: Tensor
    velocity: Tensor
    acceleration: Tensor
    jerk: Tensor

    def __post_init__(self) -> None:
        named = {field.name: getattr(self, field.name) for field in fields(self)}
        for name, value in named.items():
            if value.shape != self.lower.shape or value.ndim != 1:
                raise ShapeError(
                    f"bounds are one number for each joint: {name} has shape "
                    f"{tuple(value.shape)}, lower has {tuple(self.lower.shape)}"
                )
        _refuse(~(self.lower <= self.upper), "lower must not exceed upper", self)
        for name in ("velocity", "acceleration", "jerk"):
            _refuse(~(named[name] > 0), f"{name} must be greater than 0", self)

    @classmethod
    def of(
        cls, kinematics: Any, demonstrated: tuple[Tensor, Tensor] | None = None, **given: Any
    ) -> Self:
        """Choose the bounds of a robot, of what was demonstrated, and of the user.

        Accelerations and jerks that neither the user nor the description of the robot gives
        are three times those demonstrated, and let every joint reach its speed limit in
        0.25 s; without demonstrations, in 0.1 s. Of a limit above 4 rad/s (or m/s) that is
        only 4, or what three times the greatest acceleration of all joints makes. Every joint
        may reach its greatest acceleration in 0.025 s.

        Parameters
        ----------
        kinematics : Kinematics or Skill
            Whose limits hold, or a skill, whose peaks count too.
        demonstrated : tuple of two Tensor of shape (n_joints,), optional
            Peaks of acceleration and jerk, of
            :func:`~tpgmm_torch.motion.demonstrated_peaks.typical_peaks`.
        **given : float, array-like of shape (n_joints,) or mapping of str to float
            ``lower``, ``upper``, ``velocity``, ``acceleration``, ``jerk``: for all joints, for
            each, or for some by name. They may be tighter than the robot's own, not wider.

        Raises
        ------
        DataError, ShapeError, UnknownNameError
            If they are no numbers for these joints, or contradict the robot or each other.

        Warns
        -----
        MissingLimitsWarning
            If the description of the robot lacks limits of position or speed that are not
            given either; not where it has none of speed at all, as an MJCF, nor of joints of
            which the robot warned when it was made.
        """
        if not isinstance(kinematics, Kinematics):  # a skill
            demonstrated = demonstrated or kinematics.peaks
            kinematics = kinematics.kinematics
        names = [field.name for field in fields(cls)]
        for name in given.keys() - {*names}:
            raise UnknownNameError("bound", name, "the bounds of a motion", names)
        bound = {name: _tighten_bound(name, kinematics, given.get(name)) for name in names}
        _warn_of_missing_limits(kinematics, bound, given)
        bound |= _complete_rates(bound, demonstrated)
        return cls(**{name: value.to(kinematics.lower) for name, value in bound.items()})


def _warn_of_missing_limits(
    kinematics: Kinematics, bound: Mapping[str, Tensor], given: Mapping[str, Any]
) -> None:
    """Warn of joints of which neither the robot nor the user gives position and speed."""
    chosen = [bound[name] for name in ("lower", "upper", "velocity") if name in given]
    known = torch.zeros_like(bound["lower"], dtype=torch.bool)
    if chosen:
        known = torch.stack(chosen).isfinite().all(0)
    lacking = set(kinematics.without_limits).difference(kinematics.doubtful)
    missing = [
        name
        for name, there in zip(kinematics.joint_names, known, strict=True)
        if name in lacking and not there
    ]
    if missing and bound["velocity"].isfinite().any():
        warnings.warn(
            "the description of the robot has no limits of position or speed, or none that fit "
            f"together, of the joints {missing}: complete the URDF, or give lower, upper and "
            "velocity",
            MissingLimitsWarning,
            stacklevel=3,
        )


def _complete_rates(
    bound: Mapping[str, Tensor], demonstrated: tuple[Tensor, Tensor] | None
) -> dict[str, Tensor]:
    """Complete acceleration and jerk where they are infinite: of no robot and no user."""
    velocity, acceleration, jerk = (bound[n] for n in ("velocity", "acceleration", "jerk"))
    seconds, shown = RISE_TIME_ALONE, [torch.zeros_like(velocity)] * 2
    if demonstrated is not None:
        seconds = RISE_TIME
        shown = [as_tensor(x, "demonstrated peaks").to(velocity) for x in demonstrated]
    for found in shown:
        if found.shape != velocity.shape:
            raise ShapeError(
                f"demonstrated peaks have shape {tuple(velocity.shape)}, got "
                f"{tuple(found.shape)}"
            )
    peaks, jerks = (MARGIN * found for found in shown)
    quick = (velocity / seconds).clamp(max=max(BELIEVABLE_SPEED / seconds, float(peaks.max())))
    # of a joint without limit of speed, what was demonstrated is all that is known
    unknown = torch.where(peaks > ROUNDING, 0.0, torch.inf)
    usual = torch.maximum(torch.where(velocity.isinf(), unknown, quick), peaks)
    acceleration = torch.where(acceleration.isfinite(), acceleration, usual)
    usual = torch.maximum(jerks, acceleration / ONSET)
    return {"acceleration": acceleration, "jerk": torch.where(jerk.isfinite(), jerk, usual)}


def _tighten_bound(name: str, kinematics: Kinematics, given: Any) -> Tensor:
    """Tighten the robot's own bound by the user's."""
    limit, joints = getattr(kinematics, name), kinematics.joint_names
    if limit is None:
        limit = torch.full_like(kinematics.lower, torch.inf)
    limit = limit.double().clone()  # a file does not share them
    if given is None:
        return limit
    if isinstance(given, Mapping):
        values = limit.clone()
        for joint, value in given.items():
            if joint not in joints:
                raise UnknownNameError("joint", joint, "the robot", joints)
            values[joints.index(joint)] = as_tensor(value, f"{name} of {joint!r}")
    else:
        values = as_tensor(given, name).to(limit)
        if values.shape not in ((), limit.shape):
            raise ShapeError(
                f"{name} is one number or one for each of the {len(joints)} joints, got shape "
                f"{tuple(values.shape)}"
            )
        values = values.expand_as(limit)
    wider = values < limit if name == "lower" else values > limit
    if bool(wider.any()):
        which = wider.nonzero()[:, 0].tolist()
        listed = [f"{joints[i]} {values[i]:g} (robot: {limit[i]:g})" for i in which]
        raise DataError(
            f"{name} is wider than the robot's own limit: {', '.join(listed)}; give a tighter "
            "one, or correct the description of the robot"
        )
    return values


def _refuse(wrong: Tensor, rule: str, bounds: MotionBounds) -> None:
    if bool(wrong.any()):
        index = int(torch.nonzero(wrong)[0])
        values = ", ".join(
            f"{field.name}={getattr(bounds, field.name)[index]:g}" for field in fields(bounds)
        )
        raise DataError(
            f"bounds contradict each other, {rule}: joint {index} ({int(wrong.sum())} of "
            f"{len(wrong)}) has {values}"
        )
