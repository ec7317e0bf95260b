"""Orientation constraints in task space: section III-B, eqs (7) to (15).

Eq. (7) takes ``vec(eps_t * conj(eps_{t-1}))`` for the rotation vector of the step; it is its
half, to first order. Both operators multiply by ``gain``: 2 is exact and the default, 1 is the
paper's text, which covers half of the error in one step.

With ``geometry="tangent"`` the local coordinates are a rotation vector, three in place of
four: ``y = log(conj(b_t) eps)`` of the orientation ``eps`` (as seen from the frame, if there is
one) in the tangent space of a base orientation ``b_t`` on the sphere of unit quaternions.
Fitted, the base is a path, the Karcher mean of the demonstrations at each instant, so that a
Gaussian describes how demonstrations deviate from their mean. As ``exp(dphi) eps`` moves y by
``J_l(y)^-1 R(eps_f b_t)^T dphi``,

    J = J_l(y)^-1 R(eps_f b_t)^T J_o,   M = I,   c = -y:

a position in tangent space, whose Jacobian is exact, not only where little is left to turn.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from numbers import Real
from typing import Self

import torch
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.constraints import Interval
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.operators.base import Linearization, Operator, Reference, check_pair
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

__all__ = ["AbsoluteOrientation", "RelativeOrientation"]


GEOMETRIES = "quaternion", "tangent"


class _Orientation(Operator):
    """What the two operators share: the coordinates that an orientation is described by."""

    link: str
    gain: float
    tolerance: float
    geometry: str
    path: tuple[tuple[float, ...], ...] | None
    #: The base orientation (..., 4) at the time of :meth:`at`.
    _base: Tensor | None = None

    def __post_init__(self) -> None:
        if self.geometry not in GEOMETRIES:
            raise DataError(f"geometry is one of {list(GEOMETRIES)}, got {self.geometry!r}")
        if self.gain not in Interval(Real, 0, None, closed="neither"):
            raise DataError(f"gain is a positive number, got {self.gain!r}")
        if self.geometry == "tangent" and self.gain != 2.0:
            raise DataError(
                f"gain={self.gain} is for geometry='quaternion': rotation vectors need none"
            )
        if self.path is not None and (
            self.geometry != "tangent" or not self.path or {*map(len, self.path)} != {5}
        ):
            raise DataError(
                "path is of geometry='tangent', and has rows (time, w, x, y, z), got "
                f"geometry={self.geometry!r} and {self.path!r}"
            )

    @property
    def _tangent(self) -> bool:
        return self.geometry == "tangent"

    def dimension(self, kinematics: Kinematics | None) -> int:
        """Four: a quaternion (w, x, y, z); in tangent space three, a rotation vector [rad]."""
        return 3 if self._tangent else 4

    def tolerances(self, kinematics: Kinematics | None) -> tuple[float, ...]:
        """The tolerance; of a quaternion half of it, which a turn moves by half its angle."""
        return (self.tolerance,) * 3 if self._tangent else (self.tolerance / 2,) * 4

    def units(self, kinematics: Kinematics | None) -> tuple[str | None, ...]:
        """Radians; those of a quaternion, whose length does not vary, are unlike each other."""
        return ("rad",) * 3 if self._tangent else (None,) * 4

    def quaternion_starts(self, kinematics: Kinematics | None) -> tuple[int, ...]:
        """All of it is a quaternion, if it is one."""
        return () if self._tangent else (0,)

    def rotation_vector_starts(self, kinematics: Kinematics | None) -> tuple[int, ...]:
        """All of it is a rotation vector, if it is one."""
        return (0,) if self._tangent else ()

    def at(self, time: Tensor) -> Self:
        """With the base orientation that the path has at times (...), between its rows slerp.

        Before and behind the path it is that of its ends.
        """
        if self.path is None:
            return self
        bound = copy.copy(self)
        knots, orientations = (x.to(time) for x in self._path)
        base = quaternions.interpolate(time, knots, orientations)
        object.__setattr__(bound, "_base", base)
        return bound

    def path_variances(self, kinematics: Kinematics | None) -> tuple[float, ...]:
        """How far the path moves, alike for the three axes [rad^2]."""
        if self.path is None:
            return super().path_variances(kinematics)
        orientations = self._path[1]
        turn = quaternions.product(
            quaternions.conjugate(quaternions.mean(orientations)), orientations
        )
        variance = quaternions.log(turn).square().sum(-1).mean() / 3
        return (float(variance),) * 3

    @cached_property
    def _path(self) -> tuple[Tensor, Tensor]:
        with torch.inference_mode(False):
            rows = torch.tensor(self.path, dtype=torch.float64)
        return rows[:, 0].contiguous(), rows[:, 1:]

    def _origin(self, orientation: Tensor) -> Tensor:
        """Of tangent space in the world, ``eps_f b_t``, for the frame's orientation."""
        if self._base is not None:
            return quaternions.product(orientation, self._base.to(orientation))
        if self.path is not None:
            raise DataError(
                f"the coordinates of {self!r} follow a path: ask operator.at(time) for them"
            )
        return orientation

    def _coordinates(self, link: Reference, reference: Reference) -> Tensor:
        """The orientation of a body as seen from a reference."""
        orientation = reference.frame.orientation
        if not self._tangent:
            turn = quaternions.conjugate(orientation)
            return quaternions.product(turn, link.frame.orientation)
        turn = quaternions.conjugate(self._origin(orientation))
        return quaternions.log(quaternions.product(turn, link.frame.orientation))

    def _linearize(
        self, link: Reference, reference: Reference, state: RobotState
    ) -> Linearization:
        """How the joints turn a body as seen from a reference, eq. (11)."""
        jacobian = link.angular_jacobian
        if jacobian is None:
            jacobian = state.joints.new_zeros(3, state.joints.shape[-1])
        if reference.angular_jacobian is not None:
            jacobian = jacobian - reference.angular_jacobian
        if self._tangent:
            origin = self._origin(reference.frame.orientation)
            turn = quaternions.product(quaternions.conjugate(origin), link.frame.orientation)
            vector = quaternions.log(turn)
            inverse = quaternions.inverse_left_jacobian(vector)
            jacobian = inverse @ quaternions.to_matrix(origin).mT @ jacobian
            matrix = torch.eye(3, dtype=vector.dtype, device=vector.device)
            return Linearization(jacobian, matrix.expand(*vector.shape, 3), -vector).silent(
                link.rigid_with(reference)
            )
        present = quaternions.conjugate(link.frame.orientation)
        turn = quaternions.left_matrix(reference.frame.orientation)
        matrix = self.gain * quaternions.vector_matrix(present) @ turn
        displacement = state.joints.new_zeros(matrix.shape[:-1])
        return Linearization(jacobian, matrix, displacement).silent(link.rigid_with(reference))


