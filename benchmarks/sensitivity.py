"""Sensitivity to parameters that a user may set: what is measured at half and at twice.

    python -m benchmarks.sensitivity

The recordings are read from ``../shared/data``, and left out where they are not there.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tpgmm_datasets.bottle.skill import BottleShaking, bottle_operators
from tpgmm_evaluation.regressions.plan import Plan
from tpgmm_torch import (
    Demonstration,
    Frame,
    SelectOperators,
    Situation,
    TaskParameterizedGMM,
)
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.operators.text import format_operator
from tpgmm_torch.regression.fusion_forms import CovarianceFusion, InformationFusion
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.training.outlying_demonstrations import outlying_demonstrations

#: Values of the estimator's parameters beside the usual ones, which come first.
VALUES: Mapping[str, Sequence[Any]] = {
    "n_components": (1.0, 0.5, 0.8, 1.25, 2.0),
    "reg_covar": (1e-5, 5e-6, 2e-5),
    "covariance_shrinkage": ("auto", 0.0, 0.1, 0.2, 1.0),
    "tol": (1e-3, 5e-4, 2e-3),
    "fusion": (
        InformationFusion(),
        InformationFusion(prior_std=5.0),
        InformationFusion(prior_std=20.0),
        InformationFusion(negligible=5e-10),
        InformationFusion(negligible=2e-9),
        CovarianceFusion(1e-4),
        CovarianceFusion(5e-5),
        CovarianceFusion(2e-4),
    ),
}
#: Of those that choose operators.
SELECTION = {"threshold": (0.25, 0.125, 0.5), "tolerance": (0.005, 0.0025, 0.01)}
#: Of those that find demonstrations unlike the others.
OUTLIERS = {"threshold": (8.0, 4.0, 16.0), "duration": (0.5, 0.25, 1.0)}


@dataclass(frozen=True)
class Fold:
    """Aligned demonstrations to learn from, and others, on the same clock, to compare with."""

    train: Sequence[Demonstration]
    test: Sequence[Demonstration]
    model: TaskParameterizedGMM
    robot: Kinematics
    link: str

    def measure(self, **parameters: Any) -> tuple[float, float]:
        """Compute the error of the link's path [mm, rms], and log-likelihood per instant."""
        scale = parameters.pop("n_components", 1.0)
        k = round(scale * self.model.n_components)
        model = TaskParameterizedGMM(**self.model.get_params(deep=False))
        model.set_params(n_components=k, **parameters).fit(self.train)
        situations = list(map(Situation.of, self.test))
        played = model.predict(situations, candidates=False)
        squares = []
        for paths in zip(played, self.test, strict=True):
            here, there = (self.robot.state(p.joints).position(self.link) for p in paths)
            squares.append((here - there).square().sum(-1).mean())
        error = 1e3 * float(torch.stack(squares).mean().sqrt())
        return error, float(model.score(self.test))


def _bottle(n: int, n_operators: int = 2) -> Fold:
    """Take n demonstrations of the bottle, and ten others to compare with."""
    skill = BottleShaking(rate=20)
    clock = DynamicTimeWarping(features=["directions"]).fit(shown := skill.demonstrations(n, 0))
    # without the operator of the joints the prior decides what the hands leave free
    operators = bottle_operators()[:n_operators]
    model = TaskParameterizedGMM(30, operators, skill.robot, random_state=0)
    test = clock.transform(skill.demonstrations(10, 1000))
    return Fold(clock.transform(shown), test, model, skill.robot, "r_hand")


def _real_folds(plan: Plan, name: str, folder: str) -> Iterator[Fold]:
    """Leave out four demonstrations of a recording, one at a time."""
    if not (plan.data / folder).is_dir():
        return
    example = plan.load_module("examples.leave_one_out")
    recording = example.RECORDINGS[name](plan.data / folder)
    shown, operators = recording.demonstrations, next(iter(recording.models.values()))
    for index in np.linspace(0, len(shown) - 1, 4).astype(int):
        clock = example.ALIGNMENTS["dtw"](recording.robot)
        train = clock.fit_transform([shown[i] for i in range(len(shown)) if i != index])
        test = clock.transform([shown[index]])
        k, robot = recording.n_components, recording.robot
        model = TaskParameterizedGMM(k, operators, robot, random_state=0)
        yield Fold(train, test, model, robot, recording.link)


def parameter_sensitivity(plan: Plan) -> Iterator[str]:
    """Measure with each parameter as usual, at half and at twice its value.

    Parameters
    ----------
    plan : Plan
        Whose ``data`` holds the recordings.

    Yields
    ------
    str
        One row for each value.
    """
    sets = {
        "bottle, 5": [_bottle(5)],
        "bottle, 10": [_bottle(10)],
        "bottle, 10, hands alone": [_bottle(10, 1)],
        "g1": list(_real_folds(plan, "g1", "g1_bottle")),
        "honeytea": list(_real_folds(plan, "honeytea", "honeytea_bimanual")),
    }
    for name, values in VALUES.items():
        for value in values:
            cells = []
            for which, folds in sets.items():
                if folds:
                    found = np.mean([fold.measure(**{name: value}) for fold in folds], axis=0)
                    cells.append(f"{which}: {found[0]:.2f} mm, {found[1]:.2f} nats")
            yield f"{name} = {value}: {'; '.join(cells)}"
    yield from _choices(sets["bottle, 10"][0])


def _choices(fold: Fold) -> Iterator[str]:
    """Describe the operators that are chosen, and demonstrations unlike the others."""
    shown = list(fold.train)
    for name, values in SELECTION.items():
        for value in values:
            selection = SelectOperators(robot=fold.robot).set_params(**{name: value})
            chosen = selection.fit(shown).operators_
            texts = ", ".join(map(format_operator, chosen))
            yield f"SelectOperators({name}={value}): {texts}"
    for offset in (0.02, 0.05, 0.1):
        for name, values in OUTLIERS.items():
            for value in values:
                found = [_found(fold, index, offset, {name: value}) for index in range(10)]
                rights, wrongs = np.sum(found, axis=0)
                yield (
                    f"drop_outliers({name}={value}), bottle {1e3 * offset:g} mm aside: "
                    f"{rights} of 10 found, {wrongs} others"
                )


def _found(fold: Fold, index: int, offset: float, settings: Any) -> tuple[int, int]:
    """Count the demonstration with a bottle seen aside if it is found, and others."""
    shown = list(fold.train)
    bottle = shown[index].frames["bottle"]
    aside = bottle.position + torch.tensor([offset, 0.0, 0.0], dtype=torch.float64)
    moved = {"bottle": Frame(aside, bottle.orientation)}
    shown[index] = replace(shown[index], frames=moved)
    unlike = outlying_demonstrations(shown, bottle_operators(), fold.robot, **settings)
    numbers = [found.episode for found in unlike]
    return int(index in numbers), len(set(numbers) - {index})


if __name__ == "__main__":
    torch.set_num_threads(1)
    for line in parameter_sensitivity(Plan(Path())):
        print(line, flush=True)
