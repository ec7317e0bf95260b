"""Positions and orientations of links: what the rows of Table I have in common.

With ``eps_f`` the orientation of the frame that an operator refers to (the identity in the base
frame) and ``eps`` that of its link, the matrices M of eqs (6), (14), (15) are bilinear: of a
position ``R(eps_f)`` in ``eps_f, eps_f``, of an orientation ``g Hbar*(conj eps) H+(eps_f)`` in
``eps, eps_f``. One product with a constant gives the matrices of all operators of a stack, and
one selection of rows their Jacobians: a control tick costs per operation, not per number.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property, lru_cache
from itertools import accumulate
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.frames import Frame, Frames
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.gaussians import common_shape
from tpgmm_torch.operators.base import Linearization, Operator
from tpgmm_torch.robots.kinematics import RobotState

__all__ = ["PoseOperator"]


class PoseOperator(Operator):
    """Position or orientation of a link, in the base frame or as seen from another frame.

    What :class:`AbsolutePosition`, :class:`RelativePosition`, :class:`AbsoluteOrientation` and
    :class:`RelativeOrientation` share. Relative ones have a ``frame``, and ``held`` says
    whether it is meant as the thing that the robot may carry.
    """

    link: str
    tolerance: float
    #: The factor g of an orientation; None of a position.
    gain: Any = None
    held: bool = False

    def __post_init__(self) -> None:
        if self.link == self._frame:
            raise DataError(f"{self.link!r} seen from itself never changes: name another frame")
        if not isinstance(self.held, bool):
            raise DataError(f"held is True or False, got {self.held!r}")

    @property
    def _frame(self) -> str | None:
        return getattr(self, "frame", None)

    def links(self) -> tuple[str, ...]:
        """Return the link; the frame too, if it is the held object that is meant."""
        return (self.link, self._frame) if self._frame and self.held else (self.link,)

    def references(self) -> tuple[str, ...]:
        """Return the frame, if it is a place."""
        return (self._frame,) if self._frame and not self.held else ()

    def text(self) -> str:
        """Write it as a term, see :meth:`Operator.text`."""
        kind = "position" if self.gain is None else "orientation"
        tangent = "[tangent]" if self.rotation_vector_starts(None) else ""
        frame = f"@{'held:' * self.held}{self._frame}" if self._frame else ""
        return f"{kind}{tangent}:{self.link}{frame}"

    @cached_property
    def term(self) -> _Term:
        """Arguments of its linearisation, for :func:`linearize_poses`."""
        return _Term(self.link, self._frame, self.held, self.gain)

    def moving_reference(self, state: RobotState) -> str | None:
        """Return the link or held object that it is seen from; None if that is a place."""
        moving = state.links if self.held else state.robot_links
        return self._frame if self._frame in moving else None

    def is_bilinear(self, state: RobotState) -> bool:
        """Check that :func:`linearize_poses` serves."""
        return True

    def linearize(self, state: RobotState, frames: Frames) -> Linearization:
        """Return the row of eq. (6) for a position, of eq. (11) for an orientation.

        ``J (q - q_{t-1}) = R mu + p - x_{t-1}``, and
        ``J (q - q_{t-1}) = g Hbar*(conj eps_{t-1}) H+(eps^(j)) mu``.
        Seen from a place J is the link's; seen from another link f, whose pose moves too,
        ``J_p - J_pf + [x - p_f]x J_of`` and ``J_o - J_of``. Between an object and the link
        that carries it, or two places, this is ``0 = 0``.
        """
        return linearize_poses((self,), state, frames)

    def poses(self, state: RobotState, frames: Frames) -> tuple[Frame, Frame | None]:
        """Return the poses of what is seen and of what it is seen from, None for the base."""
        body = (
            state.pose(self.link)
            if self.link in state.links
            else _place(self.link, state, frames)
        )
        if self._frame is None:
            return body, None
        moving = self.moving_reference(state)
        return body, state.pose(moving) if moving else _place(self._frame, state, frames)


def _place(name: str, state: RobotState, frames: Frames) -> Frame:
    if name not in frames:
        known = [*frames, *state.links]
        raise UnknownNameError("frame", name, "the situation or the robot's links", known)
    return frames[name]


class _Term(NamedTuple):
    """Arguments of an operator's constants; ``gain`` is None for a position."""

    link: str
    frame: str | None
    held: bool
    gain: float | None


