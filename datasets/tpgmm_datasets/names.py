"""Names of values: as data sets spell them, and as a robot does."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from tpgmm_datasets.errors import DatasetError

__all__ = ["POSE_PARTS", "match_names", "pose_groups", "quaternion_groups", "value_names"]

#: How the parts of a pose are called after its own name: metres, and (w, x, y, z).
POSE_PARTS = ("x", "y", "z", "qw", "qx", "qy", "qz")

_WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+")
_SILENT = {"k", "joint", "pos", "position", "motor"}
_SIDES = {"l": "left", "r": "right"}


def value_names(names: Any, width: int, distinct: bool = True) -> tuple[str, ...] | None:
    """Flatten what ``info.json`` gives as names of a feature's values.

    Parameters
    ----------
    names : list, dict or None
        A flat list, a list in a list, ``{"motors": [...]}``, or name to position.
    width : int
        How many values the feature has.
    distinct : bool, default=True
        Whether repeated names count as none.

    Returns
    -------
    tuple of str or None
        None where there is no name for each value.
    """
    if isinstance(names, dict):
        if names and all(type(value) is int for value in names.values()):
            names = sorted(names, key=lambda name: names[name])
        else:
            names = list(names.values())
    while isinstance(names, list) and len(names) == 1 and isinstance(names[0], list):
        names = names[0]
    if not isinstance(names, list) or len(names) != width:
        return None
    if not all(isinstance(name, str) for name in names):
        return None
    if distinct and len(set(names)) < width:
        return None
    return tuple(names)


def _words(name: str) -> tuple[str, ...]:
    """Words of a name in any spelling: ``kLeftElbow``, ``left_elbow_joint``, ``l_elbow``."""
    words = [word.lower() for word in _WORDS.findall(name)]
    spoken = tuple(_SIDES.get(word, word) for word in words if word not in _SILENT)
    return spoken or tuple(words)


JOINT_NAMES = "Give joint_names={'name in the data set': 'joint of the robot', ...}"


def match_names(
    wanted: Sequence[str], present: Sequence[str], column: str, remedy: str = JOINT_NAMES
) -> dict[str, str]:
    """Find each wanted name among those present, whatever the spelling.

    An equal name comes first; else the one with the same words, where ``k`` and ``joint`` and
    ``pos`` say nothing and ``l``, ``r`` are left and right.

    Returns
    -------
    dict of str to str
        Present name to wanted name.

    Raises
    ------
    DatasetError
        If a name is found nowhere or fits several.
    """
    matched: dict[str, str] = {}
    for name in wanted:
        fits = [name] if name in present else [p for p in present if _words(p) == _words(name)]
        fits = [fit for fit in fits if fit not in matched]
        if len(fits) != 1:
            what = f"fits several values, {fits}" if fits else "is none of the values"
            raise DatasetError(
                f"the robot's joint {name!r} {what}; they are called {list(present)}. {remedy}",
                column=column,
            )
        matched[fits[0]] = name
    return matched


def pose_groups(names: Sequence[str] | None) -> dict[str, tuple[int, ...]]:
    """Positions of the seven parts of every pose that the names tell of.

    A pose ``bottle`` is there when ``bottle.x``, ... ``bottle.qz`` (or ``bottle_x``, ...) are.

    Returns
    -------
    dict of str to tuple of int
        By name of the pose, in the order of :data:`POSE_PARTS`.
    """
    return _groups(names, POSE_PARTS)


def quaternion_groups(names: Sequence[str] | None) -> list[tuple[int, ...]]:
    """Positions of (w, x, y, z) of every quaternion that the names tell of."""
    return list(_groups(names, POSE_PARTS[3:]).values())


def _groups(names: Sequence[str] | None, parts: tuple[str, ...]) -> dict[str, tuple[int, ...]]:
    positions: Mapping[str, int] = {name: i for i, name in enumerate(names or ())}
    groups = {}
    for name in positions:
        match = re.fullmatch(rf"(.*)([._]){parts[0]}", name)
        if match:
            stem = match[1] + match[2]
            if all(stem + part in positions for part in parts):
                groups[match[1]] = tuple(positions[stem + part] for part in parts)
    return groups