@dataclass(frozen=True)
class AbsoluteOrientation(_Orientation):
    """Orientation of a link in the base frame, equation 14.

    ``A = J_o^+ g Hbar*(conj eps_{t-1})``, ``b = q_{t-1}``.

    Parameters
    ----------
    link : str
        Name of the link (end-effector), or of an object that the robot carries; see
        :class:`AbsolutePosition`.
    gain : float, default=2.0
        The factor g; 1.0 is eq. (14) as printed.
    tolerance : float, default=0
        Standard deviation that is added to the local covariances [rad]: agreement below it
        means nothing, see :class:`Canonical`.
    geometry : {"quaternion", "tangent"}, default="quaternion"
        What the local coordinates are: the paper's four, or three, a rotation vector in the
        tangent space of the demonstrations' mean, which also serves orientations that lie far
        apart; see the guide's *Orientations that lie far apart*.
    path : tuple of (time, w, x, y, z), optional
        Base orientations of the tangent space [s, unit quaternion], as seen from the frame;
        ``fit`` finds them where they are not given.

    Examples
    --------
    >>> from tpgmm_torch import AbsoluteOrientation
    >>> AbsoluteOrientation("left_hand")
    AbsoluteOrientation(link='left_hand', gain=2.0, tolerance=0.0, geometry='quaternion')
    """

    link: str
    _: KW_ONLY
    gain: float = 2.0
    tolerance: float = 0.0
    geometry: str = "quaternion"
    path: tuple[tuple[float, ...], ...] | None = field(default=None, repr=False)

    def linearize(self, state: RobotState, frames: Mapping[str, Frame]) -> Linearization:
        """``J_o (q - q_{t-1}) = g Hbar*(conj eps_{t-1}) mu``."""
        if not self._tangent and self.link in state.robot_links:
            return Linearization(*state.orientation_map(self.link, self.gain))
        link = Reference.of(self.link, state, frames, held=True)
        return self._linearize(link, Reference.world(state), state)

    def coordinates(self, state: RobotState, frames: Mapping[str, Frame]) -> Tensor:
        """``eps_t``, or ``log(conj(b_t) eps_t)``."""
        link = Reference.of(self.link, state, frames, held=True)
        if not self._tangent:
            return link.frame.orientation
        return self._coordinates(link, Reference.world(state))

    def links(self) -> tuple[str, ...]:
        """The link."""
        return (self.link,)


