"""No robot: poses of tracked bodies are themselves the space of the mixture.

This is the TP-GMM of the paper's section II: what robots call the joint vector is the list
of the bodies' positions and quaternions, and a Gaussian in a coordinate frame becomes one
over them without a pseudo-inverse.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Self

import torch
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.frames import Frames
from tpgmm_torch.exceptions import DataError, ShapeError
from tpgmm_torch.robots.kinematics import Described, RobotState, parse_dtype

__all__ = ["Poses"]


class PosesState(RobotState):
    """The poses themselves, see :class:`RobotState`."""

    def quaternion_columns(self, link: str) -> slice | None:
        """Locate a body's quaternion in the joint vector; nowhere, of an object.

        Raises
        ------
        DataError
            If the poses were made without orientation.
        """
        if link not in self.robot_links:
            return None
        width = self.joints.shape[-1] // len(self.robot_links)
        if width == 3:
            raise DataError(
                f"link {link!r} has no orientation: the poses were made with orientation=False"
            )
        end = width * (self._index(link) + 1)
        return slice(end - 4, end)


class Poses(Described):
    """Tracked bodies in place of a robot: the joint vector holds their poses.

    Parameters
    ----------
    links : sequence of str, default=("left", "right")
        Names of the bodies.
    orientation : bool, default=True
        Whether the joint vector holds quaternions; otherwise positions alone.
    dtype, device : torch.dtype, torch.device or str
        Of the states; float64 on the CPU by default.

    Examples
    --------
    >>> Poses(["hand"]).joint_names
    ('hand.x', 'hand.y', 'hand.z', 'hand.qw', 'hand.qx', 'hand.qy', 'hand.qz')
    """

    def __init__(
        self,
        links: Sequence[str] = ("left", "right"),
        orientation: bool = True,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> None:
        if isinstance(links, str) or not links or len(set(links)) < len(links):
            raise DataError(f"links is a sequence of different names, got {links!r}")
        self.links = tuple(links)
        self.orientation = bool(orientation)
        name = str(dtype).removeprefix("torch.")
        self._config = {"links": list(links), "orientation": self.orientation, "dtype": name}
        parts = ("x", "y", "z", "qw", "qx", "qy", "qz")[: 7 if orientation else 3]
        self.joint_names = tuple(f"{link}.{part}" for link in self.links for part in parts)
        width, n = len(parts), self.n_joints
        self.quaternion_starts = tuple(range(3, n, width)) if orientation else ()
        self.lengths = tuple(i for i in range(n) if i % width < 3)
        # tensors made while inference mode is on could not serve where gradients are wanted
        with torch.inference_mode(False):
            unbounded = torch.full((n,), math.inf, dtype=dtype, device=device)
            self.lower, self.upper, self.velocity = -unbounded, unbounded, unbounded.clone()
            eye = torch.eye(n, dtype=dtype, device=device).reshape(-1, width, n)
            self._position_rows, self._quaternion_rows = eye[:, :3], eye[:, 3:]  # (L, ., n)

    def state(self, joints: Any) -> PosesState:
        """Read the poses in ``joints``, array-like of shape (..., n_joints).

        Quaternions need not have unit norm here: ``orientations`` have, ``joints`` are left.
        The angular Jacobian is ``2 Hbar*(conj eps)`` on the quaternion's columns, so that
        it gives the angular velocity of a quaternion that stays on the unit sphere.

        Raises
        ------
        ShapeError
            If the last dimension is not ``n_joints``.
        DataError
            If a value is not finite or a quaternion is zero.
        """
        joints = self.joint_tensor(joints)
        batch = joints.shape[:-1]
        poses = joints.reshape(*batch, len(self.links), self.n_joints // len(self.links))
        linear = self._position_rows.expand(*batch, -1, -1, -1)
        if self.orientation:
            orientations = quaternions.normalize(poses[..., 3:])
            turn = 2.0 * quaternions.vector_matrix(quaternions.conjugate(orientations))
            angular = turn @ self._quaternion_rows
        else:
            unit = quaternions.identity(joints.dtype, joints.device)
            orientations, angular = unit.expand(*poses.shape[:-1], 4), torch.zeros_like(linear)
        jacobians = torch.cat((linear, angular), dim=-2)
        names = self.joint_names
        parts = poses[..., :3], orientations, jacobians
        return PosesState(joints, self.links, *parts, joint_names=names)

    def retract(self, joints: Tensor) -> Tensor:
        """Bring the quaternions in (..., n_joints) back to unit norm."""
        if not self.orientation:
            return joints
        poses = joints.reshape(*joints.shape[:-1], len(self.links), 7)
        unit = quaternions.normalize(poses[..., 3:])
        return torch.cat((poses[..., :3], unit), dim=-1).flatten(-2)

    @classmethod
    def joints(cls, poses: Frames, orientation: bool = True) -> Tensor:
        """Join recorded poses to joint vectors (T, n_joints), or (n_joints,).

        Parameters
        ----------
        poses : mapping of str to Frame
            One recording per link, all of one leading shape.
        orientation : bool, default=True
            As in the constructor.

        Returns
        -------
        Tensor of shape (T, n_joints)
            The columns of ``Poses(tuple(poses), orientation)``; quaternions change their
            sign nowhere along time. Poses of leading shape () give (n_joints,).

        Raises
        ------
        ShapeError
            If the recordings differ in length.
        """
        shapes = {name: tuple(frame.batch_shape) for name, frame in poses.items()}
        if len(set(shapes.values())) != 1 or max(map(len, shapes.values())) > 1:
            raise ShapeError(f"poses need one common leading shape, (T,) or (), got {shapes}")
        columns: list[Tensor] = []
        for frame in poses.values():
            columns.append(frame.position)
            if orientation:
                turn = frame.orientation
                columns.append(quaternions.continuous(turn) if turn.ndim > 1 else turn)
        return torch.cat(columns, dim=-1)

    @classmethod
    def from_config(cls, config: Mapping[str, Any], device: torch.device | str = "cpu") -> Self:
        """Make the poses that gave this ``config``."""
        cls._check_keys(config, "links", "orientation", "dtype")
        dtype = parse_dtype(config["dtype"])
        return cls(config["links"], config["orientation"], dtype, device)

    def __repr__(self) -> str:
        return f"Poses(links={self.links}, orientation={self.orientation})"
