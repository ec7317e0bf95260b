"""Events and wrenches that a data set keeps, in columns of their own.

``event.<name>`` is true at the step of the event, ``observation.wrench.<link>`` has six values.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from tpgmm_datasets.lerobot.columns import EVENT, WRENCH
from tpgmm_datasets.lerobot.episodes import EpisodeRows, Relaxed, read_episodes
from tpgmm_datasets.lerobot.layout import Feature, Layout, open_layout


def event_features(layout: Layout) -> list[Feature]:
    """List the columns of a data set that tell of events."""
    features = layout.features.values()
    return [f for f in features if f.key.startswith(EVENT) and f.dtype == "bool"]


def flagged_events(rows: EpisodeRows) -> dict[str, float]:
    """Read when each event of an episode is, from its start [s]; the first step that is true.

    Parameters
    ----------
    rows : EpisodeRows
        Read with :func:`event_features`.
    """
    events = {}
    for key, values in rows.values.items():
        if key.startswith(EVENT) and values.dtype == bool and values.any():
            events[key.removeprefix(EVENT)] = float(rows.time[np.argmax(values[:, 0])])
    return events


def stored_events(root: Path, episodes: Collection[int]) -> dict[int, dict[str, float]]:
    """Read the events of some episodes of the data set in a folder, by their index.

    Parameters
    ----------
    root : Path
        The folder.
    episodes : collection of int
        Indices of the episodes.

    Raises
    ------
    DatasetError
        If their files cannot be read.
    """
    layout = open_layout(root)
    wanted = [episode for episode in layout.episodes if episode.index in episodes]
    rows = read_episodes(layout, wanted, event_features(layout), Relaxed(()))
    return {one.episode.index: flagged_events(one) for one in rows}


def wrench_features(layout: Layout) -> list[Feature]:
    """List the columns of a data set that hold wrenches of links."""
    features = layout.features.values()
    return [f for f in features if f.key.startswith(WRENCH) and f.width == 6]


def stored_wrenches(rows: EpisodeRows) -> dict[str, Tensor]:
    """Read wrenches (T, 6) of an episode by link: forces [N], then moments [N m].

    Parameters
    ----------
    rows : EpisodeRows
        Read with :func:`wrench_features`.
    """
    return {
        key.removeprefix(WRENCH): torch.from_numpy(values.astype(np.float64))
        for key, values in rows.values.items()
        if key.startswith(WRENCH)
    }
