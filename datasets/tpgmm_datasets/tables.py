"""Demonstrations and trajectories as flat tables of pandas, and back; CSV and parquet.

A row is a time step. The columns are ``episode``, ``time`` [s], the joints by name, what was
commanded of each (``command.elbow`` [rad or m]), the seven numbers of each frame
(``bottle.x``, ``bottle.y``, ``bottle.z`` [m], ``bottle.qw`` to ``bottle.qz``), the wrench of
each link (``wrench.tool.fx`` to ``wrench.tool.fz`` [N] and ``wrench.tool.tx`` to
``wrench.tool.tz`` [N m]), the time of each event (``event.close`` [s], the same in all rows of
an episode) and, of trajectories, the upper triangle of the joints' covariance
(``covariance.elbow.wrist``). What a column of a table that others wrote is,
:mod:`tpgmm_datasets.table_columns` decides.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from tpgmm_datasets import table_columns as roles
from tpgmm_torch.atomic import open_whole, replacing
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import Demonstration, check_demonstrations
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.pose_names import POSE_PARTS, pose_groups
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.exceptions import DataError, DependencyError, UnknownNameError

if TYPE_CHECKING:
    import pandas as pd

__all__ = [
    "demonstrations_from_frame",
    "demonstrations_to_frame",
    "read_table",
    "trajectories_to_frame",
    "write_table",
]

#: What a column of a wrench is, behind its link.
WRENCH_PARTS = ("fx", "fy", "fz", "tx", "ty", "tz")
#: Times from here on are since 1970, in this unit.
SINCE_1970 = {"ns": 1e17, "us": 1e14, "ms": 1e11}
#: How a text begins that spreadsheets take for a formula.
FORMULA = re.compile(r"'*[=+@\t\r-]")
#: Rows times columns beyond which a table is not read.
MOST_NUMBERS = 2e7

Motion = Demonstration | Trajectory


def demonstrations_to_frame(demonstrations: Sequence[Demonstration]) -> pd.DataFrame:
    """Write demonstrations as a table, one row per time step.

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
        _motion_columns(episode, one, one.frames)
        | _command_columns(one)
        | _wrench_columns(one)
        | {f"{roles.EVENT}{name}": np.full(len(one), at) for name, at in one.events.items()}
        for episode, one in enumerate(checked)
    ]
    return _join_parts(parts, checked[0])


def trajectories_to_frame(
    trajectories: Sequence[Trajectory], frames: Sequence[Mapping[str, Frame]] | None = None
) -> pd.DataFrame:
    """Write trajectories and the covariances of their joints as a table, one row per time step.

    Parameters
    ----------
    trajectories : sequence of Trajectory
        Trajectories of one model.
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
        values = as_array(one.covariance)[:, rows, columns].T
        upper = dict(zip(_covariance_names(one.joint_names), values, strict=True))
        parts.append(_motion_columns(episode, one, poses) | upper)
    return _join_parts(parts, trajectories[0])


def demonstrations_from_frame(
    table: pd.DataFrame,
    *,
    joints: Sequence[str] | None = None,
    time: str = "time",
    episode: str = roles.EPISODE,
) -> list[Demonstration]:
    """Read the demonstrations in a table.

    Parameters
    ----------
    table : pandas.DataFrame
        Rows of an episode in order of time. A pose that is the same in all rows of an episode
        becomes a constant frame; a column that is NaN throughout an episode is not in its
        demonstration. Joints without a column ``command.JOINT``, where others have one, were
        commanded where they were.
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
    table = roles.check_columns(table, joints, time, episode)
    whole = episode not in table.columns
    parts = [(0, table)] if whole else [*table.groupby(episode, sort=False)]
    parts = [(label, _in_seconds(part, time)) for label, part in parts]
    found = joints if joints is not None else roles.find_joints(table, parts, time, episode)
    names = list(found)
    called = None if names == [str(i) for i in range(len(names))] else tuple(names)
    made = []
    for label, part in parts:
        kept = part.dropna(axis="columns", how="all")
        try:
            at, values = (torch.from_numpy(numbers(kept, each)) for each in ([time], names))
            poses, events = _read_poses(kept, {time, episode, *names}), _read_events(kept)
            forces = {n: torch.from_numpy(w) for n, w in _read_wrenches(kept).items()}
            sent = _read_commands(kept, names, values)
            one = Demonstration(at[:, 0], values, poses, called, events, wrenches=forces)
            made.append(replace(one, commands=sent))
        except (DataError, UnknownNameError) as error:
            raise DataError(f"episode {label} of the table: {error}") from error
    return made


