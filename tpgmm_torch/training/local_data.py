"""The P local data sets X^(j) of a list of demonstrations (paper, section II-B)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.exceptions import ShapeError
from tpgmm_torch.operators import Operator
from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["at_equal_phase", "constant_columns", "like", "local_data"]

#: The local coordinates (T, D_j) of operator j that are expected at times (T,).
Sides = Callable[[int, Tensor], Tensor]


def local_data(
    demonstrations: Sequence[Demonstration],
    operators: Sequence[Operator],
    kinematics: Kinematics,
    expected: Sides | None = None,
    holds: Sequence[Hold] = (),
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
    holds : sequence of Hold, default=()
        Objects that the robot held: as places they are where they were last free.

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
    sides = expected
    for index, demonstration in enumerate(demonstrations):
        n, names = kinematics.n_joints, demonstration.joint_names
        if demonstration.n_joints != n and (names is None or demonstration.n_joints < n):
            raise ShapeError(
                f"demonstration {index} has {demonstration.n_joints} joints, the robot has "
                f"{n}: {kinematics.joint_names}"
            )
        if sides is None:
            sides = like(demonstration, operators, kinematics, holds)
        time = demonstration.time.to(kinematics.lower)
        blocks: list[Tensor] = []
        for j, operator in enumerate(operators):
            local = operator.local(demonstration, kinematics, holds)
            for start in operator.quaternion_starts(kinematics):
                local = _same_side(local, sides(j, time), slice(start, start + 4))
            blocks += [time[:, None], local]
        rows.append(torch.cat(blocks, dim=1))
    if expected is None:
        widths = [1 + operator.dimension(kinematics) for operator in operators]
        together = torch.cat(rows)
        turns = [bool(operator.rotation_vector_starts(kinematics)) for operator in operators]
        mask = constant_columns(together.amin(0), together.amax(0), widths, turns)
        together = torch.where(mask, together[0], together)
        rows = list(together.split([len(row) for row in rows]))
    return rows


def like(
    demonstration: Demonstration,
    operators: Sequence[Operator],
    kinematics: Kinematics,
    holds: Sequence[Hold] = (),
) -> Sides:
    """What to expect of others, if they are like this one: its coordinates at equal phase.

    Parameters
    ----------
    demonstration : Demonstration
    operators : sequence of Operator
    kinematics : Kinematics
    holds : sequence of Hold, default=()

    Returns
    -------
    callable
        For ``expected`` of :func:`local_data`.
    """
    return at_equal_phase([o.local(demonstration, kinematics, holds) for o in operators])


def at_equal_phase(templates: Sequence[Tensor]) -> Sides:
    """What to expect of others at equal phase.

    Parameters
    ----------
    templates : sequence of Tensor of shape (T, D_j)
        Local coordinates of one demonstration, per operator.
    """

    def expected(j: int, time: Tensor) -> Tensor:
        last = len(templates[j]) - 1
        return templates[j][torch.linspace(0, last, len(time)).round().long()]

    return expected


def constant_columns(
    smallest: Tensor, largest: Tensor, widths: Sequence[int], turns: Sequence[bool]
) -> Tensor:
    """Which columns vary by rounding alone: learned, they would be certain beyond reason.

    Rounding is measured by the largest coordinate of the operator, from which it comes: think
    of a quaternion that turns about one axis. Rotation vectors come from quaternions, which
    are of size 1.

    Parameters
    ----------
    smallest, largest : Tensor of shape (sum widths,)
        Of each column, in the precision of the data.
    widths : sequence of int
        ``1 + D_j`` for each operator; each block begins with time.
    turns : sequence of bool
        For each operator, whether there are rotation vectors among its coordinates.

    Returns
    -------
    Tensor of bool, of shape (sum widths,)
    """
    # recorded poses went through more than our own rounding
    rounding = max(100 * torch.finfo(smallest.dtype).eps, 1e-10)
    masks = []
    for low, high, turn in zip(
        smallest.split(list(widths)), largest.split(list(widths)), turns, strict=True
    ):
        size = torch.maximum(low.abs(), high.abs())[1:].max().clamp(min=float(turn))
        masks.append(high - low <= rounding * size)
    return torch.cat(masks)


def _same_side(local: Tensor, template: Tensor, block: slice) -> Tensor:
    """Flip a whole quaternion path if it lies on the other hemisphere than the template's."""
    sign = torch.ones_like(local[0])
    sign[block] = quaternions.hemisphere_sign((local[:, block] * template[:, block]).sum())
    return local * sign
