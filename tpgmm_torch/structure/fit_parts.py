"""A skill in parts, each learned by a model of its own."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from itertools import pairwise
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from tpgmm_torch.data.demonstrations import Demonstration, check_demonstrations
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.operators import Operator
from tpgmm_torch.skills.sequence import Sequence as SkillSequence
from tpgmm_torch.structure.select_operators import SelectOperators

__all__ = ["fit_parts"]


def fit_parts(
    model: TaskParameterizedGMM,
    demonstrations: Sequence[Demonstration],
    cuts: Sequence[float | str],
    operators: Sequence[Any] | SelectOperators | None = None,
) -> SkillSequence:
    """Learn each part of a skill by a model of its own, and chain them.

    Parameters
    ----------
    model : TaskParameterizedGMM
        Unfitted; each part has its share of ``n_components`` by its duration.
    demonstrations : sequence of Demonstration
        Aligned in time, in step at the cuts (:meth:`Segmentation.transform`).
    cuts : sequence of float or str
        Where parts end, but for the last: times [s], or events of the demonstrations.
    operators : sequence of sequences of Operator, or SelectOperators, optional
        Of each part, or how they are found in it; by default those of the model for all.

    Returns
    -------
    Sequence

    Raises
    ------
    DataError, ShapeError, UnknownNameError
        If the parts do not follow on each other, there are fewer components or other numbers
        of operators than parts, or as of the model's ``fit``.
    """
    known = check_demonstrations(demonstrations)
    edges = _edges(known, cuts)
    stretches = list(pairwise(edges))
    if isinstance(operators, SelectOperators):
        operators = [_select_for(operators, known, *own) for own in stretches]
    of_parts = [model.operators] * len(stretches) if operators is None else list(operators)
    if len(of_parts) != len(stretches):
        raise DataError(f"there are operators for {len(of_parts)} of {len(stretches)} parts")
    numbers = _shares(model.n_components, np.diff(edges))
    parts = []
    for number, own, interval in zip(numbers, of_parts, stretches, strict=True):
        part = clone(model).set_params(n_components=number, operators=own)
        parts.append(part.fit(known, interval=interval).skill)
    return SkillSequence(tuple(parts))


def _edges(known: Sequence[Demonstration], cuts: Sequence[float | str]) -> list[float]:
    """When parts begin and the last ends [s]."""
    begin = max(float(one.time[0]) for one in known)
    end = min(float(one.time[-1]) for one in known)
    edges = [begin, *(time for cut in cuts for time in _times(cut, known)), end]
    for early, late in pairwise(edges):
        if not early < late:
            raise DataError(
                f"parts follow on each other between {begin:.4g} and {end:.4g} s: the cut at "
                f"{late:.4g} s is not after {early:.4g} s"
            )
    return edges


def _select_for(
    select: SelectOperators, known: Sequence[Demonstration], begin: float, end: float
) -> tuple[Operator, ...]:
    """Return the operators that matter from ``begin`` to ``end``."""
    part = [one.at_steps((one.time >= begin) & (one.time < end)) for one in known]
    return clone(select).fit(part).operators_


def _times(cut: float | str, demonstrations: Sequence[Demonstration]) -> list[float]:
    """Return the time of a cut, or the median times of the events that a pattern names."""
    if isinstance(cut, Real):
        return [float(cut)]
    known = demonstrations[0].events
    names = [name for name in known if fnmatchcase(name, str(cut))] or [str(cut)]
    for name in names:
        for one in demonstrations:
            if name not in one.events:
                raise UnknownNameError("event", name, "a demonstration", one.events)
    return sorted(float(np.median([one.events[n] for one in demonstrations])) for n in names)


def _shares(number: int, durations: NDArray[np.float64]) -> list[int]:
    """Divide the components among the parts: at least one each."""
    if number < len(durations):
        raise DataError(
            f"{len(durations)} parts need a component each, n_components is {number}: raise "
            "it, or give fewer parts"
        )
    spare = number - len(durations)
    counts = 1 + np.floor(spare * durations / durations.sum()).astype(int)
    while counts.sum() < number:
        counts[int((durations / counts).argmax())] += 1
    return counts.tolist()
