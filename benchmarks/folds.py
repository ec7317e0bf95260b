"""Cross-validation: folds learned in common passes, and one after the other."""

from collections.abc import Iterator

from sklearn.base import clone
from sklearn.model_selection import LeaveOneOut

from benchmarks.rows import Row
from benchmarks.settings import Settings
from benchmarks.skill import COMPONENTS, aligned, skill
from benchmarks.timing import in_turns, medians, seconds
from tpgmm_datasets.bottle_experiment import bottle_operators
from tpgmm_torch import TaskParameterizedGMM
from tpgmm_torch.cross_validation import fit_folds

__all__ = ["measure"]


def measure(settings: Settings) -> Iterator[Row]:
    """Each of ten demonstrations left out once, by points and by instants."""
    shown, rounds = aligned(settings), settings.rounds(3)
    folds = [train for train, _ in LeaveOneOut().split(shown)]
    for responsibilities in ("instant", "point"):
        model = TaskParameterizedGMM(
            COMPONENTS, bottle_operators(), skill(settings).robot,
            responsibilities=responsibilities, random_state=settings.seed,
        )  # fmt: skip

        def together(model: TaskParameterizedGMM = model) -> float:
            return seconds(lambda: fit_folds(model, shown, folds))

        def alone(model: TaskParameterizedGMM = model) -> float:
            return seconds(
                lambda: [clone(model).fit([shown[k] for k in fold]) for fold in folds]
            )

        taken = medians(in_turns({"together": together, "alone": alone}, rounds))
        yield Row(
            f"fit, {len(folds)} folds that leave one out, K = {COMPONENTS}, "
            f"one responsibility per {responsibilities}",
            "s",
            taken["together"],
            "fold after fold",
            taken["alone"],
            rounds=rounds,
        )
