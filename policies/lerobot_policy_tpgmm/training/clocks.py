"""The clocks of episodes: at which time of the model each of their frames stands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

__all__ = ["Clock"]


@dataclass(frozen=True, eq=False)
class Clock:
    """Brings frames of episodes to the model's time.

    An episode that was aligned has the clock that the alignment gave it. Any other, one that
    was held out for example, runs evenly from the model's first instant to its last; without
    alignment, on its own clock.

    Parameters
    ----------
    lengths : mapping of int to int
        Number of frames of each episode of the data set.
    grid : ndarray of shape (T,), optional
        The model's time [s]; None without alignment.
    paths : mapping of int to ndarray of shape (T,)
        The fractional step of an aligned episode at each instant of the grid.
    fps : float
        Frames per second.
    """

    lengths: Mapping[int, int]
    grid: NDArray[np.float64] | None
    paths: Mapping[int, NDArray[np.float64]]
    fps: float

    def __call__(self, episodes: Tensor, steps: Tensor) -> Tensor:
        """The model's time [s], shape (B,), of steps of episodes, both of shape (B,)."""
        if self.grid is None:
            return steps.double() / self.fps
        time = torch.empty(len(steps), dtype=torch.float64)
        for episode in episodes.unique().tolist():
            rows = episodes == episode
            evenly = np.linspace(0, self.lengths[episode] - 1, len(self.grid))
            path = self.paths.get(episode, evenly)
            time[rows] = torch.from_numpy(np.interp(steps[rows].numpy(), path, self.grid))
        return time
