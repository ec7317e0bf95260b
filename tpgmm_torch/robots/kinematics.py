"""Kinematics: where the links are at a joint vector, and how they move with it.

:class:`Kinematics` is what the operators need of a robot and what a user's own robot
derives from. Positions are in metres, joints in radians (or metres, where they slide),
quaternions ``(w, x, y, z)``, Jacobians geometric and in the base frame, linear rows above
angular rows.
"""

from __future__ import annotations

import abc
import copy
from dataclasses import dataclass, replace
from typing import Any, Self

import torch
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import as_tensor
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError

__all__ = ["Kinematics", "RobotState", "dtype_name", "dtype_named"]

DTYPES = {"float32": torch.float32, "float64": torch.float64}


def dtype_named(name: Any) -> torch.dtype:
    """The dtype of a robot by ``name``, ``"float32"`` or ``"float64"``.

    Raises
    ------
    DataError
        If it is another.
    """
    if name not in DTYPES:
        raise DataError(f"a robot's dtype is one of {list(DTYPES)}, got {name!r}")
    return DTYPES[name]


def dtype_name(dtype: torch.dtype) -> str:
    """The inverse of :func:`dtype_named`, for a ``dtype`` that a robot can have."""
    name = str(dtype).removeprefix("torch.")
    dtype_named(name)
    return name


@dataclass(frozen=True, eq=False)
class RobotState:
    """A robot at one joint vector q_{t-1}: having one means that the kinematics have run.

    Parameters
    ----------
    joints : Tensor of shape (..., n_joints)
        The joint vector [rad or m].
    links : tuple of str
        Names of the L links that follow.
    positions : Tensor of shape (..., L, 3)
        Origins of the links in the base frame [m].
    orientations : Tensor of shape (..., L, 4)
        Unit quaternions of the links in the base frame.
    jacobians : Tensor of shape (..., L, 6, n_joints)
        Geometric Jacobians in the base frame: velocity, then angular velocity.
    """

    joints: Tensor
    links: tuple[str, ...]
    positions: Tensor
    orientations: Tensor
    jacobians: Tensor

    def position(self, link: str) -> Tensor:
        """``x_{t-1}`` of a link [m], shape (..., 3)."""
        return self.positions[..., self._index(link), :]

    def orientation(self, link: str) -> Tensor:
        """``eps_{t-1}`` of a link, unit quaternion of shape (..., 4)."""
        return self.orientations[..., self._index(link), :]

    def linear_jacobian(self, link: str) -> Tensor:
        """``J_p`` of a link: velocity per joint velocity, shape (..., 3, n_joints)."""
        return self.jacobians[..., self._index(link), :3, :]

    def angular_jacobian(self, link: str) -> Tensor:
        """``J_o`` of a link: angular velocity per joint velocity, shape (..., 3, n_joints)."""
        return self.jacobians[..., self._index(link), 3:, :]

    def orientation_map(self, link: str, gain: float) -> tuple[Tensor, Tensor, Tensor]:
        """What it takes to turn a ``link`` to a wanted orientation ``eps`` (eq. 11).

        ``jacobian (q - q_{t-1}) = matrix eps + offset``: here the Jacobian is ``J_o``, the
        matrix ``gain * Hbar*(conj eps_{t-1})``, the offset 0. A ``gain`` of 2 asks for the
        whole rotation vector to first order, 1 is the text of eq. (7).

        Returns
        -------
        jacobian : Tensor of shape (..., m, n_joints)
        matrix : Tensor of shape (..., m, 4)
        offset : Tensor of shape (..., m)
            Here m = 3.
        """
        orientation = self.orientation(link)
        matrix = gain * quaternions.vector_matrix(quaternions.conjugate(orientation))
        return self.angular_jacobian(link), matrix, torch.zeros_like(orientation[..., 1:])

    def __getitem__(self, index: Any) -> Self:
        """Select along the leading dimensions."""
        return replace(
            self,
            joints=self.joints[index],
            positions=self.positions[index],
            orientations=self.orientations[index],
            jacobians=self.jacobians[index],
        )

    def _index(self, link: str) -> int:
        if link not in self.links:
            raise UnknownNameError("link", link, "the state", self.links)
        return self.links.index(link)


class Kinematics(abc.ABC):
    """What the operators need of a robot; derive from it to bring your own.

    A subclass sets the attributes below and defines :meth:`state`, nothing else. It must not
    change afterwards: models share one robot instead of copying it. To be saved with a
    model it needs ``config()``, a dict for JSON, and a classmethod ``from_config(dict)``.

    Attributes
    ----------
    joint_names : tuple of str
        Names of the n coordinates of the joint vector.
    links : tuple of str
        Names of the links in its states.
    lower, upper, velocity : Tensor of shape (n_joints,)
        Limits of position and speed, infinite where unknown. Their dtype and device are
        those of the robot.
    quaternion_starts : tuple of int, default=()
        Where unit quaternions start in the joint vector; robots have none.

    Examples
    --------
    >>> import torch
    >>> class Slider(Kinematics):
    ...     joint_names, links = ("slide",), ("tip",)
    ...     lower, upper, velocity = torch.tensor([[0.0], [1.0], [0.5]], dtype=torch.float64)
    ...
    ...     def state(self, joints):
    ...         q = self.joint_tensor(joints)
    ...         positions = torch.nn.functional.pad(q, (0, 2))[..., None, :]
    ...         orientations = torch.eye(4, dtype=q.dtype)[:1].expand(*q.shape[:-1], 1, 4)
    ...         jacobians = torch.eye(6, 1, dtype=q.dtype).expand(*q.shape[:-1], 1, 6, 1)
    ...         return RobotState(q, self.links, positions, orientations, jacobians)
    >>> Slider().state([0.2]).position("tip").tolist()
    [0.2, 0.0, 0.0]
    """

    joint_names: tuple[str, ...]
    links: tuple[str, ...]
    lower: Tensor
    upper: Tensor
    velocity: Tensor
    quaternion_starts: tuple[int, ...] = ()

    @property
    def n_joints(self) -> int:
        """Number of coordinates of the joint vector."""
        return len(self.joint_names)

    @abc.abstractmethod
    def state(self, joints: Any) -> RobotState:
        """Run the kinematics at ``joints``, array-like of shape (..., n_joints).

        :meth:`joint_tensor` converts and checks them.
        """

    def retract(self, joints: Tensor) -> Tensor:
        """Bring (..., n_joints) back onto the joint manifold after a linear step: identity."""
        return joints

    def joint_tensor(self, joints: Any) -> Tensor:
        """Convert joint vectors to the robot's dtype and device.

        Raises
        ------
        ShapeError
            If the last dimension is not ``n_joints``.
        DataError
            If a value is not finite.
        """
        tensor = as_tensor(joints, "joints").to(self.lower.device, self.lower.dtype)
        if tensor.ndim == 0 or tensor.shape[-1] != self.n_joints:
            raise ShapeError(
                f"joints has shape (..., {self.n_joints}) for the joints "
                f"{list(self.joint_names)}, got {tuple(tensor.shape)}"
            )
        return tensor

    def to(
        self, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> Self:
        """The same kinematics in another dtype or on another device; itself if none changes."""
        other = copy.copy(self)
        for name in {*vars(self), "lower", "upper", "velocity"}:
            value = getattr(self, name)
            if isinstance(value, Tensor):
                wanted = dtype if value.is_floating_point() else None
                setattr(other, name, value.to(device=device, dtype=wanted))
        return other

    def __sklearn_clone__(self) -> Self:
        return self
