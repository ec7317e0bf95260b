"""Names of values: as data sets spell them, and as a robot does."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tpgmm_datasets.errors import DatasetError
from tpgmm_torch.data.pose_names import POSE_PARTS, pose_groups, quaternion_groups, words

__all__ = ["POSE_PARTS", "match_names", "pose_groups", "quaternion_groups", "value_names"]


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


JOINT_NAMES = (
    "Give joint_names={'name in the data set': 'joint of the robot', ...} (--joint-name "
    "STORED=JOINT)"
)


def match_names(
    wanted: Sequence[str],
    present: Sequence[str],
    column: str,
    remedy: str = JOINT_NAMES,
    kind: str = "the robot's joint",
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
        fits = [name] if name in present else [p for p in present if words(p) == words(name)]
        fits = [fit for fit in fits if fit not in matched]
        if len(fits) != 1:
            what = f"fits several values, {fits}" if fits else "is none of the values"
            message = f"{kind} {name!r} {what}; they are called {list(present)}. {remedy}"
            raise DatasetError(message, column=column)
        matched[fits[0]] = name
    return matched
