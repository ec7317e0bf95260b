"""Episodes in memory, as the policies learn from them: every frame one row."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.exceptions import DataError

__all__ = ["Episodes"]

STATE, ENVIRONMENT, ACTION = "observation.state", "observation.environment_state", "action"


@dataclass(frozen=True, eq=False)
class Episodes:
    """The rows of several episodes, one after the other.

    Parameters
    ----------
    fps : int
        Rows per second.
    state : Tensor of shape (N, n_joints)
        Measured joints.
    environment : Tensor of shape (N, e)
        What is known of the objects.
    action : Tensor of shape (N, n_joints)
        Joint references.
    bounds : tuple of int
        Where each episode begins, and at last where the last one ends.
    """

    fps: int
    state: Tensor
    environment: Tensor
    action: Tensor
    bounds: tuple[int, ...]

    @classmethod
    def read(cls, path: str | Path) -> Episodes:
        """All episodes of a LeRobot data set of version 3.0.

        Parameters
        ----------
        path : str or Path
            Its folder.

        Raises
        ------
        DataError
            If the folder holds no such set.
        """
        import pyarrow.dataset

        from tpgmm_datasets import describe_lerobot

        fps = describe_lerobot(path).fps
        rows = pyarrow.dataset.dataset(str(Path(path) / "data"), format="parquet")
        table = rows.to_table([STATE, ENVIRONMENT, ACTION, "episode_index", "index"])
        table = table.sort_by("index")
        numbers = table["episode_index"].to_numpy()
        bounds = (0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(numbers))
        state, environment, action = (_matrix(table[k]) for k in (STATE, ENVIRONMENT, ACTION))
        return cls(round(fps), state, environment, action, bounds)

    @classmethod
    def join(cls, fps: int, parts: Sequence[tuple[Tensor, Tensor, Tensor]]) -> Episodes:
        """Episodes given one by one.

        Parameters
        ----------
        parts : sequence of (Tensor, Tensor, Tensor)
            State, environment and action of each.
        """
        bounds = np.cumsum([0, *(len(state) for state, _, _ in parts)]).tolist()
        state, environment, action = (
            torch.cat(column).float() for column in zip(*parts, strict=True)
        )
        return cls(fps, state, environment, action, tuple(bounds))

    def __len__(self) -> int:
        return len(self.bounds) - 1

    def __iter__(self) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        for start, end in zip(self.bounds, self.bounds[1:], strict=False):
            rows = slice(start, end)
            yield self.state[rows], self.environment[rows], self.action[rows]

    def first(self, n: int) -> Episodes:
        """The first ``n`` episodes.

        Raises
        ------
        DataError
            If there are fewer.
        """
        if not 1 <= n <= len(self):
            raise DataError(f"{n} episodes are asked for, there are {len(self)}")
        end = self.bounds[n]
        return Episodes(
            self.fps,
            self.state[:end],
            self.environment[:end],
            self.action[:end],
            self.bounds[: n + 1],
        )

    def with_environment(self, environment: Tensor) -> Episodes:
        """The same with other columns of the environment.

        Parameters
        ----------
        environment : Tensor of shape (N, e)
        """
        return replace(self, environment=environment)

    def elapsed(self) -> Tensor:
        """Seconds since the beginning of its episode of every row, shape (N,)."""
        lengths = np.diff(self.bounds)
        return torch.cat([torch.arange(n) for n in lengths.tolist()]) / self.fps

    def on_common_clock(self, *others: Episodes) -> tuple[Episodes, ...]:
        """These and other episodes, warped in time onto the most typical of these.

        The warping is TP-GMM's own: on how the joint references move.
        """
        warping = DynamicTimeWarping(features=["directions"])
        aligned = [warping.fit_transform(self._demonstrations())]
        aligned += [warping.transform(other._demonstrations()) for other in others]
        n = self.state.shape[1]
        sets = []
        for episodes, motions in zip((self, *others), aligned, strict=True):
            parts = [
                (motion.joints[:, :n], rows[:1].expand(len(motion), -1), motion.joints[:, n:])
                for motion, (_, rows, _) in zip(motions, episodes, strict=True)
            ]
            sets.append(Episodes.join(self.fps, parts))
        return tuple(sets)

    def _demonstrations(self) -> list[Demonstration]:
        """State and action side by side: what moves them apart must warp them alike."""
        return [
            Demonstration(torch.arange(len(s)) / self.fps, torch.cat((s, a), dim=1).double())
            for s, _, a in self
        ]


def _matrix(column: Any) -> Tensor:
    flat = column.combine_chunks().flatten().to_numpy(zero_copy_only=False)
    return torch.from_numpy(flat.reshape(len(column), -1).astype(np.float32))
