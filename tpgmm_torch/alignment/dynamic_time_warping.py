"""Dynamic time warping of demonstrations onto one clock."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from typing import Any, Self

import numpy as np
import torch
from sklearn.utils._param_validation import Interval, StrOptions
from torch import Tensor

from tpgmm_torch.alignment.base import Alignment, seconds, steps_at
from tpgmm_torch.alignment.features import AlignmentFeatures
from tpgmm_torch.alignment.warping_paths import (
    barycenter,
    medoid,
    resample,
    warping_map,
    warping_path,
)
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.exceptions import DataError

__all__ = ["DynamicTimeWarping"]

#: Warping runs on at most this many steps; its memory and time grow with their square.
LARGEST_GRID = 2000


class DynamicTimeWarping(Alignment):
    """Bring demonstrations onto one clock, so that equal times mean equal parts of the motion.

    Each demonstration is matched with a reference by dynamic time warping on features of
    several kinds; the matching becomes a smooth increasing function of time along which
    joints, frames and events are taken over.

    Parameters
    ----------
    reference : {"medoid", "barycenter"} or int, default="medoid"
        What the others are warped onto: the demonstration with the least summed distance to
        the others, their iterative average (DBA), or the demonstration of that index.
    features : sequence of str, optional
        Groups of features to compare, see :class:`AlignmentFeatures`: ``"joints"``,
        ``"directions"`` of motion, with a robot also each link, ``"left_hand"``, and each
        link seen from each frame, ``"left_hand in bottle"``. The default is all but the last.
    weights : mapping of str to float, optional
        Weight of groups; by default 3 for the directions, and ``n ** -0.5`` for each of
        the n others. Units do not matter: each group is divided by its standard deviation.
    robot : Kinematics, optional
        Gives the link positions; see :class:`Robot` and :class:`Poses`.
    window : float, optional
        Largest difference between a warp and linear time normalisation, as a fraction of
        the duration. With ``open_end``, between a warp and equal clocks, as a fraction of
        the reference's duration.
    penalty : float, default=1.0
        Resistance against stretching and compressing: its square is added to the squared
        feature distance of each step that advances in one sequence alone. It stands in for
        a slope constraint and matters where little moves.
    open_end : bool, default=False
        Whether a demonstration may go on after the end of the reference: its best prefix is
        matched with the whole reference. The reference should then be one that ends early.
    smoothing : float, default=0.2
        Half the length of the kernel that smooths a warp [s].
    n_iter : int, default=10
        Largest number of rounds of ``reference="barycenter"``.
    n_steps : int, optional
        Time steps of the result, uniform; the default keeps the reference's time.
    interpolation : {"linear", "cubic"}, default="linear"
        Of the joints; quaternions and frames move along great arcs and straight lines.

    Attributes
    ----------
    reference_ : Demonstration or Tensor of shape (N, D)
        The reference; for a barycentre its features.
    reference_index_ : int
        Which demonstration of ``fit`` it is, or which the barycentre started from.
    time_ : Tensor of shape (T,)
        Common time grid [s]. For a barycentre it is the average clock, from 0 on.
    distortions_ : ndarray of shape (n_demonstrations,)
        Root mean square distance of features along each path, in standard deviations.
    feature_names_ : tuple of str
        The groups of features in use; those that never change are left out.
    paths_, joint_names_ : list of Tensor of shape (T,), tuple of str or None
        As in :class:`Alignment`.

    Examples
    --------
    >>> import numpy as np
    >>> from tpgmm_torch import Demonstration
    >>> def wave(seconds):
    ...     time = np.linspace(0, seconds, 200)
    ...     return Demonstration(time, np.sin(6 * time / seconds)[:, None])
    >>> aligned = DynamicTimeWarping(reference=0).fit_transform([wave(2.0), wave(2.5)])
    >>> bool((aligned[0].joints - aligned[1].joints).abs().max() < 1e-3)
    True
    """

    _parameter_constraints: dict[str, Any] = {  # noqa: RUF012
        "reference": [StrOptions({"medoid", "barycenter"}), Integral],
        "features": ["array-like", tuple, None],
        "weights": [Mapping, None],
        "robot": "no_validation",
        "window": [Interval(Real, 0, None, closed="neither"), None],
        "penalty": [Interval(Real, 0, None, closed="left")],
        "open_end": ["boolean"],
        "smoothing": [Interval(Real, 0, None, closed="left")],
        "n_iter": [Interval(Integral, 1, None, closed="left")],
        "n_steps": [Interval(Integral, 2, None, closed="left"), None],
        "interpolation": [StrOptions({"linear", "cubic"})],
    }

    def __init__(
        self,
        reference: str | int = "medoid",
        *,
        features: Sequence[str] | None = None,
        weights: Mapping[str, float] | None = None,
        robot: Any = None,
        window: float | None = None,
        penalty: float = 1.0,
        open_end: bool = False,
        smoothing: float = 0.2,
        n_iter: int = 10,
        n_steps: int | None = None,
        interpolation: str = "linear",
    ) -> None:
        self.reference = reference
        self.features = features
        self.weights = weights
        self.robot = robot
        self.window = window
        self.penalty = penalty
        self.open_end = open_end
        self.smoothing = smoothing
        self.n_iter = n_iter
        self.n_steps = n_steps
        self.interpolation = interpolation

    def fit(self, X: Sequence[Demonstration], y: object = None) -> Self:
        """Choose the reference and warp the demonstrations ``X`` onto it; ``y`` is ignored.

        Raises
        ------
        DataError
            If ``reference`` is out of range, nothing moves, or ``window`` is too narrow.
        UnknownNameError
            If a feature does not exist.
        DependencyError
            Without dtaidistance.
        """
        demonstrations = self._start(X)
        self._features = AlignmentFeatures.fit(
            demonstrations, self.robot, self.features, self.weights
        )
        self.feature_names_ = self._features.names
        sequences = [self._features(one) for one in demonstrations]
        self.reference_index_ = index = self._index(sequences)
        chosen = demonstrations[index]
        time = seconds(chosen)
        self._clock = np.linspace(time[0], time[-1], min(len(time), LARGEST_GRID))
        self._target = resample(sequences[index], time, self._clock)
        self.reference_: Demonstration | Tensor = chosen
        if self.reference == "barycenter":
            self._average(demonstrations, sequences)
            self.reference_ = torch.from_numpy(self._target)
            self.time_ = torch.from_numpy(self._clock)
        else:
            self.time_ = chosen.time.detach().cpu().double()
        if self.n_steps is not None:
            self.time_ = torch.linspace(
                float(self._clock[0]), float(self._clock[-1]), self.n_steps, dtype=torch.float64
            )
        pairs = list(zip(demonstrations, sequences, strict=True))
        warps = [self._warp(*pair) for pair in pairs]
        self.paths_ = [self._on_grid(d, w) for d, w in zip(demonstrations, warps, strict=True)]
        self.distortions_ = np.array(
            [
                np.sqrt(((resample(s, seconds(d), w) - self._target) ** 2).sum(1).mean())
                for (d, s), w in zip(pairs, warps, strict=True)
            ]
        )
        return self

    def _index(self, sequences: Sequence[Array]) -> int:
        if isinstance(self.reference, str):
            return medoid(sequences, self.window)
        n = len(sequences)
        if not -n <= self.reference < n:
            raise DataError(
                f"reference {self.reference} is out of range: there are {n} demonstrations"
            )
        return int(self.reference) % n

    def _average(
        self, demonstrations: Sequence[Demonstration], sequences: Sequence[Array]
    ) -> None:
        """Replace the reference by the barycentre, which runs on the average clock."""
        pairs = list(zip(demonstrations, sequences, strict=True))
        uniform = [resample(s, seconds(d), self._source_clock(d)) for d, s in pairs]
        average = barycenter(uniform, self._target, self.n_iter, **self._options())
        self._target = average
        warps = [self._warp(d, s) - seconds(d)[0] for d, s in pairs]
        elapsed = np.mean(warps, axis=0)
        self._clock = np.linspace(0, elapsed[-1], len(elapsed))
        self._target = resample(average, elapsed, self._clock)

    def _options(self) -> dict[str, Any]:
        window = None
        if self.window is not None:
            window = max(1, round(self.window * (len(self._clock) - 1)))
        return {"window": window, "penalty": self.penalty, "open_end": self.open_end}

    def _source_clock(self, demonstration: Demonstration) -> Array:
        """Where a demonstration is sampled: as many steps as the reference, or as long ones."""
        time, n = seconds(demonstration), len(self._clock)
        if not self.open_end:
            return np.linspace(time[0], time[-1], n)
        step = (self._clock[-1] - self._clock[0]) / (n - 1)
        return time[0] + step * np.arange(int((time[-1] - time[0]) / step * (1 + 1e-12)) + 1)

    def _warp(self, demonstration: Demonstration, sequence: Array) -> Array:
        """The instants of a demonstration that belong to those of the reference's clock."""
        clock, n = self._source_clock(demonstration), len(self._clock)
        source = resample(sequence, seconds(demonstration), clock)
        path, cost = warping_path(self._target, source, **self._options())
        if not np.isfinite(cost):
            smallest = np.ceil((n - len(clock)) / (n - 1) * 1e4) / 1e4
            raise DataError(
                f"window={self.window} is too narrow: the reference lasts longer than the "
                f"demonstration of {demonstration.duration:.6g} s by a larger fraction; the "
                f"smallest possible is {smallest:.4f}"
            )
        step = (self._clock[-1] - self._clock[0]) / (n - 1)
        warp = warping_map(path, round(self.smoothing / step))
        instants: Array = np.interp(warp, np.arange(len(clock)), clock)
        return instants

    def _on_grid(self, demonstration: Demonstration, warp: Array) -> Tensor:
        return steps_at(demonstration, np.interp(self.time_.numpy(), self._clock, warp))

    def _path(self, demonstration: Demonstration) -> Tensor:
        return self._on_grid(
            demonstration, self._warp(demonstration, self._features(demonstration))
        )
