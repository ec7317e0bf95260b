"""Poses of one object over time: jumps are confirmed, flips are resolved."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tpgmm_vision.detection.estimation import PoseEstimate
from tpgmm_vision.poses import Array, angle_between

#: How fast objects are moved: [m/s], [rad/s].
SPEED, TURN = 1.5, np.radians(360)
#: How far poses of one object that stands still may be apart: [m], [rad].
SPREAD, SPREAD_ANGLE = 0.005, np.radians(4)
#: A pose further away than an object is moved counts when as many in a row agree.
CONFIRMED = 3
#: A flip is resolved by what was seen at most this long ago [s].
MEMORY = 0.5


@dataclass(frozen=True)
class Track:
    """Where an object is, as far as is known.

    Parameters
    ----------
    pose : ndarray of shape (4, 4)
    covariance : ndarray of shape (6, 6)
        As of :class:`~tpgmm_vision.detection.estimation.PoseEstimate`.
    seen : float
        When it was measured last [s].
    valid : bool
    reason : str
        Why it is not valid.
    """

    pose: Array
    covariance: Array
    seen: float
    valid: bool
    reason: str = ""


class Tracker:
    """Filters the measured poses of an object."""

    def __init__(self) -> None:
        self._last: Track | None = None
        self._rivals: list[PoseEstimate] = []

    def update(self, found: PoseEstimate | None, time: float, reason: str = "") -> Track | None:
        """Update the pose of the object.

        Parameters
        ----------
        found : PoseEstimate, optional
            What was measured; None if it is not seen.
        time : float
            [s]
        reason : str
            Why it is not seen.

        Returns
        -------
        Track or None
            None before it was ever seen.
        """
        found = self._resolve_pose(found, time)
        if found is None or not found.valid:
            return self._missing(time, reason if found is None else found.reason)
        if self._last is not None and not self._reachable(found, time):
            self._rivals = [one for one in self._rivals if _agree(one, found)] + [found]
            if len(self._rivals) < CONFIRMED:
                return self._missing(time, "it jumps: not confirmed yet")
        self._rivals = []
        self._last = Track(found.pose, found.covariance, time, True)
        return self._last

    def _resolve_pose(self, found: PoseEstimate | None, time: float) -> PoseEstimate | None:
        """Choose from two poses that which follows what was seen shortly before."""
        last = self._last
        if found is None or found.alternative is None or last is None:
            return found
        if time - last.seen > MEMORY:
            return found
        both = [found, replace(found, pose=found.alternative)]
        angles = [angle_between(one.pose, last.pose) for one in both]
        near = both[int(np.argmin(angles))]
        # only what would not be taken for the other one
        clear = 2 * min(angles) < max(angles)
        return replace(near, valid=True, reason="") if clear else found

    def _reachable(self, found: PoseEstimate, time: float) -> bool:
        """Test whether the object can have come there from where it was."""
        assert self._last is not None
        passed = max(time - self._last.seen, 0)
        away = float(np.linalg.norm(found.pose[:3, 3] - self._last.pose[:3, 3]))
        turned = angle_between(found.pose, self._last.pose)
        return away <= SPREAD + SPEED * passed and turned <= SPREAD_ANGLE + TURN * passed

    def _missing(self, time: float, reason: str) -> Track | None:
        """Return the last pose, which is not valid."""
        last = self._last
        if last is None:
            return None
        return replace(last, valid=False, reason=f"{reason}, for {time - last.seen:.1f} s")


def _agree(one: PoseEstimate, other: PoseEstimate) -> bool:
    """Test whether two poses may be those of an object at rest."""
    away = float(np.linalg.norm(one.pose[:3, 3] - other.pose[:3, 3]))
    return away < SPREAD and angle_between(one.pose, other.pose) < SPREAD_ANGLE
