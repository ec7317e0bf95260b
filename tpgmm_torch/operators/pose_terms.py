"""The position and orientation rows of Table I for many operators at once.

With ``eps_f`` the orientation of the frame that a term refers to (the identity for absolute
ones) and ``eps`` that of its link, the matrices of eqs (6), (14), (15) are bilinear:
``R(eps_f)`` in ``eps_f, eps_f`` and ``g Hbar*(conj eps) H+(eps_f)`` in ``eps, eps_f``. One
product with a constant therefore gives the block-diagonal matrix M of a whole stack, and one
selection of rows its Jacobian: a control tick costs per operation, not per number.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache

import torch
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.gaussians import common_shape
from tpgmm_torch.operators.base import Linearization, Operator, Reference
from tpgmm_torch.operators.orientation import AbsoluteOrientation, RelativeOrientation
from tpgmm_torch.operators.position import AbsolutePosition, RelativePosition
from tpgmm_torch.robots.kinematics import RobotState

__all__ = ["PoseTerms", "pose_terms"]

POSITIONS = (AbsolutePosition, RelativePosition)
ORIENTATIONS = (AbsoluteOrientation, RelativeOrientation)


class PoseTerms:
    """The linearisation of a stack of position and orientation operators; see `pose_terms`.

    Parameters
    ----------
    operators : sequence of Operator
        Of the four classes, referring to no link of the robot.
    links : tuple of str
        Links of the robot's states.
    dtype : torch.dtype
    device : torch.device
    """

    def __init__(
        self,
        operators: Sequence[Operator],
        links: tuple[str, ...],
        dtype: torch.dtype,
        device: torch.device,
    ) -> None:
        self.names = tuple(dict.fromkeys(f for o in operators for f in o.references()))
        height = 3 * len(operators)
        width = sum(3 if type(o) in POSITIONS else 4 for o in operators)
        n_poses = len(links) + len(self.names)
        # the last row holds the present quaternions, by which hemispheres are chosen
        matrix = torch.zeros(len(operators), 16, height + 1, width, dtype=torch.float64)
        shift = torch.zeros(n_poses, 3, height, dtype=torch.float64)
        product = _quaternion_products()
        rows: list[int] = []
        first: list[int] = []
        second: list[int] = []
        column = 0
        for index, operator in enumerate(operators):
            link, row = links.index(operator.links()[0]), 3 * index
            reference = n_poses  # the identity, which stands behind all poses
            if operator.references():
                reference = len(links) + self.names.index(operator.references()[0])
            second.append(reference)
            axes = torch.arange(3)
            if isinstance(operator, POSITIONS):
                first.append(reference)
                rows += range(6 * link, 6 * link + 3)
                matrix[index, :, row : row + 3, column : column + 3] = product[:, 1:, 1:]
                shift[link, axes, row + axes] = -1.0
                if operator.references():
                    shift[reference, axes, row + axes] = 1.0
                column += 3
            elif isinstance(operator, ORIENTATIONS):
                first.append(link)
                rows += range(6 * link + 3, 6 * link + 6)
                block = slice(column, column + 4)
                matrix[index, :, row : row + 3, block] = operator.gain * product[:, 1:]
                matrix[index, :, height, block] = product[:, 0]
                column += 4
        # M row by row, the present quaternions, and c: all are linear in products of two
        # numbers of `numbers` below, positions in those with one
        size = (height + 1) * width
        terms = matrix.new_zeros(16 * len(operators) + 3 * n_poses, size + height)
        terms[: 16 * len(operators), :size] = matrix.flatten(2).flatten(0, 1)
        terms[16 * len(operators) :, size:] = shift.flatten(0, 1)
        self._terms = terms.to(device, dtype)
        self._shape, self._sizes = (height, width), (height * width, width, height)
        identity = 7 * n_poses
        left = [
            3 * n_poses + 4 * pose + i for pose in first for i in range(4) for _ in range(4)
        ]
        right = [
            3 * n_poses + 4 * pose + j for pose in second for _ in range(4) for j in range(4)
        ]
        left += range(3 * n_poses)
        right += [identity] * (3 * n_poses)
        self._pairs = torch.tensor([*left, *right], device=device)
        every = list(range(6 * len(links)))
        self._rows = None if rows == every else torch.tensor(rows, device=device)
        self._identity = quaternions.identity(dtype, device)

    def linearize(self, state: RobotState, frames: Mapping[str, Frame]) -> Linearization:
        """``J``, ``M``, ``c`` and the present quaternions of the stack."""
        poses = [Reference.of(name, state, frames).frame for name in self.names]
        positions, orientations, jacobian = state.positions, state.orientations, state.jacobians
        if state.carriers is not None:  # objects that others refer to
            own = len(state.robot_links)
            positions, orientations = positions[..., :own, :], orientations[..., :own, :]
            jacobian = jacobian[..., :own, :, :]
        batch = common_shape(positions.shape[:-2], *(f.position.shape[:-1] for f in poses))
        if positions.shape[:-2] != batch:
            positions = positions.expand(*batch, -1, 3)
            orientations = orientations.expand(*batch, -1, 4)
        poses = [p if p.position.shape[:-1] == batch else p.expand(batch) for p in poses]
        numbers = [positions.flatten(-2), *(pose.position for pose in poses)]
        numbers += [orientations.flatten(-2), *(pose.orientation for pose in poses)]
        numbers.append(self._identity.expand(*batch, 4) if batch else self._identity)
        factors = torch.cat(numbers, -1).index_select(-1, self._pairs)
        half = len(self._pairs) // 2
        both = _product(
            factors.narrow(-1, 0, half) * factors.narrow(-1, half, half), self._terms
        )
        matrix, present, shift = both.split(self._sizes, -1)
        jacobian = jacobian.flatten(-3, -2)
        if self._rows is not None:
            jacobian = jacobian.index_select(-2, self._rows)
        return Linearization(jacobian, matrix.view(*batch, *self._shape), shift, present)


@lru_cache(maxsize=64)
def pose_terms(
    operators: tuple[Operator, ...],
    links: tuple[str, ...],
    dtype: torch.dtype,
    device: torch.device,
) -> PoseTerms | None:
    """The operators linearised together, or None if they cannot be.

    Parameters
    ----------
    operators : tuple of Operator
        Position and orientation operators in the base frame or in an object's frame; others,
        and those that refer to another link or an object that is held, speak for themselves.
    links : tuple of str
    dtype : torch.dtype
    device : torch.device

    Returns
    -------
    PoseTerms or None
    """
    for operator in operators:
        if type(operator) not in (*POSITIONS, *ORIENTATIONS):
            return None
        own, *held = operator.links()
        if own not in links or held or set(operator.references()) & set(links):
            return None
    # a constant made while inference mode is on could not serve where gradients are wanted
    with torch.inference_mode(False):
        return PoseTerms(operators, links, dtype, device)


def _product(row: Tensor, matrix: Tensor) -> Tensor:
    """``row @ matrix``; of one robot, for a compiler, a sum: a loop that others can join."""
    if torch.compiler.is_compiling() and row.numel() == row.shape[-1]:
        return (row.unsqueeze(-1) * matrix).sum(-2)
    return row @ matrix


def _quaternion_products() -> Tensor:
    """``Hbar(conj a) H+(b)`` as coefficients (16, 4, 4) of the products ``a_i b_j``.

    Where a = b, the lower right 3 x 3 is the rotation matrix.
    """
    basis = torch.eye(4, dtype=torch.float64)
    right = quaternions.right_matrix(quaternions.conjugate(basis))
    return (right[:, None] @ quaternions.left_matrix(basis)).flatten(0, 1)
