"""Robots of pytorch_kinematics, whose readers know URDF, MJCF and SDF."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.robots.urdf import UrdfJoint, write_urdf


def chain_to_urdf(chain: Any) -> str:
    """Write a URDF that moves as a chain of pytorch_kinematics does.

    Parameters
    ----------
    chain : pytorch_kinematics.Chain
        Its frames become links, under a root ``world``; its joints keep their order.

    Raises
    ------
    DataError
        If it is no chain.
    """
    try:
        root = chain.find_frame(chain.idx_to_frame[0])
        frames = [("world", root)]
    except (AttributeError, KeyError) as error:
        raise DataError(f"expected a pytorch_kinematics.Chain, got {chain!r}") from error
    joints: list[UrdfJoint] = []
    while frames:
        parent, frame = frames.pop()
        joint, pose = frame.joint, _matrix(frame.link.offset) @ _matrix(frame.joint.offset)
        kind, axis = joint.joint_type, as_array(joint.axis)
        axis = axis / np.linalg.norm(axis)
        name = f"{frame.name}_mount" if kind == "fixed" else joint.name
        lower, upper = _ends(joint.limits)
        velocity = _ends(joint.velocity_limits)[1]
        if kind == "revolute" and math.isinf(upper):
            kind = "continuous"
        joints.append(
            UrdfJoint(
                name,
                kind,
                parent,
                frame.name,
                pose,
                axis / np.linalg.norm(axis),
                lower,
                upper,
                velocity,
            )
        )
        frames += [(frame.name, child) for child in reversed(frame.children)]
    return write_urdf(root.name, "world", joints)


def _matrix(offset: Any) -> Array:
    return np.eye(4) if offset is None else as_array(offset.get_matrix()[0])


def _ends(limits: Any) -> tuple[float, float]:
    """Read a range, unlimited for a single point, which readers make of one not given."""
    lower, upper = (-math.inf, math.inf) if limits is None else map(float, limits)
    return (lower, upper) if lower < upper else (-math.inf, math.inf)
