"""Roles of the columns of a table: joints, commands, poses, wrenches, events, counters."""

from __future__ import annotations

import re
import warnings
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tpgmm_torch.data.pose_names import POSE_PARTS, pose_groups
from tpgmm_torch.exceptions import DataError, PlausibilityWarning, UnknownNameError

if TYPE_CHECKING:
    import pandas as pd

    #: Episodes of a table, with what they are called.
    Parts = Sequence[tuple[Any, pd.DataFrame]]

EVENT, COVARIANCE, WRENCH, COMMAND = "event.", "covariance.", "wrench.", "command."
#: The column that may be missing.
EPISODE = "episode"
#: Where pandas keeps which columns are joints, among the attributes of a table.
JOINTS = "joints"
#: Fewer rows do not show that a column counts them.
FEWEST_COUNTED = 4
#: A column that changes per second by these, up to a share, is a clock (ns, us, ms, s).
CLOCKS, CLOCK_ERROR = (1e9, 1e6, 1e3, 1.0), 0.05
#: What is so called is no joint.
COUNTS = re.compile(
    r"(?i)((.*[._/])?(time_?stamp|stamp|seq|nanosec|nsecs?)|(.*stamp[._/])?secs?|time|clock|step"
    r"|tick|frame|index|(frame|episode|task|sample)_(index|id|nr))(_(s|ms|us|ns))?"
)
#: Columns of poses as ROS calls them.
ROS_POSE = re.compile(
    r"(?:(.*?)[./_])??(?:(?:pose|transform)[./_])*"
    r"(?:(?:position|translation)[./_](?P<x>[xyz])|(?:orientation|rotation)[./_](?P<q>[wxyz]))"
)
#: How pandas calls a column without a name.
UNNAMED = re.compile(r"(Unnamed: \d+)?")
#: Warnings name the line that called this package.
PACKAGE = str(Path(__file__).parent)


def check_columns(
    table: pd.DataFrame, joints: Sequence[str] | None, time: str, episode: str
) -> pd.DataFrame:
    """Rename columns as this package calls them, check them, and drop the empty ones.

    Parameters
    ----------
    table : pandas.DataFrame
        As somebody recorded it.
    joints : sequence of str or None
        Columns of the joints, where they are given.
    time, episode : str
        Columns of the time and the episode.

    Raises
    ------
    DataError, UnknownNameError
        If the table is empty, a column is missing or there twice, or a row has no episode.
    """
    joints = tuple(joints or ())
    table = _rename_columns(table, joints, time)
    _check_separated(table.columns)
    asked = () if episode == EPISODE else (episode,)
    for name in (time, *asked, *joints):
        if name not in table.columns:
            raise UnknownNameError("column", name, "the table", table.columns)
    if not len(table):
        raise DataError("the table has no rows")
    if episode in table.columns and table[episode].isna().any():
        raise DataError(f"column {episode!r} lacks a value: to which episode is that row?")
    return _drop_empty(table, {time, episode, *joints})


def _rename_columns(table: pd.DataFrame, joints: Sequence[str], time: str) -> pd.DataFrame:
    """Name columns by texts, each there once, and leave out empty rows."""
    if not hasattr(table, "columns"):
        raise DataError(f"a table is a pandas DataFrame, got {type(table).__name__}")
    if table.index.name == time:
        table = table.reset_index()
    kept = {*joints, *table.attrs.get(JOINTS, ())}
    table = table.rename(columns=lambda n: n if n in kept else _rename_ros_pose(str(n).strip()))
    table = table.dropna(how="all")
    _check_distinct(table.columns, kept)
    return table


def _rename_ros_pose(name: str) -> str:
    """Rename a column of a pose of ROS as this package calls it."""
    if match := ROS_POSE.fullmatch(name):
        return f"{(match[1] or 'pose').strip('/')}.{match['x'] or 'q' + match['q']}"
    return name


def _check_distinct(columns: pd.Index[Any], kept: Collection[str]) -> None:
    """Refuse two columns of one name, of which pandas calls the second NAME.1."""
    again = [name for name in columns if name not in kept and re.fullmatch(r".+\.\d+", name)]
    twice = {name for name in again if name.rpartition(".")[0] in columns}
    if twice := twice | {*columns[columns.duplicated()]}:
        raise DataError(f"the table has columns of one name: {sorted(twice)}")


def _check_separated(columns: pd.Index[Any]) -> None:
    """Refuse a table whose only column has a separator in its name."""
    if len(columns) == 1 and (found := re.findall(r"[,;\t]|\s+", columns[0])):
        message = f"the table has one column, {columns[0]!r}: its fields are separated by"
        raise DataError(f"{message} {found[0]!r}, pandas.read_csv(..., sep={found[0]!r})")


def _drop_empty(table: pd.DataFrame, known: Collection[str]) -> pd.DataFrame:
    """Drop columns of joints and poses without values, and warn of those with a name."""
    empty = [name for name in list_motion_columns(table, known) if table[name].isna().all()]
    if named := [name for name in empty if not UNNAMED.fullmatch(name)]:
        _warn(f"columns {named} of the table are empty, and left out")
    return table.drop(columns=empty)


