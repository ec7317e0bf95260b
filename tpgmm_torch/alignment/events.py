"""Alignment anchored at events."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from numbers import Integral, Real
from typing import Any, Self

import numpy as np
import torch
from sklearn.utils._param_validation import Interval, StrOptions
from torch import Tensor

from tpgmm_torch.alignment.base import Alignment, seconds, steps_at
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.exceptions import DataError

__all__ = ["EventAlignment"]


class EventAlignment(Alignment):
    """Scale time between events so that each happens at one instant in all demonstrations.

    Time is piecewise linear: the beginning, each event and the end are anchors, and every
    part between two of them lasts as long as it does on average. What happens within a part
    is not looked at.

    Parameters
    ----------
    events : sequence of str, optional
        The anchors in their order; by default all events of the demonstrations, in the order
        of their median phases.
    duration : {"mean", "median"} or float, default="mean"
        Which average of the lengths of each part; or the sum of their means is scaled to
        this [s], and 1.0 makes time the phase.
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
        "events": ["array-like", tuple, None],
        "duration": [StrOptions({"mean", "median"}), Interval(Real, 0, None, closed="neither")],
        "n_steps": [Interval(Integral, 2, None, closed="left"), None],
        "interpolation": [StrOptions({"linear", "cubic"})],
        "robot": "no_validation",
    }

    def __init__(
        self,
        events: Sequence[str] | None = None,
        *,
        duration: str | float = "mean",
        n_steps: int | None = None,
        interpolation: str = "linear",
        robot: Any = None,
    ) -> None:
        self.events = events
        self.duration = duration
        self.n_steps = n_steps
        self.interpolation = interpolation
        self.robot = robot

    def fit(self, X: Sequence[Demonstration], y: object = None) -> Self:
        """Learn when events happen on average in demonstrations ``X``; ``y`` is ignored.

        Raises
        ------
        DataError
            If there are no events, or one is missing in a demonstration, comes in another
            order than in others, or at the instant of another.
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
        self.paths_ = [self._path(one) for one in demonstrations]
        return self

    def _order(self, demonstrations: Sequence[Demonstration]) -> tuple[str, ...]:
        """Names of the anchors, each of which every demonstration has."""
        there = {name: None for one in demonstrations for name in one.events}
        wanted = there if self.events is None else dict.fromkeys(self.events)
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

    def _path(self, demonstration: Demonstration) -> Tensor:
        instants = np.interp(self.time_.numpy(), self._instants, self._anchors(demonstration))
        return steps_at(demonstration, instants)
