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
        Name of the link (end-effector), or of an object that the robot carries; see
        :class:`AbsolutePosition`.
    gain : float, default=2.0
        The factor g; 1.0 is eq. (14) as printed.
    tolerance : float, default=0
        Standard deviation that is added to the local covariances [rad]: agreement below it
        means nothing, see :class:`Canonical`.

    Examples
    --------
    >>> from tpgmm_torch import AbsoluteOrientation
    >>> AbsoluteOrientation("left_hand")
    AbsoluteOrientation(link='left_hand', gain=2.0, tolerance=0.0)
    """

    link: str
    gain: float = 2.0
    tolerance: float = 0.0

    def dimension(self, kinematics: Kinematics | None) -> int:
        """Four: a quaternion (w, x, y, z)."""
        return 4

    def tolerances(self, kinematics: Kinematics | None) -> tuple[float, ...]:
        """Half the tolerance: a turn moves a quaternion by half its angle."""
        return (self.tolerance / 2,) * 4

    def linearize(self, state: RobotState, frames: Mapping[str, Frame]) -> Linearization:
        """``J_o (q - q_{t-1}) = g Hbar*(conj eps_{t-1}) mu``."""
        if self.link in state.robot_links:
            return Linearization(*state.orientation_map(self.link, self.gain))
        link = Reference.of(self.link, state, frames, held=True)
        return _turned(link, Reference.world(state), state, self.gain)

    def coordinates(self, state: RobotState, frames: Mapping[str, Frame]) -> Tensor:
        """``eps_t``."""
        return Reference.of(self.link, state, frames, held=True).frame.orientation

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

    Examples
    --------
    >>> from tpgmm_torch import RelativeOrientation
    >>> RelativeOrientation("left_hand", "bottle")
    RelativeOrientation(link='left_hand', frame='bottle', gain=2.0, held=False, tolerance=0.0)
    """

    link: str
    frame: str
    gain: float = 2.0
    held: bool = False
    tolerance: float = 0.0

    def dimension(self, kinematics: Kinematics | None) -> int:
        """Four: a quaternion (w, x, y, z)."""
        return 4

    def tolerances(self, kinematics: Kinematics | None) -> tuple[float, ...]:
        """Half the tolerance: a turn moves a quaternion by half its angle."""
        return (self.tolerance / 2,) * 4

    def linearize(self, state: RobotState, frames: Mapping[str, Frame]) -> Linearization:
        """``J_o (q - q_{t-1}) = g Hbar*(conj eps_{t-1}) H+(eps^(j)) mu``."""
        reference = Reference.of(self.frame, state, frames, self.held)
        place = reference.angular_jacobian is None and not self.held
        if place and self.link in state.robot_links:
            turn = quaternions.left_matrix(reference.frame.orientation)
            jacobian, matrix, displacement = state.orientation_map(self.link, self.gain)
            return Linearization(jacobian, matrix @ turn, displacement)
        link = Reference.of(self.link, state, frames, held=True)
        return _turned(link, reference, state, self.gain)

    def coordinates(self, state: RobotState, frames: Mapping[str, Frame]) -> Tensor:
        """``H+(conj eps_t^(j)) eps_t``."""
        reference = Reference.of(self.frame, state, frames, self.held)
        turn = quaternions.conjugate(reference.frame.orientation)
        link = Reference.of(self.link, state, frames, held=True)
        return quaternions.product(turn, link.frame.orientation)

    def quaternion_starts(self, kinematics: Kinematics | None) -> tuple[int, ...]:
        """All of it is a quaternion."""
        return (0,)

    def links(self) -> tuple[str, ...]:
        """The link; the frame too, if it is the held object that is meant."""
        return (self.link, self.frame) if self.held else (self.link,)

    def references(self) -> tuple[str, ...]:
        """The frame, if it is a place."""
        return () if self.held else (self.frame,)


def _turned(
    link: Reference, reference: Reference, state: RobotState, gain: float
) -> Linearization:
    """How the joints turn a body as seen from a reference, eq. (11)."""
    jacobian = link.angular_jacobian
    if jacobian is None:
        jacobian = state.joints.new_zeros(3, state.joints.shape[-1])
    if reference.angular_jacobian is not None:
        jacobian = jacobian - reference.angular_jacobian
    present = quaternions.conjugate(link.frame.orientation)
    turn = quaternions.left_matrix(reference.frame.orientation)
    matrix = gain * quaternions.vector_matrix(present) @ turn
    displacement = state.joints.new_zeros(matrix.shape[:-1])
    return Linearization(jacobian, matrix, displacement).silent(link.rigid_with(reference))
