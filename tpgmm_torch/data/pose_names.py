"""Names of columns: their words, and poses, of which ``bottle.x`` to ``bottle.qz`` are one."""

from __future__ import annotations

import re
from collections.abc import Sequence

#: How the parts of a pose are called after its own name: metres, and (w, x, y, z).
POSE_PARTS = ("x", "y", "z", "qw", "qx", "qy", "qz")

_WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+")
_SILENT = {"k", "joint", "pos", "position", "motor"}
_SIDES = {"l": "left", "r": "right"}


def words(name: str) -> tuple[str, ...]:
    """Split a name in any spelling: ``kLeftElbow``, ``left_elbow_joint``, ``l_elbow``."""
    spelled = [word.lower() for word in _WORDS.findall(name)]
    spoken = tuple(_SIDES.get(word, word) for word in spelled if word not in _SILENT)
    return spoken or tuple(spelled)


def is_gripper(name: str) -> bool:
    """Check whether a joint's name is that of a gripper, which may have any unit.

    Parameters
    ----------
    name : str
        Of a joint or of a value of a data set.
    """
    words = "grip|finger|thumb|hand_?(pinky|ring|middle|index)|jaw|claw|suction"
    return re.search(words, name, re.IGNORECASE) is not None


def pose_groups(
    names: Sequence[str] | None, parts: tuple[str, ...] = POSE_PARTS
) -> dict[str, tuple[int, ...]]:
    """Find the positions of the seven parts of every pose among the names.

    A pose ``bottle`` is there when ``bottle.x``, ... ``bottle.qz`` (or ``bottle_x``, ...) are.

    Parameters
    ----------
    names : sequence of str or None
        Of columns; None has no poses.
    parts : tuple of str, default=POSE_PARTS
        Names of the parts.

    Returns
    -------
    dict of str to tuple of int
        By name of the pose, in the order of the parts.
    """
    positions = {name: i for i, name in enumerate(names or ())}
    groups = {}
    for name in positions:
        stem = name.removesuffix(parts[0])
        columns = [positions.get(stem + part, -1) for part in parts]
        if stem != name and stem.endswith((".", "_")) and min(columns) >= 0:
            groups[stem[:-1]] = tuple(columns)
    return groups


def quaternion_groups(names: Sequence[str] | None) -> list[tuple[int, ...]]:
    """Find the positions of (w, x, y, z) of every quaternion among the names.

    Parameters
    ----------
    names : sequence of str or None
        Of columns; None has no quaternions.
    """
    return list(pose_groups(names, POSE_PARTS[3:]).values())
