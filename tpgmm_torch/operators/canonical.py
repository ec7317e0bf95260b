"""Configuration-space constraints: the first row of Table I."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import lru_cache

import torch
from torch import Tensor

from tpgmm_torch.data.frames import Frames
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.operators.base import Linearization, Operator
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

__all__ = ["Canonical"]


@dataclass(frozen=True)
class Canonical(Operator):
    """The joints themselves: ``A = I``, ``b = 0``; local data are ``q_t`` (section III-C).

    Some of the joints alone, where ``joints`` names them: ``J`` is then their rows of the
    identity.

    Parameters
    ----------
    tolerance : float, default=0.005
        Standard deviation that is added to the local covariances [rad or m; of quaternions,
        the angle in rad]. In a few
        demonstrations the joints seem to keep relations exactly that they keep by chance, or
        only near the demonstrated situations; these would contradict the task elsewhere.
        0 takes them at their word, as the paper does.
    joints : sequence of str, optional
        Which of the robot's joints, by name or patterns like ``"left_*"``, in the robot's
        order; all of them by default. Tracked poses have all four coordinates of a quaternion
        or none.

    Raises
    ------
    DataError
        If ``joints`` is no sequence of names.

    Examples
    --------
    >>> from tpgmm_torch import Canonical
    >>> Canonical()
    Canonical(tolerance=0.005, joints=None)
    >>> Canonical(joints=["left_*"]).columns(["waist", "left_elbow", "left_wrist"])
    (1, 2)
    """

    tolerance: float = 0.005
    joints: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if self.joints is None:
            return
        given = self.joints
        listed = () if isinstance(given, str) else tuple(given)
        if not listed or not all(isinstance(name, str) for name in listed):
            raise DataError(
                f"joints is a sequence of at least one name or pattern, got {given!r}; "
                "leave it out for all joints"
            )
        object.__setattr__(self, "joints", listed)

    def columns(self, joint_names: Sequence[str]) -> tuple[int, ...]:
        """List the indices of its joints in the joint vector.

        Parameters
        ----------
        joint_names : sequence of str
            Of the robot.

        Raises
        ------
        UnknownNameError
            If a name or pattern fits none of them.
        """
        if self.joints is None:
            return tuple(range(len(joint_names)))
        return _columns(self.joints, tuple(joint_names))

    def tolerances(self, kinematics: Kinematics | None) -> tuple[float, ...]:
        """Return the tolerance of every joint; half of it for parts of a quaternion."""
        tolerances = [self.tolerance] * self.dimension(kinematics)
        for start in self.quaternion_starts(kinematics):
            tolerances[start : start + 4] = [self.tolerance / 2] * 4
        return tuple(tolerances)

    def units(self, kinematics: Kinematics | None) -> tuple[str | None, ...]:
        """Metres and radians; a gripper's share or a part of a quaternion is like no other."""
        if kinematics is None:
            return super().units(kinematics)
        known = dict.fromkeys(kinematics.lengths, "m") | dict.fromkeys(kinematics.angles, "rad")
        return tuple(map(known.get, self.columns(kinematics.joint_names)))

    def dimension(self, kinematics: Kinematics | None) -> int:
        """Return the number of joints."""
        if kinematics is None:
            raise DataError("Canonical() has as many coordinates as the robot has joints")
        return len(self.columns(kinematics.joint_names))

    def linearize(self, state: RobotState, frames: Frames) -> Linearization:
        """``q - q_{t-1} = mu - q_{t-1}``, or those of its rows that are named."""
        joints = self.coordinates(state, frames)
        if self.joints is None:
            return Linearization(None, None, -joints)
        n = state.joints.shape[-1]
        identity = torch.eye(n, dtype=joints.dtype, device=joints.device)
        rows = identity[list(self.columns(state.joint_names))]
        return Linearization(rows.expand(*joints.shape, n), None, -joints)

    def coordinates(self, state: RobotState, frames: Frames) -> Tensor:
        """``q_t``."""
        if self.joints is None:
            return state.joints
        if len(state.joint_names) != state.joints.shape[-1]:
            raise DataError(
                f"{self!r} looks joints up by name, and the state has {len(state.joint_names)} "
                f"names for {state.joints.shape[-1]} joints: the kinematics' state() has to "
                "pass joint_names to RobotState"
            )
        return state.joints[..., list(self.columns(state.joint_names))]

    def quaternion_starts(self, kinematics: Kinematics | None) -> tuple[int, ...]:
        """Those of the joint vector: tracked poses have some, robots have none."""
        if kinematics is None:
            return ()
        columns = self.columns(kinematics.joint_names)
        starts = []
        for start in kinematics.quaternion_starts:
            parts = [column for column in columns if start <= column < start + 4]
            if parts and len(parts) < 4:
                names = kinematics.joint_names[start : start + 4]
                raise DataError(
                    f"{self!r} has some of the coordinates {list(names)} of a quaternion: "
                    "name all four, or none"
                )
            if parts:
                starts.append(columns.index(start))
        return tuple(starts)

    def text(self) -> str:
        """Write it as a term, see :meth:`Operator.text`."""
        return "canonical" if self.joints is None else f"canonical:{','.join(self.joints)}"

    def check(self, kinematics: Kinematics, frames: Collection[str]) -> None:
        """Check that its joints exist, and that no quaternion is cut.

        Raises
        ------
        UnknownNameError, DataError
            If they do not, or one is.
        """
        self.quaternion_starts(kinematics)

    @property
    def is_posture(self) -> bool:
        """Yes."""
        return True

    @property
    def determines_joints(self) -> bool:
        """If it has all of them."""
        return self.joints is None


@lru_cache(maxsize=256)
def _columns(patterns: tuple[str, ...], names: tuple[str, ...]) -> tuple[int, ...]:
    fits = {
        pattern: [i for i, n in enumerate(names) if n == pattern or fnmatchcase(n, pattern)]
        for pattern in patterns
    }
    for pattern, found in fits.items():
        if not found:
            raise UnknownNameError("joint", pattern, "the robot", names)
    return tuple(sorted({column for found in fits.values() for column in found}))
