"""Any task parameters A, b: Definition 1 itself, where the rows of Table I do not reach."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from tpgmm_torch.data.affine import Affine
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError
from tpgmm_torch.operators.base import Linearization, Operator
from tpgmm_torch.operators.canonical import Canonical
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

__all__ = ["TaskParameters"]


@dataclass(frozen=True)
class TaskParameters(Operator):
    """Task parameters of the situation: ``x = A X + b``, x the joints or a link's position.

    Local data are ``X = A^+ (x - b)`` (section II-B). With the joints ``A^(j) = A``,
    ``b^(j) = b`` where A is square; otherwise ``b^(j) = A A^+ b + (I - A A^+) q_{t-1}``, so
    that directions that A does not reach stay as they are. With a link
    ``A^(j) = (A^+ J_p)^+``, ``b^(j) = (A^+ J_p)^+ A^+ (b - x_{t-1}) + q_{t-1}``: for a pose,
    ``A = R`` and ``b = p``, that is :class:`RelativePosition`, eq. (6).

    Parameters
    ----------
    frame : str
        Name of the :class:`Affine` among the frames of demonstrations and situations.
    link : str, optional
        Name of the link whose position [m] is seen; the joints by default.
    size : int, optional
        D, the number of columns of A; by default A is square.
    tolerance : float, default=0
        Standard deviation that is added to the local covariances, in units of X: agreement
        below it means nothing, see :class:`Canonical`.

    Examples
    --------
    >>> from tpgmm_torch import TaskParameters
    >>> TaskParameters("shelf", link="hand", size=2)
    TaskParameters(frame='shelf', link='hand', size=2, tolerance=0.0)
    """

    frame: str
    link: str | None = None
    size: int | None = None
    tolerance: float = 0.0

    def dimension(self, kinematics: Kinematics | None) -> int:
        """D: the columns of A."""
        if self.size is not None:
            return self.size
        if self.link is not None:
            return 3
        if kinematics is None:
            raise DataError(f"{self!r} has as many coordinates as the robot has joints")
        return kinematics.n_joints

    def tolerances(self, kinematics: Kinematics | None) -> tuple[float, ...]:
        """The tolerance, for every column of A."""
        return (self.tolerance,) * self.dimension(kinematics)

    def units(self, kinematics: Kinematics | None) -> tuple[str | None, ...]:
        """Those of what a square A maps; nothing is known of other columns."""
        if self.size is not None:
            return super().units(kinematics)
        return Canonical().units(kinematics) if self.link is None else ("m",) * 3

    def linearize(self, state: RobotState, frames: Mapping[str, Frame]) -> Linearization:
        """``A^+ J (q - q_{t-1}) = mu + A^+ (b - x_{t-1})``, with J = I for the joints."""
        present, affine = self._read(state, frames)
        jacobian = affine.inverse()
        if self.link is not None:
            jacobian = jacobian @ state.linear_jacobian(self.link)
        return Linearization(jacobian, None, -affine.local(present))

    def coordinates(self, state: RobotState, frames: Mapping[str, Frame]) -> Tensor:
        """``A^+ (x_t - b)``."""
        present, affine = self._read(state, frames)
        return affine.local(present)

    def links(self) -> tuple[str, ...]:
        """The link, if there is one."""
        return () if self.link is None else (self.link,)

    def references(self) -> tuple[str, ...]:
        """What the task parameters are called."""
        return (self.frame,)

    @property
    def determines_joints(self) -> bool:
        """If A is square and maps into the joints."""
        return self.link is None and self.size is None

    def _read(self, state: RobotState, frames: Mapping[str, Frame]) -> tuple[Tensor, Affine]:
        """What is mapped into, as it is at present, and the task parameters."""
        if self.frame not in frames:
            raise UnknownNameError("frame", self.frame, "the situation", frames)
        affine = frames[self.frame]
        if not isinstance(affine, Affine):
            raise DataError(
                f"{self!r} takes task parameters Affine(A, b); {self.frame!r} is a "
                f"{type(affine).__name__}. A pose is Affine(R, p)"
            )
        present = state.joints if self.link is None else state.position(self.link)
        wanted = present.shape[-1], self.size or present.shape[-1]
        if affine.linear.shape[-2:] != wanted:
            raise ShapeError(
                f"{self!r} needs A of shape {wanted}; that of {self.frame!r} has "
                f"{tuple(affine.linear.shape[-2:])}"
            )
        return present, affine
