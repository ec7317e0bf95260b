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
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from numbers import Real
from typing import Self

import torch
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.constraints import Interval
from tpgmm_torch.data.frames import Frames
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.operators.base import Linearization
from tpgmm_torch.operators.pose import PoseOperator
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

__all__ = ["AbsoluteOrientation", "RelativeOrientation"]

GEOMETRIES = "quaternion", "tangent"


class _Orientation(PoseOperator):
    """Four coordinates, a quaternion, or three, a rotation vector [rad]."""

    gain: float
    geometry: str
    path: tuple[tuple[float, ...], ...] | None
    #: The base orientation (..., 4) at the time of :meth:`at`.
    _base: Tensor | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.geometry not in GEOMETRIES:
            raise DataError(f"geometry is one of {list(GEOMETRIES)}, got {self.geometry!r}")
        if self.gain not in Interval(Real, 0, None, closed="neither"):
            raise DataError(f"gain is a positive number, got {self.gain!r}")
        if self._tangent and self.gain != 2.0:
            raise DataError(
                f"gain={self.gain} is for geometry='quaternion': rotation vectors need none"
            )
        if self.path is not None and not (self._tangent and {*map(len, self.path)} == {5}):
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
        """Return the tolerance; half of it for a quaternion, which turns by half the angle."""
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
        base = quaternions.interpolate(time, *(part.to(time) for part in self._path))
        object.__setattr__(bound, "_base", base)
        return bound

    def path_variances(self, kinematics: Kinematics | None) -> tuple[float, ...]:
        """Variance of the path, equal for the three axes [rad^2]."""
        if self.path is None:
            return super().path_variances(kinematics)
        orientations = self._path[1]
        back = quaternions.conjugate(quaternions.mean(orientations))
        turn = quaternions.log(quaternions.product(back, orientations))
        return (float(turn.square().sum(-1).mean() / 3),) * 3

    @cached_property
    def _path(self) -> tuple[Tensor, Tensor]:
        with torch.inference_mode(False):
            rows = torch.tensor(self.path, dtype=torch.float64)
        return rows[:, 0].contiguous(), rows[:, 1:]

    def _orientations(self, state: RobotState, frames: Frames) -> tuple[Tensor, Tensor]:
        """``eps`` of the link, and what its coordinates refer to: ``eps_f``, ``eps_f b_t``."""
        body, reference = self.poses(state, frames)
        eps = body.orientation
        if reference is None:
            origin = quaternions.identity(eps.dtype, eps.device).expand_as(eps)
        else:
            origin = reference.orientation
        if self._base is not None:
            return eps, quaternions.product(origin, self._base.to(eps))
        if self.path is not None:
            raise DataError(
                f"the coordinates of {self!r} follow a path: ask operator.at(time) for them"
            )
        return eps, origin

    def coordinates(self, state: RobotState, frames: Frames) -> Tensor:
        """``H+(conj eps_t^(j)) eps_t``; in tangent space ``log(conj(eps_t^(j) b_t) eps_t)``."""
        eps, origin = self._orientations(state, frames)
        seen = quaternions.product(quaternions.conjugate(origin), eps)
        return quaternions.log(seen) if self._tangent else seen

    def is_bilinear(self, state: RobotState) -> bool:
        """Check that :func:`linearize_poses` serves: not in tangent space nor tracked poses.

        Where a link's quaternion is part of the joint vector nothing has to be linearised.
        """
        if self._tangent or state.quaternion_columns(self.link) is None:
            return not self._tangent
        return bool(self.links()[1:]) or self.moving_reference(state) is not None

    def linearize(self, state: RobotState, frames: Frames) -> Linearization:
        """See :meth:`PoseOperator.linearize`; exact in tangent space and for tracked poses.

        Of tracked poses, whose quaternion is part of the joint vector, it is
        ``eps = H+(eps^(j)) mu``, and the gain has no effect.
        """
        if self.is_bilinear(state):
            return super().linearize(state, frames)
        eps, origin = self._orientations(state, frames)
        if self._tangent:
            at = super().linearize(state, frames)
            assert at.jacobian is not None
            vector = quaternions.log(quaternions.product(quaternions.conjugate(origin), eps))
            turned = quaternions.to_matrix(origin).mT @ at.jacobian
            matrix = torch.eye(3, dtype=eps.dtype, device=eps.device).expand(*vector.shape, 3)
            exact = Linearization(
                quaternions.inverse_left_jacobian(vector) @ turned, matrix, -vector
            )
            return exact if at.noise is None else exact.without(at.noise > 0)
        like, columns = state.joints, state.quaternion_columns(self.link)
        rows = torch.eye(like.shape[-1], dtype=like.dtype, device=like.device)[columns]
        matrix = quaternions.left_matrix(origin)
        present = (matrix.mT @ eps[..., None])[..., 0]
        jacobian = rows.expand(*like.shape[:-1], *rows.shape)
        return Linearization(jacobian, matrix, -like[..., columns], present)


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
        apart (:doc:`/howto/operators`).
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
        apart (:doc:`/howto/operators`).
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
