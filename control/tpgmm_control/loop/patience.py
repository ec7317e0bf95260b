"""Robots that have been waited for as long as the user wants stop for good."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from tpgmm_control.sensing.servo import Flags
from tpgmm_torch.data.arrays import Array


@dataclass(frozen=True, eq=False)
class Patience:
    """How long B robots have been waited for; immutable.

    Parameters
    ----------
    limit : float
        How long a robot is waited for before it stops for good [s].
    waited : array of shape (B,)
        For how long that has been, without a break [s].
    stopped : mapping of int to str
        Robots that have stopped, and why.
    """

    limit: float
    waited: Array
    stopped: Mapping[int, str] = field(default_factory=dict)

    @property
    def stands(self) -> Flags:
        """Robots that have stopped (B,)."""
        stands: Flags = np.zeros(len(self.waited), bool)
        stands[list(self.stopped)] = True
        return stands

    def advance(self, waits: Flags, passed: Array, reasons: Mapping[int, str]) -> Self:
        """Count how long robots are waited for, and stop those that have been too long.

        Parameters
        ----------
        waits : bool array of shape (B,)
            Robots that are waited for at this tick.
        passed : array of shape (B,)
            Duration of the tick [s].
        reasons : mapping of int to str
            Why, by robot.
        """
        waited, stopped = np.where(waits, self.waited + passed, 0.0), dict(self.stopped)
        for row in np.flatnonzero(waited >= self.limit).tolist():
            why = reasons.get(row, "")
            stopped.setdefault(row, f"stopped for good after {self.limit:g} s: {why}")
        return replace(self, waited=waited, stopped=stopped)

    def announce(self, reasons: Mapping[int, str]) -> dict[int, str]:
        """Add when robots will stop to the reasons why they are waited for."""
        left = self.limit - self.waited
        return {
            row: self.stopped.get(row, f"{text}; stops for good in {left[row]:.1f} s")
            for row, text in reasons.items()
        } | dict(self.stopped)
