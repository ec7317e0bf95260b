"""Completion of operators from demonstrations: mean orientations, and axes of forces.

Rotation vectors are Gaussian about the mean orientation at each instant. A force is controlled
along the axes along which the demonstrated forces do no work.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.exceptions import DataError, PlausibilityWarning
from tpgmm_torch.operators import (
    AbsoluteOrientation,
    Operator,
    RelativeOrientation,
    Stack,
    Wrench,
)  # fmt: skip
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.training.local_data import Motion

#: A force does no work along an axis below this share of the work that it could do. Forces
#: against a surface have shares of 0.00 to 0.02, friction 0.26 to 0.88 (wiping).
NO_WORK = 0.1
ALWAYS = (
    "{0.link!r} is in contact at all instants of all demonstrations: was the tool's weight "
    "removed from its wrenches? Else Wrench(..., contact=) is below the noise, {0.contact} N"
)


def with_force_axes(
    operators: Sequence[Operator], motions: Sequence[Motion]
) -> tuple[Operator, ...]:
    """Add axes to operators of forces: those along which they do no work.

    Parameters
    ----------
    operators : sequence of Operator
        Those that have axes keep them.
    motions : sequence of Motion
        With wrenches of the operators' links.

    Returns
    -------
    tuple of Operator

    Raises
    ------
    DataError
        If no force does no work, or a link is never in contact.
    """
    return tuple(
        _choose_axes(one, motions) if isinstance(one, Wrench) and one.axes is None else one
        for one in operators
    )


def _choose_axes(operator: Wrench, motions: Sequence[Motion]) -> Wrench:
    shares, sizes = (values.tolist() for values in shares_of_work(operator, motions))
    every = list(zip("xyz", shares, sizes, strict=True))
    found = [s < NO_WORK and size >= operator.contact for _, s, size in every]
    if not any(found):
        shown = ", ".join(f"{axis} {share:.2f} at {size:.1f} N" for axis, share, size in every)
        raise DataError(
            f"no force of {operator.link!r} in {operator.frame!r} does no work (share of "
            f"work: {shown}; below {NO_WORK} and from {operator.contact} N on): is the "
            "frame aligned with the surface? Else give the axes, Wrench(..., axes=[2])"
        )
    return replace(operator, axes=tuple(axis for axis in range(3) if found[axis]))


def shares_of_work(operator: Wrench, motions: Sequence[Motion]) -> tuple[Tensor, Tensor]:
    """Compute ``|sum_t f v| / (n rms(f) rms(|v|))`` of a force along each axis.

    Parameters
    ----------
    operator : Wrench
        Its frame's axes count, and the instants at which it is in contact.
    motions : sequence of Motion
        With wrenches of the link.

    Returns
    -------
    shares : Tensor of shape (3,)
        1 where the force has the direction of the motion, 0 where there is no motion.
    sizes : Tensor of shape (3,)
        Root mean square of the force along each axis [N].

    Raises
    ------
    DataError
        If the link is in contact at less than two instants.
    """
    every = replace(operator, axes=(0, 1, 2))
    forces, speeds = [], []
    for motion in motions:
        local = every.coordinates(motion.state, motion.frames)
        pose = every.pose(motion.state, motion.frames)
        way = pose.inverse_transform(motion.state.position(operator.link))
        touches = local[:, 3] > 0
        if len(way) > 1:
            [speed] = torch.gradient(way, spacing=(motion.time,), dim=0)
            forces.append(local[touches, :3])
            speeds.append(speed[touches])
    force, speed = (torch.cat(parts) for parts in (forces, speeds))
    if len(force) == sum(len(motion.time) for motion in motions):
        warnings.warn(ALWAYS.format(operator), PlausibilityWarning, stacklevel=2)
    if len(force) < 2:
        raise DataError(
            f"{operator.link!r} is never in contact: its force stays below "
            f"{operator.contact} N in all demonstrations, Wrench(..., contact=)"
        )
    sizes = force.square().mean(0).sqrt()
    possible = len(force) * sizes * speed.square().sum(-1).mean().sqrt()
    work = (force * speed).sum(0).abs()
    return torch.where(possible > 0, work / possible, 0.0), sizes


def with_mean_orientations(
    operators: Sequence[Operator], motions: Sequence[Motion], kinematics: Kinematics
) -> tuple[Operator, ...]:
    """Add mean orientations to operators of ``geometry="tangent"``.

    At each instant it is the mean on the sphere of what the demonstrations show then.

    Parameters
    ----------
    operators : sequence of Operator
        Those that have a path keep it.
    motions : sequence of Motion
        In step.
    kinematics : Kinematics
        On which the operators act.

    Returns
    -------
    tuple of Operator
    """
    grid = max((one.time for one in motions), key=lambda time: float(time[-1]))
    instants = grid.double()

    def add_path(operator: Operator) -> Operator:
        if isinstance(operator, Stack):
            return Stack(*map(add_path, operator.operators))
        if not isinstance(operator, AbsoluteOrientation | RelativeOrientation):
            return operator
        if operator.geometry != "tangent" or operator.path is not None:
            return operator
        plain = replace(operator, geometry="quaternion")
        seen = ((one.time, one.coordinates(plain, kinematics)) for one in motions)
        shown = [quaternions.interpolate(instants, t.double(), q.double()) for t, q in seen]
        means = quaternions.mean(torch.stack(shown, -2))
        rows = torch.cat((instants.unsqueeze(-1), means), -1)
        return replace(operator, path=tuple(map(tuple, rows.tolist())))

    return tuple(map(add_path, operators))
