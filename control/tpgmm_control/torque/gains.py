"""Stiffness, damping and tolerances of a controller of torques."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from tpgmm_control.sensing.states import check_positive

__all__ = ["TorqueGains"]


@dataclass(frozen=True)
class TorqueGains:
    """How a :class:`TorqueController` pulls, damps and presses.

    The stiffness of the joints is ``joint_frequency^2 H`` at the start. A link's, in the base
    frame, is ``link_frequency^2`` times the mass, and the inertia, that it has at the start,
    each the harmonic mean over its axes.

    Parameters
    ----------
    joint_frequency, link_frequency : float
        Natural frequencies [rad/s]. The links' is the higher one: where both contradict each
        other within their tolerances, the link moves first.
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
        If a number is not positive (tolerances and the integral may be zero).
    """

    joint_frequency: float = 20.0
    link_frequency: float = 24.0
    damping_ratio: float = 0.8
    frame_tolerance: float = 0.005
    frame_turn_tolerance: float = 0.02
    contact_stiffness: float = 1e4
    integral: float = 3.0

    def __post_init__(self) -> None:
        check_positive(self, "frame_tolerance", "frame_turn_tolerance", "integral")

    def stiffness(self, inertia: Tensor, mobility: Tensor) -> tuple[Tensor, Tensor]:
        """Of joints and links.

        Parameters
        ----------
        inertia : Tensor of shape (..., n, n)
        mobility : Tensor of shape (..., 6 B, 6 B)
            ``J H^-1 J^T`` of B links.

        Returns
        -------
        joints : Tensor of shape (..., n, n)
        links : Tensor of shape (..., 6 B, 6 B)
        """
        mass = mobility.diagonal(dim1=-2, dim2=-1).unflatten(-1, (-1, 3)).mean(-1)
        # of a link that cannot move, or turn, any stiffness will do
        links = self.link_frequency**2 / torch.where(mass > 0, mass, 1.0)
        return self.joint_frequency**2 * inertia, links.repeat_interleave(3, -1).diag_embed()
