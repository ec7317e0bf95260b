"""Dynamic time warping of demonstrations onto one clock."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from numbers import Integral, Real
from typing import Any, Self

import numpy as np
import torch
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
from tpgmm_torch.constraints import ANYTHING, Interval, Options
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.exceptions import DataError, PlausibilityWarning

__all__ = ["DynamicTimeWarping", "warn_of_linear_time"]

#: Warping runs on at most this many steps; its memory and time grow with their square.
LARGEST_GRID = 2000
#: A warp has to lower the spread of features that it did not use by this fraction,
LEAST_GAIN = 0.05
#: unless it differs from linear time by less than this fraction of the duration.
NEARLY_LINEAR = 0.02


class DynamicTimeWarping(Alignment):
    """Bring demonstrations onto one clock, so that equal times mean equal parts of the motion.

    Each demonstration is matched with a reference by dynamic time warping on features of
    several kinds; the matching becomes a smooth increasing function of time along which
    joints, frames and events are taken over. A demonstration whose warp does not bring other
    features, which were not used, nearer to the reference is left on linear time.

    Parameters
    ----------
    reference : {"medoid", "barycenter"} or int, default="medoid"
        What the others are warped onto: the demonstration with the least summed distance to
        the others, their iterative average (DBA), or the demonstration of that index.
    features : sequence of str, optional
        Groups of features to compare, see :class:`AlignmentFeatures`: ``"speed"``,
        ``"joints"``, ``"directions"`` of motion, with a robot also each link, ``"left_hand"``,
        and each link seen from each frame, ``"left_hand in bottle"``. The default is the
        speed, the joints and each link.
    weights : mapping of str to float, optional
        Weight of groups; by default 5 for the speed, 4.5 for the directions, and ``n ** -0.5``
        for each of the n others. Units do not matter: each group is divided by its standard
        deviation.
    robot : Kinematics, optional
        Gives the link positions; see :class:`Robot` and :class:`Poses`.
    window : float, optional
        Largest difference between a warp and linear time normalisation, as a fraction of
        the duration. With ``open_end``, between a warp and equal clocks, as a fraction of
        the reference's duration.
    penalty : float, default=1.5
        Resistance against stretching and compressing: its square is added to the squared
        feature distance of each step that advances in one sequence alone. It matters where
        little moves.
    max_slope : int, default=2
        How many times faster or slower than linear time normalisation a demonstration may
        run anywhere; 1 is linear time. With ``open_end``, than on equal clocks.
    open_end : bool, default=False
        Whether a demonstration may go on after the end of the reference: its best prefix is
        matched with the whole reference. The reference should then be one that ends early.
    fallback : bool, default=True
        Whether demonstrations are left on linear time, with a warning, if warping them does
        not pay: if the mean squared difference from the reference (for a barycentre, from
        the demonstration that it started from) of features that are *not* used (of
        directions, by default) falls by less than 5 %. Nothing is checked if no feature is
        left over, with ``open_end``, and of warps within 2 % of linear time.
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
    fallback_ : dict of int to str
        Which demonstrations of ``fit`` were left on linear time, and why.
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
        "reference": [Options("medoid", "barycenter"), Integral],
        "features": ["array-like", None],
        "weights": [Mapping, None],
        "robot": ANYTHING,
        "window": [Interval(Real, 0, None, closed="neither"), None],
        "penalty": [Interval(Real, 0, None, closed="left")],
        "max_slope": [Interval(Integral, 1, None, closed="left")],
        "open_end": ["boolean"],
        "fallback": ["boolean"],
        "smoothing": [Interval(Real, 0, None, closed="left")],
        "n_iter": [Interval(Integral, 1, None, closed="left")],
        "n_steps": [Interval(Integral, 2, None, closed="left"), None],
        "interpolation": [Options("linear", "cubic")],
    }

    def __init__(
        self,
        reference: str | int = "medoid",
        *,
        features: Sequence[str] | None = None,
        weights: Mapping[str, float] | None = None,
        robot: Any = None,
        window: float | None = None,
        penalty: float = 1.5,
        max_slope: int = 2,
        open_end: bool = False,
        fallback: bool = True,
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
        self.max_slope = max_slope
        self.open_end = open_end
        self.fallback = fallback
        self.smoothing = smoothing
        self.n_iter = n_iter
        self.n_steps = n_steps
        self.interpolation = interpolation

    def fit(self, X: Sequence[Demonstration], y: object = None) -> Self:
        """Choose the reference and warp the demonstrations ``X`` onto it; ``y`` is ignored.

        Raises
        ------
        DataError
            If ``reference`` is out of range, nothing moves, ``window`` is too narrow, or,
            with ``open_end``, a demonstration ends too early.
        UnknownNameError
            If a feature does not exist.

        Warns
        -----
        PlausibilityWarning
            Once, if demonstrations are left on linear time.
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
        self._witness = self._held_out(demonstrations, warps)
        reasons = [self._doubt(d, w) for d, w in zip(demonstrations, warps, strict=True)]
        self.fallback_ = {i: reason for i, reason in enumerate(reasons) if reason}
        for i in self.fallback_:
            warps[i] = self._linear(demonstrations[i])
        if self.fallback_:
            warn_of_linear_time(
                f"demonstration {i}: {why}" for i, why in self.fallback_.items()
            )
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
            return medoid(sequences, self.window, self.max_slope)
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
        return {
            "window": window,
            "penalty": self.penalty,
            "open_end": self.open_end,
            "max_slope": self.max_slope,
        }

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
        if n > self.max_slope * len(clock):
            raise DataError(
                f"a demonstration of {demonstration.duration:.6g} s is too short for a "
                f"reference of {self._clock[-1] - self._clock[0]:.6g} s: within "
                f"max_slope={self.max_slope} it does not reach its end"
            )
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

    def _held_out(
        self, demonstrations: Sequence[Demonstration], warps: Sequence[Array]
    ) -> tuple[AlignmentFeatures, Array] | None:
        """Features that warps do not depend on, and those of the reference on the clock."""
        if not self.fallback or self.open_end:
            return None
        others = AlignmentFeatures.others(demonstrations, self._features)
        if others is None:
            return None
        one = demonstrations[self.reference_index_]
        return others, resample(others(one), seconds(one), warps[self.reference_index_])

    def _doubt(self, demonstration: Demonstration, warp: Array) -> str:
        """Why a demonstration should rather run linearly; empty if it should not."""
        linear = self._linear(demonstration)
        tolerance = NEARLY_LINEAR * demonstration.duration
        if self._witness is None or np.abs(warp - linear).max() <= tolerance:
            return ""
        features, target = self._witness
        own, time = features(demonstration), seconds(demonstration)
        before, after = (
            # over both clocks: what is squeezed into an instant counts with its duration
            np.average(
                ((resample(own, time, w) - target) ** 2).sum(axis=1),
                weights=1 + np.gradient(w) / np.gradient(w).mean(),
            )
            for w in (linear, warp)
        )
        if after <= (1 - LEAST_GAIN) * before:
            return ""
        return (
            f"its difference from the reference in {', '.join(features.names)} is "
            f"{after / before:.0%} of that on linear time"
        )

    def _linear(self, demonstration: Demonstration) -> Array:
        time = seconds(demonstration)
        return np.linspace(time[0], time[-1], len(self._clock))

    def _on_grid(self, demonstration: Demonstration, warp: Array) -> Tensor:
        return steps_at(demonstration, np.interp(self.time_.numpy(), self._clock, warp))

    def _path(self, demonstration: Demonstration) -> Tensor:
        warp = self._warp(demonstration, self._features(demonstration))
        if reason := self._doubt(demonstration, warp):
            warp = self._linear(demonstration)
            warn_of_linear_time([f"of transform: {reason}"])
        return self._on_grid(demonstration, warp)


def warn_of_linear_time(found: Iterable[str]) -> None:
    """Warn that demonstrations were left on linear time, on behalf of who fits or transforms.

    Parameters
    ----------
    found : iterable of str
        Which, and why.
    """
    warnings.warn(
        "left on linear time, for warping does not bring nearer what it did not use. "
        f"{'; '.join(found)}. Is it one skill, from its beginning to its end? Choose other "
        "features, or set fallback=False",
        PlausibilityWarning,
        stacklevel=3,
    )
