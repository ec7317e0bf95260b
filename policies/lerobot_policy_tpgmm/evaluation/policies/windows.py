"""Training batches drawn from episodes in memory."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lerobot_policy_tpgmm.evaluation.policies.episodes import (
    ACTION,
    ENVIRONMENT,
    STATE,
    Episodes,
)

__all__ = ["Windows"]


class Windows:
    """Observations and the actions that follow, at a rate below that of the recording.

    A window may begin at any row of the recording and takes every ``stride``-th row from
    there; no row is lost to the lower rate. The action of a step is the reference that is to
    be reached at its end, so the last of the ``stride`` rows that the step lasts.

    Parameters
    ----------
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
        episodes: Episodes,
        stride: int,
        observed: Sequence[int] | None,
        acted: Sequence[int],
    ) -> None:
        self.episodes = episodes
        lengths = torch.tensor(episodes.bounds).diff()
        self.first = torch.tensor(episodes.bounds[:-1]).repeat_interleave(lengths)
        self.last = torch.tensor(episodes.bounds[1:]).repeat_interleave(lengths) - 1
        self.observed = None if observed is None else stride * torch.tensor(observed)
        self.acted = stride * torch.tensor(acted) + stride - 1

    def __len__(self) -> int:
        return len(self.first)

    def at(self, rows: Tensor) -> dict[str, Tensor]:
        """The windows whose present step is at these rows.

        Parameters
        ----------
        rows : Tensor of shape (B,)

        Returns
        -------
        dict
            As LeRobot's policies take it in ``forward``: observations of shape (B, ...) or
            (B, n_observed, ...), ``action`` (B, n_acted, n_joints), ``action_is_pad``. Before
            the beginning of an episode stands its first observation, after its end its last
            action.
        """
        first, last = self.first[rows, None], self.last[rows, None]
        acted = rows[:, None] + self.acted
        batch = {
            ACTION: self.episodes.action[acted.clamp(first, last)],
            "action_is_pad": (acted < first) | (acted > last),
        }
        seen = rows
        if self.observed is not None:
            seen = (rows[:, None] + self.observed).clamp(first, last)
        batch[STATE] = self.episodes.state[seen]
        batch[ENVIRONMENT] = self.episodes.environment[seen]
        return batch
