"""The P local data sets X^(j) of a list of demonstrations (paper, section II-B)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from tpgmm_torch.demonstrations import Demonstration
from tpgmm_torch.exceptions import ShapeError
from tpgmm_torch.kinematics import Kinematics
from tpgmm_torch.operators import Operator

__all__ = ["local_data"]


def local_data(
    demonstrations: Sequence[Demonstration],
    operators: Sequence[Operator],
    kinematics: Kinematics,
    expected: Callable[[int, Tensor], Tensor] | None = None,
) -> list[Tensor]:
    """Time and local coordinates of every operator, side by side.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
    operators : sequence of Operator
    kinematics : Kinematics
    expected : callable, optional
        ``expected(j, time)`` gives the local coordinates (T, D_j) that a model expects at
        ``time``; quaternions are brought to its side. By default to that of the first
        demonstration, compared at equal phase, and coordinates that vary by rounding alone
        are made constant.

    Returns
    -------
    list of Tensor of shape (T_m, sum_j (1 + D_j))
        One per demonstration; each block begins with time.

    Raises
    ------
    ShapeError, UnknownNameError
        If a demonstration does not have the robot's joints.
    """
    rows: list[Tensor] = []
    templates: list[Tensor] = []
    for index, demonstration in enumerate(demonstrations):
        n, names = kinematics.n_joints, demonstration.joint_names
        if demonstration.n_joints != n and (names is None or demonstration.n_joints < n):
            raise ShapeError(
                f"demonstration {index} has {demonstration.n_joints} joints, the robot has "
                f"{n}: {kinematics.joint_names}"
            )
        time = demonstration.time.to(kinematics.lower)
        blocks: list[Tensor] = []
        for j, operator in enumerate(operators):
            local = operator.local(demonstration, kinematics)
            if expected is not None:
                template = expected(j, time)
            elif index == 0:
                template = local
                templates.append(local)
            else:
                last = len(templates[j]) - 1
                template = templates[j][torch.linspace(0, last, len(local)).round().long()]
            for start in operator.quaternion_starts(kinematics):
                local = _same_side(local, template, slice(start, start + 4))
            blocks += [time[:, None], local]
        rows.append(torch.cat(blocks, dim=1))
    if expected is None:
        rows = _without_rounding(rows, [1 + o.dimension(kinematics) for o in operators])
    return rows


def _without_rounding(rows: list[Tensor], widths: Sequence[int]) -> list[Tensor]:
    """Make constant what varies by rounding alone: learned, it would be certain beyond reason.

    Rounding is measured by the largest coordinate of the operator, from which it comes: think
    of a quaternion that turns about one axis.
    """
    blocks: list[Tensor] = []
    for block in torch.cat(rows).split(list(widths), dim=1):
        spread = block.amax(0) - block.amin(0)
        rounding = 100 * torch.finfo(block.dtype).eps * block[:, 1:].abs().max()
        blocks.append(torch.where(spread <= rounding, block[0], block))
    return list(torch.cat(blocks, dim=1).split([len(row) for row in rows]))


def _same_side(local: Tensor, template: Tensor, block: slice) -> Tensor:
    """Flip a whole quaternion path if it lies on the other hemisphere than the template's."""
    if bool((local[:, block] * template[:, block]).sum() >= 0):
        return local
    sign = torch.ones_like(local[0])
    sign[block] = -1
    return local * sign
