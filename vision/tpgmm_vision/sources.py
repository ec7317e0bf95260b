"""Sources of object poses at run time: the protocol, and those found by entry points."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from tpgmm_vision.poses import Array

__all__ = ["SOURCES", "ObservedPose", "PoseSource"]

#: Group of entry points: functions ``make(cell, robot) -> PoseSource`` by name.
SOURCES = "tpgmm.pose_sources"


class ObservedPose(NamedTuple):
    """Where an object is.

    Parameters
    ----------
    pose : ndarray of shape (7,)
        ``x y z qw qx qy qz`` in the base frame; NaN where it was never seen.
    covariance : ndarray of shape (6, 6)
        Of the position [m^2] and, as a rotation vector in the base frame, of the orientation
        [rad^2].
    valid : bool
        Whether it was measured now and can be trusted.
    reason : str
        Why it is not valid.
    """

    pose: Array
    covariance: Array
    valid: bool
    reason: str = ""


class PoseSource(Protocol):
    """Finds the poses of objects in pictures, or elsewhere."""

    def reset(self) -> None:
        """Forget what was seen: another episode begins."""

    def poses(
        self,
        images: Mapping[str, NDArray[np.uint8]],
        joints: Mapping[str, float],
        time: float,
    ) -> dict[str, ObservedPose]:
        """The poses of all objects now.

        Parameters
        ----------
        images : mapping of str to ndarray of shape (height, width, 3)
            RGB pictures by the key of the camera.
        joints : mapping of str to float
            Measured, by the names of the robot's description [rad].
        time : float
            When they were taken [s].
        """
        ...
