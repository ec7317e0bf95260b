"""Several operators as one subspace: eqs (16), (17)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from operator import is_

import torch
from torch import Tensor

from tpgmm_torch import gaussians
from tpgmm_torch.data.frames import Frames
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.operators.base import Linearization, Operator, leaves
from tpgmm_torch.operators.orientation import AbsoluteOrientation, RelativeOrientation
from tpgmm_torch.operators.pose import linearize_poses
from tpgmm_torch.operators.position import AbsolutePosition, RelativePosition
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

__all__ = ["Stack"]

#: Operators that are linearised together. Their M has full row rank at every state, so that
#: ``M Sigma M^T`` is as definite as what was learned; one of another kind may claim to know a
#: direction exactly by mistake, which only the sum of precisions refuses.
POSE_OPERATORS = AbsolutePosition, RelativePosition, AbsoluteOrientation, RelativeOrientation


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
        """Return the sum of the dimensions."""
        return sum(operator.dimension(kinematics) for operator in self.operators)

    def linearize(self, state: RobotState, frames: Frames) -> Linearization:
        """Jacobians and displacements stacked, matrices on the diagonal."""
        parts: list[Linearization] = []
        for together, group in groupby(self.leaves, lambda leaf: _is_bilinear(leaf, state)):
            if together:
                parts.append(linearize_poses(tuple(group), state, frames))  # type: ignore[arg-type]
            else:
                parts += [operator.linearize(state, frames) for operator in group]
        return parts[0] if len(parts) == 1 else _stack_rows(parts, state.joints)

    def coordinates(self, state: RobotState, frames: Frames) -> Tensor:
        """Return the coordinates side by side."""
        parts = [operator.coordinates(state, frames) for operator in self.operators]
        return _join(parts, gaussians.common_shape(*(part.shape[:-1] for part in parts)), 1)

    def _starts(self, method: str, kinematics: Kinematics | None) -> tuple[int, ...]:
        starts: list[int] = []
        column = 0
        for operator in self.operators:
            starts += [column + start for start in getattr(operator, method)(kinematics)]
            column += operator.dimension(kinematics)
        return tuple(starts)

    def quaternion_starts(self, kinematics: Kinematics | None) -> tuple[int, ...]:
        """Those of the members, shifted to their columns."""
        return self._starts("quaternion_starts", kinematics)

    def rotation_vector_starts(self, kinematics: Kinematics | None) -> tuple[int, ...]:
        """Those of the members, shifted to their columns."""
        return self._starts("rotation_vector_starts", kinematics)

    def path_variances(self, kinematics: Kinematics | None) -> tuple[float, ...]:
        """Those of the members, side by side."""
        return tuple(v for o in self.operators for v in o.path_variances(kinematics))

    def at(self, time: Tensor) -> Operator:
        """Return the stack of the members at a time."""
        members = [operator.at(time) for operator in self.operators]
        return self if all(map(is_, members, self.operators)) else Stack(*members)

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

    def __repr__(self) -> str:
        return f"Stack({', '.join(map(repr, self.operators))})"


def _is_bilinear(operator: Operator, state: RobotState) -> bool:
    # a class that is derived from one of them may linearise in its own way
    return type(operator) in POSE_OPERATORS and operator.is_bilinear(state)  # type: ignore[attr-defined]


def _stack_rows(parts: Sequence[Linearization], like: Tensor) -> Linearization:
    """Parts below one another: matrices on the diagonal of one."""
    jacobians, matrices = zip(*(part.dense() for part in parts), strict=True)
    rows = [part.displacement for part in parts]
    tails = [matrix.shape[:-2] for matrix in (*jacobians, *matrices)]
    batch = gaussians.common_shape(like.shape[:-1], *tails, *(row.shape[:-1] for row in rows))
    present = [part.present for part in parts if part.present is not None]
    return Linearization(
        _join(jacobians, batch, 2),
        gaussians.block_diagonal(matrices, batch),
        _join(rows, batch, 1),
        _join(present, batch, 1) if len(present) == len(parts) else None,
        _noise(parts, batch),
    )


def _noise(parts: Sequence[Linearization], batch: torch.Size) -> Tensor | None:
    if all(part.noise is None for part in parts):
        return None
    zeros = torch.zeros_like
    noise = [zeros(p.displacement) if p.noise is None else p.noise for p in parts]
    return _join(noise, batch, 1)


def _join(parts: Sequence[Tensor], batch: torch.Size, rank: int) -> Tensor:
    """Parts one after the other along the first dimension behind the batch."""
    return torch.cat([part.expand(*batch, *part.shape[-rank:]) for part in parts], dim=-rank)
