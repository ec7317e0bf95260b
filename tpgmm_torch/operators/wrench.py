"""Forces that a link exerts, seen from a frame, without rows in joint space.

Silverio, Huang, Rozo, Calinon, Caldwell, "Probabilistic Learning of Torque Controllers from
Kinematic and Force Constraints", IROS 2018, fuse forces of all axes at all times. Here they
count along axes on which the force does no work, and only as far as there is contact.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import KW_ONLY, dataclass

import torch
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.frames import Frame, Frames
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.operators.base import Linearization, Operator
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

__all__ = ["Wrench"]


@dataclass(frozen=True)
class Wrench(Operator):
    """Force that a link exerts, along axes of a frame, and whether the link is in contact.

    Local coordinates are the components of the force along the axes [N], and 1 in contact, 0
    without, so that their mean over time is the share of contact. It stands behind all other
    operators, has no rows in joint space, and changes no estimate of the joints: what uses it
    are :class:`~tpgmm_control.contact.Admittance` and controllers of torque.

    Parameters
    ----------
    link : str
        Link of which demonstrations have a wrench.
    frame : str
        Name of an object's frame, or of another link: its axes count.
    axes : sequence of int, optional
        0, 1, 2 for x, y, z. By default those along which the demonstrated force does no work,
        found by ``fit``: along the others it follows from the motion, as friction does.
    tolerance : float, default=0.05
        Standard deviation that is added to the local covariances [N]: the resolution of a
        force sensor.
    contact : float, default=1.5
        Size of the force from which on the link is in contact [N], ten times the noise of a
        usual sensor at the wrist; released at half of it.

    Raises
    ------
    DataError
        If an axis is not 0, 1 or 2, or ``contact`` is not above 0.

    Examples
    --------
    >>> from tpgmm_torch.operators import Wrench
    >>> Wrench("tool", "board", axes=[2])
    Wrench(link='tool', frame='board', axes=(2,), tolerance=0.05, contact=1.5)
    """

    link: str
    frame: str
    axes: tuple[int, ...] | None = None
    _: KW_ONLY
    tolerance: float = 0.05
    contact: float = 1.5

    def __post_init__(self) -> None:
        if self.axes is not None:
            listed = tuple(self.axes)
            if not listed or sorted({*listed} & {0, 1, 2}) != list(listed):
                raise DataError(
                    f"axes are some of 0, 1, 2 for x, y, z, ascending, got {self.axes!r}; "
                    "leave them out, and fit finds those along which the force does no work"
                )
            object.__setattr__(self, "axes", listed)
        if not 0 < self.contact < math.inf:
            raise DataError(f"contact is a force above 0 N, got {self.contact!r}")

    @property
    def constrains_joints(self) -> bool:
        """No."""
        return False

    def dimension(self, kinematics: Kinematics | None) -> int:
        """Return a force for each axis, and the contact."""
        return len(self._axes) + 1

    def linearize(self, state: RobotState, frames: Frames) -> Linearization:
        """No rows: joints that have moved do not say which force there is."""
        empty, batch = state.joints, state.joints.shape[:-1]
        jacobian = empty.new_zeros(*batch, 0, empty.shape[-1])
        matrix = empty.new_zeros(*batch, 0, self.dimension(None))
        return Linearization(jacobian, matrix, empty.new_zeros(*batch, 0))

    def coordinates(self, state: RobotState, frames: Frames) -> Tensor:
        """``e^T R^T f`` for each axis ``e``, and 1 where ``|f|`` reaches ``contact``.

        Raises
        ------
        UnknownNameError
            If no wrench of the link was measured.
        """
        if self.link not in state.wrenches:
            where = "the demonstration (Demonstration(..., wrenches={link: (T, 6)}))"
            raise UnknownNameError("wrench", self.link, where, state.wrenches)
        force = state.wrenches[self.link][..., :3]
        local = self.components(force, state, frames)
        touches = (force.norm(dim=-1, keepdim=True) >= self.contact).to(local)
        return torch.cat((local, touches.expand(*local.shape[:-1], 1)), -1)

    def pose(self, state: RobotState | None, frames: Frames) -> Frame:
        """Return the pose of the frame; only that of a link needs the state."""
        if state is not None and self.frame in state.links:
            return state.pose(self.frame)
        if self.frame not in frames:
            known = [*frames, *(() if state is None else state.links)]
            raise UnknownNameError("frame", self.frame, "the situation or the robot", known)
        return frames[self.frame]

    def directions(self, state: RobotState | None, frames: Frames) -> Tensor:
        """Return the axes (..., n_axes, 3) in the base frame."""
        rotation = quaternions.to_matrix(self.pose(state, frames).orientation)
        return rotation.mT[..., list(self._axes), :]

    def components(self, vector: Tensor, state: RobotState | None, frames: Frames) -> Tensor:
        """Components (..., n_axes) along the axes, of a vector (..., 3) in the base frame."""
        return (self.directions(state, frames) @ vector.unsqueeze(-1)).squeeze(-1)

    def tolerances(self, kinematics: Kinematics | None) -> tuple[float, ...]:
        """Return the tolerance for each axis; none of the contact."""
        return (*[self.tolerance] * len(self._axes), 0.0)

    def units(self, kinematics: Kinematics | None) -> tuple[str | None, ...]:
        """Newton; the contact is like no other."""
        return (*["N"] * len(self._axes), None)

    def links(self) -> tuple[str, ...]:
        """Return the link."""
        return (self.link,)

    def references(self) -> tuple[str, ...]:
        """Return the frame."""
        return (self.frame,)

    def text(self) -> str:
        """Write it as a term, see :meth:`Operator.text`."""
        axes = f"[{''.join(map('xyz'.__getitem__, self.axes))}]" if self.axes else ""
        return f"wrench{axes}:{self.link}@{self.frame}"

    def check(self, kinematics: Kinematics, frames: Collection[str]) -> None:
        """Check that link and frame exist, see :meth:`Operator.check`."""
        if self.link not in kinematics.links:
            raise UnknownNameError("link", self.link, "the robot", kinematics.links)
        super().check(kinematics, frames)

    @property
    def _axes(self) -> tuple[int, ...]:
        if self.axes is None:
            raise DataError(f"{self!r} has no axes yet: fit finds them, or give axes=[2]")
        return self.axes


@dataclass(frozen=True, eq=False)
class ExpectedForce:
    """The force that is expected at a time.

    Parameters
    ----------
    operator : Wrench
    force : Tensor of shape (..., n_axes)
        Along its axes [N].
    covariance : Tensor of shape (..., n_axes, n_axes)
        Its covariance [N^2].
    share : Tensor of shape (...)
        Of demonstrations that are in contact then, from 0 to 1.
    """

    operator: Wrench
    force: Tensor
    covariance: Tensor
    share: Tensor

    def scale(self, weight: Tensor) -> ExpectedForce:
        """Return the part of it that is expected with a weight (...)."""
        row = weight.unsqueeze(-1)
        force, covariance = row * self.force, row.unsqueeze(-1) * self.covariance
        return ExpectedForce(self.operator, force, covariance, weight * self.share)

    def plus(self, other: ExpectedForce) -> ExpectedForce:
        """Return the sum of two parts of the expectation of one operator."""
        force, covariance = self.force + other.force, self.covariance + other.covariance
        return ExpectedForce(self.operator, force, covariance, self.share + other.share)
