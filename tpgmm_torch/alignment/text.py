"""Alignments by name, as the command line and a policy's configuration give them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tpgmm_torch.alignment.base import Alignment
from tpgmm_torch.alignment.dynamic_time_warping import DynamicTimeWarping
from tpgmm_torch.alignment.piecewise_linear import EventAlignment, LinearTimeNormalization
from tpgmm_torch.exceptions import DataError

#: Names of alignments.
METHODS = ("dtw", "barycenter", "linear", "events", "events+dtw", "none")


def parse_alignment(
    method: str, robot: Any = None, features: Sequence[str] | None = None
) -> Alignment | None:
    """Make the transformer of a name; None for ``"none"``.

    Parameters
    ----------
    method : str
        One of :data:`METHODS`; ``"events+dtw"`` warps time between events.
    robot : Kinematics, optional
        Gives link positions, and where joints hold quaternions.
    features : sequence of str, optional
        Compared by time warping, as in :class:`DynamicTimeWarping`.

    Raises
    ------
    DataError
        If there is no such alignment.

    Examples
    --------
    >>> parse_alignment("linear")
    LinearTimeNormalization()
    """
    reference = "barycenter" if method == "barycenter" else "medoid"
    warping = DynamicTimeWarping(reference, features=features, robot=robot)
    match method:
        case "none":
            return None
        case "linear":
            return LinearTimeNormalization(robot=robot)
        case "events":
            return EventAlignment(robot=robot)
        case "events+dtw":
            return EventAlignment(within=warping, robot=robot)
        case "dtw" | "barycenter":
            return warping
    raise DataError(f"an alignment is one of {list(METHODS)}, got {method!r}")
