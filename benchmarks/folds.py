"""Cross-validation: folds learned in common passes, and one after the other."""

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.model_selection import LeaveOneOut

from benchmarks.rows import Row
from benchmarks.settings import Settings
from benchmarks.skill import COMPONENTS, aligned, model
from benchmarks.timing import in_turns, medians, seconds
from tpgmm_torch import Demonstration, TaskParameterizedGMM
from tpgmm_torch.model_selection import fit_folds

__all__ = ["measure"]


def measure(settings: Settings) -> Iterator[Row]:
    """Each of ten demonstrations left out once, by points and by instants."""
    shown, rounds = aligned(settings), settings.rounds(3)
    folds = [train for train, _ in LeaveOneOut().split(shown)]
    for responsibilities in ("instant", "point"):
        options = {"responsibilities": responsibilities, "random_state": settings.seed}
        work = {"together": fit_folds, "alone": _one_by_one}
        measurements = {
            name: partial(seconds, partial(fit, model(settings, **options), shown, folds))
            for name, fit in work.items()
        }
        taken = medians(in_turns(measurements, rounds))
        yield Row(
            f"fit, {len(folds)} folds that leave one out, K = {COMPONENTS}, "
            f"one responsibility per {responsibilities}",
            "s",
            taken["together"],
            "fold after fold",
            taken["alone"],
            rounds=rounds,
        )


def _one_by_one(
    estimator: TaskParameterizedGMM,
    shown: Sequence[Demonstration],
    folds: Sequence[NDArray[Any]],
) -> list[TaskParameterizedGMM]:
    return [clone(estimator).fit([shown[k] for k in fold]) for fold in folds]
