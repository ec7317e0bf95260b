"""How many Gaussians: found by how likely demonstrations are that were left out."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from numbers import Integral, Real
from typing import Any, Self

import numpy as np
import torch
from sklearn.base import BaseEstimator
from torch import Tensor

from tpgmm_torch import gaussians
from tpgmm_torch.constraints import Interval, check_parameters
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.em.column_moments import ColumnMoments
from tpgmm_torch.exceptions import ConvergenceWarning, DataError
from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture, fit_subsets
from tpgmm_torch.operators import Canonical
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.robots.held_objects import held_objects
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.training.training_rows import LearningRows

__all__ = ["ComponentSelection"]

#: Each about a third more than the one before.
CANDIDATES = (2, 3, 4, 5, 7, 10, 13, 17, 23, 30, 40, 53)
#: With one demonstration to learn from there is no variance.
FEWEST = 3
#: So many candidates in a row that are worse than the best end the search.
PATIENCE = 2
#: At so many instants a demonstration is compared with what is expected.
INSTANTS = 100

#: An unfitted mixture of K components for rows of these moments, in groups of this size, of so
#: many demonstrations.
Make = Callable[[int, ColumnMoments, int, int], BlockGaussianMixture]


class ComponentSelection(BaseEstimator):  # type: ignore[misc]
    """Find the number of Gaussians, as ``n_components="auto"`` does.

    Each number of components is learned from all demonstrations but some, fold by fold, and
    asked for the joints of those that were left out: at each of their instants and frames, the
    reproduction's Gaussian gives them a likelihood. More components raise it until they follow
    what demonstrations do by chance. The smallest number is taken that is not worse than the
    best by more than ``threshold``, or one standard error of the difference between the two.

    It is not the likelihood of the local coordinates, which one instant decides where
    demonstrations agree to a fraction of a millimetre: agreement below ``tolerance`` means
    nothing here, and tails are those of few demonstrations.

    Parameters
    ----------
    candidates : sequence of int, default=(2, 3, 4, 5, 7, 10, 13, 17, 23, 30, 40, 53)
        Numbers of components, of which those count that leave each at least two instants. In
        ascending order; the search ends when two in a row are worse than the best.
    n_folds : int, default=5
        Demonstration m is left out in fold ``m % n_folds``.
    tolerance : float, default=0.005
        Agreement of the joints below it means nothing [rad or m].
    threshold : float, default=0.25
        The least gain that more components are worth [nats per instant].

    Attributes
    ----------
    n_components_ : int
    candidates_ : tuple of int
        Those that were tried.
    scores_ : array of shape (n_candidates, n_demonstrations)
        Mean log-likelihood of each demonstration, left out [nats per instant]; minus infinity
        for a number with which nothing can be reproduced.

    References
    ----------
    The rule of one standard error: Hastie, Tibshirani, Friedman, The Elements of Statistical
    Learning, 2009, section 7.10.

    Examples
    --------
    >>> from tpgmm_torch import Demonstration, TaskParameterizedGMM
    >>> time, rng = np.linspace(0, 2, 60), np.random.default_rng(0)
    >>> shown = [
    ...     Demonstration(time, (np.sin(6 * time) + 0.05 * rng.normal())[:, None])
    ...     for _ in range(5)
    ... ]
    >>> model = TaskParameterizedGMM("auto").fit(shown)
    >>> model.n_components_ > 4
    True
    """

    _parameter_constraints: dict[str, list[Any]] = {  # noqa: RUF012
        "candidates": ["array-like"],
        "n_folds": [Interval(Integral, 2, None, closed="left")],
        "tolerance": [Interval(Real, 0, None, closed="neither")],
        "threshold": [Interval(Real, 0, None, closed="left")],
    }

    def __init__(
        self,
        candidates: Sequence[int] = CANDIDATES,
        *,
        n_folds: int = 5,
        tolerance: float = 0.005,
        threshold: float = 0.25,
    ) -> None:
        self.candidates = candidates
        self.n_folds = n_folds
        self.tolerance = tolerance
        self.threshold = threshold

    def choose(
        self,
        demonstrations: Sequence[Demonstration],
        learning: LearningRows,
        make: Make,
        condition: Callable[[BlockGaussianMixture], Regression],
        holds: Sequence[Hold] = (),
    ) -> Self:
        """Find it for a model that learns from these rows.

        Parameters
        ----------
        demonstrations : sequence of Demonstration
        learning : LearningRows
            Of the same, in memory.
        make : callable
            ``make(K, moments, group_size, n_demonstrations)`` gives an unfitted mixture.
        condition : callable
            ``condition(mixture)`` gives what a fitted one makes of time.
        holds : sequence of Hold, default=()
            Objects that the robot held.

        Returns
        -------
        self

        Raises
        ------
        DataError
            If there are fewer than three demonstrations, or no candidate fits them.
        """
        check_parameters(self)
        count, size = len(demonstrations), learning.group_size
        if count < FEWEST:
            raise DataError(
                "how many components there are is seen from demonstrations that are left out: "
                f"it takes at least {FEWEST}, got {count}; give n_components a number"
            )
        most = min(map(len, demonstrations)) // 2
        given = sorted({int(number) for number in self.candidates})
        usable = [number for number in given if 1 <= number <= most]
        if not usable:
            raise DataError(
                f"none of the numbers of components {given} leaves each at least two of "
                f"{2 * most} instants: give ComponentSelection other candidates"
            )
        [rows] = learning.rows
        folds = torch.arange(count) % min(self.n_folds, count)
        kept = [(folds != fold).numpy() for fold in range(int(folds.max()) + 1)]
        if size > 1:  # instant by instant
            members = np.stack([np.tile(own, len(rows) // size) for own in kept])
        else:
            lengths = [len(one) for one in demonstrations]
            members = np.stack([np.repeat(own, lengths) for own in kept])
        moments = [ColumnMoments.of(rows[own]) for own in members]
        scores: list[list[float]] = []
        refusal: DataError | None = None
        for number in usable:
            mixtures = [
                make(number, known, int(own.sum()) if size > 1 else 1, int(own.sum()))
                for known, own in zip(moments, kept, strict=True)
            ]
            with warnings.catch_warnings():
                warnings.simplefilter(
                    "ignore"
                )  # what too many components do is being found out
                fit_subsets(mixtures, rows, members, size, moments)
            regressions = list(map(condition, mixtures))
            try:
                found = [
                    self._score(regressions[fold], one, int(kept[fold].sum()), holds)
                    for one, fold in zip(demonstrations, folds.tolist(), strict=True)
                ]
            except DataError as error:  # with so many nothing can be reproduced
                refusal, found = error, [-np.inf] * count
            scores.append(found)
            means = np.mean(scores, axis=1)
            if len(means) - 1 - means.argmax() >= PATIENCE:
                break
        self.candidates_, self.scores_ = tuple(usable[: len(scores)]), np.array(scores)
        best = self.scores_.mean(1).argmax()
        if refusal is not None and np.isneginf(self.scores_[best]).any():
            raise refusal
        with np.errstate(invalid="ignore"):  # infinitely far behind
            behind = self.scores_[best] - self.scores_
            spread = behind.std(1, ddof=1) / count**0.5
            chosen = int(np.flatnonzero(behind.mean(1) <= np.fmax(spread, self.threshold))[0])
        self.n_components_ = self.candidates_[chosen]
        if self.n_components_ == usable[-1] and len(usable) > 1:
            warnings.warn(
                f"{self.n_components_} components, the most that were tried, explain what was "
                "left out best: give ComponentSelection larger candidates, or more instants",
                ConvergenceWarning,
                stacklevel=3,
            )
        return self

    def _score(
        self,
        regression: Regression,
        demonstration: Demonstration,
        n_learned: int,
        holds: Sequence[Hold],
    ) -> float:
        """Mean log-likelihood of the joints of a demonstration that was left out."""
        kinematics = regression.kinematics
        steps = torch.linspace(0, len(demonstration) - 1, min(len(demonstration), INSTANTS))
        index = steps.round().long()
        like = kinematics.lower
        motion = demonstration.at_steps(index).reordered(kinematics.joint_names)
        time = motion.time.to(like)
        state = kinematics.state(motion.joints.to(like))
        frames = {name: frame.to(like) for name, frame in motion.frames.items()}
        if holds:
            state, frames = held_objects(state, time, frames, holds, attached=True)
        with torch.no_grad():
            estimate = regression.step(time, state, frames)
            step = (estimate.joints - state.joints)[..., None]
            covariance = estimate.covariance + _floor(self.tolerance, kinematics)
            name, degrees = "the covariance of what is expected", max(n_learned - 1.0, 1.0)
            density = gaussians.log_density(step, covariance, name, degrees)
        return float(density.mean())


def _floor(tolerance: float, kinematics: Kinematics) -> Tensor:
    tolerances = kinematics.lower.new_tensor(Canonical(tolerance).tolerances(kinematics))
    return tolerances.square().diag()
