"""Joints without links: what a model has when it is given no robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Self

import torch

from tpgmm_torch.robots.kinematics import Described, RobotState

__all__ = ["JointSpace"]


class JointSpace(Described):
    """Joints of those ``joint_names`` and nothing else: enough for :class:`Canonical` alone.

    ``dtype`` and ``device`` are those of its states.
    """

    def __init__(
        self,
        joint_names: Sequence[str],
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> None:
        self.joint_names = tuple(joint_names)
        self._config = {"joint_names": list(self.joint_names)}
        self.links = ()
        unbounded = torch.full((len(self.joint_names),), torch.inf, dtype=dtype, device=device)
        self.lower, self.upper, self.velocity = -unbounded, unbounded, unbounded

    def state(self, joints: Any) -> RobotState:
        """Return the state with no link in it; see :meth:`Kinematics.state`."""
        joints = self.joint_tensor(joints)
        shapes = (0, 3), (0, 4), (0, 6, self.n_joints)
        p, o, jacobians = (joints.new_zeros(*joints.shape[:-1], *shape) for shape in shapes)
        return RobotState(joints, (), p, o, jacobians, (), self.joint_names)

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """Invert ``config``."""
        return cls(config["joint_names"])

    def __repr__(self) -> str:
        return f"JointSpace({len(self.joint_names)} joints)"
