"""The number of Gaussians, by the likelihood of demonstrations that were left out."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import clone

from tpgmm_torch import gaussians
from tpgmm_torch.constraints import DemonstrationEstimator, Interval, check_parameters
from tpgmm_torch.data.demonstrations import FEWEST, Demonstration, check_demonstrations
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import ConvergenceWarning, DataError
from tpgmm_torch.operators import Canonical
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.training.local_data import Motion

__all__ = ["SelectComponents"]

#: Each about a third more than the one before.
CANDIDATES = (2, 3, 4, 5, 7, 10, 13, 17, 23, 30, 40, 53)


class SelectComponents(DemonstrationEstimator):
    """Find the number of Gaussians by cross-validation.

    Each number of components is learned from all demonstrations but some, fold by fold; at the
    instants and frames of those that were left out, the reproduction's Gaussian gives their
    joints a likelihood. More components raise it until they follow chance. The smallest number
    is taken that is not worse than the best by more than ``threshold``, or one standard error
    of the difference between the two.

    It is not the likelihood of the local coordinates, which one instant decides where
    demonstrations agree to a fraction of a millimetre: agreement below ``tolerance`` means
    nothing here, and tails are those of few demonstrations.

    Parameters
    ----------
    model : TaskParameterizedGMM
        With every other parameter.
    candidates : sequence of int, default=(2, 3, 4, 5, 7, 10, 13, 17, 23, 30, 40, 53)
        Of these, those count that leave each component two instants, in ascending order, until
        two in a row are worse than the best.
    n_folds : int, default=5
        Demonstration m is left out in fold ``m % n_folds``.
    tolerance : float, default=0.005
        Agreement of the joints below it means nothing [rad or m].
    threshold : float, default=0.25
        The least gain that more components are worth [nats per instant].
    n_instants : int, default=100
        At how many instants at most a demonstration is compared with the estimate.

    Attributes
    ----------
    best_model_ : TaskParameterizedGMM
        Fitted to all demonstrations.
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
    >>> from tpgmm_torch import Demonstration, SelectComponents, TaskParameterizedGMM
    >>> time, rng = np.linspace(0, 2, 60), np.random.default_rng(0)
    >>> shown = [
    ...     Demonstration(time, (np.sin(6 * time) + 0.05 * rng.normal())[:, None])
    ...     for _ in range(5)
    ... ]
    >>> SelectComponents(TaskParameterizedGMM()).fit(shown).n_components_ > 4
    True
    """

    _parameter_constraints: dict[str, list[Any]] = {  # noqa: RUF012
        "model": [TaskParameterizedGMM],
        "candidates": ["array-like"],
        "n_folds": [Interval(Integral, 2, None, closed="left")],
        "tolerance": [Interval(Real, 0, None, closed="neither")],
        "threshold": [Interval(Real, 0, None, closed="left")],
        "n_instants": [Interval(Integral, 1, None, closed="left")],
    }

    best_model_: TaskParameterizedGMM

    def __init__(
        self,
        model: TaskParameterizedGMM,
        candidates: Sequence[int] = CANDIDATES,
        *,
        n_folds: int = 5,
        tolerance: float = 0.005,
        threshold: float = 0.25,
        n_instants: int = 100,
    ) -> None:
        self.model = model
        self.candidates = candidates
        self.n_folds = n_folds
        self.tolerance = tolerance
        self.threshold = threshold
        self.n_instants = n_instants

    def fit(self, X: Sequence[Demonstration], y: object = None) -> Self:
        """Find the number, and learn with it.

        Parameters
        ----------
        X : sequence of Demonstration
            At least three.
        y : ignored
            Here for scikit-learn.

        Returns
        -------
        self

        Raises
        ------
        DataError, ShapeError, UnknownNameError
            If there are fewer, none of the candidates fits them, or as of the model's ``fit``.
        """
        check_parameters(self)
        demonstrations = check_demonstrations(X)
        if len(demonstrations) <= FEWEST:
            raise DataError(
                "the number of components is found on demonstrations that are left out: it "
                f"takes at least {FEWEST + 1}, got {len(demonstrations)}; give n_components a "
                "number"
            )
        usable = self._usable(demonstrations)
        scores: list[list[float]] = []
        refusal: DataError | None = None
        for number in usable:
            try:
                scores.append(self._held_out(demonstrations, number))
            except DataError as error:  # with so many nothing can be reproduced
                refusal = error
                scores.append([-np.inf] * len(demonstrations))
            means = np.mean(scores, axis=1)
            if len(means) - 1 - means.argmax() >= 2:
                break
        self.candidates_, self.scores_ = tuple(usable[: len(scores)]), np.array(scores)
        if refusal is not None and np.isneginf(self.scores_).all():
            raise refusal
        self.n_components_ = self.candidates_[self._chosen()]
        if self.n_components_ == usable[-1] and len(usable) > 1:
            warnings.warn(
                f"{self.n_components_} components, the most that were tried, explain what was "
                "left out best: give SelectComponents larger candidates, or more instants",
                ConvergenceWarning,
                stacklevel=2,
            )
        best = clone(self.model).set_params(n_components=self.n_components_)
        self.best_model_ = best.fit(demonstrations)
        return self

    def _usable(self, demonstrations: Sequence[Demonstration]) -> list[int]:
        most = min(map(len, demonstrations)) // 2
        given = sorted({int(number) for number in self.candidates})
        usable = [number for number in given if 1 <= number <= most]
        if not usable:
            raise DataError(
                f"none of the numbers of components {given} leaves each at least two of "
                f"{2 * most} instants: give SelectComponents other candidates"
            )
        return usable

    def _held_out(self, demonstrations: Sequence[Demonstration], number: int) -> list[float]:
        """Mean log-likelihood of each demonstration under the model of the other folds."""
        count = len(demonstrations)
        folds = np.arange(count) % min(self.n_folds, count)
        scores = np.empty(count)
        for fold in range(folds.max() + 1):
            kept = [one for one, own in zip(demonstrations, folds, strict=True) if own != fold]
            model = clone(self.model).set_params(n_components=number)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of too many components, which is found here
                skill = model.fit(kept).skill
            for index in np.flatnonzero(folds == fold):
                scores[index] = self._score(skill, demonstrations[index], len(kept))
        return scores.tolist()

    def _score(self, skill: Regression, demonstration: Demonstration, n_learned: int) -> float:
        """Mean log-likelihood of the joints of a demonstration that was left out."""
        kinematics, like = skill.kinematics, skill.kinematics.lower
        count = min(len(demonstration), self.n_instants)
        index = torch.linspace(0, len(demonstration) - 1, count).round().long()
        motion = Motion.of(
            demonstration.at_steps(index), kinematics, skill.holds, attached=True
        )
        floor = like.new_tensor(Canonical(self.tolerance).tolerances(kinematics)).square()
        with torch.no_grad():
            estimate = skill.estimate(motion.time, motion.state, motion.frames)
            density = gaussians.log_density(
                (estimate.joints - motion.state.joints)[..., None],
                estimate.covariance + floor.diag(),
                "the covariance of the estimate",
                max(n_learned - 1.0, 1.0),
            )
        return float(density.mean())

    def _chosen(self) -> int:
        best = self.scores_.mean(1).argmax()
        with np.errstate(invalid="ignore"):  # infinitely far behind
            behind: NDArray[np.float64] = self.scores_[best] - self.scores_
            spread = behind.std(1, ddof=1) / self.scores_.shape[1] ** 0.5
            near = behind.mean(1) <= np.fmax(spread, self.threshold)
        return int(np.flatnonzero(near)[0])
