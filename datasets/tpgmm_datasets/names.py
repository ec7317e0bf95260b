"""Names of values: as data sets spell them, and as a robot does."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

from tpgmm_datasets.errors import DatasetError
from tpgmm_torch.data.pose_names import words

#: Groups, name and position of a value.
Leaf = tuple[tuple[str, ...], Any, Any]


def value_names(
    names: Any, width: int, key: str = "", distinct: bool = True
) -> tuple[tuple[str, ...] | None, str]:
    """Flatten the names of a feature's values as ``info.json`` gives them.

    Parameters
    ----------
    names : list, dict or None
        A list, lists in lists, groups ``{"left": [...], "right": [...]}``, or name to position.
        A name that several groups have is put behind its group's.
    width : int
        How many values the feature has.
    key : str
        Name of the feature: a list of nothing but its last word names no value.
    distinct : bool, default=True
        Whether each may be there once only.

    Returns
    -------
    tuple of str or None
        A name for each value; None if they are missing or cannot be used.
    str
        Why they cannot be used; empty if they can, or are missing.
    """
    leaves = list(_list_leaves(names)) if names else []
    if not leaves or (len(leaves) == 1 < width and leaves[0][1] in re.split(r"[./]", key)):
        return None, ""
    try:
        leaves = _sort_by_position(leaves)
        bare = [name for _, name, _ in leaves]
        _check_names(bare, width)
        return tuple(_prefix_shared(leaves) if distinct else bare), ""
    except ValueError as problem:
        return None, str(problem)


def _list_leaves(names: Any) -> Iterator[Leaf]:
    """Yield groups, name and position (None where none is given), to any depth."""
    rest: list[Leaf] = [((), names, None)]
    while rest:
        groups, name, place = rest.pop()
        if isinstance(name, list):
            rest += [(groups, value, None) for value in reversed(name)]
        elif isinstance(name, dict):
            rest += [
                ((*groups, k), v, None) if isinstance(v, dict | list) else (groups, k, v)
                for k, v in reversed(name.items())
            ]
        else:
            yield groups, name, place


def _sort_by_position(leaves: list[Leaf]) -> list[Leaf]:
    positions = [position for *_, position in leaves if position is not None]
    if not positions:
        return leaves
    counts = [[*range(first, len(leaves) + first)] for first in (0, 1)]
    if {*map(type, positions)} != {int} or sorted(positions) not in counts:
        raise ValueError(f"the positions of the names, {positions}, do not count the values")
    return sorted(leaves, key=lambda leaf: leaf[2])


def _check_names(names: list[Any], width: int) -> None:
    for name in names:
        if not isinstance(name, str) or not name.strip():
            raise ValueError(f"{name!r} is no name, of {names}")
    if len(names) != width:
        raise ValueError(f"{len(names)} names for {width} values, {names}")


def _prefix_shared(leaves: list[Leaf]) -> list[str]:
    """Put the group's name before names that several groups have."""
    bare = [name for _, name, _ in leaves]
    flat = ["_".join((*g, n)) if bare.count(n) > 1 else n for g, n, _ in leaves]
    if twice := [i for i, name in enumerate(flat) if flat.count(name) > 1]:
        raise ValueError(f"{bare[twice[0]]!r} is there twice, of {bare}")
    return flat


#: What can be said where names do not match, and where there are none that can be used.
JOINT_NAMES = (
    "Give joint_names={'name in the data set': 'joint of the robot', ...} (--joint-name "
    "STORED=JOINT)"
)
NAME_ALL = (
    "Name all values in order, joint_names=['...', ...] (--joint-name NAME,NAME,...), or "
    "say that they are the robot's joints in its order, joint_names='robot' (--joint-name "
    "robot)"
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
            what = f"fits several values, {fits}" if fits else "is not among the values"
            message = f"{kind} {name!r} {what}; they are called {list(present)}. {remedy}"
            raise DatasetError(message, column=column)
        matched[fits[0]] = name
    return matched
