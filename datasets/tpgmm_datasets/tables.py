"""Demonstrations and trajectories as flat tables of pandas, and back; CSV and parquet.

A row is a time step. The columns are ``episode``, ``time`` [s], the joints by name, the seven
numbers of each frame (``bottle.x``, ``bottle.y``, ``bottle.z`` [m], ``bottle.qw`` to
``bottle.qz``), the wrench of each link (``wrench.tool.fx`` to ``wrench.tool.fz`` [N] and
``wrench.tool.tx`` to ``wrench.tool.tz`` [N m]), the time of each event (``event.close`` [s],
the same in all rows of an episode) and, of trajectories, the upper triangle of the joints'
covariance (``covariance.elbow.wrist``).
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from tpgmm_torch.atomic import open_whole, replacing
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import Demonstration, check_demonstrations
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.pose_names import POSE_PARTS, pose_groups
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.exceptions import (
    DataError,
    DependencyError,
    PlausibilityWarning,
    UnknownNameError,
)

if TYPE_CHECKING:
    import pandas as pd

__all__ = [
    "demonstrations_from_frame",
    "demonstrations_to_frame",
    "numbers",
    "read_table",
    "trajectories_to_frame",
    "write_table",
]

EVENT, COVARIANCE, WRENCH = "event.", "covariance.", "wrench."
#: What a column of a wrench is, behind its link.
WRENCH_PARTS = ("fx", "fy", "fz", "tx", "ty", "tz")
#: The column that may be missing.
EPISODE = "episode"
#: Where pandas keeps which columns are joints, among the attributes of a table.
JOINTS = "joints"
#: Fewer rows do not show that a column counts them.
FEWEST_COUNTED = 4
#: A column that changes per second by these, up to a share, is a clock (ns, us, ms, s).
CLOCKS, CLOCK_ERROR = (1e9, 1e6, 1e3, 1.0), 0.05
#: Times from here on are since 1970, in this unit.
SINCE_1970 = {"ns": 1e17, "us": 1e14, "ms": 1e11}
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
#: How a text begins that spreadsheets take for a formula.
FORMULA = re.compile(r"'*[=+@\t\r-]")
#: How pandas calls a column without a name.
UNNAMED = re.compile(r"(Unnamed: \d+)?")
#: Rows times columns beyond which a table is not read.
MOST_NUMBERS = 2e7


def demonstrations_to_frame(demonstrations: Sequence[Demonstration]) -> pd.DataFrame:
    """One row per time step of each demonstration.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
        They may differ in events: what a demonstration does not have is NaN. Joints without
        names are called by their number.

    Returns
    -------
    pandas.DataFrame
        With the columns of this module's description.

    Raises
    ------
    DataError
        If the demonstrations are not alike, or two columns would have one name.
    DependencyError
        If there is no pandas.

    Examples
    --------
    >>> shown = Demonstration(
    ...     [0.0, 0.5], [[0.0], [1.0]], {"cup": Frame([0.4, 0, 0])}, ["elbow"], {"close": 0.5}
    ... )
    >>> table = demonstrations_to_frame([shown])
    >>> table[["episode", "time", "elbow", "cup.x", "event.close"]].values.tolist()
    [[0.0, 0.0, 0.0, 0.4, 0.5], [0.0, 0.5, 1.0, 0.4, 0.5]]
    """
    checked = check_demonstrations(demonstrations)
    parts = [
        _columns(episode, one, one.frames)
        | _wrench_columns(one)
        | {f"{EVENT}{name}": np.full(len(one), at) for name, at in one.events.items()}
        for episode, one in enumerate(checked)
    ]
    return _table(parts, checked[0])


def trajectories_to_frame(
    trajectories: Sequence[Trajectory], frames: Sequence[Mapping[str, Frame]] | None = None
) -> pd.DataFrame:
    """One row per time step of each trajectory, with the covariance of its joints.

    Parameters
    ----------
    trajectories : sequence of Trajectory
        Of one model.
    frames : sequence of mapping of str to Frame, optional
        The frames of the situation of each, constant or one per time step.

    Returns
    -------
    pandas.DataFrame
        With the columns of this module's description.

    Raises
    ------
    DataError
        If the list is empty, or ``frames`` are not as many, or two columns would have one name.
    DependencyError
        If there is no pandas.
    """
    if not trajectories:
        raise DataError("expected at least one trajectory, got none")
    situations: Sequence[Mapping[str, Frame]] = frames or [{}] * len(trajectories)
    if len(situations) != len(trajectories):
        counts = f"{len(trajectories)} trajectories, and frames of {len(situations)}"
        raise DataError(f"there are {counts}")
    parts = []
    for episode, (one, poses) in enumerate(zip(trajectories, situations, strict=True)):
        rows, columns = np.triu_indices(len(one.joint_names))
        upper = as_array(one.covariance)[:, rows, columns]
        names = covariance_names(one.joint_names)
        parts.append(_columns(episode, one, poses) | dict(zip(names, upper.T, strict=True)))
    return _table(parts, trajectories[0])


def demonstrations_from_frame(
    table: pd.DataFrame,
    *,
    joints: Sequence[str] | None = None,
    time: str = "time",
    episode: str = EPISODE,
) -> list[Demonstration]:
    """The demonstrations in a table.

    Parameters
    ----------
    table : pandas.DataFrame
        Rows of an episode in order of time. A pose that is the same in all rows of an episode
        becomes a constant frame; a column that is NaN throughout an episode is not in its
        demonstration.
    joints : sequence of str, optional
        Columns of the joints [rad or m], where not all columns that are nothing else are meant,
        or where they look like poses, as those of tracked hands do.
    time : str, default="time"
        Column of the time [s].
    episode : str, default="episode"
        Column that tells episodes apart, by numbers or names; a table without a column
        ``episode`` is one.

    Returns
    -------
    list of Demonstration
        In order of appearance.

    Raises
    ------
    DataError, UnknownNameError
        If a column is missing, occurs twice or holds no numbers, a value is missing, or an
        event has two times; without ``joints``, if there is only a part of a pose, or a column
        counts the rows; and as :class:`Demonstration`. The message says in which episode.

    Examples
    --------
    >>> import pandas as pd
    >>> table = pd.DataFrame({"t": [0.0, 0.1], "elbow": [0.3, 0.4], "wrist": [0.0, 0.1]})
    >>> demonstrations_from_frame(table, time="t")
    [Demonstration(2 steps, 0.10 s, 2 joints, frames=[], events={})]
    """
    table = _checked(table, joints, time, episode)
    whole = episode not in table.columns
    parts = [(0, table)] if whole else [*table.groupby(episode, sort=False)]
    parts = [(label, _in_seconds(part, time)) for label, part in parts]
    names = list(joints) if joints is not None else _joints(table, parts, time, episode)
    called = None if names == [str(i) for i in range(len(names))] else tuple(names)
    made = []
    for label, part in parts:
        kept = part.dropna(axis="columns", how="all")
        try:
            at, values = map(
                torch.from_numpy, (numbers(kept, [time])[:, 0], numbers(kept, names))
            )
            poses, events = _poses(kept, {time, episode, *names}), _events(kept)
            forces = {n: torch.from_numpy(w) for n, w in _wrenches(kept).items()}
            made.append(Demonstration(at, values, poses, called, events, wrenches=forces))
        except (DataError, UnknownNameError) as error:
            raise DataError(f"episode {label} of the table: {error}") from error
    return made


def write_table(table: pd.DataFrame, path: str | Path) -> None:
    """Write a table, replacing what is there in one step.

    Parameters
    ----------
    table : pandas.DataFrame
        Of any of these functions.
    path : str or Path
        Ends in .csv, which has all digits, or .parquet. In a .csv a quote stands before names
        that spreadsheets would take for a formula.

    Raises
    ------
    DataError
        If it ends otherwise.
    """
    path = _known(Path(path))
    with replacing(path) as new:
        if path.suffix == ".csv":
            safe = [f"'{n}" if FORMULA.match(str(n)) else n for n in table.columns]
            table.to_csv(new, index=False, header=safe)
        else:
            table.to_parquet(new, index=False)


def read_table(path: str | Path) -> pd.DataFrame:
    """Read a table, every digit of it.

    Parameters
    ----------
    path : str or Path
        A .csv whose first line has the names of the columns, or a .parquet. Fields of a .csv
        are separated by commas, or by semicolons, tabs or blanks, and numbers may have decimal
        commas then.

    Raises
    ------
    DataError
        If there is no such file, or it has another suffix.
    DependencyError
        If there is no pandas, or no pyarrow for parquet.
    """
    path, pandas = _known(Path(path)), _pandas()
    try:
        with open_whole(path) as file:
            return _separated(file) if path.suffix == ".csv" else _parquet(file)
    except FileNotFoundError:
        raise DataError(f"there is no file {path}") from None
    except ImportError as error:
        raise DependencyError(
            f"{path} needs pyarrow: pip install 'tpgmm-torch[data]'"
        ) from error
    except pandas.errors.ParserWarning as error:
        raise DataError(f"{path} has rows of more fields than its header names") from error
    except (OSError, ValueError, LookupError, NotImplementedError) as error:  # also of parsers
        raise DataError(f"{path} is no table: {error}") from error


def _separated(file: Any) -> pd.DataFrame:
    """A .csv, whatever separates its fields."""
    head, row = (file.readline().decode(errors="replace").strip() for _ in range(2))
    file.seek(0)
    marks = [mark for mark in ",;\t" if mark in head and mark in row]
    mark = marks[0] if marks else "," if "," in head else r"\s+"
    comma = mark != "," and re.search(r"\d,\d", row)
    # by default pandas takes the first column for names of rows where these are longer than the
    # header, and before 3.1, which deprecates the option, it is wrong in the last digit
    options: dict[str, Any] = {"decimal": "," if comma else ".", "index_col": False}
    options |= {"sep": mark, "skipinitialspace": True}
    pandas = _pandas()
    if tuple(map(int, pandas.__version__.split(".")[:2])) < (3, 1):
        options["float_precision"] = "round_trip"
    with warnings.catch_warnings(action="error", category=pandas.errors.ParserWarning):
        read = pandas.read_csv(file, **options)
    return read.rename(columns=lambda n: n.removeprefix("'") if FORMULA.match(n) else n)


def _parquet(file: Any) -> pd.DataFrame:
    from pyarrow import parquet

    whole = parquet.ParquetFile(file)
    rows, columns = whole.metadata.num_rows, len(whole.schema_arrow)
    if rows * columns > MOST_NUMBERS:
        most = f"at most {MOST_NUMBERS:g} numbers are read: write it in parts"
        raise ValueError(f"it has {rows} rows of {columns} columns; {most}")
    return whole.read().to_pandas()


def covariance_names(joint_names: Sequence[str]) -> list[str]:
    """Columns of the upper triangle of the covariance of joints, row by row."""
    pairs = zip(*np.triu_indices(len(joint_names)), strict=True)
    return [f"{COVARIANCE}{joint_names[i]}.{joint_names[j]}" for i, j in pairs]


def _pandas() -> Any:
    try:
        import pandas
    except ImportError as error:
        raise DependencyError("tables need pandas: pip install 'tpgmm-torch[data]'") from error
    return pandas


def _known(path: Path) -> Path:
    if path.suffix not in (".csv", ".parquet"):
        raise DataError(f"a table's file ends in .csv or .parquet, got {str(path)!r}")
    return path


def _columns(
    episode: int, motion: Demonstration | Trajectory, frames: Mapping[str, Frame]
) -> dict[str, Array]:
    """Episode, time, joints and frames."""
    rows, names = len(motion), _joint_names(motion)
    columns = [(EPISODE, np.full(rows, episode)), ("time", as_array(motion.time))]
    columns += zip(names, as_array(motion.joints).T, strict=True)
    for name, frame in frames.items():
        pose = as_array(torch.cat((frame.position, frame.orientation), -1))
        values = np.broadcast_to(pose, (rows, len(POSE_PARTS))).T
        columns += zip([f"{name}.{part}" for part in POSE_PARTS], values, strict=True)
    if len({name for name, _ in columns}) < len(columns):
        common = "have a column in common, or one is called 'time' or 'episode': rename it"
        raise DataError(f"joints {list(names)} and frames {sorted(frames)} {common}")
    return dict(columns)


def _table(
    parts: Sequence[Mapping[str, Array]], motion: Demonstration | Trajectory
) -> pd.DataFrame:
    pandas = _pandas()
    table = pandas.concat([pandas.DataFrame(part) for part in parts], ignore_index=True)
    # parquet keeps it: joints may have names like those of poses
    table.attrs[JOINTS] = _joint_names(motion)
    return table


def _joint_names(motion: Demonstration | Trajectory) -> list[str]:
    return list(motion.joint_names or map(str, range(motion.joints.shape[-1])))


def _checked(
    table: pd.DataFrame, joints: Sequence[str] | None, time: str, episode: str
) -> pd.DataFrame:
    """The table with texts for names, each there once, and all that are asked for."""
    if not hasattr(table, "columns"):
        raise DataError(f"a table is a pandas DataFrame, got {type(table).__name__}")
    if table.index.name == time:
        table = table.reset_index()
    kept = {*(joints or ()), *table.attrs.get(JOINTS, ())}
    table = table.rename(columns=lambda n: n if n in kept else _plain(str(n).strip()))
    table = table.dropna(how="all")
    # the second of one name is NAME.1 of pandas
    again = [n for n in table.columns if n not in kept and re.fullmatch(r".+\.\d+", n)]
    twice = {n for n in again if n.rpartition(".")[0] in table.columns}
    if twice := twice | {*table.columns[table.columns.duplicated()]}:
        raise DataError(f"the table has columns of one name: {sorted(twice)}")
    if len(table.columns) == 1 and (found := re.findall(r"[,;\t]|\s+", table.columns[0])):
        message = f"the table has one column, {table.columns[0]!r}: its fields are separated by"
        raise DataError(f"{message} {found[0]!r}, pandas.read_csv(..., sep={found[0]!r})")
    asked = () if episode == EPISODE else (episode,)
    for name in (time, *asked, *(joints or ())):
        if name not in table.columns:
            raise UnknownNameError("column", name, "the table", table.columns)
    if not len(table):
        raise DataError("the table has no rows")
    if episode in table.columns and table[episode].isna().any():
        raise DataError(f"column {episode!r} lacks a value: to which episode is that row?")
    others = _others(table, {time, episode, *(joints or ())})
    empty = [name for name in others if table[name].isna().all()]
    if told := [name for name in empty if not UNNAMED.fullmatch(name)]:
        _warn(f"columns {told} of the table are empty, and left out")
    return table.drop(columns=empty)


def _joints(
    table: pd.DataFrame, parts: Sequence[tuple[Any, pd.DataFrame]], time: str, episode: str
) -> list[str]:
    """Columns that are joints: those known to be, and those that are nothing else."""
    columns = _others(table, {time, episode})
    known = {name for name in columns if f"{COVARIANCE}{name}.{name}" in table.columns}
    known |= set(table.attrs.get(JOINTS, ()))
    rest = [name for name in columns if name not in known]
    in_poses = {rest[i] for group in pose_groups(rest).values() for i in group}
    names = [name for name in columns if name not in in_poses]
    if not names:
        other = f"{columns} are poses of frames or something else"
        raise DataError(f"the table has no joints: {other}. If some are, say so: joints=[...]")
    taken = [name for name in names if name not in known]
    for frame, missing in _incomplete_poses(taken).items():
        raise DataError(
            f"the table has a part of the pose of {frame!r}, and no columns {list(missing)}: "
            "add them (1, 0, 0, 0 where it is not known), or say which are joints: joints=[...]"
        )
    values = [name for name in taken if table[name].dtype.kind in "iuf"]
    counters = [name for name in values if COUNTS.fullmatch(name)]
    steady = {n: _steady(parts, n, time) for n in values if n not in counters}
    if counters := [*counters, *(n for n, kind in steady.items() if kind == "counter")]:
        raise DataError(
            f"columns {counters} count the rows or tell the time, and are no joints: drop them "
            "(pandas: to_csv(..., index=False)), or say which are: joints=[...]"
        )
    if unnamed := [name for name in taken if UNNAMED.fullmatch(name)]:
        raise DataError(f"columns {unnamed} have no name: name or drop them, or joints=[...]")
    if even := [name for name, kind in steady.items() if kind]:
        asked = "are they joints (joints=[...]), or do they count something? Then drop them"
        _warn(f"columns {even} change by the same in every row: {asked}")
    return names


def _warn(message: str) -> None:
    warnings.warn(message, PlausibilityWarning, stacklevel=4)


def _steady(parts: Sequence[tuple[Any, pd.DataFrame]], name: str, time: str) -> str:
    """Whether a column is a ``"counter"``, a clock too, or changes ``"evenly"`` throughout."""
    steps = np.concatenate([np.diff(part[name].to_numpy(float)) for _, part in parts])
    if len(steps) < FEWEST_COUNTED - 1 or not steps[0]:
        return ""
    even = np.allclose(steps, steps[0], rtol=1e-6, atol=0)
    ticks = np.concatenate([np.diff(part[time].to_numpy(float)) for _, part in parts])
    rates = [rate for rate in CLOCKS if np.allclose(steps, rate * ticks, CLOCK_ERROR, 0)]
    return "counter" if rates or (even and steps[0] % 1 == 0) else "evenly" * even


def _in_seconds(part: pd.DataFrame, time: str) -> pd.DataFrame:
    """An episode's time and events in seconds: of dates, those since its first row."""
    first, kind = part[time].iloc[0], part[time].dtype.kind
    unit = next((u for u, low in SINCE_1970.items() if kind in "iuf" and first >= low), None)
    if kind in "biuf" and unit is None:
        return part
    options = {"unit": unit} if unit else {"format": "ISO8601", "utc": True}
    names = [time, *(name for name in part.columns if name.startswith(EVENT))]
    try:
        dates = part[names]
        dates = dates if kind == "m" else dates.apply(_pandas().to_datetime, **options)
        since = (dates - dates[time].iloc[0]).apply(lambda column: column.dt.total_seconds())
    except (ValueError, TypeError, AttributeError, OverflowError) as error:
        found = f"column {time!r} holds neither numbers nor dates, its first value is {first!r}"
        raise DataError(f"{found}: convert it to seconds") from error
    return part.assign(**since)


