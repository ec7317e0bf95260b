"""Orientation constraints in task space: section III-B, eqs (7) to (15).

Eq. (7) takes ``vec(eps_t * conj(eps_{t-1}))`` for the rotation vector of the step; it is its
half, to first order. Both operators multiply by ``gain``: 2 is exact and the default, 1 is the
paper's text, which covers half of the error in one step.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.operators.base import Linearization, Operator, Reference
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

__all__ = ["AbsoluteOrientation", "RelativeOrientation"]


@dataclass(frozen=True)
class AbsoluteOrientation(Operator):
    """Orientation of a link in the base frame, equation 14.

    ``A = J_o^+ g Hbar*(conj eps_{t-1})``, ``b = q_{t-1}``.

    Parameters
    ----------
    link : str
        Name of the link (end-effector).
    gain : float, default=2.0
        The factor g; 1.0 is eq. (14) as printed.

    Examples
    --------
    >>> from tpgmm_torch import AbsoluteOrientation
    >>> AbsoluteOrientation("left_hand")
    AbsoluteOrientation(link='left_hand', gain=2.0)
    """

    link: str
    gain: float = 2.0

    def dimension(self, kinematics: Kinematics | None) -> int:
        """Four: a quaternion (w, x, y, z)."""
        return 4

    def linearize(self, state: RobotState, frames: Mapping[str, Frame]) -> Linearization:
        """``J_o (q - q_{t-1}) = g Hbar*(conj eps_{t-1}) mu``."""
        return Linearization(*state.orientation_map(self.link, self.gain))

    def coordinates(self, state: RobotState, frames: Mapping[str, Frame]) -> Tensor:
        """``eps_t``."""
        return state.orientation(self.link)

    def quaternion_starts(self, kinematics: Kinematics | None) -> tuple[int, ...]:
        """All of it is a quaternion."""
        return (0,)

    def links(self) -> tuple[str, ...]:
        """The link."""
        return (self.link,)


@dataclass(frozen=True)
class RelativeOrientation(Operator):
    """Orientation of a link seen from a frame, equation 15.

    ``A = J_o^+ g Hbar*(conj eps_{t-1}) H+(eps_t^(j))``, ``b = q_{t-1}``. The frame may be
    another link of the robot: the Jacobian is then ``J_o`` of the link minus that of the frame.

    Parameters
    ----------
    link : str
        Name of the link (end-effector).
    frame : str
        Name of an object's frame, or of another link.
    gain : float, default=2.0
        The factor g; 1.0 is eq. (15) as printed.

    Examples
    --------
    >>> from tpgmm_torch import RelativeOrientation
    >>> RelativeOrientation("left_hand", "bottle")
    RelativeOrientation(link='left_hand', frame='bottle', gain=2.0)
    """

    link: str
    frame: str
    gain: float = 2.0

    def dimension(self, kinematics: Kinematics | None) -> int:
        """Four: a quaternion (w, x, y, z)."""
        return 4

    def linearize(self, state: RobotState, frames: Mapping[str, Frame]) -> Linearization:
        """``J_o (q - q_{t-1}) = g Hbar*(conj eps_{t-1}) H+(eps^(j)) mu``."""
        reference = Reference.of(self.frame, state, frames)
        turn = quaternions.left_matrix(reference.frame.orientation)
        if reference.angular_jacobian is None:
            jacobian, matrix, displacement = state.orientation_map(self.link, self.gain)
            return Linearization(jacobian, matrix @ turn, displacement)
        jacobian = state.angular_jacobian(self.link) - reference.angular_jacobian
        present = quaternions.conjugate(state.orientation(self.link))
        matrix = self.gain * quaternions.vector_matrix(present) @ turn
        return Linearization(jacobian, matrix, state.joints.new_zeros(matrix.shape[:-1]))

    def coordinates(self, state: RobotState, frames: Mapping[str, Frame]) -> Tensor:
        """``H+(conj eps_t^(j)) eps_t``."""
        reference = Reference.of(self.frame, state, frames)
        turn = quaternions.conjugate(reference.frame.orientation)
        return quaternions.product(turn, state.orientation(self.link))

    def quaternion_starts(self, kinematics: Kinematics | None) -> tuple[int, ...]:
        """All of it is a quaternion."""
        return (0,)

    def links(self) -> tuple[str, ...]:
        """The link."""
        return (self.link,)

    def references(self) -> tuple[str, ...]:
        """The frame."""
        return (self.frame,)
