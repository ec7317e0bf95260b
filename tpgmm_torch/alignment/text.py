"""Alignments by name, as the command line and a policy's configuration give them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tpgmm_torch.alignment.base import Alignment
from tpgmm_torch.alignment.dynamic_time_warping import DynamicTimeWarping
from tpgmm_torch.alignment.events import EventAlignment
from tpgmm_torch.alignment.linear import LinearTimeNormalization
from tpgmm_torch.exceptions import DataError

__all__ = ["METHODS", "parse_alignment"]

#: The names that there are.
METHODS = ("dtw", "barycenter", "linear", "events", "events+dtw", "none")


def parse_alignment(
    method: str, robot: Any = None, features: Sequence[str] | None = None
) -> Alignment | None:
    """The transformer that a name stands for; None for ``"none"``.

    Parameters
    ----------
    method : str
        One of :data:`METHODS`; ``"events+dtw"`` warps time between events.
    robot : Kinematics, optional
        Gives link positions, and where joints hold quaternions.
    features : sequence of str, optional
        What time warping compares, as in :class:`DynamicTimeWarping`.

    Raises
    ------
    DataError
        If there is no such alignment.

    Examples
    --------
    >>> parse_alignment("linear")
    LinearTimeNormalization()
    """
    if method not in METHODS:
        raise DataError(f"an alignment is one of {list(METHODS)}, got {method!r}")
    if method == "none":
        return None
    if method == "linear":
        return LinearTimeNormalization(robot=robot)
    if method == "events":
        return EventAlignment(robot=robot)
    reference = "barycenter" if method == "barycenter" else "medoid"
    warping = DynamicTimeWarping(reference, features=features, robot=robot)
    return EventAlignment(within=warping, robot=robot) if method == "events+dtw" else warping
