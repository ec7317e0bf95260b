"""Description of a data set and its faults, without making demonstrations of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tpgmm_datasets.conversion.joints import joint_feature, names_of
from tpgmm_datasets.errors import DatasetError
from tpgmm_datasets.lerobot.columns import ENVIRONMENT, EVENT, KNOWN, SEEN
from tpgmm_datasets.lerobot.episodes import EpisodeRows, read_episodes
from tpgmm_datasets.lerobot.hub import local_folder
from tpgmm_datasets.lerobot.layout import BOOKKEEPING, CAMERAS, Feature, Layout, open_layout
from tpgmm_datasets.units import guess_unit, with_pose_units
from tpgmm_torch.data.pose_names import is_gripper, pose_groups

__all__ = ["DatasetInfo", "describe_lerobot"]

#: By column.
Values = dict[str, Any]


@dataclass(frozen=True)
class ColumnInfo(Feature):
    """A numeric column of a data set.

    Parameters
    ----------
    key, dtype : str
        Name and type.
    shape : tuple of int
        Shape of a row's value.
    names : tuple of str or None
        One per value, where the metadata give them so that they can be used.
    units : tuple of str or None
        One per value: those declared; for the joints of a set that declares none, a guess
        with a question mark, the same for all but grippers.
    misnamed : str
        Why the names cannot be used.
    low, high : tuple of float or None
        Range of each value over the episodes without problems; None without such an episode.
    """

    low: tuple[float, ...] | None = None
    high: tuple[float, ...] | None = None


@dataclass(frozen=True)
class DatasetInfo:
    """Description of a data set, returned by :func:`describe_lerobot`.

    Parameters
    ----------
    path : Path
        The folder.
    version : str
        Layout, for example ``"v3.0"``.
    robot_type : str or None
        As declared.
    fps : float
        Rows per second.
    columns : tuple of ColumnInfo
        The numeric ones, without LeRobot's bookkeeping.
    cameras : tuple of str
        Video and image columns, which are not read.
    joints : str or None
        The column that ``load_lerobot`` takes for the joints.
    frames, events : tuple of str
        Frames and events that ``load_lerobot`` finds by itself.
    tasks : tuple of str
        All tasks.
    lengths : tuple of int
        Rows of each episode, by the metadata.
    tracked : mapping of str to (float, float)
        Objects that were tracked in the pictures: in which share of all rows each was seen,
        and was seen or inferred.
    problems : tuple of DatasetError
        All that is wrong; empty for a set that loads. What is wrong with the joints, and what
        is given may mend, has ``check="joints"``.
    """

    path: Path
    version: str
    robot_type: str | None
    fps: float
    columns: tuple[ColumnInfo, ...]
    cameras: tuple[str, ...]
    joints: str | None
    frames: tuple[str, ...]
    events: tuple[str, ...]
    tasks: tuple[str, ...]
    lengths: tuple[int, ...]
    tracked: Mapping[str, tuple[float, float]]
    problems: tuple[DatasetError, ...]

    @property
    def duration(self) -> float:
        """Seconds of all episodes."""
        return sum(self.lengths) / self.fps


def describe_lerobot(path: str | Path) -> DatasetInfo:
    """Read a whole data set, at bounded memory, and tell what is in it.

    Parameters
    ----------
    path : str or Path
        A folder, or a name on the hub, as in ``load_lerobot``.

    Returns
    -------
    DatasetInfo
        All problems are in it; at most one per column and episode.

    Raises
    ------
    DatasetError
        If its metadata cannot be read at all.

    Examples
    --------
    >>> from tpgmm_datasets import save_lerobot
    >>> from tpgmm_torch import Demonstration
    >>> import tempfile
    >>> shown = Demonstration([0.0, 0.1, 0.2], [[0.0], [0.5], [1.0]], joint_names=["elbow"])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = save_lerobot([shown], Path(folder) / "bends", fps=10, task="bend the elbow")
    ...     found = describe_lerobot(path)
    >>> found.version, found.lengths, found.tasks, found.problems
    ('v3.0', (3,), ('bend the elbow',), ())
    """
    layout = open_layout(local_folder(path))
    problems = list(layout.problems)
    features = _list_numeric(layout)
    episodes = read_episodes(layout, layout.episodes, features, problems.append)
    ranges, sums = _summarise_values(episodes)
    joints = _find_joints(layout, problems)
    environment = layout.features.get(ENVIRONMENT)
    return DatasetInfo(
        layout.root,
        layout.version,
        layout.robot_type,
        layout.fps,
        tuple(_describe_column(item, ranges.get(item.key), joints) for item in features),
        tuple(key for key, feature in layout.features.items() if feature.is_camera),
        joints,
        tuple(pose_groups(environment.names)) if environment else (),
        tuple(f.key.removeprefix(EVENT) for f in features if f.key.startswith(EVENT)),
        layout.tasks,
        tuple(episode.length for episode in layout.episodes),
        _share_tracked(layout, sums) if {SEEN, KNOWN} <= sums.keys() else {},
        tuple(problems),
    )


def _list_numeric(layout: Layout) -> list[Feature]:
    """List the columns of numbers that are not LeRobot's own."""
    features = [item for key, item in layout.features.items() if key not in BOOKKEEPING]
    return [item for item in features if item.dtype not in (*CAMERAS, "string")]


def _find_joints(layout: Layout, problems: list[DatasetError]) -> str | None:
    """Return the column of the joints, and add what is wrong with it to the problems."""
    joints = None
    try:
        joints = joint_feature(layout)
        names_of(layout.feature(joints), None, None)
    except DatasetError as problem:
        problems.append(problem)
    return joints


def _summarise_values(episodes: Iterable[EpisodeRows]) -> tuple[Values, Values]:
    """Return the range of each value by column, and the sums of those of tracking."""
    ranges, sums = Values(), Values()
    for rows in episodes:
        for key, values in rows.values.items():
            low, high = values.min(axis=0), values.max(axis=0)
            if key in ranges:
                low, high = np.minimum(low, ranges[key][0]), np.maximum(high, ranges[key][1])
            ranges[key] = low, high
            if key in (SEEN, KNOWN):
                sums[key] = sums.get(key, 0) + values.sum(axis=0)
    return ranges, sums


def _share_tracked(layout: Layout, sums: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """Return in which share of all rows each object was seen, and was seen or inferred."""
    rows = max(sum(episode.length for episode in layout.episodes), 1)
    shares = [np.ravel(sums[key]) / rows for key in (SEEN, KNOWN)]
    named = zip(layout.features[SEEN].names or (), *shares, strict=False)
    return {name: (float(seen), float(known)) for name, seen, known in named}


def _describe_column(feature: Feature, extremes: Any, joints: str | None) -> ColumnInfo:
    if extremes is None:
        return ColumnInfo(**vars(feature))
    low, high = (tuple(map(float, values)) for values in extremes)
    column = ColumnInfo(**vars(feature), low=low, high=high)
    if feature.units is not None or feature.key != joints:
        return column
    # the joints of a feature have one unit, grippers may have their own
    apart = np.array([is_gripper(name) for name in feature.names or ("",) * len(low)])
    alike = np.array((low, high))[:, ~apart]
    common = guess_unit(alike.min(initial=0.0), alike.max(initial=0.0))
    ranges = zip(low, high, apart, strict=True)
    guesses = [f"{guess_unit(a, b) if gripper else common}?" for a, b, gripper in ranges]
    return replace(column, units=with_pose_units(feature.names, guesses))