def _plain(name: str) -> str:
    """A column's name; those of ROS's poses become this module's."""
    if match := ROS_POSE.fullmatch(name):
        return f"{(match[1] or 'pose').strip('/')}.{match['x'] or 'q' + match['q']}"
    return name


def _others(table: pd.DataFrame, known: set[str]) -> list[str]:
    """Columns that are joints or poses."""
    return [
        name
        for name in table.columns
        if name not in known and not name.startswith((EVENT, COVARIANCE, WRENCH))
    ]


def _poses(part: pd.DataFrame, others: set[str]) -> dict[str, Frame]:
    """The frames, constant where nothing changes."""
    columns = _others(part, others)
    frames: dict[str, Frame] = {}
    for name, group in pose_groups(columns).items():
        pose = numbers(part, [columns[i] for i in group])
        pose = pose[0] if bool((pose == pose[0]).all()) else pose
        frames[name] = Frame(pose[..., :3], pose[..., 3:])
    return frames


def _wrench_columns(motion: Demonstration) -> dict[str, Array]:
    """The values of wrenches, by column."""
    return {
        f"{WRENCH}{link}.{part}": values
        for link, wrench in motion.wrenches.items()
        for part, values in zip(WRENCH_PARTS, as_array(wrench).T, strict=True)
    }


