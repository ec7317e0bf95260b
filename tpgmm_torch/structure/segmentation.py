"""Where a skill has parts: found in what happens, and in what matters when."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from numbers import Real
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, TransformerMixin, clone

from tpgmm_torch.alignment.piecewise_linear import EventAlignment, LinearTimeNormalization
from tpgmm_torch.checks.report import Finding, Report
from tpgmm_torch.constraints import Interval, Options, check_parameters
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.demonstrations import Demonstration, Situation, check_demonstrations
from tpgmm_torch.events import find_boundaries
from tpgmm_torch.exceptions import NotFittedError
from tpgmm_torch.notebook import in_columns
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.structure.select_operators import FEWEST, SelectOperators

__all__ = ["Segmentation"]

#: Two boundaries of different demonstrations may be one if their progress differs by less.
ALIKE = 0.1
#: A frame is passed where it matters by so much more than at both ends of a part: three
#: coordinates are held e times more exactly [nats]; and by this share of the most that any
#: frame does.
PASSING, NOTABLE = 3.0, 0.25
#: Boundaries that are further from each other, as a share of the duration, are not in step.
OUT_OF_STEP = 0.04


@dataclass(frozen=True)
class Cut:
    """A boundary that demonstrations have in common.

    Parameters
    ----------
    progress : float
        When it is, as a share of the duration.
    reason : str
    share : float
        Of the demonstrations in which it was found.
    anchored : bool
        Whether it can be found in a demonstration alone.
    """

    progress: float
    reason: str
    share: float
    anchored: bool = True


class Segmentation(TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Find the parts of a skill.

    In each demonstration a part may end where a gripper closes or opens, where an object is
    taken or let go, and where the robot comes to rest
    (:func:`~tpgmm_torch.events.find_boundaries`). What demonstrations agree on
    counts: candidates are matched in their order, the boundaries of the demonstration that is
    most like the others are kept which most of these have too, and where one lacks a boundary
    it is in proportion between its neighbours. Within the parts that follow, a boundary is
    added where a frame is passed: it matters more there than at both ends.

    Parameters
    ----------
    robot : Kinematics, optional
        Whose links take objects, as in :class:`TaskParameterizedGMM`.
    agreement : float, default=0.6
        The share of the demonstrations that must have a boundary.
    shortest : float, default=0.04
        Parts last at least this share of the duration.
    selection : "auto", SelectOperators or None, default="auto"
        What tells when operators matter, of at least three demonstrations; "auto" is one with
        default settings, None looks at what happens alone.

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
        "selection": [Options("auto"), SelectOperators, None],
    }

    def __init__(
        self,
        robot: Kinematics | None = None,
        *,
        agreement: float = 0.6,
        shortest: float = 0.04,
        selection: SelectOperators | str | None = "auto",
    ) -> None:
        self.robot = robot
        self.agreement = agreement
        self.shortest = shortest
        self.selection = selection

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
        cuts = self._agreed(phases, reasons)
        self._set(cuts, demonstrations, phases)
        passing = self._passing(demonstrations)
        if passing:
            cuts = sorted([*cuts, *passing], key=lambda cut: cut.progress)
            self._set(cuts, demonstrations, phases)
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
        self._check_fitted()
        if isinstance(X, Sequence) and X and all(isinstance(item, Situation) for item in X):
            return list(X)
        demonstrations = check_demonstrations(X)
        phases, _ = self._candidates(demonstrations)
        return _named(demonstrations, self._placed(demonstrations, phases))

    def report(self) -> str:
        """A table of the boundaries: when they are, why, and how many demonstrations say so."""
        self._check_fitted()
        lines = [
            ("part", "begins at", "earliest", "latest", "found in", "because of"),
            ("1", "0 %", "", "", "", "the beginning"),
        ]
        for number, times in enumerate(self.boundaries_.T):
            lines.append(
                (
                    str(number + 2),
                    f"{100 * self.progress_[number]:.0f} %",
                    f"{times.min():.2f} s",
                    f"{times.max():.2f} s",
                    f"{100 * self.shares_[number]:.0f} %",
                    self.reasons_[number],
                )
            )
        return in_columns(lines)

    def out_of_step(self, demonstrations: Sequence[Demonstration]) -> Report:
        """What there is to say of boundaries that are not at one time in all demonstrations.

        Parameters
        ----------
        demonstrations : sequence of Demonstration
            Those of ``fit``.
        """
        self._check_fitted()
        typical = float(np.median([one.duration for one in demonstrations]))
        apart = np.abs(self.boundaries_ - np.median(self.boundaries_, axis=0)).max(axis=0)
        late = [number for number, most in enumerate(apart) if most > OUT_OF_STEP * typical]
        findings = []
        if late:
            most = float(apart.max())
            findings.append(
                Finding(
                    "parts",
                    f"the beginnings of parts {[number + 2 for number in late]} are up to "
                    f"{most:.2g} s from where they are in most demonstrations",
                    "Align at them: EventAlignment(['part *']) of what Segmentation gives, or "
                    "--alignment parts",
                    value=most,
                )
            )
        return Report.of(findings, f"{len(demonstrations)} demonstrations")

    def times(self) -> list[float]:
        """Median times at which parts end, but for the last [s]."""
        self._check_fitted()
        return np.median(self.boundaries_, axis=0).tolist() if self.n_parts_ > 1 else []

    def _candidates(
        self, demonstrations: Sequence[Demonstration]
    ) -> tuple[list[Array], list[list[str]]]:
        """Of each demonstration, where a part may end, as shares of its duration, and why."""
        found = [find_boundaries(one, self.robot) for one in demonstrations]
        phases = [
            np.array([(at.time - float(one.time[0])) / one.duration for at in own])
            for one, own in zip(demonstrations, found, strict=True)
        ]
        return phases, [[at.reason for at in own] for own in found]

    def _agreed(self, phases: Sequence[Array], reasons: Sequence[Sequence[str]]) -> list[Cut]:
        """Those of the demonstration most like the others that most of these have, too."""
        table = [[_matched(one, other) for other in phases] for one in phases]
        # a boundary that the others lack counts as much as one that they have
        common = [(2.0 * np.sum(np.array(row) >= 0) - np.size(row)) for row in table]
        matches = np.array(table[int(np.argmax(common))])  # (M, candidates)
        cuts: list[Cut] = []
        shares = (matches >= 0).mean(0)
        for i in np.argsort(-shares, kind="stable"):  # of two that are near, the surer
            alike = [(m, at) for m, at in enumerate(matches[:, i]) if at >= 0]
            progress = float(np.median([phases[m][at] for m, at in alike]))
            near = min(abs(progress - at) for at in (0, 1, *(cut.progress for cut in cuts)))
            if shares[i] >= self.agreement and near >= self.shortest:
                [(reason, _)] = Counter(reasons[m][at] for m, at in alike).most_common(1)
                cuts.append(Cut(progress, reason, float(shares[i])))
        return sorted(cuts, key=lambda cut: cut.progress)

    def _set(
        self,
        cuts: Sequence[Cut],
        demonstrations: Sequence[Demonstration],
        phases: Sequence[Array],
    ) -> None:
        self._cuts, self.n_parts_ = tuple(cuts), 1 + len(cuts)
        self.progress_ = np.array([cut.progress for cut in cuts])
        self.reasons_ = tuple(cut.reason for cut in cuts)
        self.shares_ = np.array([cut.share for cut in cuts])
        self.boundaries_ = self._placed(demonstrations, phases)

    def _placed(
        self, demonstrations: Sequence[Demonstration], phases: Sequence[Array]
    ) -> Array:
        """When the boundaries are in demonstrations, (M, B), given what may be some in each."""
        anchored = np.array([cut.progress for cut in self._cuts if cut.anchored])
        rows = np.empty((len(demonstrations), len(self._cuts)))
        for row, one, own in zip(rows, demonstrations, phases, strict=True):
            match = _matched(anchored, own)
            there = match >= 0
            known = np.concatenate(([0.0], anchored[there], [1.0]))
            here = np.concatenate(([0.0], own[match[there]], [1.0]))
            row[:] = float(one.time[0])
            row += one.duration * np.interp(self.progress_, known, here)
        return rows

    def _passing(self, demonstrations: Sequence[Demonstration]) -> list[Cut]:
        """Where operators matter in passing, between the boundaries that are known."""
        if self.selection is None or self.robot is None or len(demonstrations) < FEWEST:
            return []
        selection = SelectOperators()
        if isinstance(self.selection, SelectOperators):
            selection = clone(self.selection)
        if selection.robot is None:
            selection.set_params(robot=self.robot)
        parts = [f"part {number + 2}" for number in range(len(self._cuts))]
        steps = LinearTimeNormalization(1.0, robot=self.robot)
        if parts:
            steps = EventAlignment(parts, duration=1.0, robot=self.robot)
        aligned = steps.fit_transform(_named(demonstrations, self.boundaries_))
        selection.fit(aligned)
        edges = np.array([0.0, *(aligned[0].events[name] for name in parts), 1.0])
        known = np.array([0.0, *self.progress_, 1.0])
        most = max((gain.max() for gain in selection.frame_relevance_.values()), default=0.0)
        found: list[Cut] = []
        for begin, end in pairwise(edges):
            inside = (selection.time_ >= begin) & (selection.time_ <= end)
            time = selection.time_[inside]
            for name, relevance in selection.frame_relevance_.items():
                gain = relevance[inside]
                if len(gain) < 3:
                    continue
                peak = int(gain.argmax())
                at = float(np.interp(time[peak], edges, known))
                near = min(abs(at - other) for other in (*known, *(c.progress for c in found)))
                more = gain[peak] - max(gain[0], gain[-1], 0.0)
                if more > max(PASSING, NOTABLE * most) and near >= self.shortest:
                    found.append(Cut(at, f"passing {name}", 1.0, anchored=False))
        return found

    def _check_fitted(self) -> None:
        if not hasattr(self, "boundaries_"):
            raise NotFittedError(
                "this Segmentation is not fitted yet: call fit(demonstrations)"
            )

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.two_d_array = False  # X is a list of demonstrations
        return tags


def _named(demonstrations: Sequence[Demonstration], boundaries: Array) -> list[Demonstration]:
    """Demonstrations with their boundaries (M, B) as events."""
    named = []
    for one, times in zip(demonstrations, boundaries, strict=True):
        others = {name: at for name, at in one.events.items() if not name.startswith("part ")}
        parts = {f"part {number + 2}": float(at) for number, at in enumerate(times)}
        named.append(replace(one, events=others | parts))
    return named


def _matched(one: Array, other: Array) -> NDArray[np.int64]:
    """For each instant of one, (A,), which of the other (B,) it is, -1 where there is none.

    Those are matched that leave the least sum of distances, in the order of both; one that is
    left out costs as much as half the largest distance.
    """
    cost = np.empty((len(one) + 1, len(other) + 1))
    cost[:, 0] = ALIKE / 2 * np.arange(len(one) + 1)
    cost[0] = ALIKE / 2 * np.arange(len(other) + 1)
    for i, at in enumerate(one):
        for j, there in enumerate(other):
            left_out = ALIKE / 2 + min(cost[i, j + 1], cost[i + 1, j])
            cost[i + 1, j + 1] = min(cost[i, j] + abs(at - there), left_out)
    match, i, j = np.full(len(one), -1), len(one), len(other)
    while i and j:
        if cost[i, j] == cost[i - 1, j - 1] + abs(one[i - 1] - other[j - 1]):
            i, j = i - 1, j - 1
            match[i] = j
        elif cost[i, j] == ALIKE / 2 + cost[i - 1, j]:
            i -= 1
        else:
            j -= 1
    return match
