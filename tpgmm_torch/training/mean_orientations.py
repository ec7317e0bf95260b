"""The mean orientation of demonstrations over time, about which tangent spaces are laid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from tpgmm_torch import quaternions
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.operators import AbsoluteOrientation, Operator, RelativeOrientation, Stack
from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["with_mean_orientations"]

#: Rows of a path at most: between them it is interpolated.
MOST = 1000


def with_mean_orientations(
    operators: Sequence[Operator],
    demonstrations: Sequence[Demonstration],
    kinematics: Kinematics,
    holds: Sequence[Hold] = (),
) -> tuple[Operator, ...]:
    """Operators with ``geometry="tangent"`` given the path that they lack.

    At each instant of the longest demonstration's time it is the Karcher mean of the
    orientations seen from the operator's frame; a demonstration that is over counts with its
    last one.

    Parameters
    ----------
    operators : sequence of Operator
        Those in other coordinates, and those that have a path, stay as they are.
    demonstrations : sequence of Demonstration
        At least one.
    kinematics : Kinematics
    holds : sequence of Hold, default=()
        Objects that were held: as places they are where they were last free.
    """

    def completed(operator: Operator) -> Operator:
        if isinstance(operator, Stack):
            return Stack(*map(completed, operator.operators))
        if not isinstance(operator, AbsoluteOrientation | RelativeOrientation):
            return operator
        if operator.geometry != "tangent" or operator.path is not None:
            return operator
        plain = replace(operator, geometry="quaternion")
        shown = [
            quaternions.interpolate(
                instants,
                one.time.to(instants),
                plain.local(one, kinematics, holds).double(),
            )
            for one in demonstrations
        ]
        means = quaternions.mean(torch.stack(shown, -2))
        rows = torch.cat((instants.unsqueeze(-1), means), -1)
        return replace(operator, path=tuple(map(tuple, rows.tolist())))

    grid = max((one.time for one in demonstrations), key=lambda time: float(time[-1]))
    places = torch.linspace(0, len(grid) - 1, min(len(grid), MOST)).round().long()
    instants = grid.to(kinematics.lower.device, torch.float64)[places]
    return tuple(map(completed, operators))
