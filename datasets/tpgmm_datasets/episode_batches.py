"""LeRobot data sets larger than memory: batches of whole episodes, again and again."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import batched
from pathlib import Path
from typing import Any

from tpgmm_datasets.errors import DatasetError
from tpgmm_datasets.reader import open_recording
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.mixture.processes import ALONE, Processes

__all__ = ["EpisodeBatches"]


class EpisodeBatches:
    """The episodes of a LeRobot data set in batches, for ``TaskParameterizedGMM.fit``.

    Each ``iter()`` reads from the first on. The metadata are checked when it is made, the
    rows of an episode when it comes, and what is implausible about all of them after the first
    reading.

    Parameters
    ----------
    path : str or Path
        As for :func:`load_lerobot`.
    size : int, default=16
        Episodes in a batch: what is in memory at a time is three batches.
    processes : Processes, optional
        Processes that learn together, see
        :func:`tpgmm_torch.mixture.processes.joined_processes`: each has a consecutive
        share of the episodes.
    **options
        All other arguments of :func:`load_lerobot`.

    Raises
    ------
    DatasetError
        As :func:`load_lerobot`, or if the size is not positive.
    DataError
        If there are fewer episodes than processes.

    Examples
    --------
    >>> import tempfile
    >>> from tpgmm_datasets import save_lerobot
    >>> shown = [Demonstration([0.0, 0.1], [[0.0], [end]]) for end in (1.0, 2.0, 3.0)]
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = save_lerobot(shown, Path(folder) / "bends", fps=10, task="bend")
    ...     batches = EpisodeBatches(path, 2)
    ...     [len(batch) for batch in batches], len(batches)
    ([2, 1], 2)
    """

    def __init__(
        self, path: str | Path, size: int = 16, *, processes: Processes = ALONE, **options: Any
    ) -> None:
        if size < 1:
            raise DatasetError(f"a batch holds at least one episode, got size={size}")
        recording = open_recording(path, **options)
        episodes = tuple(processes.share(recording.episodes))
        self._checked = False
        self.size, self._recording = size, replace(recording, episodes=episodes)

    def __len__(self) -> int:
        """Return the number of batches."""
        return -(-len(self._recording.episodes) // self.size)

    def __iter__(self) -> Iterator[list[Demonstration]]:
        """Read all episodes from the first on."""
        demonstrations = self._recording.demonstrations(check=not self._checked)
        self._checked = True
        return map(list, batched(demonstrations, self.size))
