"""Whether demonstrations show one way of doing a skill, or several."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from numbers import Integral, Real
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from tpgmm_torch.constraints import DemonstrationEstimator, Interval, Options, check_parameters
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import FEWEST, Demonstration, check_demonstrations
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.operators import Operator
from tpgmm_torch.operators.text import format_operator
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.skills.skill import Skill
from tpgmm_torch.skills.ways import Ways
from tpgmm_torch.training.local_data import Motion
from tpgmm_torch.training.mixture_settings import check_operators, kinematics_for
from tpgmm_torch.training.outlying_demonstrations import comparable_coordinates
from tpgmm_torch.training.shares import Share
from tpgmm_torch.training.training_rows import read_rows

__all__ = ["SelectWays"]

#: Joints that hardly move are compared by this range [rad or m].
SMALLEST_RANGE = 0.2
#: Stretches of the skill of which each is looked at by itself.
STRETCHES = 20
#: A partition that where demonstrations begin shows as well, to so large a share of what it
#: gains in likelihood later, is one of situations.
SITUATION = 0.5


@dataclass(frozen=True)
class _View:
    """Demonstrations in the coordinates of one operator: floor, and values (N, T, D)."""

    operator: Operator
    values: Array
    near: float

    def of(self, members: NDArray[np.intp]) -> _View:
        """Return the same of some of the demonstrations."""
        return replace(self, values=self.values[members])

    def places(self) -> Iterator[tuple[_View, int, Array]]:
        """List stretches, and coordinates (N,) of the demonstrations on each axis there."""
        for stretch, means in enumerate(self.stretches.swapaxes(0, 1)):
            for along in _axes(means):
                yield self, stretch, along

    @property
    def stretches(self) -> Array:
        """Means (N, S, D) over stretches."""
        edges = _edges(self.values.shape[1])
        sums = np.add.reduceat(self.values, edges[:-1], axis=1)
        return np.asarray(sums / np.diff(edges)[:, None])


@dataclass(frozen=True)
class _Split:
    """A partition of demonstrations that one stretch of one view shows.

    ``bic`` (K,) is that of 1 to K modes there, ``worth`` that less that of one, ``gain``
    the log-likelihood's, ``separation`` the smallest distance of two modes' means in standard
    deviations within them.
    """

    labels: NDArray[np.intp]
    bic: Array
    worth: float
    gain: float
    separation: float
    view: _View
    stretch: int


class SelectWays(DemonstrationEstimator):
    """Find the ways in which demonstrations do a skill, such as left and right of an obstacle.

    Two ways are far apart somewhere, in units of how much demonstrations of one way differ
    there. So each operator's coordinates are looked at stretch by stretch along aligned time:
    the demonstrations' means there, on each of their principal axes, are divided into 1, 2, ...
    modes of one variance, and BIC says how many. To have looked at B places costs log B nats
    for each mode more, so that chance gaps between few demonstrations do not count. Modes are
    divided again in the same manner.

    What a shift in time by ``shift`` explains is no other way, nor is what the situation
    shows at the start: one model follows objects that stand here or there.

    Parameters
    ----------
    model : TaskParameterizedGMM
        Its operators' coordinates count, and each way is learned with its parameters.
    n_ways : "auto" or int, default="auto"
        A number divides demonstrations into that many ways where they differ most, whatever
        BIC says.
    max_ways : int, default=4
        Largest number of ways at one place.
    shift : float, default=0.1
        Share of the duration by which demonstrations may be early or late.

    Attributes
    ----------
    models_ : list of TaskParameterizedGMM
        One per way, fitted.
    skill_ : Ways, or Regression where there is one way
        What runs.
    best_model_ : Ways, or TaskParameterizedGMM where there is one way
    n_ways_ : int
    labels_ : array of int, of shape (N,)
        The mode of each demonstration; mode 0 is that of the first one.
    bic_ : array of shape (max_ways,)
        Of 1, 2, ... modes where they are plainest; infinity for those that leave a mode less
        than two demonstrations.

    References
    ----------
    Schwarz: Estimating the Dimension of a Model, Annals of Statistics 6 (1978). Principal axes
    and repeated division: Hamerly, Elkan: Learning the k in k-means, NIPS 2003.

    Examples
    --------
    >>> from tpgmm_control import rollout
    >>> from tpgmm_torch import Demonstration, Situation
    >>> from tpgmm_torch.structure.select_ways import SelectWays
    >>> rng, time = np.random.default_rng(0), np.linspace(0, 1, 50)
    >>> shown = [
    ...     Demonstration(time, (side * np.sin(3 * time) + 0.02 * rng.normal())[:, None])
    ...     for side in (1, -1, 1, 1, -1, -1)
    ... ]
    >>> selection = SelectWays(TaskParameterizedGMM(4)).fit(shown)
    >>> selection.labels_.tolist()
    [0, 1, 0, 0, 1, 1]
    >>> [trajectory] = rollout(selection.skill_, [Situation([0.0])])
    >>> bool(trajectory.joints.abs().max() > 0.9)
    True
    """

    _parameter_constraints: dict[str, list[Any]] = {  # noqa: RUF012
        "model": [TaskParameterizedGMM],
        "n_ways": [Options("auto"), Interval(Integral, 1, None, closed="left")],
        "max_ways": [Interval(Integral, 2, None, closed="left")],
        "shift": [Interval(Real, 0, 1, closed="left")],
    }

    def __init__(
        self,
        model: TaskParameterizedGMM,
        n_ways: int | str = "auto",
        *,
        max_ways: int = 4,
        shift: float = 0.1,
    ) -> None:
        self.model = model
        self.n_ways = n_ways
        self.max_ways = max_ways
        self.shift = shift

    def fit(self, X: Sequence[Demonstration], y: object = None) -> Self:
        """Find them.

        Parameters
        ----------
        X : sequence of Demonstration
            Aligned in time; fewer than four show one way.
        y : ignored
            Here for scikit-learn.

        Returns
        -------
        self

        Raises
        ------
        DataError, ShapeError, UnknownNameError
            If demonstrations do not fit together, or with the operators and the robot, or are
            too few for ``n_ways``.
        """
        check_parameters(self)
        known = check_demonstrations(X)
        count = len(known)
        self._given = None if isinstance(self.n_ways, str) else int(self.n_ways)
        if self._given and count < FEWEST * self._given > FEWEST:
            raise DataError(
                f"{self._given} modes of at least {FEWEST} demonstrations each need "
                f"{FEWEST * self._given}, got {count}"
            )
        self.labels_: NDArray[np.intp] = np.zeros(count, dtype=np.intp)
        self.bic_: Array = np.full(self.max_ways, np.inf)
        self._found: list[_Split] = []
        self._divide(self._views(known))
        self.n_ways_ = int(self.labels_.max()) + 1
        pairs = list(zip(self.labels_, known, strict=True))
        shown = [[one for k, one in pairs if k == way] for way in range(self.n_ways_)]
        self.models_ = [clone(self.model).fit(own) for own in shown]
        self.skill_: Ways | Regression = self.models_[0].skill
        self.best_model_: TaskParameterizedGMM | Skill = self.models_[0]
        if self.n_ways_ > 1:
            skills = tuple(model.skill for model in self.models_)
            limits = tuple(map(_largest_surprise, skills, shown))
            self.skill_ = Ways(skills, tuple(np.bincount(self.labels_) / count), limits)
            self.best_model_ = self.skill_
        return self

    def report(self) -> str:
        """Report how many modes there are and why, as text.

        Raises
        ------
        NotFittedError
        """
        self._check_fitted("labels_")
        count = len(self.labels_)
        if self.n_ways_ == 1:
            return f"1 way: nowhere do the {count} demonstrations differ as several ways would"
        lines = [f"{self.n_ways_} ways:"]
        for mode in range(self.n_ways_):
            members = np.flatnonzero(self.labels_ == mode)
            names = ", ".join(map(str, members))
            lines.append(f"  {mode}  {len(members)} of {count} demonstrations: {names}")
        for split in self._found:
            begin, end = (
                self._time[round((len(self._time) - 1) * edge / STRETCHES)]
                for edge in (split.stretch, split.stretch + 1)
            )
            lines.append(
                f"  seen by {format_operator(split.view.operator)}, plainest from {begin:.2f} "
                f"to {end:.2f} s: {split.separation:.3g} standard deviations apart"
            )
        return "\n".join(lines)

    def _views(self, known: Sequence[Demonstration]) -> list[_View]:
        operators, robot = check_operators(self.model.operators), self.model.robot
        kinematics = kinematics_for(known, operators, robot, "float64", "cpu")
        rows = read_rows(Share(known), operators, kinematics)
        self._time = as_array(rows.time)
        data = rows.at_phases(len(rows.time))
        return [
            _View(leaf, as_array(values), near)
            for leaf, values, near in comparable_coordinates(
                data, rows.operators, kinematics, SMALLEST_RANGE
            )
        ]

    def _divide(self, views: Sequence[_View]) -> None:
        """Divide all demonstrations, and the parts again until none falls apart."""
        parts, whole = [np.arange(len(self.labels_))], []
        while parts:
            members = parts.pop(0)
            split = self._split([view.of(members) for view in views])
            if split is None:
                whole.append(members)
                continue
            if not self._found:
                self.bic_[: len(split.bic)] = split.bic
            self._found.append(split)
            new = [members[split.labels == k] for k in range(split.labels.max() + 1)]
            (whole if self._given else parts).extend(new)
        for mode, members in enumerate(sorted(whole, key=lambda part: int(part[0]))):
            self.labels_[members] = mode

    def _split(self, views: Sequence[_View]) -> _Split | None:
        """Divide some demonstrations best; None if BIC says that they are one mode."""
        most = min(self._given or self.max_ways, len(views[0].values) // FEWEST)
        if most < 2:
            return None
        places = [place for view in views for place in view.places()]
        cost = math.log(max(len(places), 1))
        splits = [_divide_along(*place, cost, most, self._given) for place in places]
        best = sorted(filter(None, splits), key=lambda split: split.worth)
        if self._given:
            return next(iter(best), None)
        found = (s for s in best if not self._is_shift(s) and not _is_situation(s, views))
        return next(found, None)

    def _is_shift(self, split: _Split) -> bool:
        """Check whether modes differ by a shift in time: in a little while they meet."""
        values, labels = split.view.values, split.labels
        edges = _edges(values.shape[1])
        now = (edges[split.stretch] + edges[split.stretch + 1]) // 2
        most = round(self.shift * values.shape[1])
        around = values[:, max(now - most, 0) : now + most + 1]
        gaps = np.linalg.norm(values[:, now, None, None] - around[None], axis=-1)
        shifted, same = gaps.min(-1), labels[:, None] == labels
        shifted = np.minimum(shifted, shifted.T)
        distances = np.linalg.norm(values[:, None, now] - values[None, :, now], axis=-1)
        others = same & ~np.eye(len(labels), dtype=bool)
        nearest = np.where(others, distances, np.inf).min(1)
        return bool(shifted[~same].min() <= max(nearest.max(), split.view.near))


def _divide_along(
    view: _View, stretch: int, along: Array, cost: float, most: int, given: int | None
) -> _Split | None:
    """Divide along one axis of one stretch; None if there is one mode."""
    partitions = _partitions(along, most)
    scores = np.array([_log_likelihood(along, labels, view.near) for labels in partitions])
    k = np.arange(1, most + 1)
    bic = -2 * scores + k * math.log(len(along)) + 2 * cost * (k - 1)
    best = most - 1 if given else int(bic.argmin())
    if not best:
        return None
    labels, gain = partitions[best], float(scores[best] - scores[0])
    means, squares = _scatter(along, labels)
    within = max(math.sqrt(squares / (len(along) - len(means))), view.near)
    apart = float(np.diff(np.sort(means)).min() / within)
    return _Split(labels, bic, float(bic[best] - bic[0]), gain, apart, view, stretch)


def _edges(count: int) -> NDArray[np.intp]:
    """Divide T instants into stretches: return their edges."""
    number = min(STRETCHES, count)
    return np.linspace(0, count, number + 1).round().astype(np.intp)


def _axes(values: Array) -> Array:
    """Coordinates (A, N) of N vectors (N, D) on their principal axes."""
    apart = values - values.mean(0)
    u, s, _ = np.linalg.svd(apart, full_matrices=False)
    return np.asarray((u * s).T)


def _partitions(values: Array, most: int) -> list[NDArray[np.intp]]:
    """Labels (N,) that divide numbers into 1 to ``most`` modes with the least squares.

    In one dimension modes are intervals, and the best are found by dynamic programming
    (Fisher 1958).
    """
    order = np.argsort(values, kind="stable")
    ordered, n = values[order], len(values)
    first, second = (np.concatenate(([0.0], np.cumsum(ordered**p))) for p in (1, 2))
    begin, end = np.arange(n + 1)[:, None], np.arange(n + 1)[None]
    size = end - begin
    with np.errstate(invalid="ignore", divide="ignore"):
        squares = second[None] - second[:, None] - (first[None] - first[:, None]) ** 2 / size
    squares = np.where(size >= FEWEST, squares, np.inf)  # of an interval [begin, end)
    least, cuts = squares[0], []
    found: list[NDArray[np.intp]] = [np.zeros(n, dtype=np.intp)]
    for _ in range(2, most + 1):
        total = least[:, None] + squares
        cuts.append(total.argmin(0))
        least = total.min(0)
        edges = [n]
        for where in reversed(cuts):
            edges.append(int(where[edges[-1]]))
        labels = np.empty(n, dtype=np.intp)
        labels[order] = np.searchsorted(sorted(edges[1:]), np.arange(n), side="right")
        found.append(labels)
    return found


def _scatter(values: Array, labels: NDArray[np.intp]) -> tuple[Array, float]:
    """Means of modes, and the sum of squares within them."""
    means = np.bincount(labels, values) / np.bincount(labels)
    return means, float(((values - means[labels]) ** 2).sum())


def _log_likelihood(values: Array, labels: NDArray[np.intp], near: float) -> float:
    """Compute the log-likelihood of numbers under modes of one variance, at least ``near^2``.

    It is the restricted one: means are integrated out, from a prior as wide as all numbers,
    because K means of few numbers take much of what tells the variance.
    """
    sizes = np.bincount(labels)
    means, squares = _scatter(values, labels)
    n, free = len(values), len(values) - len(means)
    wide = max(float(values.std(ddof=1)), near)
    variance = max(squares / free, near**2)
    log_density = -0.5 * (free * math.log(2 * math.pi * variance) + squares / variance)
    log_means = -0.5 * float(np.log(sizes).sum()) - len(means) * math.log(wide)
    return log_density + log_means + float((sizes * np.log(sizes / n)).sum())


def _is_situation(split: _Split, views: Sequence[_View]) -> bool:
    """Check whether beginnings, as some operator sees them, show the modes too."""
    one = np.zeros_like(split.labels)
    gains = [
        _log_likelihood(along, split.labels, view.near) - _log_likelihood(along, one, view.near)
        for view in views
        for along in _axes(view.values[:, 0])
    ]
    return max(gains) > SITUATION * split.gain


def _largest_surprise(skill: Regression, demonstrations: Sequence[Demonstration]) -> float:
    """Compute the largest surprise of the demonstrations that a skill learned from [nats]."""
    motions = [Motion.of(one, skill.kinematics, skill.holds) for one in demonstrations]
    return max(
        float(skill.surprise(one.time, one.state.joints, one.frames).max()) for one in motions
    )
