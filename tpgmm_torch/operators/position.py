"""Position constraints in task space: section III-A, eqs (3) to (6)."""

from dataclasses import KW_ONLY, dataclass

from torch import Tensor

from tpgmm_torch.data.frames import Frames
from tpgmm_torch.operators.pose import PoseOperator
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

__all__ = ["AbsolutePosition", "RelativePosition"]


class _Position(PoseOperator):
    """Three coordinates [m]."""

    def dimension(self, kinematics: Kinematics | None) -> int:
        """Three [m]."""
        return 3

    def tolerances(self, kinematics: Kinematics | None) -> tuple[float, ...]:
        """Return the tolerance, along each axis."""
        return (self.tolerance,) * 3

    def units(self, kinematics: Kinematics | None) -> tuple[str | None, ...]:
        """Metres."""
        return ("m",) * 3

    def coordinates(self, state: RobotState, frames: Frames) -> Tensor:
        """``R_t^T (x_t - p_t)``; in the base frame ``x_t``."""
        body, reference = self.poses(state, frames)
        point = body.position
        return point if reference is None else reference.inverse_transform(point)


@dataclass(frozen=True)
class AbsolutePosition(_Position):
    """Position of a link in the base frame, equation 4.

    ``A = J_p^+``, ``b = -J_p^+ x + q``.

    Parameters
    ----------
    link : str
        Name of the link (end-effector), or of an object: while the robot carries it, of its
        point on the link that does; while it is free, the operator has no effect.
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


@dataclass(frozen=True)
class RelativePosition(_Position):
    """Position of a link seen from a frame, equation 6.

    ``A = J_p^+ R``, ``b = J_p^+ (p - x) + q``. The frame may be another link of the robot (one
    hand relative to the other): both then move with the joints, and the Jacobian is the
    relative one.

    Parameters
    ----------
    link : str
        Name of the link (end-effector), or of an object: while the robot carries it, it is a
        point of the link that does; while it is free, the operator has no effect.
    frame : str
        Name of an object's frame, or of another link.
    held : bool, default=False
        Whether the frame is the object as a thing, which moves with the joints while the
        robot carries it: then the operator of the hand that carries it has no effect, that of
        the other hand is the closed chain's. By default it is a place: the pose of the object
        when it was last free.
    tolerance : float, default=0
        Standard deviation that is added to the local covariances [m]: agreement below it
        means nothing, see :class:`Canonical`.

    Raises
    ------
    DataError
        If link and frame are one, or ``held`` is neither True nor False.

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
