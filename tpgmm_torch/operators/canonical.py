"""Configuration-space constraints: the first row of Table I."""

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.operators.base import Linearization, Operator
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

__all__ = ["Canonical"]


@dataclass(frozen=True)
class Canonical(Operator):
    """The joints themselves: ``A = I``, ``b = 0``; local data are ``q_t`` (section III-C).

    Parameters
    ----------
    tolerance : float, default=0.005
        Standard deviation that is added to the local covariances [rad or m; of quaternions,
        the angle in rad]. In a few
        demonstrations the joints seem to keep relations exactly that they keep by chance, or
        only near the demonstrated situations; these would contradict the task elsewhere.
        0 takes them at their word, as the paper does.

    Examples
    --------
    >>> from tpgmm_torch import Canonical
    >>> Canonical()
    Canonical(tolerance=0.005)
    """

    tolerance: float = 0.005

    def tolerances(self, kinematics: Kinematics | None) -> tuple[float, ...]:
        """The tolerance, for every joint; half of it for what is part of a quaternion."""
        tolerances = [self.tolerance] * self.dimension(kinematics)
        for start in self.quaternion_starts(kinematics):
            tolerances[start : start + 4] = [self.tolerance / 2] * 4
        return tuple(tolerances)

    def dimension(self, kinematics: Kinematics | None) -> int:
        """The number of joints."""
        if kinematics is None:
            raise DataError("Canonical() has as many coordinates as the robot has joints")
        return kinematics.n_joints

    def linearize(self, state: RobotState, frames: Mapping[str, Frame]) -> Linearization:
        """``q - q_{t-1} = mu - q_{t-1}``."""
        return Linearization(None, None, -state.joints)

    def coordinates(self, state: RobotState, frames: Mapping[str, Frame]) -> Tensor:
        """``q_t``."""
        return state.joints

    def quaternion_starts(self, kinematics: Kinematics | None) -> tuple[int, ...]:
        """Those of the joint vector: tracked poses have some, robots have none."""
        return () if kinematics is None else kinematics.quaternion_starts

    @property
    def determines_joints(self) -> bool:
        """Always."""
        return True
