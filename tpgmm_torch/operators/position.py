"""Position constraints in task space: section III-A, eqs (3) to (6)."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.operators.base import Linearization, Operator, Reference
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

__all__ = ["AbsolutePosition", "RelativePosition"]


@dataclass(frozen=True)
class AbsolutePosition(Operator):
    """Position of a link in the base frame, equation 4.

    ``A = J_p^+``, ``b = -J_p^+ x + q``.

    Parameters
    ----------
    link : str
        Name of the link (end-effector).

    Examples
    --------
    >>> from tpgmm_torch import AbsolutePosition
    >>> AbsolutePosition("left_hand")
    AbsolutePosition(link='left_hand')
    """

    link: str

    def dimension(self, kinematics: Kinematics | None) -> int:
        """Three [m]."""
        return 3

    def linearize(self, state: RobotState, frames: Mapping[str, Frame]) -> Linearization:
        """``J_p (q - q_{t-1}) = mu - x_{t-1}``."""
        return Linearization(state.linear_jacobian(self.link), None, -state.position(self.link))

    def coordinates(self, state: RobotState, frames: Mapping[str, Frame]) -> Tensor:
        """``x_t``."""
        return state.position(self.link)

    def links(self) -> tuple[str, ...]:
        """The link."""
        return (self.link,)


@dataclass(frozen=True)
class RelativePosition(Operator):
    """Position of a link seen from a frame, equation 6.

    ``A = J_p^+ R``, ``b = J_p^+ (p - x) + q``. The frame may be another link of the robot (one
    hand relative to the other): both then move with the joints, and the Jacobian is the
    relative one.

    Parameters
    ----------
    link : str
        Name of the link (end-effector).
    frame : str
        Name of an object's frame, or of another link.

    Examples
    --------
    >>> from tpgmm_torch import RelativePosition
    >>> RelativePosition("left_hand", "bottle")
    RelativePosition(link='left_hand', frame='bottle')
    """

    link: str
    frame: str

    def dimension(self, kinematics: Kinematics | None) -> int:
        """Three [m]."""
        return 3

    def linearize(self, state: RobotState, frames: Mapping[str, Frame]) -> Linearization:
        """``J (q - q_{t-1}) = R mu + p - x_{t-1}``.

        For an object ``J = J_p``. For another link f, ``R_f mu + p_f`` moves too; with
        ``d = x - p_f`` the present difference, ``J = J_p - J_pf + [d]x J_of``.
        """
        reference = Reference.of(self.frame, state, frames)
        position = state.position(self.link)
        jacobian = state.linear_jacobian(self.link)
        displacement = reference.frame.position - position
        if reference.linear_jacobian is not None and reference.angular_jacobian is not None:
            swing = torch.linalg.cross(
                reference.angular_jacobian, displacement[..., None], dim=-2
            )
            jacobian = jacobian - reference.linear_jacobian + swing
        matrix = quaternions.to_matrix(reference.frame.orientation)
        return Linearization(jacobian, matrix, displacement)

    def coordinates(self, state: RobotState, frames: Mapping[str, Frame]) -> Tensor:
        """``R_t^T (x_t - p_t)``."""
        reference = Reference.of(self.frame, state, frames)
        return reference.frame.inverse_transform(state.position(self.link))

    def links(self) -> tuple[str, ...]:
        """The link."""
        return (self.link,)

    def references(self) -> tuple[str, ...]:
        """The frame."""
        return (self.frame,)
