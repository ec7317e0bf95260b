"""Golden references: three skills, ten situations each, equal after a change of code."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch

from lerobot_env_bimanual.bottle.carry_and_put import CarryAndPut
from tpgmm_datasets.bottle.skill import BottleShaking, bottle_operators
from tpgmm_evaluation.benchmarks import benchmark
from tpgmm_evaluation.regressions.plan import Measured, Plan
from tpgmm_torch import (
    Demonstration,
    Frame,
    RelativeOrientation,
    RelativePosition,
    Situation,
    Stack,
    TaskParameterizedGMM,
)
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.robots import Poses

#: Situations to reproduce, and states for one batch of steps.
SITUATIONS, STATES = 10, 64


def measure_planted(plan: Plan) -> Measured:
    """Measure a tracked hand, two frames that matter, and no robot: the task of the tests."""
    task = plan.load_module("tests.support.planted").PlantedTask(3, 2)
    operators = [
        Stack(RelativePosition("hand", name), RelativeOrientation("hand", name))
        for name in task.relevant
    ]
    situations = list(map(Situation.of, task.demonstrations(SITUATIONS, 2)))
    model = TaskParameterizedGMM(8, operators, Poses(["hand"]))
    return _golden(model, task.demonstrations(6, 1), situations)


def measure_bottle(plan: Plan) -> Measured:
    """Measure the paper's skill as ``make demo`` learns it, or at a tenth of its rate."""
    skill = BottleShaking(rate=10 if plan.small else 100)
    shown = skill.demonstrations(10, 0)
    aligned = DynamicTimeWarping(features=["directions"]).fit_transform(shown)
    model = TaskParameterizedGMM(30, bottle_operators(), skill.robot)
    return _golden(model, aligned, skill.situations(SITUATIONS, 1000))


def measure_carrying(plan: Plan) -> Measured:
    """Measure a bottle that both hands take, hold and put on a tray."""
    task, skill = benchmark("carry_and_put"), CarryAndPut(rate=10 if plan.small else 50)
    aligned = DynamicTimeWarping(robot=skill.robot).fit_transform(skill.demonstrations(10, 0))
    model = TaskParameterizedGMM(20, task.operators(True), skill.robot)
    return _golden(model, aligned, skill.situations(SITUATIONS, 1000))


#: By the name of the skill.
GOLDENS: Mapping[str, Callable[[Plan], Measured]] = {
    "planted": measure_planted,
    "bottle": measure_bottle,
    "carried": measure_carrying,
}


def _golden(
    model: TaskParameterizedGMM, shown: Sequence[Demonstration], situations: Sequence[Situation]
) -> Measured:
    """Compute parameters, likelihood, references, and a batch of single steps."""
    model.fit(shown)
    rng = np.random.default_rng(0)
    drawn = rng.integers(len(shown[0]), size=STATES)
    joints = torch.stack([shown[i % len(shown)].joints[at] for i, at in enumerate(drawn)])
    time = shown[0].time[drawn]
    frames = {
        name: Frame.stack([situations[i % SITUATIONS].frames[name] for i in range(STATES)])
        for name in situations[0].frames
    }
    step, paths = model.step(time, joints, frames), model.predict(situations)
    found = {
        "weights": model.weights_,
        "means": torch.cat([mean.flatten() for mean in model.means_]),
        "covariances": torch.cat([matrix.flatten() for matrix in model.covariances_]),
        "score": model.score_samples(shown),
        "step": step.joints,
        "step's covariance": step.covariance,
        "references": torch.stack([path.joints for path in paths]),
        "references' variances": torch.stack(
            [path.covariance.diagonal(dim1=-2, dim2=-1) for path in paths]
        ),
    }
    return {f"same:{name}": np.asarray(value) for name, value in found.items()}
