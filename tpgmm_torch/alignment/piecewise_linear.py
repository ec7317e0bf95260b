"""Piecewise linear alignment: between beginning and end, or also at events between them."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from itertools import pairwise
from typing import Any, Self

import numpy as np
import torch
from sklearn.base import clone

from tpgmm_torch.alignment.base import Alignment, retime
from tpgmm_torch.alignment.dynamic_time_warping import DynamicTimeWarping, warn_of_linear_time
from tpgmm_torch.alignment.features import quaternion_columns
from tpgmm_torch.constraints import ANYTHING, Options
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.exceptions import DataError, PlausibilityWarning

__all__ = ["EventAlignment", "LinearTimeNormalization"]

#: Shorter parts are not warped [time steps].
SHORTEST_PART = 5


class LinearTimeNormalization(Alignment):
    """Scale time so that all demonstrations last equally long.

    Parameters
    ----------
    duration : {"mean", "median"}, default="mean"
        Which average of the durations.
    robot : Kinematics, optional
        Says where recorded poses hold quaternions.

    Attributes
    ----------
    time_ : Tensor of shape (T,)
        Common time grid, from 0, of as many time steps as demonstrations have in the median
        [s].
    paths_, joint_names_ : list of ndarray of shape (T,), tuple of str or None
        As in :class:`Alignment`.

    Examples
    --------
    >>> slow = Demonstration([0.0, 2.0, 4.0], [[0.0], [1.0], [2.0]])
    >>> quick = Demonstration([0.0, 1.0, 2.0], [[0.0], [1.0], [2.0]])
    >>> aligned = LinearTimeNormalization().fit_transform([slow, quick])
    >>> [one.duration for one in aligned]
    [3.0, 3.0]
    """

    _parameter_constraints: dict[str, Any] = {  # noqa: RUF012
        "duration": [Options("mean", "median")],
        "robot": ANYTHING,
    }

    def __init__(self, duration: str = "mean", *, robot: Any = None) -> None:
        self.duration = duration
        self.robot = robot

    def fit(self, X: Sequence[Demonstration], y: object = None) -> Self:
        """Learn the common duration and grid from demonstrations ``X``; ``y`` is ignored."""
        demonstrations = self._start(X)
        self._fit_clock(demonstrations)
        self.paths_ = list(map(self._path, demonstrations))
        return self

    def _fit_clock(self, demonstrations: Sequence[Demonstration]) -> None:
        """Learn when anchors are on the common clock, and the time grid."""
        lengths = np.diff([self._anchors(one) for one in demonstrations])
        average = np.median if self.duration == "median" else np.mean
        self._instants = np.concatenate(([0.0], average(lengths, axis=0).cumsum()))
        n_steps = round(float(np.median([len(one) for one in demonstrations])))
        self.time_ = torch.linspace(0, float(self._instants[-1]), n_steps, dtype=torch.float64)

    def _anchors(self, demonstration: Demonstration) -> Array:
        """Return beginning, events and end of a demonstration [s]."""
        return as_array(demonstration.time)[[0, -1]]

    def _path(self, demonstration: Demonstration) -> Array:
        anchors = self._anchors(demonstration)
        return np.asarray(np.interp(self.time_.numpy(), self._instants, anchors))


class EventAlignment(LinearTimeNormalization):
    """Scale time between events so that each happens at one instant in all demonstrations.

    Time is piecewise linear: the beginning, each event and the end are anchors, and every
    part between two of them lasts as long as it does on average. Within a part time is not
    warped, unless ``within`` says how.

    Parameters
    ----------
    events : sequence of str, optional
        The anchors in their order, by name or pattern (``"part *"``); by default all events of
        the demonstrations, in the order of their median phases.
    duration : {"mean", "median"}, default="mean"
        Which average of the lengths of each part.
    within : DynamicTimeWarping, optional
        How each part is warped in itself, with its own reference and features; anchors stay.
        Its slopes are relative to the evenly stretched part. Parts without motion, or of fewer
        than five steps, stay evenly stretched.
    robot : Kinematics, optional
        Says where recorded poses hold quaternions.

    Attributes
    ----------
    time_ : Tensor of shape (T,)
        Common time grid, from 0, of as many time steps as demonstrations have in the median
        [s].
    events_ : tuple of str
        The anchors in their order.
    instants_ : dict of str to float
        When each of them is on the common clock [s].
    parts_ : list of DynamicTimeWarping or None
        How each part is warped; None for those that are stretched evenly.
    fallback_ : dict of (int, int) to str
        Which demonstrations were left on linear time in which part, and why.
    paths_, joint_names_ : list of ndarray of shape (T,), tuple of str or None
        As in :class:`Alignment`.

    Examples
    --------
    >>> time = np.linspace(0, 4, 41)
    >>> early = Demonstration(time, time[:, None], events={"close": 1.0})
    >>> late = Demonstration(time, time[:, None], events={"close": 3.0})
    >>> aligned = EventAlignment().fit_transform([early, late])
    >>> [one.events["close"] for one in aligned]
    [2.0, 2.0]
    """

    _parameter_constraints: dict[str, Any] = {  # noqa: RUF012
        **LinearTimeNormalization._parameter_constraints,
        "events": ["array-like", None],
        "within": [DynamicTimeWarping, None],
    }

    def __init__(
        self,
        events: Sequence[str] | None = None,
        *,
        duration: str = "mean",
        within: DynamicTimeWarping | None = None,
        robot: Any = None,
    ) -> None:
        super().__init__(duration, robot=robot)
        self.events = events
        self.within = within

    def fit(self, X: Sequence[Demonstration], y: object = None) -> Self:
        """Learn when events happen on average in demonstrations ``X``; ``y`` is ignored.

        Raises
        ------
        DataError
            If there are no events, or one is missing in a demonstration, comes in another
            order than in others, or at the instant of another.

        Warns
        -----
        PlausibilityWarning
            Once, if demonstrations are left on linear time in parts.
        """
        demonstrations = self._start(X)
        self.events_ = self._order(demonstrations)
        for index, one in enumerate(demonstrations):
            self._anchors(one, f"demonstration {index}")
        self._fit_clock(demonstrations)
        self.instants_ = dict(zip(self.events_, self._instants[1:-1].tolist(), strict=True))
        self._fit_parts(demonstrations)
        self.paths_ = [
            self._join_parts(one, [part and part.paths_[i] for part in self.parts_])
            for i, one in enumerate(demonstrations)
        ]
        return self

    def _order(self, demonstrations: Sequence[Demonstration]) -> tuple[str, ...]:
        """Sort the names of the anchors, each of which every demonstration has."""
        known = dict.fromkeys(name for one in demonstrations for name in one.events)
        wanted = self._match_events([name for name in known if name not in ("start", "end")])
        if not wanted:
            raise DataError(
                "there are no events to align at: find them (find_events, events=... of "
                "load_lerobot, --event), or use LinearTimeNormalization"
            )
        for name in wanted:
            _check_event(name, demonstrations, known)
        if self.events is not None:
            return tuple(wanted)
        return tuple(sorted(wanted, key=lambda name: _median_phase(name, demonstrations)))

    def _match_events(self, known: list[str]) -> list[str]:
        """Match the events to align at, asked for by name or pattern, or take all."""
        if self.events is None:
            return known
        found = {event: [n for n in known if fnmatchcase(n, event)] for event in self.events}
        names = [name for event, fits in found.items() for name in fits or [event]]
        return [name for name in dict.fromkeys(names) if name not in ("start", "end")]

    def _anchors(self, demonstration: Demonstration, which: str = "the demonstration") -> Array:
        """Return beginning, events and end of a demonstration [s]."""
        for name in self.events_:
            if name not in demonstration.events:
                raise DataError(
                    f"{which} has no event {name!r}; it has {sorted(demonstration.events)}"
                )
        names = ("start", *self.events_, "end")
        instants = list(map(demonstration.event, names))
        for (early, first), (late, second) in pairwise(zip(names, instants, strict=True)):
            if first >= second:
                raise DataError(
                    f"{late!r} at {second:.6g} s is not after {early!r} at {first:.6g} s in "
                    f"{which}: was the event found rightly? The order is {list(names)}"
                )
        return np.array(instants)

    def _fit_parts(self, demonstrations: Sequence[Demonstration]) -> None:
        """Learn how each part is warped in itself."""
        names = ("start", *self.events_, "end")
        self.parts_: list[DynamicTimeWarping | None] = [
            None if self.within is None else self._warping(demonstrations, number)
            for number in range(len(names) - 1)
        ]
        self.fallback_ = {
            (i, number): why
            for number, part in enumerate(self.parts_)
            if part is not None
            for i, why in part.fallback_.items()
        }
        if self.fallback_:
            warn_of_linear_time(
                f"demonstration {i} from {names[number]!r} to {names[number + 1]!r}: {why}"
                for (i, number), why in self.fallback_.items()
            )

    def _warping(
        self, demonstrations: Sequence[Demonstration], number: int
    ) -> DynamicTimeWarping | None:
        """Learn to warp a part; None where nothing moves or there are few time steps."""
        parts = [self._part(one, number) for one in demonstrations]
        moving = any(bool(one.joints.diff(dim=0).any()) for one in parts)
        if len(parts[0]) < SHORTEST_PART or not moving:
            return None
        part: DynamicTimeWarping = clone(self.within)
        part.set_params(robot=self.robot if part.robot is None else part.robot)
        with warnings.catch_warnings():  # one warning is of all parts
            warnings.simplefilter("ignore", PlausibilityWarning)
            return part.fit(parts)

    def _part(self, demonstration: Demonstration, number: int) -> Demonstration:
        """Cut out the part behind anchor ``number``, evenly stretched."""
        begin, end = self._instants[number : number + 2]
        step = float(self._instants[-1]) / (len(self.time_) - 1)
        n_steps = max(round((end - begin) / step), 1) + 1
        first, last = self._anchors(demonstration)[number : number + 2]
        return retime(
            demonstration,
            np.linspace(first, last, n_steps),
            torch.linspace(begin, end, n_steps, dtype=torch.float64),
            quaternion_columns(demonstration, self.robot),
        )

    def _path(self, demonstration: Demonstration) -> Array:
        paths = [
            None if part is None else part._path(self._part(demonstration, number))
            for number, part in enumerate(self.parts_)
        ]
        return self._join_parts(demonstration, paths)

    def _join_parts(self, demonstration: Demonstration, paths: Sequence[Array | None]) -> Array:
        """Join parts: warped by ``paths``, stretched elsewhere."""
        grid = self.time_.numpy()
        evenly = grid.copy()
        for (begin, end), path in zip(pairwise(self._instants), paths, strict=True):
            if path is not None:
                inside = (grid >= begin) & (grid <= end)
                clock = np.linspace(begin, end, len(path))
                evenly[inside] = np.interp(grid[inside], clock, path)
        return np.asarray(np.interp(evenly, self._instants, self._anchors(demonstration)))


def _check_event(
    name: str, demonstrations: Sequence[Demonstration], known: Iterable[str]
) -> None:
    """Refuse an event that a demonstration does not have."""
    lost = [i for i, one in enumerate(demonstrations) if name not in one.events]
    if lost:
        raise DataError(
            f"event {name!r} is missing in demonstrations {lost}; events are "
            f"{sorted(known)}. Leave them out, or align at others: events=[...]"
        )


def _median_phase(event: str, demonstrations: Sequence[Demonstration]) -> float:
    """Compute when an event happens, as a share of the duration."""
    phases = [(d.events[event] - d.event("start")) / d.duration for d in demonstrations]
    return float(np.median(phases))
