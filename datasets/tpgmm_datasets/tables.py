"""Demonstrations as one tidy table, and back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import torch

from tpgmm_datasets.errors import DatasetError
from tpgmm_datasets.lerobot.columns import pose_values
from tpgmm_datasets.names import POSE_PARTS
from tpgmm_torch.data.arrays import as_array
from tpgmm_torch.data.demonstrations import Demonstration, check_demonstrations
from tpgmm_torch.data.frames import Frame

__all__ = ["demonstrations_from_frame", "demonstrations_to_frame"]

FRAME_KINDS = ("frame", "constant frame")
KINDS = ("joint", *FRAME_KINDS, "event")


def demonstrations_to_frame(demonstrations: Sequence[Demonstration]) -> pd.DataFrame:
    """One row per time step of each demonstration.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
        They may differ in frames and events.

    Returns
    -------
    pandas.DataFrame
        Indexed by ``episode`` and ``time`` [s]. The columns have two levels: the kind, and a
        name. ``table["joint"]`` has the joints by name (by number where they have none);
        ``table["frame"]`` the poses that change, ``bottle.x`` ... ``bottle.qz``;
        ``table["constant frame"]`` those that do not; ``table["event"]`` the time of each
        event. What a demonstration does not have is NaN.

    Examples
    --------
    >>> shown = Demonstration([0.0, 0.5], [[0.0], [1.0]], joint_names=["elbow"])
    >>> demonstrations_to_frame([shown])["joint"]["elbow"].tolist()
    [0.0, 1.0]
    """
    parts = [
        _part(demonstration, episode)
        for episode, demonstration in enumerate(check_demonstrations(demonstrations))
    ]
    table = pd.concat(parts)
    table.columns = pd.MultiIndex.from_tuples(list(table.columns), names=["kind", "name"])
    return table


def _part(demonstration: Demonstration, episode: int) -> pd.DataFrame:
    rows = len(demonstration)
    names = demonstration.joint_names or range(demonstration.n_joints)
    joints = as_array(demonstration.joints)
    columns: dict[Any, Any] = {("joint", name): joints[:, i] for i, name in enumerate(names)}
    for name, frame in demonstration.frames.items():
        kind = "frame" if frame.batch_shape else "constant frame"
        pose = pose_values(frame, rows)
        columns |= {(kind, f"{name}.{part}"): pose[:, i] for i, part in enumerate(POSE_PARTS)}
    for name, at in demonstration.events.items():
        columns["event", name] = np.full(rows, at)
    index = pd.MultiIndex.from_arrays(
        [np.full(rows, episode), as_array(demonstration.time)], names=["episode", "time"]
    )
    # a dict of tuples would become a MultiIndex, which pandas aligns by sorting
    part = pd.DataFrame(dict(enumerate(columns.values())), index=index)
    part.columns = pd.Index(list(columns), tupleize_cols=False)
    return part


def demonstrations_from_frame(table: pd.DataFrame) -> list[Demonstration]:
    """The demonstrations of a table as :func:`demonstrations_to_frame` makes it.

    Parameters
    ----------
    table : pandas.DataFrame
        Rows of one episode in order of time; a column that is NaN throughout an episode is
        not in its demonstration.

    Returns
    -------
    list of Demonstration
        In order of appearance, as float64.

    Raises
    ------
    DatasetError
        If index or columns are others, or a value is missing.

    Examples
    --------
    >>> shown = Demonstration([0.0, 0.5], [[0.0], [1.0]], joint_names=["elbow"])
    >>> demonstrations_from_frame(demonstrations_to_frame([shown, shown]))[1].joint_names
    ('elbow',)
    """
    if list(table.index.names) != ["episode", "time"]:
        raise DatasetError(
            f"the table's index is (episode, time), got {list(table.index.names)}"
        )
    unknown = [column for column in table.columns if column[0] not in KINDS]
    if table.columns.nlevels != 2 or unknown:
        raise DatasetError(
            f"the table's columns are (kind, name) with kinds {list(KINDS)}; "
            f"got {unknown or list(table.columns)}"
        )
    groups = table.groupby(level="episode", sort=False)
    return [_demonstration(episode, part) for episode, part in groups]


def _demonstration(episode: Any, part: pd.DataFrame) -> Demonstration:
    part = part.dropna(axis="columns", how="all")
    where = f"episode {episode} of the table"
    for column in part.columns[part.isna().any()]:
        raise DatasetError(f"{where} lacks some values", column=f"{column[0]}: {column[1]}")
    names = {kind: [name for k, name in part.columns if k == kind] for kind in KINDS}
    if not names["joint"]:
        raise DatasetError(f"{where} has no joints")
    numbered = names["joint"] == list(range(len(names["joint"])))
    poses = [(k, n.rpartition(".")[0]) for k, n in part.columns if k in FRAME_KINDS]
    frames = {}
    for kind, name in dict.fromkeys(poses):
        columns = [(kind, f"{name}.{x}") for x in POSE_PARTS]
        lacking = [full for _, full in columns if full not in names[kind]]
        if lacking:
            raise DatasetError(f"{where} lacks {lacking} of frame {name!r}")
        pose = torch.from_numpy(np.array(part[columns], dtype=np.float64))
        pose = pose if kind == "frame" else _only(pose, name, where)
        frames[name] = Frame(pose[..., :3], pose[..., 3:])
    events = {
        name: float(_only(torch.from_numpy(np.array(part[[("event", name)]])), name, where))
        for name in names["event"]
    }
    return Demonstration(
        torch.from_numpy(np.array(part.index.get_level_values("time"), dtype=np.float64)),
        torch.from_numpy(np.array(part["joint"], dtype=np.float64)),
        frames,
        None if numbered else tuple(map(str, names["joint"])),
        events,
    )


def _only(values: torch.Tensor, name: str, where: str) -> torch.Tensor:
    """The one row that is repeated."""
    if bool((values != values[:1]).any()):
        raise DatasetError(f"{where}: {name!r} is to be constant, but it changes")
    return values[0]
