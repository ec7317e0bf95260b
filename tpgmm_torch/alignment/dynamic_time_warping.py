"""Dynamic time warping of demonstrations onto one clock."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from numbers import Integral, Real
from typing import Any, Self

import numpy as np
import torch

from tpgmm_torch.alignment.base import Alignment
from tpgmm_torch.alignment.features import AlignmentFeatures
from tpgmm_torch.alignment.warping_paths import (
    barycenter,
    medoid,
    resample,
    warping_map,
    warping_path,
)
from tpgmm_torch.constraints import ANYTHING, Interval, Options
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.exceptions import DataError, PlausibilityWarning

__all__ = ["DynamicTimeWarping"]

#: A warp needs no gain that differs from linear time by less than this share of the duration.
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
        Onto which the others are warped: the demonstration with the least summed distance to
        the others, their iterative average (DBA), or the demonstration of that index.
    features : sequence of str, optional
        Groups of features to compare, see :class:`AlignmentFeatures`: ``"speed"``,
        ``"joints"``, ``"directions"`` of motion, with a robot also each link, ``"left_hand"``,
        and each link seen from each frame, ``"left_hand in bottle"``. The default is the
        speed, the joints and each link. Units do not matter: each group is divided by its
        standard deviation.
    robot : Kinematics, optional
        Gives the link positions; see :class:`Robot` and :class:`Poses`.
    penalty : float, default=1.5
        Resistance against stretching and compressing: its square is added to the squared
        feature distance of each step that advances in one sequence alone. It matters where
        little moves.
    max_slope : int, default=2
        How many times faster or slower than linear time normalisation a demonstration may
        run anywhere; 1 is linear time.
    smoothing : float, default=0.2
        Half the length of the kernel that smooths a warp [s].
    min_gain : float or None, default=0.05
        Demonstrations are left on linear time, with a warning, if warping them does not pay:
        if the mean squared difference from the reference (for a barycentre, from the
        demonstration that it started from) of features that are *not* used (of directions, by
        default) falls by less than this share. Nothing is checked if it is None, if no feature
        is left over, and of warps within 2 % of linear time.
    max_steps : int, default=2000
        Number of time steps that warping runs on at most; memory and time grow with its square.

    Attributes
    ----------
    reference_index_ : int
        The demonstration of ``fit`` that is the reference, or from which the barycentre
        started.
    time_ : Tensor of shape (T,)
        Common time grid [s]: the reference's. For a barycentre it is the average clock, from
        0 on.
    fallback_ : dict of int to str
        Which demonstrations of ``fit`` were left on linear time, and why.
    feature_names_ : tuple of str
        The groups of features in use; those that never change are left out.
    paths_, joint_names_ : list of ndarray of shape (T,), tuple of str or None
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
        "robot": ANYTHING,
        "penalty": [Interval(Real, 0, None, closed="left")],
        "max_slope": [Interval(Integral, 1, None, closed="left")],
        "smoothing": [Interval(Real, 0, None, closed="left")],
        "min_gain": [Interval(Real, 0, 1, closed="left"), None],
        "max_steps": [Interval(Integral, 2, None, closed="left")],
    }

    def __init__(
        self,
        reference: str | int = "medoid",
        *,
        features: Sequence[str] | None = None,
        robot: Any = None,
        penalty: float = 1.5,
        max_slope: int = 2,
        smoothing: float = 0.2,
        min_gain: float | None = 0.05,
        max_steps: int = 2000,
    ) -> None:
        self.reference = reference
        self.features = features
        self.robot = robot
        self.penalty = penalty
        self.max_slope = max_slope
        self.smoothing = smoothing
        self.min_gain = min_gain
        self.max_steps = max_steps

    def fit(self, X: Sequence[Demonstration], y: object = None) -> Self:
        """Choose the reference and warp the demonstrations ``X`` onto it; ``y`` is ignored.

        Raises
        ------
        DataError
            If ``reference`` is out of range, or nothing moves.
        UnknownNameError
            If a feature does not exist.

        Warns
        -----
        PlausibilityWarning
            Once, if demonstrations are left on linear time.
        """
        demonstrations = self._start(X)
        self._features = AlignmentFeatures.fit(demonstrations, self.robot, self.features)
        self.feature_names_ = self._features.names
        sequences = [self._features(one) for one in demonstrations]
        self.reference_index_ = self._index(sequences)
        chosen = demonstrations[self.reference_index_]
        time = as_array(chosen.time)
        self._clock = np.linspace(time[0], time[-1], min(len(time), self.max_steps))
        self._target = resample(sequences[self.reference_index_], time, self._clock)
        self.time_ = chosen.time.detach().cpu().double()
        if self.reference == "barycenter":
            self._average(demonstrations, sequences)
            self.time_ = torch.from_numpy(self._clock)
        warps = list(map(self._warp, demonstrations, sequences))
        # features that warps do not depend on, and those of the reference on the clock
        checked = self.min_gain is not None
        self._held_out = self._features.others(demonstrations) if checked else None
        if self._held_out is not None:
            warp = warps[self.reference_index_]
            self._held_out_target = resample(self._held_out(chosen), time, warp)
        reasons = list(map(self._reason_against, demonstrations, warps))
        self.fallback_ = {i: reason for i, reason in enumerate(reasons) if reason}
        if self.fallback_:
            warn_of_linear_time(
                f"demonstration {i}: {why}" for i, why in self.fallback_.items()
            )
        self.paths_ = list(map(self._on_grid, demonstrations, warps, reasons))
        return self

    def _index(self, sequences: Sequence[Array]) -> int:
        if isinstance(self.reference, str):
            return medoid(sequences, self.max_slope)
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
        uniform = list(map(self._uniform, demonstrations, sequences))
        average = barycenter(uniform, self._target, self.penalty, self.max_slope)
        self._target = average
        warps = [
            self._warp(demonstration, sequence) - float(demonstration.time[0])
            for demonstration, sequence in zip(demonstrations, sequences, strict=True)
        ]
        elapsed = np.mean(warps, axis=0)
        self._clock = np.linspace(0, elapsed[-1], len(elapsed))
        self._target = resample(average, elapsed, self._clock)

    def _linear(self, demonstration: Demonstration) -> Array:
        """Space as many instants of a demonstration as the reference has, evenly [s]."""
        time = as_array(demonstration.time)
        return np.linspace(time[0], time[-1], len(self._clock))

    def _uniform(self, demonstration: Demonstration, sequence: Array) -> Array:
        """Compute features of a demonstration at those instants."""
        return resample(sequence, as_array(demonstration.time), self._linear(demonstration))

    def _warp(self, demonstration: Demonstration, sequence: Array) -> Array:
        """Match the instants of a demonstration with those of the reference's clock."""
        source = self._uniform(demonstration, sequence)
        path, _ = warping_path(self._target, source, self.penalty, self.max_slope)
        step = (self._clock[-1] - self._clock[0]) / (len(self._clock) - 1)
        warp = warping_map(path, round(self.smoothing / step))
        return np.asarray(np.interp(warp, np.arange(len(warp)), self._linear(demonstration)))

    def _reason_against(self, demonstration: Demonstration, warp: Array) -> str:
        """Tell why a demonstration should rather run linearly; empty if it should not."""
        linear = self._linear(demonstration)
        tolerance = NEARLY_LINEAR * demonstration.duration
        if (
            self._held_out is None
            or self.min_gain is None
            or np.abs(warp - linear).max() <= tolerance
        ):
            return ""
        features, time = self._held_out(demonstration), as_array(demonstration.time)
        before, after = (
            # over both clocks: a part squeezed into an instant counts with its duration
            np.average(
                ((resample(features, time, w) - self._held_out_target) ** 2).sum(axis=1),
                weights=1 + np.gradient(w) / np.gradient(w).mean(),
            )
            for w in (linear, warp)
        )
        if after <= (1 - self.min_gain) * before:
            return ""
        return (
            f"its difference from the reference in {', '.join(self._held_out.names)} is "
            f"{after / before:.0%} of that on linear time"
        )

    def _on_grid(self, demonstration: Demonstration, warp: Array, reason: str) -> Array:
        """Compute instants on the grid, linear where there is a reason against warping."""
        chosen = self._linear(demonstration) if reason else warp
        return np.asarray(np.interp(self.time_.numpy(), self._clock, chosen))

    def _path(self, demonstration: Demonstration) -> Array:
        warp = self._warp(demonstration, self._features(demonstration))
        reason = self._reason_against(demonstration, warp)
        if reason:
            warn_of_linear_time([f"of transform: {reason}"])
        return self._on_grid(demonstration, warp, reason)


def warn_of_linear_time(found: Iterable[str]) -> None:
    """Warn which demonstrations were left on linear time, and why, as ``found`` says."""
    warnings.warn(
        f"left on linear time: {'; '.join(found)}. Warping does not bring nearer the features "
        "that it did not use: is it one skill, from its beginning to its end? Choose other "
        "features, or set min_gain=None",
        PlausibilityWarning,
        stacklevel=3,
    )
