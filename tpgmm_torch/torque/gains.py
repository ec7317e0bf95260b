"""Stiffness, damping and tolerances of a controller of torques."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from tpgmm_torch.exceptions import DataError, ShapeError

__all__ = ["TorqueGains"]


@dataclass(frozen=True)
class TorqueGains:
    """How a :class:`TorqueController` pulls, damps and presses.

    Parameters
    ----------
    joints : sequence of float, or of rows of an (n, n) matrix, optional
        Stiffness of the joints ``K_q`` [N m/rad or N/m]. By default
        ``joint_frequency^2 H`` at the start.
    link : sequence of 6 float, or of rows of a (6, 6) matrix, optional
        Stiffness of a link's pose ``K_x``, ``K_o`` [N/m; N m/rad], in the base frame. By
        default ``link_frequency^2`` times the mass (and the inertia) that the link has at the
        start, the harmonic mean over its axes.
    joint_frequency, link_frequency : float
        Natural frequencies of the defaults [rad/s]. The links' is the higher one: where both
        contradict each other within their tolerances, the link moves first.
    damping_ratio : float
        Of each mode of inertia and stiffness; 1 is critical.
    frame_tolerance, frame_turn_tolerance : float
        Standard deviation of the pose of frames that positions [m] and orientations [rad] are
        relative to. It decides the force: against a position that is known to a tenth of
        a millimetre, and is inside of a board, no force would win.
    contact_stiffness : float
        Of tool and surface in series [N/m]; the damping along axes of forces is
        ``2 zeta sqrt(k m)`` with the mass that the link has along them.
    integral : float
        Rate at which the error of a force is integrated in contact [1/s].

    Raises
    ------
    DataError
        If a number is not finite and positive (tolerances and the integral may be zero).
    """

    joints: tuple[float, ...] | tuple[tuple[float, ...], ...] | None = None
    link: tuple[float, ...] | tuple[tuple[float, ...], ...] | None = None
    joint_frequency: float = 20.0
    link_frequency: float = 24.0
    damping_ratio: float = 0.8
    frame_tolerance: float = 0.005
    frame_turn_tolerance: float = 0.02
    contact_stiffness: float = 1e4
    integral: float = 3.0

    def __post_init__(self) -> None:
        may_vanish = "frame_tolerance", "frame_turn_tolerance", "integral"
        for name in (field.name for field in fields(self)):
            value = getattr(self, name)
            if isinstance(value, float | int):
                if not (0 < value < math.inf or (value == 0 and name in may_vanish)):
                    raise DataError(
                        f"{name} of TorqueGains is above 0 and finite, got {value!r}"
                    )
            elif value is not None:
                _matrix(value, name)
        if self.link is not None and len(self.link) != 6:
            raise ShapeError(f"link has 6 numbers, 3 [N/m] and 3 [N m/rad], got {self.link!r}")

    def joint_stiffness(self, inertia: Tensor) -> Tensor:
        """``K_q`` (..., n, n) of robots of an inertia (..., n, n)."""
        if self.joints is None:
            return self.joint_frequency**2 * inertia
        matrix = _matrix(self.joints, "joints").to(inertia)
        if matrix.shape[-1] != inertia.shape[-1]:
            raise ShapeError(
                f"joints of TorqueGains has {len(matrix)} rows for {inertia.shape[-1]} joints"
            )
        return matrix.expand_as(inertia)

    def link_stiffness(self, mobility: Tensor) -> Tensor:
        """``K_x``, ``K_o`` (..., 6, 6) of links with ``J H^-1 J^T`` (..., 6, 6)."""
        if self.link is not None:
            return _matrix(self.link, "link").to(mobility).expand_as(mobility)
        inverse_masses = mobility.diagonal(dim1=-2, dim2=-1).unflatten(-1, (2, 3)).mean(-1)
        # of a link that cannot move, or turn, any stiffness will do
        inverse_masses = torch.where(inverse_masses > 0, inverse_masses, 1.0)
        stiffness = self.link_frequency**2 / inverse_masses
        return stiffness.repeat_interleave(3, -1).diag_embed()


def _matrix(values: tuple[float, ...] | tuple[tuple[float, ...], ...], name: str) -> Tensor:
    """A diagonal, or all of a matrix, which is symmetric positive definite."""
    given = torch.as_tensor(values, dtype=torch.float64)
    matrix = given.diag() if given.ndim == 1 else given
    symmetric = matrix.ndim == 2 and matrix.shape == matrix.mT.shape
    if not symmetric or not torch.allclose(matrix, matrix.mT):
        raise ShapeError(
            f"{name} of TorqueGains is a diagonal or a symmetric matrix: {values!r}"
        )
    if not bool(matrix.isfinite().all()) or not bool((torch.linalg.eigvalsh(matrix) > 0).all()):
        raise DataError(
            f"{name} of TorqueGains is positive definite and finite, got {values!r}"
        )
    return matrix
