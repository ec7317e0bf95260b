"""What ``tpgmm fit`` learns from: all episodes at once, or batches."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch

from tpgmm_tools.cli import options

if TYPE_CHECKING:
    from sklearn.pipeline import Pipeline

    from tpgmm_tools.cli.plugins import Recordings
    from tpgmm_torch.alignment.base import Alignment
    from tpgmm_torch.data.demonstrations import Demonstration
    from tpgmm_torch.large_data.processes import Processes
    from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["AlignedBatches", "TrainingData", "read_training_data"]


@dataclass
class AlignedBatches:
    """Batches of episodes brought onto one clock as they come.

    Parameters
    ----------
    batches : iterable of sequence of Demonstration
        Those of this process.
    alignment : Alignment, Pipeline or None
        Fitted already.
    durations : list of float
        Of the episodes of the last pass, before alignment [s].
    steps : int
        Number of their time steps, after.
    """

    batches: Iterable[Sequence[Demonstration]]
    alignment: Alignment | Pipeline | None
    durations: list[float] = field(default_factory=list)
    steps: int = 0

    def __iter__(self) -> Iterator[Sequence[Demonstration]]:
        """Read and align, and note how long the episodes are."""
        self.durations, self.steps = [], 0
        for batch in self.batches:
            self.durations += [demonstration.duration for demonstration in batch]
            aligned = batch if self.alignment is None else self.alignment.transform(batch)
            self.steps += sum(map(len, aligned))
            yield aligned


@dataclass(frozen=True)
class TrainingData:
    """Demonstrations of this process, and what is told of all.

    Parameters
    ----------
    source : sequence of Demonstration, or AlignedBatches
        For ``fit``.
    frames : tuple of str
        Names of the frames.
    read : sequence of Demonstration
        All as they were read; none where they come in batches.
    aligned : sequence of Demonstration
        The same aligned.
    """

    source: Sequence[Demonstration] | AlignedBatches
    frames: tuple[str, ...]
    read: Sequence[Demonstration]
    aligned: Sequence[Demonstration]

    def summary(self, processes: Processes) -> tuple[list[float], int]:
        """Durations of all episodes, and their steps after alignment, after ``fit``.

        All processes have to ask.
        """
        if not isinstance(self.source, AlignedBatches):
            return [d.duration for d in self.read], sum(map(len, self.aligned))
        durations = torch.tensor(self.source.durations, dtype=torch.float64)
        (steps,) = processes.sum(torch.tensor(float(self.source.steps), dtype=torch.float64))
        return processes.concatenate(durations).tolist(), int(steps)


def read_training_data(
    recordings: Recordings,
    robot: Kinematics | None,
    alignment: str,
    batch_episodes: int | None,
    processes: Processes,
) -> TrainingData:
    """Read what this process learns from.

    Without batches each process reads and aligns all episodes, then learns from its share.
    With ``batch_episodes`` it reads its share alone, and the alignment, named as in
    ``--alignment``, is that of the first batch of all.

    Parameters
    ----------
    recordings, robot, alignment, batch_episodes, processes
        What the options say, and those that learn together.
    """
    if batch_episodes is None:
        read = recordings.demonstrations()
        aligned = options.align(read, alignment, robot)
        return TrainingData(processes.share(aligned), tuple(read[0].frames), read, aligned)
    first = next(iter(recordings.batches(batch_episodes)))
    chosen = options.aligner(alignment, robot)
    fitted = None if chosen is None else chosen.fit(first)
    batches = recordings.batches(batch_episodes, processes)
    return TrainingData(AlignedBatches(batches, fitted), tuple(first[0].frames), (), ())
