"""How much time passes in a tick, where observations tell when they were made.

Drives get one reference for a tick. References that are as far apart as the ticks before were
long jerk: after a tick that comes late, the drives have come to rest, and the next reference is
two steps ahead. Held objects slip then, and what two hands hold together is torn.
"""

from __future__ import annotations

from collections import deque
from typing import Final

import torch
from torch import Tensor

from tpgmm_control.loop.locate import LONGEST_TICK

#: Ticks whose mean duration the next one is taken to have: so gently is a late one caught up.
TICKS: Final = 20


class TickDurations:
    """The mean duration of the last ticks, of each robot of a batch.

    Ticks of equal length have that length from the first on. Of others no time is lost: what a
    tick takes longer is given back by the ``TICKS`` next ones, in equal parts.
    """

    def __init__(self) -> None:
        self._last: Tensor | None = None
        self._known: deque[Tensor] = deque(maxlen=TICKS)

    def next(self, timestamps: Tensor, usual: float) -> float | Tensor:
        """Return the seconds for which the next reference is.

        Parameters
        ----------
        timestamps : Tensor of shape (B, 1) or (B,)
            When the present observations were made [s].
        usual : float
            Of the first tick, which follows no other [s].

        Returns
        -------
        float or Tensor of shape (B,)
            Of a robot whose time did not increase what it says itself, so that the controller
            can refuse it: not positive, or not finite.
        """
        now, last = timestamps.flatten().to("cpu", torch.float64), self._last
        if last is None:
            self._last = now
            return usual
        passed = now - last
        increased = (passed > 0) & now.isfinite()
        self._last = torch.where(now.isfinite(), now, last)
        # a loop that stood for longer goes on as if it had stood for that long
        self._known.append(passed.clamp(max=LONGEST_TICK).where(increased, torch.nan))
        return torch.stack(list(self._known)).nanmean(0).where(increased, passed)
