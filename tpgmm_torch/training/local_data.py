"""Local data sets X^(j): what every operator sees of a demonstration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frames
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.exceptions import ShapeError
from tpgmm_torch.operators import Operator
from tpgmm_torch.robots.held_objects import held_objects
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

#: The local coordinates (T, D_j) of operator j that are expected at times (T,).
Expected = Callable[[int, Tensor], Tensor]


@dataclass(frozen=True, eq=False)
class Motion:
    """A demonstration in the robot's joint order, its kinematics computed once.

    Parameters
    ----------
    time : Tensor of shape (T,)
        Instants [s].
    state : RobotState
        Of batch shape (T,), with the objects that it holds.
    frames : mapping of str to Frame
        Objects, those that are held where they were last free.
    """

    time: Tensor
    state: RobotState
    frames: Frames

    @classmethod
    def of(
        cls,
        demonstration: Demonstration,
        kinematics: Kinematics,
        holds: Sequence[Hold] = (),
        *,
        attached: bool = False,
    ) -> Self:
        """Compute the motion of a ``demonstration`` in which the robot holds ``holds``.

        Where that is ``attached``, the joints move it; else its Jacobians are zero.

        Raises
        ------
        ShapeError, UnknownNameError
            If it has not the robot's joints.
        """
        n = kinematics.n_joints
        if demonstration.joint_names is None and demonstration.n_joints != n:
            raise ShapeError(
                f"a demonstration has {demonstration.n_joints} joints, the robot has {n}: "
                f"{kinematics.joint_names}"
            )
        ordered = demonstration.reorder(kinematics.joint_names)
        state = kinematics.state(ordered.joints)
        if ordered.wrenches:
            measured = {link: one.to(state.joints) for link, one in ordered.wrenches.items()}
            state = replace(state, wrenches=measured)
        frames = {name: frame.to(state.joints) for name, frame in ordered.frames.items()}
        time = ordered.time.to(kinematics.lower)
        if holds:
            state, frames = held_objects(state, time, frames, holds, attached=attached)
        return cls(time, state, frames)

    def coordinates(self, operator: Operator, kinematics: Kinematics) -> Tensor:
        """Compute local coordinates (T, D_j), quaternions continuous in sign."""
        return operator.along(self.time, self.state, self.frames, kinematics)


def local_data(
    demonstrations: Sequence[Demonstration],
    operators: Sequence[Operator],
    kinematics: Kinematics,
    expected: Expected | None = None,
    holds: Sequence[Hold] = (),
) -> list[Tensor]:
    """Compute rows of time and local coordinates of each demonstration.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
        Of one skill, aligned in time.
    operators : sequence of Operator
        In whose local coordinates it is seen.
    kinematics : Kinematics
        On which the operators act.
    expected : callable, optional
        Quaternions come to the side of what it says; by default to that of the first
        demonstration, and columns that vary by rounding alone become constant.
    holds : sequence of Hold, default=()
        From when to when the robot holds objects.

    Returns
    -------
    list of Tensor of shape (T_m, sum_j (1 + D_j))

    Raises
    ------
    ShapeError
        If a demonstration has not the robot's joints.
    """
    motions = [Motion.of(one, kinematics, holds) for one in demonstrations]
    seen = [[motion.coordinates(one, kinematics) for one in operators] for motion in motions]
    side = expected or like(seen[0])
    rows = [
        match_rows(motion, local, operators, kinematics, side)
        for motion, local in zip(motions, seen, strict=True)
    ]
    if expected is not None:
        return rows
    together = torch.cat(rows)
    low, high = together.aminmax(dim=0)
    mask = constant_columns(low, high, operators, kinematics)
    together = torch.where(mask, together[0], together)
    return list(together.split([len(row) for row in rows]))


def match_rows(
    motion: Motion,
    local: Sequence[Tensor],
    operators: Sequence[Operator],
    kinematics: Kinematics,
    expected: Expected,
) -> Tensor:
    """Join time and local coordinates of a motion, quaternions on the side of what is expected.

    Parameters
    ----------
    motion : Motion
        Whose time counts.
    local : sequence of Tensor of shape (T_m, D_j)
        Its coordinates, as each of the ``operators`` sees them.
    operators : sequence of Operator
        Say where quaternions are.
    kinematics : Kinematics
        On which the operators act.
    expected : callable
        Says on which side quaternions are.

    Returns
    -------
    Tensor of shape (T_m, sum_j (1 + D_j))
    """
    blocks: list[Tensor] = []
    for j, (operator, block) in enumerate(zip(operators, local, strict=True)):
        template, sign = expected(j, motion.time), torch.ones_like(block[0])
        for start in operator.quaternion_starts(kinematics):
            columns = slice(start, start + 4)
            agreement = (block[:, columns] * template[:, columns]).sum()
            sign[columns] = quaternions.hemisphere_sign(agreement)
        blocks += [motion.time[:, None], block * sign]
    return torch.cat(blocks, dim=1)


def like(templates: Sequence[Tensor]) -> Expected:
    """Expect the coordinates of one motion, at equal phase.

    Parameters
    ----------
    templates : sequence of Tensor of shape (T, D_j)
        Of each operator.
    """
    return lambda j, time: at_phases(templates[j], len(time))


def at_phases(rows: Tensor, count: int) -> Tensor:
    """Select rows of one motion, at equal distances from first to last.

    Parameters
    ----------
    rows : Tensor of shape (T, ...)
        Of one motion, in the order of time.
    count : int
        Number of rows to select.

    Returns
    -------
    Tensor of shape (count, ...)
    """
    return rows[((len(rows) - 1) * torch.linspace(0, 1, count)).round().long()]


def constant_columns(
    smallest: Tensor, largest: Tensor, operators: Sequence[Operator], kinematics: Kinematics
) -> Tensor:
    """Find columns that vary by rounding alone, to be made constant.

    Parameters
    ----------
    smallest, largest : Tensor of shape (sum_j (1 + D_j),)
        Of each column.
    operators : sequence of Operator
        In whose local coordinates it is seen.
    kinematics : Kinematics
        On which the operators act.

    Returns
    -------
    Tensor of shape (sum_j (1 + D_j),)
    """
    # recorded poses went through more than our own rounding
    rounding = max(100 * torch.finfo(smallest.dtype).eps, 1e-10)
    widths = [1 + one.dimension(kinematics) for one in operators]
    blocks = zip(operators, smallest.split(widths), largest.split(widths), strict=True)
    masks = []
    for operator, low, high in blocks:
        # rotation vectors are logarithms of numbers of the order of 1
        least = float(bool(operator.rotation_vector_starts(kinematics)))
        size = torch.maximum(low.abs(), high.abs())[1:].max().clamp(min=least)
        masks.append(high - low <= rounding * size)
    return torch.cat(masks)
