"""Several operators as one subspace: eqs (16), (17)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.gaussians import common_shape
from tpgmm_torch.operators.base import Linearization, Operator
from tpgmm_torch.operators.pose_terms import pose_terms
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

__all__ = ["Stack", "leaves"]


@dataclass(frozen=True, init=False)
class Stack(Operator):
    """Operators stacked *before* the pseudo-inverse: ``[J_1; J_2] dq = [M_1 mu_1 + c_1; ...]``.

    Their local coordinates stand side by side in one Gaussian, so that correlations between
    them are learned, and they share one pseudo-inverse: with joints in common (a waist that
    carries both arms) this differs from projecting each by itself. Eq. (17) prints two block
    rows where the Jacobian of eq. (16) has four: those of the orientations are zero.

    Parameters
    ----------
    *operators : Operator
        In the order of the local coordinates.

    Raises
    ------
    DataError
        If there is none, or one of them is not an operator.

    Examples
    --------
    >>> from tpgmm_torch import AbsolutePosition, Stack
    >>> Stack(AbsolutePosition("left_hand"), AbsolutePosition("right_hand"))
    Stack(AbsolutePosition(link='left_hand', tolerance=0.0), AbsolutePosition(link='right_...))
    """

    operators: tuple[Operator, ...]

    def __init__(self, *operators: Operator) -> None:
        if not operators:
            raise DataError("Stack needs at least one operator, for example Stack(Canonical())")
        for operator in operators:
            if not isinstance(operator, Operator):
                raise DataError(f"Stack takes operators, got {type(operator).__name__}")
        object.__setattr__(self, "operators", operators)

    @cached_property
    def leaves(self) -> tuple[Operator, ...]:
        """The members, and those of members that are stacks themselves, in their order."""
        return leaves(self.operators)

    def dimension(self, kinematics: Kinematics | None) -> int:
        """The sum of the dimensions."""
        return sum(operator.dimension(kinematics) for operator in self.operators)

    def linearize(self, state: RobotState, frames: Mapping[str, Frame]) -> Linearization:
        """Jacobians and displacements stacked, matrices on the diagonal."""
        like = state.joints
        # where a state maps orientations in its own way, so must each operator
        if type(state).orientation_map is RobotState.orientation_map:
            terms = pose_terms(self.leaves, state.robot_links, like.dtype, like.device)
            if terms is not None:
                return terms.linearize(state, frames)
        parts = [operator.linearize(state, frames) for operator in self.operators]
        identity = torch.eye(like.shape[-1], dtype=like.dtype, device=like.device)
        jacobians, matrices, displacements = [], [], []
        for part in parts:
            rows = part.displacement.shape[-1]
            jacobian = identity if part.jacobian is None else part.jacobian
            matrix = identity.new_ones(rows).diag() if part.matrix is None else part.matrix
            jacobians.append(jacobian)
            matrices.append(matrix)
            displacements.append(part.displacement)
        batch = common_shape(
            like.shape[:-1],
            *(matrix.shape[:-2] for matrix in (*jacobians, *matrices)),
            *(vector.shape[:-1] for vector in displacements),
        )
        rows, columns = sum(m.shape[-2] for m in matrices), sum(m.shape[-1] for m in matrices)
        diagonal = like.new_zeros(*batch, rows, columns)
        row = column = 0
        for matrix in matrices:
            m, d = matrix.shape[-2:]
            diagonal[..., row : row + m, column : column + d] = matrix
            row, column = row + m, column + d
        noise = None
        if any(part.noise is not None for part in parts):
            each = [
                torch.zeros_like(p.displacement) if p.noise is None else p.noise for p in parts
            ]
            noise = torch.cat([one.expand(*batch, one.shape[-1]) for one in each], dim=-1)
        return Linearization(
            torch.cat([j.expand(*batch, *j.shape[-2:]) for j in jacobians], dim=-2),
            diagonal,
            torch.cat([c.expand(*batch, c.shape[-1]) for c in displacements], dim=-1),
            noise=noise,
        )

    def coordinates(self, state: RobotState, frames: Mapping[str, Frame]) -> Tensor:
        """The coordinates side by side."""
        parts = [operator.coordinates(state, frames) for operator in self.operators]
        batch = common_shape(*(part.shape[:-1] for part in parts))
        return torch.cat([part.expand(*batch, part.shape[-1]) for part in parts], dim=-1)

    def quaternion_starts(self, kinematics: Kinematics | None) -> tuple[int, ...]:
        """Those of the members, shifted to their columns."""
        starts: list[int] = []
        column = 0
        for operator in self.operators:
            starts += [column + start for start in operator.quaternion_starts(kinematics)]
            column += operator.dimension(kinematics)
        return tuple(starts)

    def rotation_vector_starts(self, kinematics: Kinematics | None) -> tuple[int, ...]:
        """Those of the members, shifted to their columns."""
        starts: list[int] = []
        column = 0
        for operator in self.operators:
            starts += [column + s for s in operator.rotation_vector_starts(kinematics)]
            column += operator.dimension(kinematics)
        return tuple(starts)

    def path_variances(self, kinematics: Kinematics | None) -> tuple[float, ...]:
        """Those of the members, side by side."""
        return tuple(v for o in self.operators for v in o.path_variances(kinematics))

    def at(self, time: Tensor) -> Operator:
        """The stack of what the members are then."""
        members = [operator.at(time) for operator in self.operators]
        same = all(now is one for now, one in zip(members, self.operators, strict=True))
        return self if same else Stack(*members)

    def tolerances(self, kinematics: Kinematics | None) -> tuple[float, ...]:
        """Those of the members, side by side."""
        return tuple(t for o in self.operators for t in o.tolerances(kinematics))

    def units(self, kinematics: Kinematics | None) -> tuple[str | None, ...]:
        """Those of the members, side by side."""
        return tuple(unit for o in self.operators for unit in o.units(kinematics))

    def links(self) -> tuple[str, ...]:
        """All links of the members."""
        return tuple(dict.fromkeys(name for o in self.operators for name in o.links()))

    def references(self) -> tuple[str, ...]:
        """All references of the members."""
        return tuple(dict.fromkeys(name for o in self.operators for name in o.references()))

    @property
    def determines_joints(self) -> bool:
        """If one of the members does."""
        return any(operator.determines_joints for operator in self.operators)

    def _rows(self) -> dict[str, object]:
        return {str(number): member for number, member in enumerate(self.operators, 1)}

    def __repr__(self) -> str:
        return f"Stack({', '.join(map(repr, self.operators))})"


def leaves(operators: Sequence[Operator]) -> tuple[Operator, ...]:
    """The members of stacks, and what is no stack, of some ``operators`` in their order."""
    return tuple(
        leaf
        for operator in operators
        for leaf in (operator.leaves if isinstance(operator, Stack) else (operator,))
    )
