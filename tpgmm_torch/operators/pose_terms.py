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
        Of the four classes.
    links : tuple of str
        Links of the robot itself.
    dtype : torch.dtype
    device : torch.device

    Attributes
    ----------
    names : tuple of str
        The places that the operators refer to.
    objects : tuple of str
        What they refer to as things, which the robot may carry.
    fixed : bool
        Whether all that they refer to stands still, whatever the joints do.
    """

    def __init__(
        self,
        operators: Sequence[Operator],
        links: tuple[str, ...],
        dtype: torch.dtype,
        device: torch.device,
    ) -> None:
        every = (name for o in operators for name in o.references())
        self.names = tuple(dict.fromkeys(name for name in every if name not in links))
        every = (name for o in operators for name in o.links())
        self.objects = tuple(dict.fromkeys(name for name in every if name not in links))
        moving = (*links, *self.objects)  # with the joints, or perhaps
        self._moving, self._n_links = moving, len(links)
        height = 3 * len(operators)
        width = sum(3 if type(o) in POSITIONS else 4 for o in operators)
        n_poses = len(moving) + len(self.names)
        # the last row holds the present quaternions, by which hemispheres are chosen
        matrix = torch.zeros(len(operators), 16, height + 1, width, dtype=torch.float64)
        shift = torch.zeros(n_poses, 3, height, dtype=torch.float64)
        product = _quaternion_products()
        rows: list[int] = []
        still = 6 * len(moving)  # behind the rows of all Jacobians, one of zeros
        carried: list[int] = []  # the rows of what is referred to, if it moves
        swinging: list[int] = []
        self._bodies: list[tuple[int, int]] = []
        first: list[int] = []
        second: list[int] = []
        column = 0
        for index, operator in enumerate(operators):
            link, *things = operator.links()
            place, row = moving.index(link), 3 * index
            reference = n_poses  # the identity, which stands behind all poses
            for name in (*things, *operator.references()):
                known = moving if name in things or name in links else self.names
                reference = known.index(name) + (0 if known is moving else len(moving))
            second.append(reference)
            moves = reference < len(moving)
            self._bodies.append((place, reference if moves else -1))
            axes = torch.arange(3)
            angular = 3 if isinstance(operator, ORIENTATIONS) else 0
            rows += range(6 * place + angular, 6 * place + angular + 3)
            for listed, part in ((carried, angular), (swinging, 3)):
                start = 6 * reference + part
                listed += range(start, start + 3) if moves else [still] * 3
            if not angular:
                first.append(reference)
                matrix[index, :, row : row + 3, column : column + 3] = product[:, 1:, 1:]
                shift[place, axes, row + axes] = -1.0
                if reference < n_poses:
                    shift[reference, axes, row + axes] = 1.0
                column += 3
            else:
                first.append(place)
                block = slice(column, column + 4)
                matrix[index, :, row : row + 3, block] = operator.gain * product[:, 1:]  # type: ignore[attr-defined]
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
        whole = list(range(still))
        self._rows = None if rows == whole else torch.tensor(rows, device=device)
        self._carried = None
        if any(row != still for row in carried):
            self._carried = torch.tensor([*carried, *swinging], device=device)
        self.fixed = self._carried is None and not self.objects
        self._identity = quaternions.identity(dtype, device)
        self._speaking: dict[tuple[int, ...], Tensor | None] = {}

    def linearize(self, state: RobotState, frames: Mapping[str, Frame]) -> Linearization:
        """``J``, ``M``, ``c`` and the present quaternions of the stack."""
        poses = [Reference.of(name, state, frames).frame for name in self.names]
        state = self._with_objects(state, frames)
        positions, orientations = state.positions, state.orientations
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
        matrix = matrix.view(*batch, *self._shape)
        whole = jacobian = state.jacobians.flatten(-3, -2)
        if self._rows is not None:
            jacobian = whole.index_select(-2, self._rows)
        if self._carried is not None:
            jacobian = jacobian - self._of_references(whole, shift)
        if not self.objects:
            return Linearization(jacobian, matrix, shift, present)
        speaks = self._speaks(state)
        if speaks is None:
            return Linearization(jacobian, matrix, shift, present)
        jacobian, matrix = jacobian * speaks[..., None], matrix * speaks[..., None]
        noise = (1.0 - speaks).expand_as(shift)
        return Linearization(jacobian, matrix, shift * speaks, present, noise)

    def _with_objects(self, state: RobotState, frames: Mapping[str, Frame]) -> RobotState:
        """The robot's links and the objects, in that order, and nothing else."""
        if state.links == self._moving:
            return state
        for name in self.objects:
            if name not in state.links:
                state = state.with_link(name, None, Reference.of(name, state, frames).frame)
        return state.with_objects(self.objects)

    def _of_references(self, jacobians: Tensor, shift: Tensor) -> Tensor:
        """How the references move with the joints, and carry the links' points along."""
        assert self._carried is not None
        zero = torch.zeros_like(jacobians[..., :1, :])
        rows = torch.cat((jacobians, zero), -2).index_select(-2, self._carried)
        own, angular = rows.chunk(2, -2)
        arms = shift.unflatten(-1, (-1, 3))[..., None]
        angular = angular.unflatten(-2, (-1, 3))
        batch = common_shape(arms.shape[:-3], angular.shape[:-3])
        angular = angular.expand(*batch, *angular.shape[-3:])
        swing = torch.linalg.cross(angular, arms.expand(*batch, *arms.shape[-3:]), dim=-2)
        return own - swing.flatten(-3, -2)

    def _speaks(self, state: RobotState) -> Tensor | None:
        """1 for rows that the joints change, 0 for others, (..., m); None if all speak."""
        carriers = state.carriers
        assert carriers is not None
        if carriers.ndim == 1:
            key = tuple(carriers.tolist())
            if key not in self._speaking:
                self._speaking[key] = self._speaks_with(carriers)
            return self._speaking[key]
        return self._speaks_with(carriers)

    def _speaks_with(self, carriers: Tensor) -> Tensor | None:
        """:meth:`_speaks`, of objects with these carriers (..., V)."""
        batch, n = carriers.shape[:-1], self._n_links
        own = torch.arange(n, device=carriers.device).expand(*batch, n)
        bodies = torch.cat((own, carriers, torch.full_like(own[..., :1], -1)), -1)
        one, other = (bodies[..., list(of)] for of in zip(*self._bodies, strict=True))
        speaks = one != other
        if bool(speaks.all()):
            return None
        return speaks.to(self._terms.dtype).repeat_interleave(3, -1)


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
        Position and orientation operators; others, and those in tangent space, speak for
        themselves.
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
        if operator.rotation_vector_starts(None):
            return None  # logarithms and their Jacobians are not bilinear
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
