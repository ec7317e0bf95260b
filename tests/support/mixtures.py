"""Random regression problems, in our terms and in the oracles'."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tests.support import oracles
from tests.support.oracles import Array
from tests.support.worlds import LEFT, OBJECT, RIGHT, OnPoses, OnRobot, World
from tpgmm_torch import (
    AbsoluteOrientation,
    AbsolutePosition,
    Canonical,
    Frame,
    RelativeOrientation,
    RelativePosition,
    Stack,
)
from tpgmm_torch.operators import Operator
from tpgmm_torch.regression.conditionals import Conditionals
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.fusion_forms import CovarianceFusion, Fusion, InformationFusion
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.robots import RobotState


def random_local(rng: np.random.Generator, n_components: int, centre: Array) -> oracles.Local:
    """Gaussians over time in [0, 2] s and coordinates around ``centre``, with correlations."""
    size = 1 + len(centre)
    means = 0.15 * rng.standard_normal((n_components, size))
    means[:, 0] = rng.uniform(0, 2, n_components)
    means[:, 1:] += centre
    factors = rng.standard_normal((n_components, size, size)) / np.sqrt(size)
    scale = np.diag([0.4] + [0.2] * (size - 1))
    return oracles.Local(
        means, scale @ (factors @ factors.swapaxes(-1, -2) + 0.2 * np.eye(size)) @ scale
    )


def conditionals_of(local: oracles.Local) -> Conditionals:
    return Conditionals.of(torch.from_numpy(local.means), torch.from_numpy(local.covariances))


#: The rows of Table I of those that name a link, and perhaps what it is seen from.
ROWS = {
    AbsolutePosition: oracles.absolute_position,
    AbsoluteOrientation: oracles.absolute_orientation,
    RelativePosition: oracles.relative_position,
    RelativeOrientation: oracles.relative_orientation,
}


def row_of(at: oracles.At, operator: Operator) -> oracles.Row:
    """Give an operator's row of Table I, as the oracles write it."""
    if isinstance(operator, Stack):
        return oracles.stack(*(row_of(at, one) for one in operator.operators))
    if isinstance(operator, Canonical):
        return oracles.canonical(at)
    frame = [operator.frame] if hasattr(operator, "frame") else []
    return ROWS[type(operator)](at, operator.link, *frame)


@dataclass(frozen=True)
class Case:
    """Operators in a world, with their rows of Table I."""

    world: World
    operators: Sequence[Operator]

    def rows(self, at: oracles.At) -> list[oracles.Row]:
        return [row_of(at, operator) for operator in self.operators]


@dataclass(frozen=True)
class Problem:
    """A case at random states (of a batch) with a random mixture."""

    case: Case
    state: RobotState
    frames: Mapping[str, Frame]
    mixtures: list[oracles.Local]
    weights: np.ndarray

    @classmethod
    def of(cls, case: Case, n_components: int, *batch: int, seed: int = 0) -> "Problem":
        rng = np.random.default_rng([seed, n_components])
        kinematics = case.world.kinematics
        centre, around = case.world.scene(seed=seed)
        # states around one, so that the same mixture is near all of them
        near = 0.05 * rng.standard_normal((*batch, kinematics.n_joints))
        joints = kinematics.retract(centre.joints + torch.from_numpy(near))
        shift = torch.from_numpy(0.05 * rng.standard_normal((*batch, 3)))
        pose = around[OBJECT]
        frames = {OBJECT: Frame(pose.position + shift, pose.orientation.expand(*batch, 4))}
        centres = [operator.coordinates(centre, around).numpy() for operator in case.operators]
        mixtures = [random_local(rng, n_components, at) for at in centres]
        weights = rng.dirichlet(3 * np.ones(n_components))
        return cls(case, kinematics.state(joints), frames, mixtures, weights)

    def regression(self, **options: Any) -> Regression:
        conditionals = [conditionals_of(local) for local in self.mixtures]
        log_weights = torch.from_numpy(self.weights).log()
        kinematics = self.case.world.kinematics
        return Regression(kinematics, self.case.operators, conditionals, log_weights, **options)

    def estimate(
        self, time: Tensor | None = None, *, candidates: bool = False, **options: Any
    ) -> Estimate:
        """Estimate at a time, or at that of ``times()``, by a regression with the options."""
        now = times() if time is None else time
        at = self.state, self.frames
        return self.regression(**options).estimate(now, *at, candidates=candidates)

    def rows(self, index: tuple[int, ...] = ()) -> list[oracles.Row]:
        return self.case.rows(self.at(index))

    def at(self, index: tuple[int, ...] = ()) -> oracles.At:
        here = {name: frame[index] for name, frame in self.frames.items()}
        return self.case.world.at(self.state[index], here)

    def answer(self, time: float, index: tuple[int, ...] = (), **how: Any) -> oracles.Answer:
        at = self.at(index)
        rows = self.case.rows(at)
        return oracles.regress(time, at.joints, rows, self.mixtures, self.weights, **how)


def form(
    fusion: str = "information",
    activation: str = "time",
    epsilon: float = 1e-4,
    **information: Any,
) -> Fusion:
    """A form of fusion by its name."""
    if fusion == "covariance":
        return CovarianceFusion(epsilon, activation)
    return InformationFusion(**information)


def times(*batch: int) -> Tensor:
    return torch.from_numpy(np.random.default_rng(9).uniform(0, 2, batch))


def assert_close(actual: Tensor, expected: object, tolerance: float = 1e-8) -> None:
    expected = torch.as_tensor(np.asarray(expected))
    torch.testing.assert_close(actual, expected, rtol=tolerance, atol=tolerance)


def assert_equal_estimates(a: Estimate, b: Estimate, tolerance: float = 1e-10) -> None:
    assert_close(a.joints, b.joints, tolerance)
    assert_close(a.covariance, b.covariance, tolerance)
    assert_close(a.activation, b.activation, tolerance)
    for one, other in zip(a.candidates, b.candidates, strict=True):
        assert_close(one.mean, other.mean, tolerance)
        assert_close(one.covariance, other.covariance, tolerance)
        assert_close(one.share, other.share, tolerance)


def pose_of(link: str, frame: str) -> Stack:
    return Stack(RelativePosition(link, frame), RelativeOrientation(link, frame))


BOTH_HANDS = Stack(pose_of(LEFT, OBJECT), pose_of(RIGHT, OBJECT))


ABSOLUTE = [
    kind(link) for link in (LEFT, RIGHT) for kind in (AbsolutePosition, AbsoluteOrientation)
]
POSITIONS = Stack(RelativePosition(LEFT, OBJECT), AbsolutePosition(RIGHT))
THREE = [RelativePosition(LEFT, OBJECT), pose_of(LEFT, RIGHT), Canonical()]
CASES = {
    "canonical": Case(OnRobot(), [Canonical()]),
    "both hands": Case(OnRobot(), [BOTH_HANDS]),
    "the paper's": Case(OnRobot(), [BOTH_HANDS, Canonical()]),
    "positions": Case(OnRobot(), [POSITIONS, Canonical()]),
    "three": Case(OnRobot(), THREE),
    "two that leave joints free": Case(
        OnRobot(), [AbsolutePosition(LEFT), AbsoluteOrientation(RIGHT)]
    ),
    "poses in two frames": Case(OnPoses(), [BOTH_HANDS, Stack(*ABSOLUTE), Canonical()]),
}
