"""Episodes put together again from the shuffled batches of a training loop."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from tpgmm_torch.exceptions import DataError

#: What is kept of a frame.
COLUMNS = (OBS_STATE, OBS_ENV_STATE, ACTION)

#: How far a timestamp may be from its place, in frames.
OFF_GRID = 0.1


def episode_ranges(dataset_meta: Any) -> dict[int, range]:
    """Return the global indices of the frames of each episode of a LeRobot data set."""
    names = ("episode_index", "dataset_from_index", "dataset_to_index")
    columns = [dataset_meta.episodes[name] for name in names]
    return {
        int(episode): range(int(first), int(stop))
        for episode, first, stop in zip(*columns, strict=True)
    }


def locate_frames(
    batch: Mapping[str, Any], ranges: Mapping[int, range]
) -> tuple[Tensor, Tensor]:
    """Return the episode and the step of each frame of a batch.

    Parameters
    ----------
    batch : mapping of str to Tensor
        As a LeRobot data loader gives it.
    ranges : mapping of int to range
        From :func:`episode_ranges`.

    Returns
    -------
    episodes, steps : Tensor of shape (B,)
        Steps count from 0 in each episode.

    Raises
    ------
    DataError
        If the batch does not say, or the data set has no such frame.
    """
    for key in ("index", "episode_index", OBS_STATE):
        if key not in batch:
            raise DataError(f"training needs {key!r} in each batch, which has {sorted(batch)}")
    indices = batch["index"].detach().cpu().flatten()
    episodes = batch["episode_index"].detach().cpu().flatten()
    for episode, index in zip(episodes.tolist(), indices.tolist(), strict=True):
        if index not in ranges.get(episode, ()):
            raise DataError(
                f"the data set of the policy has no frame {index} in episode "
                f"{episode}: give it the meta data of the set that it is trained on"
            )
    starts = torch.tensor([ranges[episode].start for episode in episodes.tolist()])
    return episodes, indices - starts


class EpochRecorder:
    """Keeps each frame once, and knows when all are there.

    The training part of a data set is not known beforehand: LeRobot names the whole
    set alone to a policy. An epoch is over when a frame comes again and no episode has a gap;
    by then each of the training episodes has been seen, and no other.

    Parameters
    ----------
    ranges : mapping of int to range
        The global indices of the frames of each episode, from :func:`episode_ranges`.
    fps : float
        Frames per second.
    """

    def __init__(self, ranges: Mapping[int, range], fps: float) -> None:
        self.ranges, self.fps = ranges, fps
        self._seen = torch.zeros(max(r.stop for r in ranges.values()), dtype=torch.bool)
        self._columns: dict[str, Tensor] = {}
        self._batch_size = 0

    def record(self, batch: Mapping[str, Any]) -> bool:
        """Keep the frames of a batch.

        Parameters
        ----------
        batch : mapping of str to Tensor
            As a LeRobot data loader gives it, behind the policy's preprocessor.

        Returns
        -------
        bool
            Whether one of them had come before.

        Raises
        ------
        DataError
            If a value is not finite, a column is missing, or a frame is not in the data set,
            comes at another time, or has other values than before.
        """
        numbers, steps = locate_frames(batch, self.ranges)
        self._check(batch, numbers, steps)
        self._batch_size = max(self._batch_size, len(steps))
        indices = batch["index"].detach().cpu().flatten()
        repeated = self._seen[indices]
        for key in COLUMNS:
            if key not in batch:
                continue
            column = batch[key].detach().cpu()
            if key not in self._columns:
                self._columns[key] = column.new_zeros(len(self._seen), *column.shape[1:])
            kept = self._columns[key]
            changed = repeated & (kept[indices] != column).reshape(len(steps), -1).any(1)
            if changed.any():
                raise DataError(
                    f"{key} of frame {int(steps[changed][0])} of episode "
                    f"{int(numbers[changed][0])} has other values than when it came before: a "
                    "tpgmm policy learns the data as they are, without random transforms"
                )
            kept[indices] = column
        self._seen[indices] = True
        return bool(repeated.any())

    def _check(self, batch: Mapping[str, Any], numbers: Tensor, steps: Tensor) -> None:
        """Refuse values that are not finite, and frames that come at another time."""
        for key in (*COLUMNS, ACTION):
            finite = batch.get(key, steps).detach().cpu().isfinite().reshape(len(steps), -1)
            bad = ~finite.all(1)
            if bad.any():
                number, step = int(numbers[bad][0]), int(steps[bad][0])
                raise DataError(f"{key} holds NaN or infinity: episode {number}, frame {step}")
        timestamps = batch.get("timestamp", steps / self.fps).detach().cpu().flatten()
        off = (timestamps * self.fps - steps).abs() > OFF_GRID
        if off.any():
            raise DataError(
                f"the frames of episode {int(numbers[off][0])} do not come at {self.fps:g} per "
                f"second: frame {int(steps[off][0])} has the timestamp "
                f"{float(timestamps[off][0]):.6g} s. Resample the set: "
                f"tpgmm dataset convert SOURCE TARGET --rate {self.fps:g}"
            )

    @property
    def episodes(self) -> dict[int, dict[str, Tensor]]:
        """The columns, of shape (T, ...), of each episode of which a frame has come."""
        return {
            number: {key: c[frames.start : frames.stop] for key, c in self._columns.items()}
            for number, frames in self.ranges.items()
            if self._seen[frames.start : frames.stop].any()
        }

    @property
    def complete(self) -> bool:
        """True if there are episodes, all of them without gaps."""
        return 0 < int(self._seen.sum()) == self._count_frames()

    def _count_frames(self) -> int:
        """Count the frames that the episodes have in the data set."""
        return sum(len(self.ranges[number]) for number in self.episodes)

    def clear(self) -> None:
        """Free the memory of what was recorded."""
        self._columns.clear()

    def __str__(self) -> str:
        """Say how many frames have come, and how many steps of training are needed."""
        n_episodes, n_frames = len(self.episodes), self._count_frames()
        if not n_episodes:
            return "no frame has come yet"
        needed = math.ceil(n_frames / self._batch_size)
        return (
            f"{int(self._seen.sum())} of the {n_frames} frames of {n_episodes} episodes have "
            f"come: with batch_size={self._batch_size} an epoch takes at least "
            f"{needed} step{'s' * (needed != 1)}"
        )