def linearize_poses(
    operators: Iterable[PoseOperator], state: RobotState, frames: Frames
) -> Linearization:
    """``J``, ``M``, ``c`` and the present quaternions of operators that are stacked.

    Parameters
    ----------
    operators : iterable of PoseOperator
    state : RobotState
    frames : mapping of str to Frame
    """
    terms, like = tuple(operator.term for operator in operators), state.joints
    at = constants_of(terms, state.links, len(state.carriers), like.dtype, like.device)
    places = [*(_place(name, state, frames) for name in at.places), *at.base]
    batch = common_shape(state.positions.shape[:-2], *(place.batch_shape for place in places))
    positions, orientations = _all_poses(state, places, batch)
    way = positions.index_select(-2, at.seen_from) - positions.index_select(-2, at.seen)
    way = way * at.is_position
    first = orientations.index_select(-2, at.first).unsqueeze(-1)
    pairs = first * orientations.index_select(-2, at.seen_from).unsqueeze(-2)
    matrices = _product(pairs.flatten(-3), at.matrix)
    matrices = matrices.view(*matrices.shape[:-1], *at.shape)
    # the rows of each link, linear and angular, in threes, and three of zeros if some need them
    whole = state.jacobians.shape
    threes = state.jacobians.reshape(*whole[:-3], 2 * len(state.links), 3, whole[-1])
    if at.is_still:
        threes = torch.cat((threes, torch.zeros_like(threes[..., :1, :, :])), -3)
    jacobian = threes.index_select(-3, at.rows)
    if at.is_moving:  # what it is seen from moves, and carries the points along
        angular = threes.index_select(-3, at.angular_rows).expand(*batch, -1, -1, -1)
        swing = torch.linalg.cross(angular, way[..., None].expand_as(angular), dim=-2)
        jacobian = jacobian - threes.index_select(-3, at.reference_rows) + swing
    result = Linearization(
        jacobian.flatten(-3, -2), matrices[..., :-1, :], way.flatten(-2), matrices[..., -1, :]
    )
    carriers = (*range(len(state.robot_links)), *state.carriers, *[-1] * len(places))
    rigid = [carriers[one] == carriers[other] for one, other in at.bodies]
    if all(one is False for one in rigid):
        return result
    flags = [torch.as_tensor(one, device=like.device).expand(batch) for one in rigid]
    return result.without(torch.stack(flags, -1).repeat_interleave(3, -1))


class Constants:
    """The constants of :func:`linearize_poses` for P operators.

    Poses are those of the links, of the ``places`` that the operators refer to, and the base.

    Parameters
    ----------
    terms, links, n_objects, **options
        As for :func:`constants_of`.
    """

    def __init__(
        self, terms: Sequence[_Term], links: tuple[str, ...], n_objects: int, **options: Any
    ) -> None:
        robot_links = links[: len(links) - n_objects]
        bodies = [(term.link, links) for term in terms]
        references = [(term.frame, links if term.held else robot_links) for term in terms]
        fixed = [n for n, moving in (*bodies, *references) if n and n not in moving]
        self.places = tuple(dict.fromkeys(fixed))

        def pose(name: str | None, moving: tuple[str, ...]) -> int:
            if name in moving:
                return moving.index(name)
            return len(links) + (*self.places, None).index(name)

        def index(values: Iterable[int]) -> Tensor:
            return torch.tensor([*values], device=options["device"])

        seen, seen_from = ([pose(*one) for one in group] for group in (bodies, references))
        self.bodies = list(zip(seen, seen_from, strict=True))
        self.is_moving = min(seen_from) < len(links)
        self.is_still = any((self.is_moving, max(seen) >= len(links)))
        self.matrix, self.shape = _bilinear(terms, **options)
        unit = quaternions.identity(**options)
        base = Frame.from_checked(torch.zeros_like(unit[:3]), unit)
        self.base = [base] * (None in dict(references))  # if one refers to it
        self.seen, self.seen_from = index(seen), index(seen_from)
        angular = index(term.gain is not None for term in terms).long()
        self.first = torch.where(angular > 0, self.seen, self.seen_from)
        self.is_position = (1 - angular).to(unit)[:, None]
        still = index([2 * len(links)])  # of poses that no joint moves
        self.rows = torch.minimum(2 * self.seen + angular, still)
        self.reference_rows = torch.minimum(2 * self.seen_from + angular, still)
        self.angular_rows = torch.minimum(2 * self.seen_from + 1, still)


