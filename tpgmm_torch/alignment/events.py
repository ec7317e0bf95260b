"""Alignment anchored at events."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from fnmatch import fnmatchcase
from itertools import pairwise
from numbers import Integral, Real
from typing import Any, Self

import numpy as np
import torch
from sklearn.base import clone
from torch import Tensor

from tpgmm_torch.alignment.base import Alignment, retime, seconds, steps_at
from tpgmm_torch.alignment.dynamic_time_warping import DynamicTimeWarping, warn_of_linear_time
from tpgmm_torch.alignment.features import quaternion_columns
from tpgmm_torch.constraints import ANYTHING, Interval, Options
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.exceptions import DataError, PlausibilityWarning

__all__ = ["EventAlignment"]

#: Shorter parts are not warped.
FEWEST_STEPS = 5


class EventAlignment(Alignment):
    """Scale time between events so that each happens at one instant in all demonstrations.

    Time is piecewise linear: the beginning, each event and the end are anchors, and every
    part between two of them lasts as long as it does on average. What happens within a part
    is not looked at, unless ``within`` warps it.

    Parameters
    ----------
    events : sequence of str, optional
        The anchors in their order, by name or pattern (``"part *"``); by default all events of
        the demonstrations, in the order of their median phases.
    duration : {"mean", "median"} or float, default="mean"
        Which average of the lengths of each part; or the sum of their means is scaled to
        this [s], and 1.0 makes time the phase.
    within : DynamicTimeWarping, optional
        How each part is warped in itself, with its own reference and features; anchors stay.
        Its slopes are relative to the evenly stretched part. Parts without motion, or of fewer
        than five steps, stay evenly stretched.
    n_steps : int, optional
        Time steps of the result; the default is the demonstrations' median.
    interpolation : {"linear", "cubic"}, default="linear"
        Of the joints; quaternions and frames move along great arcs and straight lines.
    robot : Kinematics, optional
        Says where recorded poses hold quaternions.

    Attributes
    ----------
    time_ : Tensor of shape (n_steps,)
        Common time grid, from 0 [s].
    events_ : tuple of str
        The anchors in their order.
    instants_ : dict of str to float
        When each of them is on the common clock [s].
    parts_ : list of DynamicTimeWarping or None
        How each part is warped; None for those that are stretched evenly.
    fallback_ : dict of (int, int) to str
        Which demonstrations were left on linear time in which part, and why.
    paths_, joint_names_ : list of Tensor of shape (n_steps,), tuple of str or None
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
        "events": ["array-like", None],
        "duration": [Options("mean", "median"), Interval(Real, 0, None, closed="neither")],
        "within": [DynamicTimeWarping, None],
        "n_steps": [Interval(Integral, 2, None, closed="left"), None],
        "interpolation": [Options("linear", "cubic")],
        "robot": ANYTHING,
    }

    def __init__(
        self,
        events: Sequence[str] | None = None,
        *,
        duration: str | float = "mean",
        within: DynamicTimeWarping | None = None,
        n_steps: int | None = None,
        interpolation: str = "linear",
        robot: Any = None,
    ) -> None:
        self.events = events
        self.duration = duration
        self.within = within
        self.n_steps = n_steps
        self.interpolation = interpolation
        self.robot = robot

    def fit(self, X: Sequence[Demonstration], y: object = None) -> Self:
        """Learn when events happen on average in demonstrations ``X``; ``y`` is ignored.

        Raises
        ------
        DataError
            If there are no events, or one is missing in a demonstration, comes in another
            order than in others, or at the instant of another; or ``within`` has an open end.

        Warns
        -----
        PlausibilityWarning
            Once, if demonstrations are left on linear time in parts.
        """
        demonstrations = self._start(X)
        self.events_ = self._order(demonstrations)
        parts = np.diff([self._anchors(one, i) for i, one in enumerate(demonstrations)])
        lengths = np.median(parts, axis=0) if self.duration == "median" else parts.mean(axis=0)
        if not isinstance(self.duration, str):
            lengths *= self.duration / lengths.sum()
        self._instants = np.concatenate(([0.0], lengths.cumsum()))
        self.instants_ = dict(zip(self.events_, self._instants[1:-1].tolist(), strict=True))
        n_steps = self.n_steps or round(float(np.median([len(d) for d in demonstrations])))
        self.time_ = torch.linspace(0, self._instants[-1], n_steps, dtype=torch.float64)
        self._fit_parts(demonstrations)
        paths = [
            [None if part is None else part.paths_[i] for part in self.parts_]
            for i in range(len(demonstrations))
        ]
        self.paths_ = list(map(self._joined, demonstrations, paths))
        return self

    def _order(self, demonstrations: Sequence[Demonstration]) -> tuple[str, ...]:
        """Names of the anchors, each of which every demonstration has."""
        there = {name: None for one in demonstrations for name in one.events}
        wanted = there
        if self.events is not None:
            fits = [[n for n in there if fnmatchcase(n, event)] for event in self.events]
            wanted = dict.fromkeys(
                name
                for event, names in zip(self.events, fits, strict=True)
                for name in names or [event]
            )
        names = [name for name in wanted if name not in ("start", "end")]
        if not names:
            raise DataError(
                "there are no events to align at: find them (find_events, events=... of "
                "load_lerobot, --event), or use LinearTimeNormalization"
            )
        for name in names:
            lost = [i for i, one in enumerate(demonstrations) if name not in one.events]
            if lost:
                raise DataError(
                    f"event {name!r} is missing in demonstrations {lost}; events are "
                    f"{sorted(there)}. Leave them out, or align at others: events=[...]"
                )
        if self.events is not None:
            return tuple(names)
        phases = {
            name: np.median(
                [(d.events[name] - float(d.time[0])) / d.duration for d in demonstrations]
            )
            for name in names
        }
        return tuple(sorted(names, key=lambda name: float(phases[name])))

    def _anchors(self, demonstration: Demonstration, index: int | None = None) -> Array:
        """Beginning, events and end of a demonstration [s]."""
        names = ("start", *self.events_, "end")
        which = "the demonstration" if index is None else f"demonstration {index}"
        lost = [name for name in self.events_ if name not in demonstration.events]
        if lost:
            raise DataError(
                f"{which} has no event {lost[0]!r}; it has {sorted(demonstration.events)}"
            )
        time = seconds(demonstration)
        instants = [float(time[0]), *(demonstration.events[n] for n in self.events_)]
        instants.append(float(time[-1]))
        for (early, first), (late, second) in pairwise(zip(names, instants, strict=True)):
            if first >= second:
                raise DataError(
                    f"{late!r} at {second:.6g} s is not after {early!r} at {first:.6g} s in "
                    f"{which}: was the event found rightly? The order is {list(names)}"
                )
        return np.array(instants)

    def _fit_parts(self, demonstrations: Sequence[Demonstration]) -> None:
        """Learn how each part is warped in itself."""
        self.parts_: list[DynamicTimeWarping | None] = [None] * (len(self._instants) - 1)
        self.fallback_: dict[tuple[int, int], str] = {}
        if self.within is None:
            return
        if self.within.open_end:
            raise DataError("parts end at events: give within=DynamicTimeWarping() no open end")
        names = ("start", *self.events_, "end")
        for number in range(len(self.parts_)):
            parts = [self._part(one, number) for one in demonstrations]
            shown = [one for one in parts if one is not None]
            if not any(bool(one.joints.diff(dim=0).any()) for one in shown):
                continue
            part = clone(self.within)
            if part.robot is None:
                part.set_params(robot=self.robot)
            with warnings.catch_warnings():  # one warning tells of all parts
                warnings.simplefilter("ignore", PlausibilityWarning)
                part.fit(shown)
            self.parts_[number] = part
            self.fallback_ |= {(i, number): why for i, why in part.fallback_.items()}
        if self.fallback_:
            warn_of_linear_time(
                f"demonstration {i} from {names[number]!r} to {names[number + 1]!r}: {why}"
                for (i, number), why in self.fallback_.items()
            )

    def _part(self, demonstration: Demonstration, number: int) -> Demonstration | None:
        """The part behind anchor ``number``, evenly stretched; None if it is too short."""
        begin, end = self._instants[number : number + 2]
        step = float(self._instants[-1]) / (len(self.time_) - 1)
        n_steps = round((end - begin) / step) + 1
        if n_steps < FEWEST_STEPS:
            return None
        first, last = self._anchors(demonstration)[number : number + 2]
        path = steps_at(demonstration, np.linspace(first, last, n_steps))
        time = torch.linspace(begin, end, n_steps, dtype=torch.float64)
        return retime(demonstration, path, time, quaternion_columns(demonstration, self.robot))

    def _path(self, demonstration: Demonstration) -> Tensor:
        paths: list[Tensor | None] = []
        for number, part in enumerate(self.parts_):
            shown = self._part(demonstration, number)
            paths.append(None if part is None or shown is None else part._path(shown))
        return self._joined(demonstration, paths)

    def _joined(self, demonstration: Demonstration, paths: Sequence[Tensor | None]) -> Tensor:
        """Fractional time steps: warped in parts by ``paths``, stretched between anchors."""
        grid = self.time_.numpy()
        evenly = grid.copy()
        for number, path in enumerate(paths):
            if path is None:
                continue
            begin, end = self._instants[number : number + 2]
            inside = (grid >= begin) & (grid <= end)
            clock = np.linspace(begin, end, len(path))
            steps = np.interp(grid[inside], clock, path.numpy())
            evenly[inside] = np.interp(steps, (0, float(path[-1])), (begin, end))
        instants = np.interp(evenly, self._instants, self._anchors(demonstration))
        return steps_at(demonstration, instants)