def _wrenches(part: pd.DataFrame) -> dict[str, Array]:
    """Wrenches (T, 6) by link."""
    columns = [name for name in part.columns if name.startswith(WRENCH)]
    links = dict.fromkeys(name.removeprefix(WRENCH).rpartition(".")[0] for name in columns)
    found = {
        link: numbers(part, [f"{WRENCH}{link}.{axis}" for axis in WRENCH_PARTS])
        for link in links
    }
    if odd := [name for name in columns if name.rpartition(".")[2] not in WRENCH_PARTS]:
        raise DataError(f"columns {odd} are not {WRENCH}LINK. and {list(WRENCH_PARTS)}")
    return found


def _events(part: pd.DataFrame) -> dict[str, float]:
    events = {}
    for name in (name for name in part.columns if name.startswith(EVENT)):
        values = numbers(part, [name])
        if bool((values != values[0]).any()):
            raise DataError(f"column {name!r} is one time [s], but it changes")
        events[name.removeprefix(EVENT)] = float(values[0, 0])
    return events


def numbers(part: pd.DataFrame, names: Sequence[str]) -> Array:
    """Columns of a table as numbers (rows, columns), none of them missing.

    Parameters
    ----------
    part : pandas.DataFrame
    names : sequence of str
        Of the columns.

    Raises
    ------
    DataError, UnknownNameError
        If a column is missing, or holds something else.
    """
    columns = []
    for name in names:
        if name not in part.columns:
            raise UnknownNameError("column", name, "the table", part.columns)
        values = part[name]
        if values.dtype.kind not in "biuf":
            raise DataError(
                f"column {name!r} holds no numbers, its first value is {values.iloc[0]!r}: "
                "leave it out (joints=[...]); decimal commas: pandas.read_csv(..., decimal=',')"
            )
        if values.isna().any():
            row = values.index[values.isna()][0]
            raise DataError(f"column {name!r} lacks a value in row {row}")
        columns.append(values.to_numpy(dtype=np.float64))
    return np.stack(columns, axis=1)


def _incomplete_poses(names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """By pose of which the names have a part, the columns that complete it.

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