def _bilinear(terms: Sequence[_Term], **options: Any) -> tuple[Tensor, tuple[int, int]]:
    """Coefficients of all operators' matrices in ``a_i b_j``, and the shape of the matrices.

    ``Hbar(conj a) H+(b)`` has (16, 4, 4) of them; of a = b, ``R(a)`` is below right. The last
    row is of the present quaternions.
    """
    eye = torch.eye(4, dtype=torch.float64)
    right = quaternions.right_matrix(quaternions.conjugate(eye))
    both = (right[:, None] @ quaternions.left_matrix(eye)).flatten(0, 1)
    ends = [*accumulate(3 if term.gain is None else 4 for term in terms)]
    shape = 3 * len(terms) + 1, ends[-1]
    matrix = torch.zeros(len(terms), 16, *shape, dtype=torch.float64)
    for at, (term, end) in enumerate(zip(terms, ends, strict=True)):
        rows = matrix[at, :, 3 * at : 3 * at + 3, :end]
        if term.gain is None:
            rows[..., -3:] = both[:, 1:, 1:]
        else:
            rows[..., -4:] = term.gain * both[:, 1:]
            matrix[at, :, -1, end - 4 : end] = both[:, 0]
    return matrix.flatten(2).flatten(0, 1).to(**options), shape


@lru_cache(maxsize=64)
def constants_of(
    terms: tuple[_Term, ...],
    links: tuple[str, ...],
    n_objects: int,
    dtype: torch.dtype,
    device: torch.device,
) -> Constants:
    """Return the constants of operators, made once.

    Parameters
    ----------
    terms : tuple
        The operators' :attr:`PoseOperator.term`.
    links : tuple of str
        Names of the links, objects last.
    n_objects : int
        How many of them are objects.
    dtype, device : torch.dtype, torch.device
    """
    # a constant made while inference mode is on could not serve where gradients are wanted
    with torch.inference_mode(False):
        return Constants(terms, links, n_objects, dtype=dtype, device=device)


def _all_poses(
    state: RobotState, places: Sequence[Frame], batch: torch.Size
) -> tuple[Tensor, Tensor]:
    """Positions (..., L + F, 3) and orientations of the links, and behind them of places."""
    positions = state.positions, *(place.position.unsqueeze(-2) for place in places)
    orientations = state.orientations, *(place.orientation.unsqueeze(-2) for place in places)

    def join(parts: Sequence[Tensor]) -> Tensor:
        shapes = [(*batch, *part.shape[-2:]) for part in parts]
        both = zip(parts, shapes, strict=True)
        return torch.cat([p if p.shape == shape else p.expand(shape) for p, shape in both], -2)

    return join(positions), join(orientations)


def _product(row: Tensor, matrix: Tensor) -> Tensor:
    """``row @ matrix``; of one robot, for a compiler, a sum: a loop that others can join."""
    if torch.compiler.is_compiling() and row.numel() == row.shape[-1]:
        return (row.unsqueeze(-1) * matrix).sum(-2)
    return row @ matrix
