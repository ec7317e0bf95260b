"""Rows of episodes: read file by file, checked, as arrays."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from tpgmm_datasets.errors import CHECKS, DatasetError, DatasetWarning, list_problems
from tpgmm_datasets.lerobot.files import METADATA_KEY
from tpgmm_datasets.lerobot.layout import BOOKKEEPING, Episode, Feature, Layout
from tpgmm_datasets.lerobot.parquet import MOST_IN_EPISODE, episode_tables, open_parquet
from tpgmm_datasets.lerobot.row_times import row_times, time_problems

Array = np.ndarray[Any, Any]
#: What is done with a problem: raise it, or let it pass.
Policy = Callable[[DatasetError], None]
#: How arrow calls the types that it names differently.
ARROW_NAMES = {"float32": "float", "float64": "double", "float16": "halffloat"}
#: What may be in the file in place of what info.json declares: nothing of it is lost.
WIDER = {("float32", "double"), ("float16", "double"), ("float16", "float")}


@dataclass(frozen=True)
class EpisodeRows:
    """The checked rows of one episode.

    Parameters
    ----------
    episode : Episode
        What the metadata say of it.
    time : ndarray of shape (T,)
        Seconds from its start.
    values : mapping of str to ndarray of shape (T, width)
        By feature, as stored.
    """

    episode: Episode
    time: Array
    values: Mapping[str, Array]


class Relaxed:
    """Reaction to a problem: raise it, or keep it if its check is among ``relax``.

    Parameters
    ----------
    relax : collection of str
        Names of :data:`CHECKS`.

    Raises
    ------
    DatasetError
        If one does not exist.
    """

    def __init__(self, relax: Collection[str]) -> None:
        self.names = {relax} if isinstance(relax, str) else set(relax)
        self.problems: list[DatasetError] = []
        if not self.names <= set(CHECKS):
            unknown = sorted(self.names - set(CHECKS))
            raise DatasetError(f"relax names {unknown}; the checks are {sorted(CHECKS)}")

    def __call__(self, problem: DatasetError) -> None:
        """Raise a problem, or keep it."""
        if problem.check not in self.names:
            raise problem
        self.problems.append(problem)

    def warn(self) -> None:
        """Warn of the problems that were kept since, those that are alike as one."""
        for text in list_problems(self.problems):
            # the caller is some levels up, how many depends on the way
            warnings.warn(f"left out or not checked: {text}", DatasetWarning, stacklevel=3)
        self.problems = []


def read_episodes(
    layout: Layout, wanted: Sequence[Episode], features: list[Feature], policy: Policy
) -> Iterator[EpisodeRows]:
    """Yield the wanted episodes in order of their index, file by file at bounded memory.

    An episode with a problem that ``policy`` does not raise is left out.
    """
    groups: dict[Path, list[Episode]] = {}
    for episode in wanted:
        groups.setdefault(episode.file, []).append(episode)
    for episodes in groups.values():
        try:
            yield from _read_file(layout, episodes, features, policy)
        except DatasetError as problem:
            policy(problem)


def _read_file(
    layout: Layout, episodes: Sequence[Episode], features: list[Feature], policy: Policy
) -> Iterator[EpisodeRows]:
    file, needed = episodes[0].file, ["episode_index", *(feature.key for feature in features)]
    expected = {episode.index: episode for episode in episodes}
    listed = {one.index: one.length for one in layout.episodes if one.file == file}
    with open_parquet(layout.root / file, layout.root, needed, BOOKKEEPING) as parquet:
        schema = parquet.schema_arrow
        for problem in _compare_declarations(layout, file, schema.metadata):
            policy(problem)
        counters = set(BOOKKEEPING[:4]).intersection(schema.names)
        values = len(counters) + sum(feature.width for feature in features)
        _check_size(file, parquet.metadata.num_rows, values, listed.values())
        tables = episode_tables(parquet, file, sorted(counters.union(needed)))
        for index, table in _check_listing(tables, file, listed, policy):
            if index in expected:
                yield from _read_rows(layout, expected.pop(index), table, features, policy)
    for index, episode in sorted(expected.items()):
        message = f"the metadata list it with {episode.length} rows, the file has none"
        policy(DatasetError(message, check="metadata", file=file, episode=index))


def _check_listing(
    tables: Iterable[tuple[int, pa.Table]], file: Path, listed: Collection[int], policy: Policy
) -> Iterator[tuple[int, pa.Table]]:
    """Yield the rows of episodes that the metadata list in a file, those of each once."""
    seen: set[int] = set()
    for index, table in tables:
        if index in seen:
            message = "its rows are there twice, or are not together"
            policy(DatasetError(message, check="duplicates", file=file, episode=index))
        elif index not in listed:
            message = "the metadata do not list it in this file"
            policy(DatasetError(message, check="metadata", file=file, episode=index))
        else:
            yield index, table
        seen.add(index)


def _check_size(file: Path, rows: int, values: int, lengths: Collection[int]) -> None:
    """Refuse rows that are too wide for an episode to fit into memory."""
    longest = max(lengths)
    if (longest + max(rows - sum(lengths), 0)) * values > MOST_IN_EPISODE:
        raise DatasetError(
            f"it has {rows} rows of {values} values, for episodes of at most {longest}; of one "
            f"at most {MOST_IN_EPISODE} values are read",
            check="metadata",
            file=file,
        )


def _compare_declarations(
    layout: Layout, file: Path, metadata: Mapping[bytes, bytes] | None
) -> Iterator[DatasetError]:
    """Yield differences between ``info.json`` and what our writer left in the data file."""
    if not metadata or METADATA_KEY not in metadata:
        return
    try:
        declared = json.loads(metadata[METADATA_KEY])
        pairs = [("fps", declared["fps"], layout.info.get("fps"))]
        present = layout.info["features"]
        pairs += [(key, one, present.get(key)) for key, one in declared["features"].items()]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        message = f"the description in the file is corrupted: {error!r}"
        raise DatasetError(message, check="missing", file=file) from error
    for name, there, here in pairs:
        if there != here:
            message = f"the file was written with {there!r}, but info.json says {here!r}"
            yield DatasetError(message, check="metadata", file=file, column=name)


def _read_rows(
    layout: Layout, episode: Episode, table: pa.Table, features: list[Feature], policy: Policy
) -> Iterator[EpisodeRows]:
    """Yield the checked arrays of an episode; none if a problem of it is let pass."""
    problems = list(_check_rows(layout, episode, table))
    values = {}
    for feature in features:
        try:
            values[feature.key] = _read_values(table, feature, episode)
        except DatasetError as error:
            problems.append(error)
    for problem in problems:
        policy(problem)
    if not problems:
        stamps = table["timestamp"].to_numpy() if "timestamp" in table.column_names else None
        yield EpisodeRows(episode, row_times(stamps, len(table), layout.fps), values)


def _check_rows(layout: Layout, episode: Episode, table: pa.Table) -> Iterator[DatasetError]:
    """Yield contradictions between the rows of an episode and the metadata, and in time."""
    where, rows = episode.where, len(table)
    if rows != episode.length:
        message = f"the metadata give {episode.length} rows, the file has {rows}"
        yield DatasetError(message, check="metadata", **where)
    for name, start in {"frame_index": 0, "index": episode.start}.items():
        if name in table.column_names and start is not None:
            yield from _check_counter(table[name], start, where | {"column": name})
    if "timestamp" in table.column_names:
        column = table["timestamp"]
        if not pa.types.is_floating(column.type) or column.null_count:
            yield DatasetError("not all are numbers", check="nan", column="timestamp", **where)
        else:
            yield from time_problems(column.to_numpy(), layout.fps, **where)


def _check_counter(column: Any, start: int, where: Mapping[str, Any]) -> Iterator[DatasetError]:
    """Check that a column counts from ``start`` in steps of one."""
    if not pa.types.is_integer(column.type) or column.null_count:
        yield DatasetError("not all are whole numbers", **where)
    elif (column.to_numpy() != np.arange(start, start + len(column))).any():
        message = f"it does not count from {start} in steps of one"
        yield DatasetError(message, check="metadata", **where)


def _read_values(table: pa.Table, feature: Feature, episode: Episode) -> Array:
    """Read the values of a feature, shape (T, width), without a copy where arrow allows."""
    where, rows = episode.where | {"column": feature.key}, len(table)
    flat = _flatten(table[feature.key].combine_chunks(), where)
    declared, stored = feature.dtype, str(flat.type)
    if stored != ARROW_NAMES.get(declared, declared) and (declared, stored) not in WIDER:
        message = f"it holds {stored}, info.json declares {declared}"
        raise DatasetError(message, check="metadata", **where)
    if len(flat) != rows * feature.width:
        count = len(flat) / rows
        message = f"it has {count:g} values per row, info.json declares {list(feature.shape)}"
        raise DatasetError(message, check="metadata", **where)
    values: Array = flat.to_numpy(zero_copy_only=False).reshape(rows, feature.width)
    if values.dtype.kind == "f" and not (finite := np.isfinite(values)).all():
        row, place = np.argwhere(~finite)[0].tolist()
        first = f"row {row}, {feature.labels[place]}"
        message = f"{(~finite).sum()} values are NaN or infinite, the first: {first}"
        raise DatasetError(message, check="nan", **where)
    return values


def _flatten(column: Any, where: Mapping[str, Any]) -> Any:
    """Flatten an arrow column of numbers, or of equally long lists of them."""
    if isinstance(column.type, pa.ExtensionType):
        column = column.storage
    nulls = column.null_count
    lists = pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list
    while any(is_list(column.type) for is_list in lists):
        if not pa.types.is_fixed_size_list(column.type) and not nulls:
            lengths = column.value_lengths().unique().to_pylist()
            if len(lengths) > 1:
                raise DatasetError(f"its rows have {sorted(lengths)} values", **where)
        column = column.flatten()
        nulls += column.null_count
    numeric = pa.types.is_floating, pa.types.is_integer, pa.types.is_boolean
    if not any(is_kind(column.type) for is_kind in numeric):
        raise DatasetError(f"it holds {column.type}, not numbers", **where)
    if nulls:
        raise DatasetError(f"{nulls} values are missing (null)", check="nan", **where)
    return column
