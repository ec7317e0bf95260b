"""When the phases of a skill end, in demonstrations of different speed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

#: By which share of its demonstration's pace a phase takes more or less time.
UNEVEN = 0.12


@dataclass(frozen=True)
class Phases:
    """The phases of a skill, one after the other.

    Parameters
    ----------
    nominal : mapping of str to float
        How long each takes [s].
    rate : float
        Time steps per second.
    stretch : float
        Durations are spread evenly between ``1 - stretch`` and ``1 + stretch`` of the nominal
        one; each phase moreover takes up to 12 % more or less of its demonstration.
    """

    nominal: Mapping[str, float]
    rate: float
    stretch: float

    def lengths(self, n: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """Draw how long phases take in ``n`` demonstrations, shape (n, n_phases) [s]."""
        nominal = np.array(list(self.nominal.values()))
        shares = nominal * rng.uniform(1 - UNEVEN, 1 + UNEVEN, (n, len(nominal)))
        total = nominal.sum() * rng.permutation(np.linspace(-1, 1, n) * self.stretch + 1)
        return np.asarray(shares / shares.sum(1, keepdims=True) * total[:, None])

    def nominal_ends(self, n: int) -> Tensor:
        """Return when phases end without any spread, shape (n, n_phases) [s]."""
        lengths = torch.tensor(list(self.nominal.values()), dtype=torch.float64)
        return lengths.cumsum(0).expand(n, -1)

    def progress(self, time: Tensor, ends: Tensor) -> dict[str, Tensor]:
        """Compute how much of each phase is done at times (..., n), in [0, 1]."""
        starts = torch.cat((torch.zeros_like(ends[:, :1]), ends[:, :-1]), dim=1)
        done = ((time[..., None] - starts) / (ends - starts)).clamp(0, 1)
        return dict(zip(self.nominal, done.unbind(-1), strict=True))

    def steps(self, ends: Tensor) -> list[int]:
        """Count the time steps of each demonstration."""
        return [int(last) + 1 for last in torch.floor(ends[:, -1] * self.rate + 1e-9)]

    def times(self, steps: int) -> Tensor:
        """Return the instants of a number of time steps [s]."""
        return torch.arange(steps, dtype=torch.float64) / self.rate
