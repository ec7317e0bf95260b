"""Where a skill has parts: found in what happens."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from numbers import Real
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import TransformerMixin

from tpgmm_torch.checks.report import in_columns
from tpgmm_torch.constraints import DemonstrationEstimator, Interval, check_parameters
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.demonstrations import Demonstration, Situation, check_demonstrations
from tpgmm_torch.events import find_boundaries
from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["Segmentation"]


class Segmentation(TransformerMixin, DemonstrationEstimator):  # type: ignore[misc]
    """Find the parts of a skill.

    In each demonstration a part may end where a gripper closes or opens, where an object is
    taken or let go, and where the robot comes to rest
    (:func:`~tpgmm_torch.events.find_boundaries`). What demonstrations agree on
    counts: candidates are matched in their order, the boundaries of the demonstration that is
    most like the others are kept which most of these have too, and where one lacks a boundary
    it is in proportion between its neighbours.

    Parameters
    ----------
    robot : Kinematics, optional
        Whose links take objects, as in :class:`TaskParameterizedGMM`.
    agreement : float, default=0.6
        The share of the demonstrations that must have a boundary.
    shortest : float, default=0.04
        Parts last at least this share of the duration.
    shift : float, default=0.1
        Share of the duration by which boundaries of different demonstrations may differ and be
        one.

    Attributes
    ----------
    n_parts_ : int
        One more than there are boundaries B.
    boundaries_ : array of shape (M, B)
        When they are in each demonstration [s].
    progress_ : array of shape (B,)
        The same as shares of the duration, median over demonstrations.
    reasons_ : tuple of str
        Why each is a boundary.
    shares_ : array of shape (B,)
        In how many of the demonstrations it was found, as a share.

    References
    ----------
    Fod, Matarić, Jenkins: Automated derivation of primitives for movement classification,
    Autonomous Robots 12 (2002), cut at joints' zero velocities.

    Examples
    --------
    >>> time = np.arange(121) / 20
    >>> def demonstrate(pause, end):
    ...     u = np.clip([time / pause, (time - pause - 1) / (5 - pause)], 0, 1)
    ...     path = (u**3 * (10 - 15 * u + 6 * u**2)).sum(0)
    ...     return Demonstration(time, end * path[:, None])
    >>> found = Segmentation().fit([demonstrate(2.0, 0.9), demonstrate(2.5, 1.1)])
    >>> found.reasons_, found.boundaries_.round(1).tolist()
    (('stop',), [[2.6], [3.0]])
    """

    _parameter_constraints: dict[str, list[Any]] = {  # noqa: RUF012
        "robot": [Kinematics, None],
        "agreement": [Interval(Real, 0, 1, closed="right")],
        "shortest": [Interval(Real, 0, 1, closed="left")],
        "shift": [Interval(Real, 0, 1, closed="left")],
    }

    def __init__(
        self,
        robot: Kinematics | None = None,
        *,
        agreement: float = 0.6,
        shortest: float = 0.04,
        shift: float = 0.1,
    ) -> None:
        self.robot = robot
        self.agreement = agreement
        self.shortest = shortest
        self.shift = shift

    def fit(self, X: Sequence[Demonstration], y: object = None) -> Self:
        """Find the parts.

        Parameters
        ----------
        X : sequence of Demonstration
            Aligned in time or not.
        y : ignored
            Here for scikit-learn.

        Returns
        -------
        self

        Raises
        ------
        DataError, ShapeError, UnknownNameError
            If the demonstrations do not fit together, or with the robot.
        """
        check_parameters(self)
        demonstrations = check_demonstrations(X)
        phases, reasons = self._candidates(demonstrations)
        cuts = sorted(self._agree(phases, reasons))
        self.n_parts_ = 1 + len(cuts)
        self.progress_ = np.array([progress for progress, _, _ in cuts])
        self.reasons_ = tuple(reason for _, reason, _ in cuts)
        self.shares_ = np.array([share for _, _, share in cuts])
        self.boundaries_ = self._place(demonstrations, phases)
        return self

    def transform(self, X: Sequence[Any]) -> list[Any]:
        """Demonstrations with the events ``"part 2"``, ``"part 3"``, ..., where these begin.

        ``EventAlignment(["part *"])`` brings them into step.

        Parameters
        ----------
        X : sequence of Demonstration
            Or of :class:`Situation`, which pass unchanged.

        Returns
        -------
        list of Demonstration

        Raises
        ------
        NotFittedError
            Before ``fit``.
        """
        self._check_fitted("boundaries_")
        if isinstance(X, Sequence) and X and all(isinstance(item, Situation) for item in X):
            return list(X)
        demonstrations = check_demonstrations(X)
        phases, _ = self._candidates(demonstrations)
        placed, named = self._place(demonstrations, phases), []
        for one, times in zip(demonstrations, placed, strict=True):
            others = {k: at for k, at in one.events.items() if not k.startswith("part ")}
            parts = {f"part {number}": float(at) for number, at in enumerate(times, 2)}
            named.append(replace(one, events=others | parts))
        return named

    def report(self) -> str:
        """Tabulate the boundaries: when they are, why, and how many demonstrations agree."""
        self._check_fitted("boundaries_")
        lines = [
            ("part", "begins at", "earliest", "latest", "found in", "because of"),
            ("1", "0%", "", "", "", "the beginning"),
        ]
        known = zip(
            self.boundaries_.T, self.progress_, self.shares_, self.reasons_, strict=True
        )
        for number, (times, progress, share, reason) in enumerate(known, 2):
            begins = f"{progress:.0%}", f"{times.min():.2f} s", f"{times.max():.2f} s"
            lines.append((str(number), *begins, f"{share:.0%}", reason))
        return in_columns(lines)

    def times(self) -> list[float]:
        """Median times at which parts end, but for the last [s]."""
        self._check_fitted("boundaries_")
        return np.median(self.boundaries_, axis=0).tolist() if self.n_parts_ > 1 else []

    def _candidates(
        self, demonstrations: Sequence[Demonstration]
    ) -> tuple[list[Array], list[list[str]]]:
        """Find where parts of each demonstration may end, as shares of it, and why."""
        found = [find_boundaries(one, self.robot) for one in demonstrations]
        phases = [
            np.array([(at.time - float(one.time[0])) / one.duration for at in own])
            for one, own in zip(demonstrations, found, strict=True)
        ]
        return phases, [[at.reason for at in own] for own in found]

    def _agree(
        self, phases: Sequence[Array], reasons: Sequence[Sequence[str]]
    ) -> list[tuple[float, str, float]]:
        """Progress, reason and share of the boundaries that most demonstrations have."""
        table = [
            np.array([_match(one, other, self.shift) for other in phases]) for one in phases
        ]
        # of the demonstration most like the others: what these lack counts as what they have
        matches = max(table, key=lambda row: 2 * np.sum(row >= 0) - row.size)
        shares = (matches >= 0).mean(0)
        cuts, taken = list[tuple[float, str, float]](), [0.0, 1.0]
        for i in np.argsort(-shares, kind="stable"):  # of two that are near, the surer
            alike = [(m, at) for m, at in enumerate(matches[:, i]) if at >= 0]
            progress = float(np.median([phases[m][at] for m, at in alike]))
            near = np.abs(np.subtract(taken, progress)).min()
            if shares[i] >= self.agreement and near >= self.shortest:
                taken.append(progress)
                [(reason, _)] = Counter(reasons[m][at] for m, at in alike).most_common(1)
                cuts.append((progress, reason, float(shares[i])))
        return cuts

    def _place(self, demonstrations: Sequence[Demonstration], phases: Sequence[Array]) -> Array:
        """When the boundaries are in demonstrations, (M, B), given what may be some in each."""
        rows = np.empty((len(demonstrations), len(self.progress_)))
        for row, one, own in zip(rows, demonstrations, phases, strict=True):
            match = _match(self.progress_, own, self.shift)
            there = match >= 0
            known = np.concatenate(([0.0], self.progress_[there], [1.0]))
            here = np.concatenate(([0.0], own[match[there]], [1.0]))
            row[:] = float(one.time[0])
            row += one.duration * np.interp(self.progress_, known, here)
        return rows


def _match(one: Array, other: Array, shift: float) -> NDArray[np.int64]:
    """For each instant of one, (A,), which of the other (B,) it is, -1 where there is none.

    Those are matched that leave the least sum of distances, in the order of both; one that is
    left out costs as much as half the largest distance.
    """
    cost = np.empty((len(one) + 1, len(other) + 1))
    cost[:, 0] = shift / 2 * np.arange(len(one) + 1)
    cost[0] = shift / 2 * np.arange(len(other) + 1)
    for i, at in enumerate(one):
        for j, there in enumerate(other):
            left_out = shift / 2 + min(cost[i, j + 1], cost[i + 1, j])
            cost[i + 1, j + 1] = min(cost[i, j] + abs(at - there), left_out)
    match, i, j = np.full(len(one), -1), len(one), len(other)
    while i and j:
        if cost[i, j] == cost[i - 1, j - 1] + abs(one[i - 1] - other[j - 1]):
            i, j = i - 1, j - 1
            match[i] = j
        elif cost[i, j] == shift / 2 + cost[i - 1, j]:
            i -= 1
        else:
            j -= 1
    return match
