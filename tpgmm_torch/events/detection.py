"""What every detector of events has in common: one instant, and how sure it is."""

from __future__ import annotations

import abc
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tpgmm_torch.checks.report import Finding, Report
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.exceptions import DataError

__all__ = [
    "LEAST_CONFIDENCE",
    "Detection",
    "Detector",
    "doubtful_events",
    "find_events",
    "hysteresis",
    "uniqueness",
]

#: What is found with less is no event.
LEAST_CONFIDENCE = 0.2


@dataclass(frozen=True)
class Detection:
    """When an event was, if it was one.

    Parameters
    ----------
    time : float
        On the demonstration's clock [s]; NaN where nothing like it happens.
    confidence : float
        From 0 (nothing, or noise) to 1 (once, at once, and nothing else like it).
    """

    time: float
    confidence: float

    @property
    def certain(self) -> bool:
        """Whether it counts as an event."""
        return math.isfinite(self.time) and self.confidence >= LEAST_CONFIDENCE


NOTHING = Detection(math.nan, 0.0)


class Detector(abc.ABC):
    """Finds one event in a demonstration."""

    @abc.abstractmethod
    def find(self, demonstration: Demonstration, robot: Any = None) -> Detection:
        """When it happens, and how sure that is.

        Parameters
        ----------
        demonstration : Demonstration
            With the signals, frames or joints that are looked at.
        robot : Kinematics, optional
            Where links are.

        Raises
        ------
        DataError
            If what is looked at is not there.
        """


def find_events(
    demonstrations: Iterable[Demonstration],
    events: Mapping[str, Detector],
    robot: Any = None,
    *,
    plausibility: str = "warn",
) -> list[Demonstration]:
    """Demonstrations with the events that are found in them.

    Parameters
    ----------
    demonstrations : iterable of Demonstration
    events : mapping of str to Detector
        By the event's name; :func:`parse_event` makes them of text.
    robot : Kinematics, optional
        Where links are.
    plausibility : {"warn", "error", "ignore"}, default="warn"
        What is done about events that are found with a confidence below
        ``LEAST_CONFIDENCE``: they are left out, and named in one warning or error.

    Raises
    ------
    DataError
        If what a detector looks at is not there.
    PlausibilityError
        If something is doubtful and that is an error.

    Warns
    -----
    PlausibilityWarning
        Once, with the demonstrations in which an event is doubtful.

    Examples
    --------
    >>> from tpgmm_torch.events.text import parse_event
    >>> time = np.arange(100) / 10
    >>> opening = np.where((time > 3) & (time < 8), 0.0, 1.0)
    >>> shown = Demonstration(time, opening[:, None], joint_names=["gripper"])
    >>> [found] = find_events([shown], {"close": parse_event("closing:gripper")})
    >>> round(found.events["close"], 1)
    3.1
    """
    completed, doubtful = [], []
    for index, demonstration in enumerate(demonstrations):
        found = {name: d.find(demonstration, robot) for name, d in events.items()}
        sure = {name: at.time for name, at in found.items() if at.certain}
        doubtful += [(index, n, at.confidence) for n, at in found.items() if n not in sure]
        completed.append(replace(demonstration, events={**demonstration.events, **sure}))
    findings = doubtful_events(doubtful)
    Report.of(findings, f"{len(completed)} demonstrations").act(plausibility)
    return completed


def doubtful_events(
    doubtful: Sequence[tuple[int, str, float]], among: str = "demonstration"
) -> list[Finding]:
    """What there is to say of events that were not found, all of one name together.

    Parameters
    ----------
    doubtful : sequence of (int, str, float)
        Index, event and confidence.
    among : str, default="demonstration"
        What the index is of.
    """
    findings = []
    for name in dict.fromkeys(name for _, name, _ in doubtful):
        where = [(index, confidence) for index, other, confidence in doubtful if other == name]
        numbers = ", ".join(str(index) for index, _ in where)
        lowest, highest = min(sure for _, sure in where), max(sure for _, sure in where)
        findings.append(
            Finding(
                "events",
                f"{name!r} is not found with confidence {LEAST_CONFIDENCE} in {among}s "
                f"{numbers} (there {lowest:.3f} to {highest:.3f})",
                "Leave them out, look for it in other signals, or say when it is",
                (name,),
                tuple(index for index, _ in where),
                lowest,
            )
        )
    return findings


def hysteresis(values: Array, on: float, off: float) -> list[tuple[int, int]]:
    """Stretches that begin where values reach ``on`` and last until they are below ``off``.

    Parameters
    ----------
    values : array of shape (T,)
    on, off : float
        The larger and the smaller threshold; between them nothing changes.

    Returns
    -------
    list of (int, int)
        First step of each, and the first after it, which is T where it lasts to the end.

    Examples
    --------
    >>> hysteresis(np.array([0.0, 0.5, 0.7, 0.4, 0.7, 0.2, 0.5]), on=0.6, off=0.3)
    [(2, 5)]
    """
    told = np.where(values >= on, 1, np.where(values <= off, -1, 0))
    last: NDArray[np.intp] = np.maximum.accumulate(
        np.where(told != 0, np.arange(len(told)), -1)
    )
    state = (last >= 0) & (told[last] == 1)
    edges = np.diff(np.concatenate(([False], state, [False])).astype(np.int8))
    starts, stops = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    return list(zip(starts.tolist(), stops.tolist(), strict=True))


def uniqueness(lengths: Array, chosen: int) -> float:
    """One less the second longest over the chosen of some ``lengths`` [s]."""
    if lengths[chosen] <= 0:
        return 0.0
    return max(0.0, 1 - float(np.delete(lengths, chosen).max(initial=0.0) / lengths[chosen]))


def at_least_two_steps(demonstration: Demonstration) -> None:
    """Refuse a demonstration in which nothing can happen."""
    if len(demonstration) < 2:
        raise DataError("the demonstration has one time step: nothing happens in it")
