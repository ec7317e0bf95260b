"""Poses among named columns: ``bottle.x`` to ``bottle.qz`` are one."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

__all__ = ["POSE_PARTS", "pose_groups", "quaternion_groups"]

#: How the parts of a pose are called after its own name: metres, and (w, x, y, z).
POSE_PARTS = ("x", "y", "z", "qw", "qx", "qy", "qz")


def pose_groups(names: Sequence[str] | None) -> dict[str, tuple[int, ...]]:
    """Positions of the seven parts of every pose that the names tell of.

    A pose ``bottle`` is there when ``bottle.x``, ... ``bottle.qz`` (or ``bottle_x``, ...) are.

    Parameters
    ----------
    names : sequence of str or None
        Of columns; None has no poses.

    Returns
    -------
    dict of str to tuple of int
        By name of the pose, in the order of :data:`POSE_PARTS`.
    """
    return _groups(names, POSE_PARTS)


def quaternion_groups(names: Sequence[str] | None) -> list[tuple[int, ...]]:
    """Positions of (w, x, y, z) of every quaternion that the names tell of.

    Parameters
    ----------
    names : sequence of str or None
        Of columns; None has no quaternions.
    """
    return list(_groups(names, POSE_PARTS[3:]).values())


def _groups(names: Sequence[str] | None, parts: tuple[str, ...]) -> dict[str, tuple[int, ...]]:
    positions: Mapping[str, int] = {name: i for i, name in enumerate(names or ())}
    groups = {}
    for name in positions:
        match = re.fullmatch(rf"(.*)([._]){parts[0]}", name, re.DOTALL)
        if match:
            stem = match[1] + match[2]
            if all(stem + part in positions for part in parts):
                groups[match[1]] = tuple(positions[stem + part] for part in parts)
    return groups
