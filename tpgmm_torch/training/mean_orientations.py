"""Mean orientations over time, about which rotation vectors are Gaussian."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from tpgmm_torch import quaternions
from tpgmm_torch.operators import AbsoluteOrientation, Operator, RelativeOrientation, Stack
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.training.local_data import Motion

__all__ = ["with_mean_orientations"]


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
        shown = [
            quaternions.interpolate(
                instants, one.time.double(), one.coordinates(plain, kinematics).double()
            )
            for one in motions
        ]
        means = quaternions.mean(torch.stack(shown, -2))
        rows = torch.cat((instants.unsqueeze(-1), means), -1)
        return replace(operator, path=tuple(map(tuple, rows.tolist())))

    return tuple(map(add_path, operators))
