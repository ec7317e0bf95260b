"""Detecting robots that somebody else has moved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch.data.arrays import Array
from tpgmm_torch.motion.follower import Seconds
from tpgmm_torch.sensing.trust import Trust

__all__ = ["Displacement"]

#: Time in which a displacement is forgotten [s].
MEMORY = 0.5


@dataclass(frozen=True, eq=False)
class Displacement:
    """Robots that move away from their references faster than these move; immutable.

    A robot that is slow, or stopped, is left behind as fast as its reference moves; one that is
    displaced goes faster.

    Parameters
    ----------
    gap : array of shape (..., n_joints), optional
        Between robot and reference at the last tick [rad or m]; None before the first one.
    displaced : array of shape (..., n_joints) or float
        How far the robot was moved lately [rad or m].
    """

    gap: Array | None = None
    displaced: Array | float = 0.0

    def detect(
        self, measured: Tensor, reference: Tensor, velocity: Tensor, dt: Seconds, trust: Trust
    ) -> tuple[Tensor | None, Displacement]:
        """Displaced robots, and what is known at the next tick.

        Parameters
        ----------
        measured, reference, velocity : Tensor of shape (..., n_joints)
            Measured joints, NaN where they are not known; the last reference and its velocity.
        dt : float or array of shape (...)
            Duration of the tick [s].
        trust : Trust
            Thresholds.

        Returns
        -------
        robots : Tensor of bool of shape (...), or None
            None if no robot was displaced.
        displacement : Displacement
        """
        # in numpy, which takes a third of the time of torch
        posture, target = measured.numpy(force=True), reference.numpy(force=True)
        gap, speed = np.abs(posture - target), np.abs(velocity.numpy(force=True))
        before, unknown = self.gap, np.isnan(gap)
        if before is None:
            return None, Displacement(np.where(unknown, 0.0, gap))
        if unknown.any():
            gap = np.where(unknown, before, gap)
        each = dt[..., None] if isinstance(dt, np.ndarray) else dt
        kept = self.displaced * np.maximum(0.0, 1 - each / MEMORY)
        displaced = np.maximum(kept + gap - before - speed * each, 0.0)
        far = gap > trust.largest_gap + trust.lag * speed
        far |= displaced > trust.largest_push
        following = Displacement(gap, displaced)
        if not far.any():
            return None, following
        return torch.as_tensor(far.any(-1), device=reference.device), following

    def forget(self, joints: Tensor) -> Displacement:
        """The same, with some joints (..., n_joints) at their references."""
        if self.gap is None:
            return self
        rows = joints.numpy(force=True)
        return Displacement(np.where(rows, 0.0, self.gap), np.where(rows, 0.0, self.displaced))
