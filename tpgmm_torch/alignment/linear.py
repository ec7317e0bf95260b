"""Linear normalisation of time."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch.alignment.base import Alignment, seconds, steps_at
from tpgmm_torch.constraints import ANYTHING, Interval, Options
from tpgmm_torch.data.demonstrations import Demonstration

__all__ = ["LinearTimeNormalization"]


class LinearTimeNormalization(Alignment):
    """Scale time so that all demonstrations last equally long.

    Parameters
    ----------
    duration : {"mean", "median"} or float, default="mean"
        Of the result [s]; 1.0 makes time the phase.
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
    paths_, joint_names_ : list of Tensor of shape (n_steps,), tuple of str or None
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
        "duration": [Options("mean", "median"), Interval(Real, 0, None, closed="neither")],
        "n_steps": [Interval(Integral, 2, None, closed="left"), None],
        "interpolation": [Options("linear", "cubic")],
        "robot": ANYTHING,
    }

    def __init__(
        self,
        duration: str | float = "mean",
        *,
        n_steps: int | None = None,
        interpolation: str = "linear",
        robot: Any = None,
    ) -> None:
        self.duration = duration
        self.n_steps = n_steps
        self.interpolation = interpolation
        self.robot = robot

    def fit(self, X: Sequence[Demonstration], y: object = None) -> Self:
        """Learn the common duration and grid from demonstrations ``X``; ``y`` is ignored."""
        demonstrations = self._start(X)
        duration = self.duration
        if isinstance(duration, str):
            average = np.mean if duration == "mean" else np.median
            duration = float(average([one.duration for one in demonstrations]))
        n_steps = self.n_steps or round(float(np.median([len(d) for d in demonstrations])))
        self.time_ = torch.linspace(0, duration, n_steps, dtype=torch.float64)
        self.paths_ = [self._path(one) for one in demonstrations]
        return self

    def _path(self, demonstration: Demonstration) -> Tensor:
        time = seconds(demonstration)
        return steps_at(demonstration, np.linspace(time[0], time[-1], len(self.time_)))