def list_motion_columns(table: pd.DataFrame, known: Collection[str]) -> list[str]:
    """List the columns of joints and poses: all but the ``known``, events, commands, ...

    Parameters
    ----------
    table : pandas.DataFrame
        The table, or the rows of an episode.
    known : collection of str
        Columns that are something else.
    """
    others = EVENT, COVARIANCE, WRENCH, COMMAND
    return [n for n in table.columns if n not in known and not n.startswith(others)]


def find_joints(table: pd.DataFrame, parts: Parts, time: str, episode: str) -> list[str]:
    """Find the columns that are joints: those known to be, and those that are nothing else.

    Parameters
    ----------
    table : pandas.DataFrame
        From :func:`check_columns`.
    parts : sequence of (label, pandas.DataFrame)
        Its episodes, time in seconds.
    time, episode : str
        Columns of the time and the episode.

    Raises
    ------
    DataError
        If there are none, only a part of a pose, a column without a name, or a clock or counter
        among them.
    """
    columns = list_motion_columns(table, {time, episode})
    known = {name for name in columns if f"{COVARIANCE}{name}.{name}" in table.columns}
    known |= set(table.attrs.get(JOINTS, ()))
    rest = [name for name in columns if name not in known]
    taken = _drop_poses(rest)
    names = [name for name in columns if name in {*known, *taken}]
    if not names:
        other = f"{columns} are poses of frames or something else"
        raise DataError(f"the table has no joints: {other}. If some are, say so: joints=[...]")
    _check_joints(table, parts, taken, time)
    return names


def _drop_poses(names: list[str]) -> list[str]:
    """Return the names that are in no whole pose."""
    in_poses = {i for group in pose_groups(names).values() for i in group}
    return [name for i, name in enumerate(names) if i not in in_poses]


def _check_joints(table: pd.DataFrame, parts: Parts, names: list[str], time: str) -> None:
    """Refuse columns that cannot be joints, and warn of those that may count something."""
    for frame, missing in _find_incomplete_poses(names).items():
        raise DataError(
            f"the table has a part of the pose of {frame!r}, and no columns {list(missing)}: "
            "add them (1, 0, 0, 0 where it is not known), or say which are joints: joints=[...]"
        )
    even = _refuse_counters(parts, [n for n in names if table[n].dtype.kind in "iuf"], time)
    if unnamed := [name for name in names if UNNAMED.fullmatch(name)]:
        raise DataError(f"columns {unnamed} have no name: name or drop them, or joints=[...]")
    if even:
        asked = "are they joints (joints=[...]), or do they count something? Then drop them"
        _warn(f"columns {even} change by the same in every row: {asked}")


def _refuse_counters(parts: Parts, names: list[str], time: str) -> list[str]:
    """Refuse columns that count rows or tell the time; return those that change evenly."""
    counters = [name for name in names if COUNTS.fullmatch(name)]
    steady = {n: _classify_steps(parts, n, time) for n in names if n not in counters}
    if counters := [*counters, *(n for n, kind in steady.items() if kind == "counter")]:
        raise DataError(
            f"columns {counters} count the rows or tell the time, and are no joints: drop them "
            "(pandas: to_csv(..., index=False)), or say which are: joints=[...]"
        )
    return [name for name, kind in steady.items() if kind]


def _warn(message: str) -> None:
    warnings.warn(message, PlausibilityWarning, skip_file_prefixes=(PACKAGE,))


def _classify_steps(parts: Parts, name: str, time: str) -> str:
    """Return ``"counter"`` (a clock too), ``"evenly"`` if a column changes so, else ``""``."""
    steps = np.concatenate([np.diff(part[name].to_numpy(float)) for _, part in parts])
    if len(steps) < FEWEST_COUNTED - 1 or not steps[0]:
        return ""
    even = np.allclose(steps, steps[0], rtol=1e-6, atol=0)
    ticks = np.concatenate([np.diff(part[time].to_numpy(float)) for _, part in parts])
    rates = [rate for rate in CLOCKS if np.allclose(steps, rate * ticks, CLOCK_ERROR, 0)]
    return "counter" if rates or (even and steps[0] % 1 == 0) else "evenly" * even


def _find_incomplete_poses(names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Map each pose of which the names have a part to the columns that complete it.

    All of ``x``, ``y``, ``z``, or two of a quaternion's parts, count as a pose.
    """
    parts: dict[str, set[str]] = {}
    for name in names:
        if match := re.fullmatch(r"(.+[._])(x|y|z|qw|qx|qy|qz)", name, re.DOTALL):
            parts.setdefault(match[1], set()).add(match[2])
    return {
        stem[:-1]: tuple(stem + part for part in POSE_PARTS if part not in there)
        for stem, there in parts.items()
        if there != set(POSE_PARTS)
        and (there >= {"x", "y", "z"} or len(there & set(POSE_PARTS[3:])) > 1)
    }
