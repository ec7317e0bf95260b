"""Sources of object poses at run time: the protocol, and those found by entry points."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import Any, NamedTuple, Protocol

from tpgmm_torch.exceptions import DependencyError, UnknownNameError
from tpgmm_vision.poses import Array, Picture

__all__ = ["ObservedPose", "PoseSource", "pose_source"]

#: Group of entry points: functions ``make(cell, robot) -> PoseSource`` by name.
SOURCES = "tpgmm.pose_sources"
#: The one of this package.
TAGS = EntryPoint("tags", "tpgmm_vision.detection.tag_source:TagSource", SOURCES)


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
    """Finds the poses of objects in pictures, or elsewhere.

    Attributes
    ----------
    problem : str
        What makes all poses wrong, such as a camera that was moved; the robot has to stop as
        long as it is not empty.
    """

    problem: str

    def reset(self) -> None:
        """Forget what was seen: another episode begins."""

    def poses(
        self, images: Mapping[str, Picture], joints: Mapping[str, float], time: float
    ) -> dict[str, ObservedPose]:
        """Find the poses of all objects now.

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


def pose_source(cell: Any, robot: Any = None) -> PoseSource:
    """Make the source of poses that a cell names.

    Parameters
    ----------
    cell : Cell
    robot : Kinematics, optional
        Needed where a camera is on a link.

    Raises
    ------
    UnknownNameError
        If no source has that name.
    DependencyError
        If it cannot be loaded.
    """
    known = {TAGS.name: TAGS} | {entry.name: entry for entry in entry_points(group=SOURCES)}
    if cell.source not in known:
        raise UnknownNameError("source", cell.source, "what is installed", known)
    try:
        make = known[cell.source].load()
    except Exception as error:  # whatever is wrong with it
        raise DependencyError(
            f"{cell.source!r}, a plugin in {SOURCES!r}, cannot be loaded: "
            f"{type(error).__name__}: {error}"
        ) from error
    source: PoseSource = make(cell, robot)
    return source
