"""Poses of one object over time: jumps are confirmed, flips are resolved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tpgmm_vision.detection.estimation import PoseEstimate
from tpgmm_vision.poses import angle_between

#: How fast objects are moved: [m/s], [rad/s].
SPEED, TURN = 1.5, np.radians(360)
#: How far poses of one object that stands still may be apart: [m], [rad].
SPREAD, SPREAD_ANGLE = 0.005, np.radians(4)
#: A pose further away than an object is moved counts when as many in a row agree.
CONFIRMED = 3
#: A flip is resolved by what was seen at most this long ago [s].
MEMORY = 0.5


class Tracker:
    """Filters the measured poses of an object."""

    def __init__(self) -> None:
        self._last: PoseEstimate | None = None
        self._seen = 0.0  # when [s]
        self._rivals: list[PoseEstimate] = []

    def update(
        self, found: PoseEstimate | None, time: float, reason: str = ""
    ) -> PoseEstimate | None:
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
        PoseEstimate or None
            What counts, the last pose where nothing was measured, and whether it is valid; None
            before it was ever seen.
        """
        found = self._resolve_pose(found, time)
        if found is None or not found.valid:
            return self._missing(time, reason if found is None else found.reason)
        if self._last is not None and not self._reachable(found, self._last, time):
            self._rivals = [one for one in self._rivals if _agree(one, found)] + [found]
            if len(self._rivals) < CONFIRMED:
                return self._missing(time, "it jumps: not confirmed yet")
        self._rivals, self._last, self._seen = [], found, time
        return found

    def _resolve_pose(self, found: PoseEstimate | None, time: float) -> PoseEstimate | None:
        """Choose from two poses that which follows what was seen shortly before."""
        last = self._last
        if found is None or found.alternative is None:
            return found
        if last is None or time - self._seen > MEMORY:
            return found
        both = [found, replace(found, pose=found.alternative)]
        angles = [angle_between(one.pose, last.pose) for one in both]
        near = both[int(np.argmin(angles))]
        # only what would not be taken for the other one
        clear = 2 * min(angles) < max(angles)
        return replace(near, valid=True, reason="") if clear else found

    def _reachable(self, found: PoseEstimate, last: PoseEstimate, time: float) -> bool:
        """Test whether the object can have come there from where it was."""
        passed = max(time - self._seen, 0)
        away, turned = _measure_step(found, last)
        return away <= SPREAD + SPEED * passed and turned <= SPREAD_ANGLE + TURN * passed

    def _missing(self, time: float, reason: str) -> PoseEstimate | None:
        """Return the last pose, which is not valid."""
        reason = f"{reason}, for {time - self._seen:.1f} s"
        return self._last and replace(self._last, valid=False, reason=reason)


def _agree(one: PoseEstimate, other: PoseEstimate) -> bool:
    """Test whether two poses may be those of an object at rest."""
    away, turned = _measure_step(one, other)
    return away < SPREAD and turned < SPREAD_ANGLE


def _measure_step(one: PoseEstimate, other: PoseEstimate) -> tuple[float, float]:
    """Measure how far two poses are apart [m], [rad]."""
    away = float(np.linalg.norm(one.pose[:3, 3] - other.pose[:3, 3]))
    return away, angle_between(one.pose, other.pose)
