"""Write demonstrations as a LeRobot data set of version 3.0, or add frames to one."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import reduce
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from tpgmm_datasets.conversion.assembly import FrameSource, frame_sources, stored_frames
from tpgmm_datasets.conversion.poses import MeasuredPoses
from tpgmm_datasets.errors import DatasetError
from tpgmm_datasets.lerobot import columns as kept
from tpgmm_datasets.lerobot import statistics as summed
from tpgmm_datasets.lerobot.episodes import Relaxed, read_episodes
from tpgmm_datasets.lerobot.files import METADATA_KEY, file_path, free_place, write_tables
from tpgmm_datasets.lerobot.hub import local_folder
from tpgmm_datasets.lerobot.layout import Layout, open_layout
from tpgmm_datasets.lerobot.parquet import open_parquet, read_columns
from tpgmm_torch.atomic import replacing
from tpgmm_torch.data.demonstrations import Demonstration, check_demonstrations

__all__ = ["add_frames", "save_lerobot"]

DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
#: LeRobot's numbers: of files in a folder, and of the size of a file, which it does not need.
CHUNK_FILES, FILE_MEGABYTES = 1000, 100


def save_lerobot(
    demonstrations: Sequence[Demonstration],
    path: str | Path,
    *,
    fps: int,
    task: str | Sequence[str],
    actions: Sequence[Any] | None = None,
    robot_type: str | None = None,
    units: Mapping[str, str] | None = None,
    dtype: str = "float32",
    append: bool = False,
) -> Path:
    """Write demonstrations as a LeRobot data set (v3.0), one episode each.

    Joints become ``observation.state``; commands, or without them the joints one step ahead,
    ``action``; all frames together ``observation.environment_state``, seven values each; an
    event ``close`` the column ``event.close``, true at the nearest step. Time starts at 0 in
    the set. LeRobot's own tools open it, and ``load_lerobot(path)`` gives the demonstrations
    back (to the precision of ``dtype``; events to the nearest step).

    Parameters
    ----------
    demonstrations : sequence of Demonstration
        With the same joints and frames, sampled at ``fps``.
    path : str or Path
        The folder; it must not exist, unless ``append``.
    fps : int
        Steps per second; LeRobot stores a whole number.
    task : str or sequence of str
        What was done, for all or for each demonstration.
    actions : sequence of array-like of shape (T, n_joints), optional
        What was commanded at each step of each demonstration, if not its ``commands``.
    robot_type : str, optional
        Name of the robot, for the metadata.
    units : mapping of str to str, optional
        ``"m"`` or ``"raw"`` (a scale of its own, like a gripper's) by name, for joints that
        are not in radians.
    dtype : {"float32", "float64"}, default="float32"
        How joints and frames are stored. LeRobot's policies read float32 in either case.
    append : bool, default=False
        Add the episodes to the set at ``path``, if there is one.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    DatasetError
        If the folder exists, time does not follow ``fps``, actions do not fit to the
        demonstrations, or the episodes to the set they are appended to.

    Notes
    -----
    An interrupted write leaves the old set, or none where there was none. Processes that
    append to one set wait for each other.

    Examples
    --------
    >>> import tempfile
    >>> shown = Demonstration([0.0, 0.1, 0.2], [[0.0], [0.5], [1.0]], joint_names=["elbow"])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = save_lerobot([shown], Path(folder) / "bends", fps=10, task="bend the elbow")
    ...     sorted(item.name for item in path.iterdir())
    ['data', 'meta']
    """
    given, demonstrations = demonstrations, check_demonstrations(demonstrations)
    commanded = _check_actions(given, actions)
    path = Path(path)
    tasks = _tasks(task, len(demonstrations))
    if dtype not in ("float32", "float64"):
        raise DatasetError(f"dtype is 'float32' or 'float64', got {dtype!r}")
    if int(fps) != fps or fps <= 0:
        raise DatasetError(f"LeRobot stores fps as a whole number > 0, got {fps!r}")
    declared = {
        "codebase_version": "v3.0",
        "robot_type": robot_type,
        "fps": int(fps),
        "features": kept.features_of(demonstrations, dtype, units),
        "chunks_size": CHUNK_FILES,
        "data_files_size_in_mb": FILE_MEGABYTES,
        "video_files_size_in_mb": 200,
        "data_path": DATA_PATH,
        "video_path": None,
    }
    with replacing(path, keep=True) as new:  # the files of old episodes stay as they are
        if path.exists() and not append:
            remedy = "remove it, or pass append=True to add episodes to that set"
            raise DatasetError(f"{path} exists; {remedy}")
        # what another process has appended by now is there, and no third can come between
        old = open_layout(path) if path.exists() else None
        info = declared if old is None else _extend_info(old, declared)
        _Writer(new, info, old).write(demonstrations, tasks, commanded)
    return path


@dataclass(frozen=True)
class Column:
    """A column for a copy of a data set.

    Parameters
    ----------
    names : sequence of str
        Names of its values.
    values : dict of int to ndarray of shape (T, width)
        By the episode's index; one type for all.
    """

    names: Sequence[str]
    values: dict[int, np.ndarray[Any, Any]]

    @property
    def declaration(self) -> dict[str, Any]:
        """Its entry in ``info.json``."""
        dtype = str(next(iter(self.values.values())).dtype)
        return {"dtype": dtype, "shape": [len(self.names)], "names": list(self.names)}


def add_frames(
    path: str | Path,
    out: str | Path,
    frames: Mapping[str, FrameSource],
    *,
    columns: Mapping[str, Column] | None = None,
    offsets: Mapping[str, Sequence[float]] | None = None,
    files: Mapping[str, str] | None = None,
) -> Path:
    """Write a copy of a LeRobot data set (v3.0) with the poses of more frames.

    They are put behind what is in ``observation.environment_state``, seven values each, so that
    LeRobot's policies see the objects too. All else stays as it is; videos are linked where
    that can be, else copied.

    Parameters
    ----------
    path : str or Path
        The data set, as for :func:`load_lerobot`.
    out : str or Path
        The folder of the copy; it must not exist.
    frames : mapping of str to str, Path, Frame, sequence or mapping of Frame
        A table of poses, or frames that are given, as for :func:`load_lerobot`. Where a link is
        at an event can be learned without such a copy.
    columns : mapping of str to Column, optional
        Further columns.
    offsets : mapping of str to sequence of float, optional
        By the feature of joints, what is declared to be added to its values once they are in
        radians or metres; the stored values stay.
    files : mapping of str to str, optional
        Further files, texts by their path in the copy.

    Returns
    -------
    Path
        The folder of the copy.

    Raises
    ------
    DatasetError
        If the set is damaged or of another version, the folder exists, a frame is there
        already, or its poses do not fit to the episodes. There is no copy then.
    """
    path, out = local_folder(path), Path(out)
    layout = open_to_copy(path, out)
    sources = frame_sources(layout, frames, layout.episodes)
    if {*map(type, sources.values())} != {MeasuredPoses}:
        raise DatasetError(
            f"a table (NAME=POSES.csv) or frames by episode can be added, got {dict(frames)}; "
            "LINK@EVENT and features are learned from the set as it is"
        )
    columns = columns or {}
    environment = layout.features.get(kept.ENVIRONMENT)
    declared = {kept.ENVIRONMENT: kept.with_frames(environment, list(sources))}
    declared |= {key: column.declaration for key, column in columns.items()}
    if there := columns.keys() & layout.features.keys():
        raise DatasetError(f"the set has the columns {sorted(there)} already")
    features = _declare_offsets({**layout.info["features"], **declared}, offsets or {})
    with replacing(out) as new:
        open_to_copy(path, out)
        hidden = shutil.ignore_patterns(".*")
        shutil.copytree(path, new, ignore=hidden, copy_function=_link_videos)
        statistics = _add_columns(new, layout, sources, columns, declared)
        whole = _add_statistics(new, layout.root, statistics)
        stats = new / "meta" / "stats.json"
        try:
            stored = {**json.loads(stats.read_text(encoding="utf-8"))}
        except (OSError, ValueError, TypeError, RecursionError) as error:
            raise DatasetError(f"no statistics: {error}", file="meta/stats.json") from error
        _write_json(stats, {**stored, **whole})
        _write_json(new / "meta" / "info.json", {**layout.info, "features": features})
        for name, text in (files or {}).items():
            (new / name).write_text(text, encoding="utf-8")
    return out


def _declare_offsets(
    features: dict[str, Any], offsets: Mapping[str, Sequence[float]]
) -> dict[str, Any]:
    for key, shifts in offsets.items():
        info = {**(features[key].get("info") or {}), "offsets": list(shifts)}
        features[key] = {**features[key], "info": info}
    return features


def _add_columns(
    new: Path,
    layout: Layout,
    sources: Mapping[str, Any],
    columns: Mapping[str, Column],
    declared: Mapping[str, Any],
) -> dict[int, summed.Statistics]:
    """Add the declared columns to the data files; return their statistics by episode."""
    found = dict[int, summed.Statistics]()
    old = [layout.features[kept.ENVIRONMENT]] if kept.ENVIRONMENT in layout.features else []
    read = read_episodes(layout, layout.episodes, old, Relaxed(()))
    for file, episodes in groupby(read, key=lambda rows: rows.episode.file):
        parts = []
        for rows in episodes:
            values = rows.values.get(kept.ENVIRONMENT, np.empty((len(rows.time), 0)))
            index = rows.episode.index
            poses = stored_frames(layout, sources, rows)
            added = kept.frame_columns(values, poses, declared, index)
            added |= {key: column.values[index] for key, column in columns.items()}
            parts.append(kept.feature_table(added, declared))
            found[index] = summed.episode_statistics(added)
        table = pa.concat_tables(parts)
        _rewrite(layout.root, new, file, {key: table[key] for key in declared})
    return found


def _add_statistics(
    new: Path, old: Path, found: Mapping[int, summed.Statistics]
) -> summed.Statistics:
    """Add statistics to the lists of episodes; return those of the whole set."""
    whole = reduce(summed.merge_statistics, found.values())
    names = [(feature, name) for feature in whole for name in whole[feature]]
    for listed in (old / "meta" / "episodes").glob("*/*.parquet"):
        [column] = read_columns(listed, old, ["episode_index"]).columns
        stats = {}
        for feature, name in names:
            key = f"stats/{feature}/{name}"
            listing = [found[number][feature][name].tolist() for number in column.to_pylist()]
            stats[key] = pa.array(listing, _episode_type(key))
        _rewrite(old, new, listed.relative_to(old), stats)
    return whole


def open_to_copy(path: Path, out: Path) -> Layout:
    """Open the metadata of a set to which :func:`add_frames` can add.

    Raises
    ------
    DatasetError
        If it is damaged, of another version or empty, or the folder of the copy exists.
    """
    layout = open_layout(path)
    for problem in layout.problems:
        raise problem
    if layout.version != "v3.0" or not layout.episodes:
        raise DatasetError(
            f"frames are added to sets of v3.0, this is {layout.version} with "
            f"{len(layout.episodes)} episodes: convert it first (tpgmm dataset convert, or "
            "LeRobot's own converter, which keeps videos)"
        )
    if out.exists():
        raise DatasetError(f"{out} exists; remove it, or give another folder for the copy")
    return layout


def _link_videos(source: str, target: str) -> None:
    """Link what is large and never changed in place, else copy."""
    if Path(source).suffix in (".mp4", ".png", ".jpg"):
        with suppress(OSError):
            os.link(os.path.realpath(source), target)
            return
    shutil.copy2(source, target)


def _rewrite(old: Path, new: Path, file: Path, columns: Mapping[str, Any]) -> None:
    """Write a parquet file of a set with some columns replaced, or added behind the others."""
    with open_parquet(old / file, old, ()) as parquet:
        table = parquet.read()
    for name, column in columns.items():
        if name in table.column_names:
            table = table.set_column(table.column_names.index(name), name, column)
        else:
            table = table.append_column(name, column)
    write_tables(new / file, [table])


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    text = json.dumps(content, indent=4, default=np.ndarray.tolist)
    path.write_text(text, encoding="utf-8")


def _tasks(task: str | Sequence[str], count: int) -> list[str]:
    tasks = [task] * count if isinstance(task, str) else list(task)
    if len(tasks) != count or not all(isinstance(item, str) and item for item in tasks):
        raise DatasetError(f"task is a text or one per demonstration, not empty; got {task!r}")
    return tasks


def _check_actions(
    demonstrations: Sequence[Demonstration], actions: Sequence[Any] | None
) -> Sequence[Demonstration | None]:
    """Return references as demonstrations, with the same names and checked as those are."""
    if actions is None:
        return [None] * len(demonstrations)
    if len(actions) != len(demonstrations):
        counts = f"actions of {len(actions)} and joints of {len(demonstrations)}"
        raise DatasetError(f"there are {counts} demonstrations")
    pairs = zip(demonstrations, actions, strict=True)
    return check_demonstrations([replace(item, joints=action) for item, action in pairs])


def _extend_info(old: Layout, new: dict[str, Any]) -> dict[str, Any]:
    """Return the ``info.json`` of the old set, if the new episodes fit to it."""
    if old.problems:
        raise DatasetError(f"the set cannot grow before it is in order: {old.problems[0]}")
    info = dict(old.info)
    features = {**new["features"]}
    # an event that none of the new demonstrations has stays a column
    features |= {k: v for k, v in info["features"].items() if k.startswith("event.")}
    shown = {**new, "robot_type": new["robot_type"] or info.get("robot_type")}
    _check_alike(shown, info, ("codebase_version", "fps", "robot_type"))
    keys, there = ({"features": sorted(each)} for each in (features, info["features"]))
    _check_alike(keys, there, ["features"])
    for key, feature in features.items():
        _check_alike(feature, info["features"][key], ("dtype", "shape", "names"), key)
    return info


def _check_alike(
    new: Mapping[str, Any], old: Mapping[str, Any], names: Sequence[str], key: str | None = None
) -> None:
    for name in names:
        if new[name] != old.get(name):
            message = f"the set has {name} {old.get(name)!r}, the demonstrations {new[name]!r}"
            raise DatasetError(message, column=key)


class _Writer:
    """Write episodes after those of the set ``old``, if there is one."""

    def __init__(self, root: Path, info: dict[str, Any], old: Layout | None) -> None:
        self.root, self.info = root, info
        self.tasks = [] if old is None else list(old.tasks)
        self.episodes = 0 if old is None else len(old.episodes)
        self.rows = 0 if old is None else sum(episode.length for episode in old.episodes)
        self.statistics = None if old is None else _old_statistics(old)
        # files of old episodes stay where they are
        self.before = root if old is None else old.root
        self.place = free_place(self.before, info["data_path"], info["chunks_size"])
        self.listed: list[dict[str, Any]] = []

    def write(
        self,
        demonstrations: Sequence[Demonstration],
        tasks: Sequence[str],
        commanded: Sequence[Demonstration | None],
    ) -> None:
        path = self.root / file_path(self.info["data_path"], *self.place)
        pairs = zip(demonstrations, tasks, commanded, strict=True)
        tables = (self._episode(number, *one) for number, one in enumerate(pairs))
        declared = {"fps": self.info["fps"], "features": self.info["features"]}
        write_tables(path, tables, {METADATA_KEY: json.dumps(declared).encode()})
        chunk, file = free_place(self.before, EPISODES_PATH, self.info["chunks_size"])
        for row in self.listed:
            row |= {"meta/episodes/chunk_index": chunk, "meta/episodes/file_index": file}
        schema = pa.schema([(key, _episode_type(key)) for key in self.listed[0]])
        table = pa.Table.from_pylist(self.listed, schema)
        write_tables(self.root / file_path(EPISODES_PATH, chunk, file), [table])
        self._tables()

    def _episode(
        self, number: int, shown: Demonstration, task: str, commanded: Demonstration | None
    ) -> pa.Table:
        features = self.info["features"]
        if task not in self.tasks:
            self.tasks.append(task)
        first = features["observation.state"]["names"]
        if (shown.joint_names is None) != (first is None):
            raise DatasetError(f"demonstration {number} has joint_names unlike the others")
        if first is not None:
            shown = shown.reorder(first)
            commanded = commanded and commanded.reorder(first)
        columns = kept.demonstration_columns(shown, number, features, self.info["fps"])
        if commanded is not None:
            columns |= kept.action_column(commanded, number, features)
        rows = len(shown)
        columns["episode_index"] = np.full((rows, 1), self.episodes)
        columns["index"] = np.arange(self.rows, self.rows + rows)[:, None]
        columns["task_index"] = np.full((rows, 1), self.tasks.index(task))
        columns = {key: columns[key] for key in features}
        new, before = summed.episode_statistics(columns), self.statistics
        row: dict[str, Any] = {
            "episode_index": self.episodes,
            "tasks": [task],
            "length": rows,
            "data/chunk_index": self.place[0],
            "data/file_index": self.place[1],
            "dataset_from_index": self.rows,
            "dataset_to_index": self.rows + rows,
        }
        for key, column in new.items():
            row |= {f"stats/{key}/{name}": column[name].tolist() for name in column}
        self.listed.append(row)
        self.statistics = new if before is None else summed.merge_statistics(before, new)
        self.episodes, self.rows = self.episodes + 1, self.rows + rows
        return kept.feature_table(columns, features)

    def _tables(self) -> None:
        meta = self.root / "meta"
        index = pd.Index(self.tasks, name="task")
        tasks = pd.DataFrame({"task_index": np.arange(len(self.tasks))}, index=index)
        tasks.to_parquet(meta / "tasks.parquet", write_page_checksum=True)

        self.info |= {
            "total_episodes": self.episodes,
            "total_frames": self.rows,
            "total_tasks": len(self.tasks),
            "splits": {"train": f"0:{self.episodes}"},
        }
        _write_json(meta / "info.json", self.info)
        _write_json(meta / "stats.json", self.statistics or {})


def _episode_type(key: str) -> pa.DataType:
    if key == "tasks":
        return pa.list_(pa.string())
    if key.startswith("stats/"):
        return pa.list_(pa.int64() if key.endswith("/count") else pa.float64())
    return pa.int64()


def _old_statistics(old: Layout) -> summed.Statistics:
    path = old.root / "meta" / "stats.json"
    needed = {"min", "max", "mean", "std", "count", *summed.QUANTILES}
    with suppress(OSError, ValueError, TypeError, AttributeError):
        stored = json.loads(path.read_text(encoding="utf-8"))
        found = {key: {n: np.array(v) for n, v in stored[key].items()} for key in old.features}
        if all(needed <= set(column) for column in found.values()):
            return found
    message = "statistics of some columns are missing or not readable; the set cannot grow"
    raise DatasetError(message, file="meta/stats.json")
