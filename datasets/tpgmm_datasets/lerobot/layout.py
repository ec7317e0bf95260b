"""The folder of a LeRobot data set: what ``meta/`` says, in both layouts.

v3.0 keeps many episodes in each parquet file and lists them in ``meta/episodes``; v2.1 has
one parquet file per episode and ``meta/episodes.jsonl``. Both become one :class:`Layout`.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tpgmm_datasets.errors import DatasetError
from tpgmm_datasets.lerobot.files import chunked_files
from tpgmm_datasets.lerobot.parquet import read_columns
from tpgmm_datasets.names import value_names
from tpgmm_torch.atomic import read_whole

#: Columns that LeRobot keeps for itself.
BOOKKEEPING = ("timestamp", "frame_index", "episode_index", "index", "task_index")
CAMERAS = ("video", "image")
INFO = "meta/info.json"
#: Of a row: what is longer is a mistake, and would fill the memory.
MOST_VALUES = 100_000
#: Indices beyond this are mistakes: floats could not count them.
LARGEST_INDEX = 2**53
HIGHEST_FPS = 1e6
#: Of a listed episode: the first two in both layouts, all in v3.0.
ROW_NUMBERS = (
    "episode_index",
    "length",
    "dataset_from_index",
    "dataset_to_index",
    "data/chunk_index",
    "data/file_index",
)


@dataclass(frozen=True)
class Feature:
    """One column as ``info.json`` declares it.

    Parameters
    ----------
    key : str
        Name of the column.
    dtype : str
        ``"float32"``, ``"int64"``, ``"bool"``, ``"video"``, ...
    shape : tuple of int
        Shape of one row's value.
    names : tuple of str or None
        One name per value; None where the metadata name none, or not so that it can be used.
    units : tuple of str or None
        One unit per value, where the metadata tell (those of this project's writer do).
    misnamed : str
        Why the names cannot be used.
    offsets : tuple of float or None
        What is added to each value once it is in radians or metres, where the metadata of a
        tracked set tell: how far the motors are from the joints of the robot's description.
    """

    key: str
    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...] | None = None
    units: tuple[str, ...] | None = None
    misnamed: str = ""
    offsets: tuple[float, ...] | None = None

    @property
    def width(self) -> int:
        """Number of values per row."""
        return math.prod(self.shape)

    @property
    def labels(self) -> tuple[str, ...]:
        """Name of its values in messages."""
        return self.names or tuple(f"value {i}" for i in range(self.width))

    @property
    def is_camera(self) -> bool:
        """True of a video or image, which this project does not read."""
        return self.dtype in CAMERAS


@dataclass(frozen=True)
class Episode:
    """Where an episode lies, according to the metadata.

    Parameters
    ----------
    index : int
        Its ``episode_index``.
    length : int
        Number of rows.
    tasks : tuple of str
        What was to be done.
    file : Path
        The parquet file, relative to the root.
    start : int or None
        ``index`` of its first row in the whole set; None where the metadata do not tell.
    """

    index: int
    length: int
    tasks: tuple[str, ...]
    file: Path
    start: int | None = None

    @property
    def where(self) -> dict[str, Any]:
        """File and index, for errors."""
        return {"file": self.file, "episode": self.index}


@dataclass(frozen=True)
class Layout:
    """All that the metadata of a data set say.

    Parameters
    ----------
    root : Path
        The folder.
    version : str
        ``"v2.0"``, ``"v2.1"`` or ``"v3.0"``.
    fps : float
        Rows per second.
    robot_type : str or None
        As declared.
    features : mapping of str to Feature
        The declared columns.
    episodes : tuple of Episode
        In order of their index.
    tasks : tuple of str
        All tasks.
    info : mapping
        ``info.json`` as it is.
    problems : tuple of DatasetError
        Contradictions found in the metadata themselves.
    """

    root: Path
    version: str
    fps: float
    robot_type: str | None
    features: Mapping[str, Feature]
    episodes: tuple[Episode, ...]
    tasks: tuple[str, ...]
    info: Mapping[str, Any]
    problems: tuple[DatasetError, ...] = ()

    def feature(self, key: str) -> Feature:
        """Return the declared feature of that name.

        Raises
        ------
        DatasetError
            If it does not exist, or is a video.
        """
        readable = sorted(k for k, f in self.features.items() if not f.is_camera)
        if key not in readable:
            message = f"there is no numeric column of that name; the set has {readable}"
            raise DatasetError(message, file=INFO, column=key)
        return self.features[key]


def open_layout(root: Path) -> Layout:
    """Read the metadata of the data set in folder ``root``.

    Raises
    ------
    DatasetError
        If there is no data set, its version is unknown, or its metadata cannot be read.
    """
    info = _read_info(root)
    version, robot_type = info.get("codebase_version"), info.get("robot_type")
    fps: Any = info.get("fps")
    if version not in ("v2.0", "v2.1", "v3.0"):
        raise DatasetError(
            f"codebase_version is {version!r}; v2.0, v2.1 and v3.0 are read. "
            "LeRobot's own converters bring older sets to v3.0",
            file=INFO,
        )
    if type(fps) not in (int, float) or not 0 < fps < HIGHEST_FPS:
        message = f"fps is {str(fps)[:20]}, not a number above 0 and below {HIGHEST_FPS:g}"
        raise DatasetError(message, file=INFO)
    features = _features(info)
    modern = version == "v3.0"
    rows = _list_episodes(root) if modern else _json_lines(root, "meta/episodes.jsonl")
    episodes = sorted((_episode(info, *row, modern) for row in rows), key=lambda e: e.index)
    tasks = _tasks(root, modern)
    return Layout(
        root,
        str(version),
        float(fps),
        None if robot_type is None else str(robot_type),
        features,
        tuple(episodes),
        tasks,
        info,
        tuple(_contradictions(root, info, episodes, tasks)),
    )


def _read_info(root: Path) -> dict[str, Any]:
    if not (root / INFO).is_file():
        message = f"{root} is not a LeRobot data set: it has no {INFO}"
        raise DatasetError(message, check="missing")
    return _object(_bytes(root, INFO), INFO)


def _bytes(root: Path, file: str) -> bytes:
    try:
        return read_whole(root / file)
    except OSError as error:
        raise DatasetError(str(error), check="missing", file=file) from error


def _object(text: bytes, place: str) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"this is not JSON: {error}", file=place) from error
    if not isinstance(found, dict):
        raise DatasetError("this is not a JSON object", file=place)
    return found


def _features(info: Mapping[str, Any]) -> dict[str, Feature]:
    declared = info.get("features")
    if not isinstance(declared, dict) or not declared:
        raise DatasetError("'features' declares no columns", file=INFO)
    return {key: _feature(key, entry) for key, entry in declared.items()}


def _feature(key: str, entry: Any) -> Feature:
    entry = _as_dict(entry)
    dtype, shape = entry.get("dtype"), entry.get("shape")
    sizes: list[Any] = shape if isinstance(shape, list) else [None]
    if not isinstance(dtype, str) or not all(type(n) is int and n > 0 for n in sizes):
        message = f"a feature needs a dtype and a shape, got {dtype!r} and {shape!r}"
        raise DatasetError(message, file=INFO, column=key)
    width = math.prod(sizes)
    if width > MOST_VALUES and dtype not in CAMERAS:
        message = f"a row has {width} values ({shape!r}); at most {MOST_VALUES} are read"
        raise DatasetError(message, file=INFO, column=key)
    extra = _as_dict(entry.get("info"))
    names, misnamed = value_names(entry.get("names"), width, key)
    units, wrong = value_names(extra.get("units"), width, distinct=False)
    if wrong:
        message = f"its units cannot be used, {wrong}: mend them, or leave them out"
        raise DatasetError(message, file=INFO, column=key)
    offsets = _parse_offsets(extra.get("offsets"), width, key)
    return Feature(key, dtype, tuple(sizes), names, units, misnamed, offsets)


def _as_dict(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _parse_offsets(offsets: Any, width: int, key: str) -> tuple[float, ...] | None:
    """Check that offsets, where there are any, are finite numbers, one for each value."""
    if offsets is None:
        return None
    whole = isinstance(offsets, list) and len(offsets) == width
    if not whole or not all(type(x) in (int, float) and math.isfinite(x) for x in offsets):
        message = f"its joint offsets are {width} numbers in radians, got {str(offsets)[:80]}"
        raise DatasetError(message, file=INFO, column=key)
    return tuple(map(float, offsets))


def _list_episodes(root: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    files = chunked_files(root / "meta" / "episodes")
    if not files:
        message = "no episodes are listed: never finalised (LeRobotDataset.finalize), or a part"
        raise DatasetError(message, check="missing", file="meta/episodes")
    for path in files:
        for row in read_columns(path, root, (*ROW_NUMBERS, "tasks")).to_pylist():
            yield str(path.relative_to(root)), row


def _json_lines(root: Path, file: str) -> Iterator[tuple[str, dict[str, Any]]]:
    if not (root / file).is_file():
        raise DatasetError("the file is missing", check="missing", file=file)
    for number, text in enumerate(_bytes(root, file).splitlines(), start=1):
        if text.strip():
            place = f"{file}, line {number}"
            yield place, _object(text, place)


def _episode(info: Mapping[str, Any], place: str, row: dict[str, Any], modern: bool) -> Episode:
    _check_numbers(row, ROW_NUMBERS if modern else ROW_NUMBERS[:2], place)
    index, length = row["episode_index"], row["length"]
    tasks = row.get("tasks") or ()
    if not all(isinstance(task, str) for task in tasks):
        raise DatasetError(f"tasks are no text: {tasks!r}", file=place, column="tasks")
    if not modern:
        file = episode_file(info, "data_path", index, None)
        return Episode(index, length, tuple(tasks), file)
    start, stop, *numbers = (row[name] for name in ROW_NUMBERS[2:])
    if stop - start != length:
        message = f"the length is {length} but the rows go from {start} to {stop}"
        raise DatasetError(message, file=place, episode=index)
    file = episode_file(info, "data_path", index, (numbers[0], numbers[1]))
    return Episode(index, length, tuple(tasks), file, start)


def _check_numbers(row: Mapping[str, Any], names: Sequence[str], place: str) -> None:
    for name in names:
        if type(row.get(name)) is not int or not 0 <= row[name] <= LARGEST_INDEX:
            message = f"{row.get(name)!r} is not a whole number from 0 to 2^53"
            raise DatasetError(message, file=place, column=name)


def episode_file(
    info: Mapping[str, Any], template: str, index: int, place: Any, **texts: str
) -> Path:
    """Find the file of an episode, relative to the root, by a template in ``info.json``.

    Parameters
    ----------
    info : mapping
        ``info.json`` as it is.
    template : str
        ``"data_path"`` or ``"video_path"``.
    index : int
        Index of the episode.
    place : (int, int) or None
        Numbers of chunk and file in v3.0; None in v2.1, where an episode has its own file.
    **texts : str
        Further fields of the template: ``video_key``.

    Raises
    ------
    DatasetError
        If there is no such template, or it leads out of the set.
    """
    text, size = info.get(template), info.get("chunks_size", 1000)
    if type(size) is not int or size < 1:
        raise DatasetError(f"chunks_size is {size!r}", file=INFO)
    chunk, number = place or (index // size, index)
    numbers = {
        "episode_index": index,
        "episode_chunk": chunk,
        "chunk_index": chunk,
        "file_index": number,
    }
    # no attributes, and no width that would fill the memory
    plain = "|".join(["[^{}]", *(f"{{{name}}}" for name in texts)])
    fields = rf"({{({'|'.join(numbers)})(:0?\d?\dd)?}}|{plain})+"
    if not isinstance(text, str) or not re.fullmatch(fields, text):
        raise DatasetError(
            f"{template} {text!r} cannot be filled in: it has fields like "
            f"{{chunk_index:03d}}, of {sorted({**numbers, **texts})}",
            file=INFO,
        )
    file = Path(text.format(**numbers, **texts))
    if file.is_absolute() or ".." in file.parts or "\0" in str(file):
        raise DatasetError(f"{template} {text!r} leaves the set", file=INFO)
    return file


def _tasks(root: Path, modern: bool) -> tuple[str, ...]:
    if not modern:
        return tuple(str(row.get("task")) for _, row in _json_lines(root, "meta/tasks.jsonl"))
    path = root / "meta" / "tasks.parquet"
    try:
        stored = read_columns(path, root, ("task",))
    except DatasetError as error:
        if error.column != "task":
            raise
        # pandas writes an index without a name under one of its own
        stored = read_columns(path, root, ("__index_level_0__",))
    return tuple(map(str, stored.column(0).to_pylist()))


def _contradictions(
    root: Path, info: Mapping[str, Any], episodes: list[Episode], tasks: tuple[str, ...]
) -> Iterator[DatasetError]:
    counts = {
        "total_episodes": len(episodes),
        "total_frames": sum(episode.length for episode in episodes),
        "total_tasks": len(tasks),
    }
    for name, count in counts.items():
        if info.get(name, count) != count:
            message = f"{name} is {info[name]!r}, but the set lists {count}"
            yield DatasetError(message, check="metadata", file=INFO)
    seen: set[int] = set()
    for one in episodes:
        if one.index in seen:
            message = "the metadata list it twice"
            yield DatasetError(message, check="duplicates", episode=one.index)
        seen.add(one.index)
        for task in set(one.tasks) - set(tasks):
            message = f"its task {task!r} is not among the tasks of the set, {list(tasks)}"
            yield DatasetError(message, check="metadata", episode=one.index)
    listed = {episode.file for episode in episodes}
    for path in chunked_files(root / "data"):
        if path.relative_to(root) not in listed:
            message = "no episode lies in this file: left over of another or a broken recording"
            yield DatasetError(message, check="metadata", file=path.relative_to(root))