def write_table(table: pd.DataFrame, path: str | Path) -> None:
    """Write a table, replacing what is there in one step.

    Parameters
    ----------
    table : pandas.DataFrame
        Table from any of these functions.
    path : str or Path
        Ends in .csv, which has all digits, or .parquet. In a .csv a quote stands before names
        that spreadsheets would take for a formula.

    Raises
    ------
    DataError
        If it ends otherwise.
    """
    path = _check_suffix(Path(path))
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
    path, pandas = _check_suffix(Path(path)), _import_pandas()
    try:
        with open_whole(path) as file:
            return _read_csv(file) if path.suffix == ".csv" else _read_parquet(file)
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


def _read_csv(file: Any) -> pd.DataFrame:
    """Read a .csv, whatever separates its fields."""
    head, row = (file.readline().decode(errors="replace").strip() for _ in range(2))
    file.seek(0)
    mark = _find_separator(head, row)
    comma = mark != "," and re.search(r"\d,\d", row)
    # by default pandas takes the first column for names of rows where these are longer than the
    # header, and before 3.1, which deprecates the option, it is wrong in the last digit
    options: dict[str, Any] = {"decimal": "," if comma else ".", "index_col": False}
    options |= {"sep": mark, "skipinitialspace": True}
    pandas = _import_pandas()
    if tuple(map(int, pandas.__version__.split(".")[:2])) < (3, 1):
        options["float_precision"] = "round_trip"
    with warnings.catch_warnings(action="error", category=pandas.errors.ParserWarning):
        read = pandas.read_csv(file, **options)
    return read.rename(columns=lambda n: n.removeprefix("'") if FORMULA.match(n) else n)


def _find_separator(head: str, row: str) -> str:
    """Return the mark that is in both lines, else a comma of the header, else blanks."""
    marks = [mark for mark in ",;\t" if mark in head and mark in row]
    return marks[0] if marks else "," if "," in head else r"\s+"


def _read_parquet(file: Any) -> pd.DataFrame:
    from pyarrow import parquet

    whole = parquet.ParquetFile(file)
    rows, columns = whole.metadata.num_rows, len(whole.schema_arrow)
    if rows * columns > MOST_NUMBERS:
        most = f"at most {MOST_NUMBERS:g} numbers are read: write it in parts"
        raise ValueError(f"it has {rows} rows of {columns} columns; {most}")
    return whole.read().to_pandas()


def _covariance_names(joint_names: Sequence[str]) -> list[str]:
    """Name the columns of the upper triangle of the covariance of joints, row by row."""
    pairs = zip(*np.triu_indices(len(joint_names)), strict=True)
    return [f"{roles.COVARIANCE}{joint_names[i]}.{joint_names[j]}" for i, j in pairs]


def _import_pandas() -> Any:
    try:
        import pandas
    except ImportError as error:
        raise DependencyError("tables need pandas: pip install 'tpgmm-torch[data]'") from error
    return pandas


def _check_suffix(path: Path) -> Path:
    if path.suffix not in (".csv", ".parquet"):
        raise DataError(f"a table's file ends in .csv or .parquet, got {str(path)!r}")
    return path


def _motion_columns(
    episode: int, motion: Motion, frames: Mapping[str, Frame]
) -> dict[str, Array]:
    """Return the columns of episode, time, joints and frames."""
    rows, names = len(motion), _name_joints(motion)
    columns = [(roles.EPISODE, np.full(rows, episode)), ("time", as_array(motion.time))]
    columns += zip(names, as_array(motion.joints).T, strict=True)
    for name, frame in frames.items():
        pose = as_array(torch.cat((frame.position, frame.orientation), -1))
        values = np.broadcast_to(pose, (rows, len(POSE_PARTS))).T
        columns += zip([f"{name}.{part}" for part in POSE_PARTS], values, strict=True)
    if len({name for name, _ in columns}) < len(columns):
        common = "have a column in common, or one is called 'time' or 'episode': rename it"
        raise DataError(f"joints {list(names)} and frames {sorted(frames)} {common}")
    return dict(columns)


def _join_parts(parts: Sequence[Mapping[str, Array]], motion: Motion) -> pd.DataFrame:
    pandas = _import_pandas()
    table = pandas.concat([pandas.DataFrame(part) for part in parts], ignore_index=True)
    # parquet keeps it: joints may have names like those of poses
    table.attrs[roles.JOINTS] = _name_joints(motion)
    return table


def _name_joints(motion: Motion) -> list[str]:
    return list(motion.joint_names or map(str, range(motion.joints.shape[-1])))


