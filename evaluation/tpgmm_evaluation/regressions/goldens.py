"""Golden references: three skills, ten situations each, equal after a change of code."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from lerobot_policy_tpgmm.evaluation.benchmarks import benchmark
from tpgmm_datasets.bottle.carrying import CarryAndPut
from tpgmm_datasets.bottle.experiment import bottle_operators
from tpgmm_datasets.bottle.skill import BottleShaking
from tpgmm_torch import (
    Demonstration,
    Frame,
    Poses,
    RelativeOrientation,
    RelativePosition,
    Situation,
    Stack,
    TaskParameterizedGMM,
    quaternions,
)
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.motion.minimum_jerk import minimum_jerk

__all__ = ["GOLDENS"]

#: Situations to reproduce, and states for one batch of steps.
SITUATIONS, STATES = 10, 64

Measured = Mapping[str, NDArray[np.float64]]


def _random_frame(rng: np.random.Generator, reach: float, turn: float) -> Frame:
    turned = quaternions.exp(torch.from_numpy(rng.uniform(-turn, turn, 3)))
    return Frame(rng.uniform(-reach, reach, 3), turned)


def planted_demonstrations(n: int, seed: int, n_steps: int = 101) -> list[Demonstration]:
    """A tracked hand that goes to a pose in frame ``a``, then to one in frame ``b``.

    Parameters
    ----------
    n : int
        Frames are drawn anew for each.
    seed : int
    n_steps : int, default=101
        Over ten seconds.
    """
    rng, goals = np.random.default_rng(seed), np.random.default_rng(0)
    poses = [_random_frame(goals, 0.1, 0.6) for _ in range(3)]  # in a, in b, at the start
    time = torch.linspace(0, 10, n_steps, dtype=torch.float64)
    found = []
    for _ in range(n):
        frames = {name: _random_frame(rng, 0.3, 0.5) for name in "ab"}
        start = Frame(poses[2].position + 0.03 * rng.standard_normal(3), poses[2].orientation)
        position = start.position.expand(n_steps, 3)
        orientation = start.orientation.expand(n_steps, 4)
        for name, goal, begin in (("a", poses[0], 0.0), ("b", poses[1], 5.0)):
            wanted, share = frames[name].compose(goal), minimum_jerk((time - begin) / 4)
            position = position + share[:, None] * (wanted.position - position)
            orientation = quaternions.slerp(orientation, wanted.orientation, share)
        noisy = position + 1e-3 * torch.from_numpy(rng.standard_normal((n_steps, 3)))
        joints = Poses.joints({"hand": Frame(noisy, orientation)})
        found.append(Demonstration(time, joints, frames, Poses(["hand"]).joint_names))
    return found


def planted(small: bool) -> Measured:
    """Two frames that matter, and no robot."""
    operators = [
        Stack(RelativePosition("hand", name), RelativeOrientation("hand", name))
        for name in "ab"
    ]
    model = TaskParameterizedGMM(8, operators, Poses(["hand"]))
    situations = [Situation.of(one) for one in planted_demonstrations(SITUATIONS, 2)]
    return _golden(model, planted_demonstrations(6, 1), situations)


def bottle(small: bool) -> Measured:
    """The paper's skill as ``make demo`` learns it; a small one has a tenth of its instants."""
    skill = BottleShaking(rate=10 if small else 100)
    shown = skill.demonstrations(10, 0)
    aligned = DynamicTimeWarping(features=["directions"]).fit_transform(shown)
    model = TaskParameterizedGMM(30, bottle_operators(), skill.robot)
    return _golden(model, aligned, skill.situations(SITUATIONS, 1000))


def carried(small: bool) -> Measured:
    """A bottle that both hands take and put on a tray: it is held, and a thing of its own."""
    task, skill = benchmark("carry_and_put"), CarryAndPut(rate=10 if small else 50)
    aligned = DynamicTimeWarping(robot=skill.robot).fit_transform(skill.demonstrations(10, 0))
    model = TaskParameterizedGMM(20, task.operators(True), skill.robot)
    return _golden(model, aligned, skill.situations(SITUATIONS, 1000))


#: Name of the skill -> what it gives, from whether it is the small form.
GOLDENS: Mapping[str, Callable[[bool], Measured]] = {
    "planted": planted,
    "bottle": bottle,
    "carried": carried,
}


def _golden(
    model: TaskParameterizedGMM,
    shown: Sequence[Demonstration],
    situations: Sequence[Situation],
) -> Measured:
    """What was learned, its likelihood, references, and a batch of single steps."""
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
        "means": torch.cat([each.flatten() for each in model.means_]),
        "covariances": torch.cat([each.flatten() for each in model.covariances_]),
        "score": model.score_samples(shown),
        "step": step.joints,
        "step's covariance": step.covariance,
        "references": torch.stack([path.joints for path in paths]),
        "references' variances": torch.stack(
            [path.covariance.diagonal(dim1=-2, dim2=-1) for path in paths]
        ),
    }
    return {f"same:{name}": np.asarray(value) for name, value in found.items()}
