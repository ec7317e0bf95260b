"""Cross-validation whose folds are learned together, in passes over the data that they share.

scikit-learn's own tools fit fold after fold, each from the beginning. Most of what that takes
is the same for all folds: where the hands were in each demonstration, and the expansion of the
points that EM walks through. Folds differ by what counts, and so they are learned as restarts
are: side by side, along the dimension of the components.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from time import perf_counter
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import clone
from sklearn.metrics import check_scoring
from sklearn.model_selection import check_cv

from tpgmm_torch.checks.summary import TrainingSummary
from tpgmm_torch.checks.training import check, summarize
from tpgmm_torch.data.demonstrations import Demonstration, check_demonstrations
from tpgmm_torch.em.column_moments import ColumnMoments
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.metrics import reproduction_scorer
from tpgmm_torch.mixture.block_gaussian_mixture import fit_subsets
from tpgmm_torch.training.hold_detection import holds_for
from tpgmm_torch.training.mixture_settings import check_operators, kinematics_for
from tpgmm_torch.training.outlying_demonstrations import outlying_demonstrations
from tpgmm_torch.training.training_rows import rows_in_memory, share_one_grid, typical_time

__all__ = ["cross_validate", "fit_folds"]


def cross_validate(
    estimator: TaskParameterizedGMM,
    X: Sequence[Demonstration],
    *,
    cv: Any = None,
    scoring: Callable[..., float] | None = reproduction_scorer,
    return_estimator: bool = False,
) -> dict[str, Any]:
    """Evaluate a model on demonstrations left out, as scikit-learn's function of that name.

    Parameters
    ----------
    estimator : TaskParameterizedGMM
        What is fitted to each fold, as a clone.
    X : sequence of Demonstration
    cv : int, cross-validation generator or iterable, optional
        As in scikit-learn: None is five folds, ``LeaveOneOut()`` one per demonstration.
    scoring : callable, default=reproduction_scorer
        ``scoring(model, demonstrations)``; None is the log-likelihood.
    return_estimator : bool, default=False
        Whether to return the models, too.

    Returns
    -------
    dict
        ``test_score``, ``fit_time`` (each fold's share of the common time) and ``score_time``
        in seconds, arrays of shape (n_folds,), and perhaps ``estimator``, a list.

    Raises
    ------
    DataError, ShapeError, UnknownNameError
        As :meth:`TaskParameterizedGMM.fit`, and if there are not enough demonstrations.

    Examples
    --------
    >>> from sklearn.model_selection import LeaveOneOut
    >>> time = np.linspace(0, 1, 50)
    >>> shown = [Demonstration(time, time[:, None] * end) for end in (0.9, 1.0, 1.1)]
    >>> model = TaskParameterizedGMM(n_components=2)
    >>> found = cross_validate(model, shown, cv=LeaveOneOut())
    >>> len(found["test_score"]), bool((found["test_score"] > -0.2).all())
    (3, True)
    """
    demonstrations = check_demonstrations(X)
    try:
        folds = list(check_cv(cv).split(demonstrations))
    except ValueError as error:
        raise DataError(f"{len(demonstrations)} demonstrations: {error}") from error
    began = perf_counter()
    models = fit_folds(estimator, demonstrations, [train for train, _ in folds])
    fit_time = (perf_counter() - began) / len(folds)
    score = check_scoring(estimator, scoring)
    scores, score_times = [], []
    for model, (_, test) in zip(models, folds, strict=True):
        began = perf_counter()
        scores.append(score(model, [demonstrations[index] for index in test]))
        score_times.append(perf_counter() - began)
    found: dict[str, Any] = {
        "fit_time": np.full(len(folds), fit_time),
        "score_time": np.array(score_times),
        "test_score": np.array(scores),
    }
    return found | ({"estimator": models} if return_estimator else {})


def fit_folds(
    estimator: TaskParameterizedGMM, X: Sequence[Demonstration], folds: Iterable[ArrayLike]
) -> list[TaskParameterizedGMM]:
    """Fit one model to each fold, in common passes.

    The models are those that ``clone(estimator).fit`` makes of each fold, to rounding;
    quaternions lie on the side of the first demonstration of all, not of the fold.

    Parameters
    ----------
    estimator : TaskParameterizedGMM
        It stays as it is.
    X : sequence of Demonstration
    folds : iterable of array-like of int
        Which demonstrations each model learns from.

    Returns
    -------
    list of TaskParameterizedGMM

    Raises
    ------
    DataError, ShapeError, UnknownNameError
        As :meth:`TaskParameterizedGMM.fit`; and if a fold is empty, or has numbers of
        demonstrations that do not exist.
    """
    demonstrations = check_demonstrations(X)
    chosen = [_numbers(fold, len(demonstrations)) for fold in folds]
    shown = [[demonstrations[index] for index in fold] for fold in chosen]
    models = [clone(estimator) for _ in chosen]
    estimator.check_parameters()
    if estimator.selects:  # each fold finds its own
        return [model.fit(own) for model, own in zip(models, shown, strict=True)]
    operators = check_operators(estimator.operators)
    kinematics = kinematics_for(
        demonstrations, operators, estimator.robot, estimator.dtype, estimator.device
    )
    holds = {holds_for(estimator.holds, own, operators, kinematics) for own in shown if own}
    twice = any(len(set(fold)) < len(fold) for fold in chosen)
    # some folds would have one responsibility per instant, others not
    mixed = (
        estimator.responsibilities == "auto"
        and not share_one_grid(demonstrations)
        and any(map(share_one_grid, shown))
    )
    together = not (twice or mixed) and len(holds) == 1
    if together and estimator.robust:  # what a fold leaves out, it leaves out alone
        [held] = holds
        together = not any(
            outlying_demonstrations(own, operators, kinematics, held) for own in shown
        )
    if not together:
        return [model.fit(own) for model, own in zip(models, shown, strict=True)]
    episodes = summarize(demonstrations, kinematics)
    family = estimator.covariance_type, estimator.covariance_shrinkage
    correlated = family[0] in ("full", "tied") and family[1] == 0
    report = check(episodes, kinematics, operators, correlated=correlated)
    report.act(estimator.plausibility)
    [held] = holds
    learning = rows_in_memory(
        demonstrations,
        operators,
        kinematics,
        responsibilities=estimator.responsibilities,
        holds=held,
    )
    size, [rows] = learning.group_size, learning.rows
    belongs = np.zeros((len(chosen), len(demonstrations)), dtype=bool)
    for row, fold in zip(belongs, chosen, strict=True):
        row[fold] = True
    if size > 1:  # instant by instant
        members = np.tile(belongs, len(rows) // size)
    else:
        members = np.repeat(belongs, [len(d) for d in demonstrations], axis=1)
    moments = [ColumnMoments.of(rows[own]) for own in members]
    mixtures = [
        model.unfitted_mixture(
            known, len(fold) if size > 1 else 1, operators, kinematics, len(fold)
        )
        for model, fold, known in zip(models, chosen, moments, strict=True)
    ]
    fit_subsets(mixtures, rows, members, size, moments)
    for model, mixture, own, fold in zip(models, mixtures, shown, chosen, strict=True):
        time = typical_time(own).to(learning.time)
        model.set_mixture(mixture, operators, kinematics, time, held)
        model.summary_ = TrainingSummary.of([episodes[index] for index in fold], kinematics)
        model.demonstration_weights_ = torch.ones(len(fold), dtype=torch.float64)
    return models


def _numbers(fold: ArrayLike, count: int) -> NDArray[np.intp]:
    """Which demonstrations, once it is known that they exist."""
    numbers = np.asarray(fold)
    if numbers.ndim != 1 or not len(numbers) or numbers.dtype.kind not in "iu":
        raise DataError(f"a fold is a list of numbers of demonstrations, got {fold!r}")
    if numbers.min() < 0 or numbers.max() >= count:
        raise DataError(f"a fold asks for {numbers.tolist()}; there are {count} demonstrations")
    return numbers
