"""Wrenches that a data set keeps: columns ``observation.wrench.LINK`` of six values."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from tpgmm_datasets.lerobot.columns import WRENCH
from tpgmm_datasets.lerobot.episodes import EpisodeRows
from tpgmm_datasets.lerobot.layout import Feature, Layout

__all__ = ["stored_wrenches", "wrench_features"]


def wrench_features(layout: Layout) -> list[Feature]:
    """The columns of a data set that hold wrenches of links."""
    features = layout.features.values()
    return [f for f in features if f.key.startswith(WRENCH) and f.width == 6]


def stored_wrenches(rows: EpisodeRows) -> dict[str, Tensor]:
    """Wrenches (T, 6) of an episode by link: forces [N], then moments [N m].

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
