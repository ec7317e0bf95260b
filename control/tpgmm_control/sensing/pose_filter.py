"""The 1-euro filter on observed poses of objects."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from tpgmm_control.sensing.states import check_positive, replace_fields
from tpgmm_torch.data.frames import LEVER

__all__ = ["OneEuro"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class OneEuro:
    """Settings of the 1-euro filter: little jitter at rest, little lag in motion.

    A first-order low pass whose cutoff frequency grows with the filtered speed,

        ``cutoff (1 + (noise / n)^2) + slope * speed``.

    A pose without noise passes unchanged: n is the median of the last second differences of the
    pose, which neither a motion nor a jump adds to.

    Parameters
    ----------
    cutoff : float
        Of a noisy object at rest [Hz]; ``inf`` passes everything as it is.
    slope : float
        By how much the cutoff grows with the speed [Hz s/m; rotations count 0.2 m/rad].
    speed_cutoff : float
        Of the speed itself [Hz].
    noise : float
        What is little noise, as a standard deviation [m].

    Raises
    ------
    DataError
        If one is not positive; the slope may be 0.

    References
    ----------
    Casiez, Roussel, Vogel: 1 Euro Filter: A Simple Speed-based Low-pass Filter for Noisy Input
    in Interactive Systems, CHI 2012.
    """

    cutoff: float = 0.5
    slope: float = 8.0
    speed_cutoff: float = 0.5
    noise: float = 5e-4

    def __post_init__(self) -> None:
        check_positive(self, "slope")


#: A quaternion's coordinates change half as fast as it turns.
METRIC = np.array([1.0] * 3 + [(2 * LEVER) ** 2] * 4)
#: Second differences that the noise is the median of.
MEMORY = 15
#: Of white noise of variance v in six coordinates, the median of the squared second
#: differences: 6 v times that of the chi-squared distribution.
MEDIAN = 6 * 2 * float(gammaincinv(6 / 2, 0.5))


@dataclass(frozen=True, eq=False)
class PoseFilter:
    """A filtered pose for each robot of a batch.

    Parameters
    ----------
    settings : OneEuro
    pose : ndarray of shape (..., 7)
        Position [m] and unit quaternion (w, x, y, z).
    velocity : ndarray of shape (..., 7)
        Filtered change of its coordinates [1/s].
    change : ndarray of shape (..., 7)
        From the pose before the last to the last that was seen.
    last : ndarray of shape (..., 7)
        The last one that was seen.
    history : ndarray of shape (15, ...)
        Squared second differences [m^2].
    share : float, or ndarray of shape (...)
        Of the last pose that was seen, in the pose: below 1, the pose is late.
    """

    settings: OneEuro
    pose: Floats
    velocity: Floats
    change: Floats
    last: Floats
    history: Floats
    share: float | Floats = 1.0

    @classmethod
    def first(cls, settings: OneEuro, pose: Floats) -> Self:
        """A filter that has seen one ``pose`` (..., 7)."""
        zero = np.zeros_like(pose)
        return cls(settings, pose, zero, zero, pose, np.zeros((MEMORY, *pose.shape[:-1])))

    def update(self, pose: Floats, dt: float | Floats) -> Self:
        """The filter after one more ``pose`` (..., 7), ``dt`` seconds later.

        Its quaternion may be on either side; ``dt`` may be one of each robot, shape (...).
        """
        settings = self.settings
        if math.isinf(settings.cutoff):
            return replace_fields(self, pose=pose, last=pose)
        if (pose == self.last).all() and not (self.change.any() or self.history.any()):
            return self
        side = (pose[..., 3:] * self.pose[..., 3:]).sum(-1, keepdims=True)
        turn = np.copysign(1.0, side) * pose[..., 3:]
        pose = np.concatenate((pose[..., :3], turn), -1)
        change = pose - self.last
        bend = np.square(change - self.change) @ METRIC
        history = np.concatenate((self.history[1:], bend[None]))
        variance = np.sort(history, axis=0)[MEMORY // 2] / MEDIAN
        each = dt[..., None] if isinstance(dt, np.ndarray) else dt
        velocity = self.velocity + _share(settings.speed_cutoff, each) * (
            change / each - self.velocity
        )
        speed = np.sqrt(np.square(velocity) @ METRIC)
        cutoff = settings.cutoff * (1 + settings.noise**2 / np.maximum(variance, 1e-300))
        share = _share(cutoff + settings.slope * speed, dt)
        out = self.pose + share[..., None] * (pose - self.pose)
        turn = out[..., 3:]
        out[..., 3:] = turn / np.sqrt((turn * turn).sum(-1, keepdims=True))
        # a pose without noise passes bit for bit
        out = np.where(share[..., None] == 1, pose, out)
        return replace_fields(
            self, pose=out, velocity=velocity, change=change, last=pose, history=history,
            share=share,
        )  # fmt: skip


def _share(cutoff: float | Floats, dt: float | Floats) -> Any:
    """Share of the new value in a first-order low pass."""
    return 1 / (1 + 1 / (2 * math.pi * cutoff * dt))