@dataclass(frozen=True)
class RelativeOrientation(_Orientation):
    """Orientation of a link seen from a frame, equation 15.

    ``A = J_o^+ g Hbar*(conj eps_{t-1}) H+(eps_t^(j))``, ``b = q_{t-1}``. The frame may be
    another link of the robot: the Jacobian is then ``J_o`` of the link minus that of the frame.

    Parameters
    ----------
    link : str
        Name of the link (end-effector), or of an object that the robot carries; see
        :class:`RelativePosition`.
    frame : str
        Name of an object's frame, or of another link.
    gain : float, default=2.0
        The factor g; 1.0 is eq. (15) as printed.
    held : bool, default=False
        Whether the frame is the object as a thing that the robot may carry, or the place
        where it was when it was last free; see :class:`RelativePosition`.
    tolerance : float, default=0
        Standard deviation that is added to the local covariances [rad]: agreement below it
        means nothing, see :class:`Canonical`.
    geometry : {"quaternion", "tangent"}, default="quaternion"
        What the local coordinates are: the paper's four, or three, a rotation vector in the
        tangent space of the demonstrations' mean, which also serves orientations that lie far
        apart; see the guide's *Orientations that lie far apart*.
    path : tuple of (time, w, x, y, z), optional
        Base orientations of the tangent space [s, unit quaternion], as seen from the frame;
        ``fit`` finds them where they are not given.

    Examples
    --------
    >>> from tpgmm_torch import RelativeOrientation
    >>> RelativeOrientation("left_hand", "bottle")
    RelativeOrientation(link='left_hand', frame='bottle', gain=2.0, held=False, ...)
    """

    link: str
    frame: str
    _: KW_ONLY
    gain: float = 2.0
    held: bool = False
    tolerance: float = 0.0
    geometry: str = "quaternion"
    path: tuple[tuple[float, ...], ...] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_pair(self.link, self.frame, self.held)

    def linearize(self, state: RobotState, frames: Mapping[str, Frame]) -> Linearization:
        """``J_o (q - q_{t-1}) = g Hbar*(conj eps_{t-1}) H+(eps^(j)) mu``."""
        reference = Reference.of(self.frame, state, frames, self.held)
        place = reference.angular_jacobian is None and not self.held
        if place and not self._tangent and self.link in state.robot_links:
            turn = quaternions.left_matrix(reference.frame.orientation)
            jacobian, matrix, displacement = state.orientation_map(self.link, self.gain)
            return Linearization(jacobian, matrix @ turn, displacement)
        link = Reference.of(self.link, state, frames, held=True)
        return self._linearize(link, reference, state)

    def coordinates(self, state: RobotState, frames: Mapping[str, Frame]) -> Tensor:
        """``H+(conj eps_t^(j)) eps_t``, or its ``log(conj(b_t) ...)``."""
        reference = Reference.of(self.frame, state, frames, self.held)
        link = Reference.of(self.link, state, frames, held=True)
        return self._coordinates(link, reference)

    def links(self) -> tuple[str, ...]:
        """The link; the frame too, if it is the held object that is meant."""
        return (self.link, self.frame) if self.held else (self.link,)

    def references(self) -> tuple[str, ...]:
        """The frame, if it is a place."""
        return () if self.held else (self.frame,)
