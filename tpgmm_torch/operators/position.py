"""Position constraints in task space: section III-A, eqs (3) to (6)."""

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass

import torch
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.operators.base import Linearization, Operator, Reference, check_pair
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

__all__ = ["AbsolutePosition", "RelativePosition"]


@dataclass(frozen=True)
class AbsolutePosition(Operator):
    """Position of a link in the base frame, equation 4.

    ``A = J_p^+``, ``b = -J_p^+ x + q``.

    Parameters
    ----------
    link : str
        Name of the link (end-effector), or of an object: while the robot carries it, of its
        point on the link that does; while it is free, the operator says nothing.
    tolerance : float, default=0
        Standard deviation that is added to the local covariances [m]: agreement below it
        means nothing, see :class:`Canonical`.

    Examples
    --------
    >>> from tpgmm_torch import AbsolutePosition
    >>> AbsolutePosition("left_hand")
    AbsolutePosition(link='left_hand', tolerance=0.0)
    """

    link: str
    _: KW_ONLY
    tolerance: float = 0.0

    def dimension(self, kinematics: Kinematics | None) -> int:
        """Three [m]."""
        return 3

    def tolerances(self, kinematics: Kinematics | None) -> tuple[float, ...]:
        """The tolerance, along each axis."""
        return (self.tolerance,) * 3

    def units(self, kinematics: Kinematics | None) -> tuple[str | None, ...]:
        """Metres."""
        return ("m",) * 3

    def linearize(self, state: RobotState, frames: Mapping[str, Frame]) -> Linearization:
        """``J_p (q - q_{t-1}) = mu - x_{t-1}``."""
        if self.link in state.robot_links:
            jacobian = state.linear_jacobian(self.link)
            return Linearization(jacobian, None, -state.position(self.link))
        point = Reference.of(self.link, state, frames, held=True)
        return _moved(point, Reference.world(state), state)

    def coordinates(self, state: RobotState, frames: Mapping[str, Frame]) -> Tensor:
        """``x_t``."""
        return Reference.of(self.link, state, frames, held=True).frame.position

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
        Name of the link (end-effector), or of an object: while the robot carries it, it is a
        point of the link that does; while it is free, the operator says nothing.
    frame : str
        Name of an object's frame, or of another link.
    held : bool, default=False
        Whether the frame is the object as a thing, which moves with the joints while the
        robot carries it: then the operator of the hand that carries it says nothing, that of
        the other hand is the closed chain's. By default it is a place: the pose of the object
        when it was last free.
    tolerance : float, default=0
        Standard deviation that is added to the local covariances [m]: agreement below it
        means nothing, see :class:`Canonical`.

    Examples
    --------
    >>> from tpgmm_torch import RelativePosition
    >>> RelativePosition("left_hand", "bottle")
    RelativePosition(link='left_hand', frame='bottle', held=False, tolerance=0.0)
    >>> put = RelativePosition("bottle", "tray")
    >>> other_hand = RelativePosition("right_hand", "bottle", held=True)
    """

    link: str
    frame: str
    _: KW_ONLY
    held: bool = False
    tolerance: float = 0.0

    def __post_init__(self) -> None:
        check_pair(self.link, self.frame, self.held)

    def dimension(self, kinematics: Kinematics | None) -> int:
        """Three [m]."""
        return 3

    def tolerances(self, kinematics: Kinematics | None) -> tuple[float, ...]:
        """The tolerance, along each axis."""
        return (self.tolerance,) * 3

    def units(self, kinematics: Kinematics | None) -> tuple[str | None, ...]:
        """Metres."""
        return ("m",) * 3

    def linearize(self, state: RobotState, frames: Mapping[str, Frame]) -> Linearization:
        """``J (q - q_{t-1}) = R mu + p - x_{t-1}``.

        For a place ``J = J_p``. For another link f, ``R_f mu + p_f`` moves too; with
        ``d = x - p_f`` the present difference, ``J = J_p - J_pf + [d]x J_of``. Between an
        object and the link that carries it, or two places, this is ``0 = 0``.
        """
        point = Reference.of(self.link, state, frames, held=True)
        return _moved(point, Reference.of(self.frame, state, frames, self.held), state)

    def coordinates(self, state: RobotState, frames: Mapping[str, Frame]) -> Tensor:
        """``R_t^T (x_t - p_t)``."""
        reference = Reference.of(self.frame, state, frames, self.held)
        point = Reference.of(self.link, state, frames, held=True)
        return reference.frame.inverse_transform(point.frame.position)

    def links(self) -> tuple[str, ...]:
        """The link; the frame too, if it is the held object that is meant."""
        return (self.link, self.frame) if self.held else (self.link,)

    def references(self) -> tuple[str, ...]:
        """The frame, if it is a place."""
        return () if self.held else (self.frame,)


def _moved(point: Reference, reference: Reference, state: RobotState) -> Linearization:
    """How the joints move a point as seen from a reference, eq. (6)."""
    displacement = reference.frame.position - point.frame.position
    jacobian = point.linear_jacobian
    if jacobian is None:
        jacobian = state.joints.new_zeros(3, state.joints.shape[-1])
    if reference.linear_jacobian is not None and reference.angular_jacobian is not None:
        angular = reference.angular_jacobian.expand(*displacement.shape[:-1], -1, -1)
        swing = torch.linalg.cross(angular, displacement[..., None], dim=-2)
        jacobian = jacobian - reference.linear_jacobian + swing
    matrix = quaternions.to_matrix(reference.frame.orientation)
    return Linearization(jacobian, matrix, displacement).silent(point.rigid_with(reference))
