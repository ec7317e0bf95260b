"""Episodes in memory, every frame one row, and the training batches drawn from them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from tpgmm_evaluation.policies.elapsed_time import time_features
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.exceptions import DataError

COLUMNS = (OBS_STATE, OBS_ENV_STATE, ACTION)


@dataclass(frozen=True, eq=False)
class Episodes:
    """The rows of several episodes, one after the other.

    Parameters
    ----------
    fps : int
        Rows per second.
    columns : dict of str to Tensor of shape (N, n)
        ``observation.state`` (measured joints), ``observation.environment_state`` (what is
        known of the objects) and ``action`` (joint references), in this order.
    bounds : tuple of int
        Where each episode begins, and at last where the last one ends.
    """

    fps: int
    columns: dict[str, Tensor]
    bounds: tuple[int, ...]

    @classmethod
    def read(cls, path: str | Path) -> Episodes:
        """Read all episodes of a LeRobot data set of version 3.0."""
        import pyarrow.dataset

        from tpgmm_datasets import describe_lerobot

        fps = describe_lerobot(path).fps
        rows = pyarrow.dataset.dataset(str(Path(path) / "data"), format="parquet")
        table = rows.to_table([*COLUMNS, "episode_index", "index"]).sort_by("index")
        numbers = table["episode_index"].to_numpy()
        bounds = (0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(numbers))
        return cls(round(fps), {name: _matrix(table[name]) for name in COLUMNS}, bounds)

    @classmethod
    def join(cls, fps: int, parts: Sequence[tuple[Tensor, Tensor, Tensor]]) -> Episodes:
        """Join episodes, each given by its state, environment and action."""
        bounds = np.cumsum([0, *(len(state) for state, _, _ in parts)]).tolist()
        columns = [torch.cat(column).float() for column in zip(*parts, strict=True)]
        return cls(fps, dict(zip(COLUMNS, columns, strict=True)), tuple(bounds))

    @property
    def widths(self) -> tuple[int, ...]:
        """Numbers of entries of state, environment and action."""
        return tuple(column.shape[1] for column in self.columns.values())

    def __len__(self) -> int:
        return len(self.bounds) - 1

    def __iter__(self) -> Iterator[tuple[Tensor, ...]]:
        for start, end in pairwise(self.bounds):
            yield tuple(column[start:end] for column in self.columns.values())

    def first(self, n: int) -> Episodes:
        """Return the first ``n`` episodes."""
        if not 1 <= n <= len(self):
            raise DataError(f"{n} episodes are asked for, there are {len(self)}")
        columns = {name: column[: self.bounds[n]] for name, column in self.columns.items()}
        return Episodes(self.fps, columns, self.bounds[: n + 1])

    def elapsed_time(self) -> Tensor:
        """Compute the seconds since the beginning of its episode of every row, shape (N,)."""
        lengths = np.diff(self.bounds)
        return torch.cat([torch.arange(n) for n in lengths.tolist()]) / self.fps

    def with_time(self) -> Episodes:
        """Append :func:`time_features` of the elapsed time to the environment."""
        environment = self.columns[OBS_ENV_STATE], time_features(self.elapsed_time())
        return replace(
            self, columns={**self.columns, OBS_ENV_STATE: torch.cat(environment, dim=1)}
        )

    def on_common_clock(self, *others: Episodes) -> tuple[Episodes, ...]:
        """Warp these and other episodes in time onto the most typical of these.

        The warping is TP-GMM's own: on how fast the joint references move, and where.
        """
        warping = DynamicTimeWarping()
        aligned = [warping.fit_transform(self._demonstrations())]
        aligned += [warping.transform(other._demonstrations()) for other in others]
        n, *_ = self.widths
        sets = []
        for episodes, motions in zip((self, *others), aligned, strict=True):
            parts = [
                (motion.joints[:, :n], rows[:1].expand(len(motion), -1), motion.joints[:, n:])
                for motion, (_, rows, _) in zip(motions, episodes, strict=True)
            ]
            sets.append(Episodes.join(self.fps, parts))
        return tuple(sets)

    def _demonstrations(self) -> list[Demonstration]:
        """Put state and action side by side, so that they are warped alike."""
        return [
            Demonstration(torch.arange(len(s)) / self.fps, torch.cat((s, a), dim=1).double())
            for s, _, a in self
        ]


class Windows:
    """Observations and the actions that follow, at a rate below that of the recording.

    A window may begin at any row of the recording and takes every ``stride``-th row from
    there; no row is lost to the lower rate. The action of a step is the reference that is to
    be reached at its end, so the last of the ``stride`` rows that the step lasts.

    Parameters
    ----------
    columns, bounds
        As in :class:`Episodes`.
    stride : int
        Rows of the recording for each step of the policy.
    observed : sequence of int or None
        The steps whose observations are given, 0 being the present one (LeRobot's
        ``observation_delta_indices``).
    acted : sequence of int
        The steps whose actions are to be predicted (``action_delta_indices``).
    """

    def __init__(
        self,
        columns: Mapping[str, Tensor],
        bounds: Sequence[int],
        stride: int,
        observed: Sequence[int] | None,
        acted: Sequence[int],
    ) -> None:
        self.columns, edges = columns, torch.tensor(bounds)
        self.first = edges[:-1].repeat_interleave(edges.diff())
        self.last = edges[1:].repeat_interleave(edges.diff()) - 1
        self.observed = None if observed is None else stride * torch.tensor(observed)
        self.acted = stride * torch.tensor(acted) + stride - 1

    def __len__(self) -> int:
        return len(self.first)

    def at(self, rows: Tensor) -> dict[str, Tensor]:
        """Return the windows whose present step is at these rows.

        Parameters
        ----------
        rows : Tensor of shape (B,)
            Rows of the recording.

        Returns
        -------
        dict
            As LeRobot's policies take it in ``forward``: observations of shape (B, ...) or
            (B, n_observed, ...), ``action`` (B, n_acted, n_joints), ``action_is_pad``. Before
            the beginning of an episode stands its first observation, after its end its last
            action.
        """
        first, last = self.first[rows, None], self.last[rows, None]
        acted, seen = rows[:, None] + self.acted, rows
        if self.observed is not None:
            seen = (rows[:, None] + self.observed).clamp(first, last)
        batch = {name: column[seen] for name, column in self.columns.items()}
        batch[ACTION] = self.columns[ACTION][acted.clamp(first, last)]
        batch["action_is_pad"] = (acted < first) | (acted > last)
        return batch


def policy_stride(fps: int, rate: int) -> int:
    """Return the number of rows of a recording for one step of a policy.

    Raises
    ------
    DataError
        If the recording's rate is no multiple of the policy's.
    """
    stride, rest = divmod(fps, rate)
    if rest:
        raise DataError(
            f"the episodes have {fps} steps per second, which is no multiple of the policy's "
            f"{rate}"
        )
    return stride


def _matrix(column: Any) -> Tensor:
    flat = column.combine_chunks().flatten().to_numpy(zero_copy_only=False)
    return torch.from_numpy(flat.reshape(len(column), -1).astype(np.float32))