def _in_seconds(part: pd.DataFrame, time: str) -> pd.DataFrame:
    """Convert an episode's time and events to seconds: of dates, those since its first row."""
    first, kind = part[time].iloc[0], part[time].dtype.kind
    unit = _find_epoch_unit(first, kind)
    if kind in "biuf" and unit is None:
        return part
    options = {"unit": unit} if unit else {"format": "ISO8601", "utc": True}
    names = [time, *(name for name in part.columns if name.startswith(roles.EVENT))]
    try:
        dates = part[names]
        dates = dates if kind == "m" else dates.apply(_import_pandas().to_datetime, **options)
        since = (dates - dates[time].iloc[0]).apply(lambda column: column.dt.total_seconds())
    except (ValueError, TypeError, AttributeError, OverflowError) as error:
        found = f"column {time!r} holds neither numbers nor dates, its first value is {first!r}"
        raise DataError(f"{found}: convert it to seconds") from error
    return part.assign(**since)


def _find_epoch_unit(first: Any, kind: str) -> str | None:
    """Return the unit of times since 1970; None for times that are not, or no numbers."""
    return next((u for u, low in SINCE_1970.items() if kind in "iuf" and first >= low), None)


def _read_poses(part: pd.DataFrame, others: set[str]) -> dict[str, Frame]:
    """Read the frames, constant where nothing changes."""
    columns = roles.list_motion_columns(part, others)
    frames: dict[str, Frame] = {}
    for name, group in pose_groups(columns).items():
        pose = numbers(part, [columns[i] for i in group])
        pose = pose[0] if bool((pose == pose[0]).all()) else pose
        frames[name] = Frame(pose[..., :3], pose[..., 3:])
    return frames


def _command_columns(motion: Demonstration) -> dict[str, Array]:
    """Return what joints were commanded, by column."""
    if motion.commands is None:
        return {}
    names = [f"{roles.COMMAND}{name}" for name in _name_joints(motion)]
    return dict(zip(names, as_array(motion.commands).T, strict=True))


def _read_commands(
    part: pd.DataFrame, joints: Sequence[str], measured: torch.Tensor
) -> torch.Tensor | None:
    """Read the commands of joints (T, n_joints); None where there are none."""
    known = [f"{roles.COMMAND}{name}" for name in joints]
    found = [n for n in part.columns if n.startswith(roles.COMMAND) and n not in joints]
    if odd := [name for name in found if name not in known]:
        raise DataError(
            f"columns {odd} are commands of no joint: call them {roles.COMMAND} and one of "
            f"{list(joints)}, or drop them"
        )
    commands = measured.clone()
    for name in found:
        commands[:, known.index(name)] = torch.from_numpy(numbers(part, [name])[:, 0])
    return commands if found else None


def _wrench_columns(motion: Demonstration) -> dict[str, Array]:
    """Return the values of wrenches, by column."""
    return {
        f"{roles.WRENCH}{link}.{part}": values
        for link, wrench in motion.wrenches.items()
        for part, values in zip(WRENCH_PARTS, as_array(wrench).T, strict=True)
    }


def _read_wrenches(part: pd.DataFrame) -> dict[str, Array]:
    """Read wrenches (T, 6) by link."""
    columns = [name for name in part.columns if name.startswith(roles.WRENCH)]
    links = dict.fromkeys(name[len(roles.WRENCH) :].rpartition(".")[0] for name in columns)
    parts = {link: [f"{roles.WRENCH}{link}.{axis}" for axis in WRENCH_PARTS] for link in links}
    found = {link: numbers(part, names) for link, names in parts.items()}
    if odd := [name for name in columns if name.rpartition(".")[2] not in WRENCH_PARTS]:
        raise DataError(f"columns {odd} are not {roles.WRENCH}LINK. and {list(WRENCH_PARTS)}")
    return found


def _read_events(part: pd.DataFrame) -> dict[str, float]:
    events = {}
    for name in (name for name in part.columns if name.startswith(roles.EVENT)):
        values = numbers(part, [name])
        if bool((values != values[0]).any()):
            raise DataError(f"column {name!r} is one time [s], but it changes")
        events[name.removeprefix(roles.EVENT)] = float(values[0, 0])
    return events


def numbers(part: pd.DataFrame, names: Sequence[str]) -> Array:
    """Return columns of a table as numbers (rows, columns), none of them missing.

    Parameters
    ----------
    part : pandas.DataFrame
        The table, or the rows of an episode.
    names : sequence of str
        The columns, in the order of the result.

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
