"""Random regression problems, in our terms and in the oracles'."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from tests import oracles
from tests.worlds import LEFT, OBJECT, RIGHT, OnPoses, OnRobot, World
from tpgmm_torch import (
    AbsoluteOrientation,
    AbsolutePosition,
    Canonical,
    Frame,
    Operator,
    RelativeOrientation,
    RelativePosition,
    RobotState,
    Stack,
)
from tpgmm_torch.regression import LocalMixture, Regression

Rows = Callable[[oracles.At], list[oracles.Row]]


def random_local(
    rng: np.random.Generator, n_components: int, centre: np.ndarray
) -> oracles.Local:
    """Gaussians over time in [0, 2] s and coordinates around ``centre``, with correlations."""
    size = 1 + len(centre)
    means = np.concatenate((rng.uniform(0, 2, 1), centre)) + np.concatenate(
        (
            rng.uniform(-0.5, 0.5, (n_components, 1)),
            0.15 * rng.standard_normal((n_components, size - 1)),
        ),
        axis=1,
    )
    factors = rng.standard_normal((n_components, size, size)) / np.sqrt(size)
    scale = np.diag([0.4] + [0.2] * (size - 1))
    return oracles.Local(means, scale @ (factors @ factors.mT + 0.2 * np.eye(size)) @ scale)


def local_mixture(local: oracles.Local) -> LocalMixture:
    return LocalMixture.of(torch.from_numpy(local.means), torch.from_numpy(local.covariances))


@dataclass(frozen=True)
class Case:
    """Operators in a world, with their rows of Table I."""

    world: World
    operators: Sequence[Operator]
    rows: Rows


@dataclass(frozen=True)
class Problem:
    """A case at random states (of a batch) with a random mixture."""

    case: Case
    state: RobotState
    frames: Mapping[str, Frame]
    mixtures: list[oracles.Local]
    weights: np.ndarray
    options: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, case: Case, n_components: int, *batch: int, seed: int = 0) -> "Problem":
        rng = np.random.default_rng([seed, n_components])
        centre_state, centre_frames = case.world.scene(seed=seed)
        # a batch of states around one, so that the same mixture is near all of them
        near = 0.05 * rng.standard_normal((*batch, case.world.kinematics.n_joints))
        joints = case.world.kinematics.retract(centre_state.joints + torch.from_numpy(near))
        shift = torch.from_numpy(0.05 * rng.standard_normal((*batch, 3)))
        pose = centre_frames[OBJECT]
        frames = {OBJECT: Frame(pose.position + shift, pose.orientation.expand(*batch, 4))}
        mixtures = [
            random_local(rng, n_components, o.coordinates(centre_state, centre_frames).numpy())
            for o in case.operators
        ]
        weights = rng.dirichlet(3 * np.ones(n_components))
        return cls(case, case.world.kinematics.state(joints), frames, mixtures, weights)

    def regression(self, **options: Any) -> Regression:
        mixtures = [local_mixture(local) for local in self.mixtures]
        log_weights = torch.from_numpy(self.weights).log()
        kinematics = self.case.world.kinematics
        return Regression(kinematics, self.case.operators, mixtures, log_weights, **options)

    def rows(self, index: tuple[int, ...] = ()) -> list[oracles.Row]:
        return self.case.rows(self.at(index))

    def at(self, index: tuple[int, ...] = ()) -> oracles.At:
        here = {name: frame[index] for name, frame in self.frames.items()}
        return self.case.world.at(self.state[index], here)

    def answer(
        self, time: float, index: tuple[int, ...] = (), **options: Any
    ) -> oracles.Answer:
        at = self.at(index)
        return oracles.regress(
            time, at.joints, self.case.rows(at), self.mixtures, self.weights, **options
        )


def pose_of(link: str, frame: str) -> Stack:
    return Stack(RelativePosition(link, frame), RelativeOrientation(link, frame))


def pose_rows(at: oracles.At, link: str, frame: str) -> list[oracles.Row]:
    return [
        oracles.relative_position(at, link, frame),
        oracles.relative_orientation(at, link, frame),
    ]


BOTH_HANDS = Stack(pose_of(LEFT, OBJECT), pose_of(RIGHT, OBJECT))


def both_hands(at: oracles.At) -> oracles.Row:
    return oracles.stack(*pose_rows(at, LEFT, OBJECT), *pose_rows(at, RIGHT, OBJECT))


CASES = {
    "canonical": Case(OnRobot(), [Canonical()], lambda at: [oracles.canonical(at)]),
    "both hands": Case(OnRobot(), [BOTH_HANDS], lambda at: [both_hands(at)]),
    "the paper's": Case(
        OnRobot(), [BOTH_HANDS, Canonical()], lambda at: [both_hands(at), oracles.canonical(at)]
    ),
    "three": Case(
        OnRobot(),
        [RelativePosition(LEFT, OBJECT), pose_of(LEFT, RIGHT), Canonical()],
        lambda at: [
            oracles.relative_position(at, LEFT, OBJECT),
            oracles.stack(*pose_rows(at, LEFT, RIGHT)),
            oracles.canonical(at),
        ],
    ),
    "two that leave joints free": Case(
        OnRobot(),
        [AbsolutePosition(LEFT), AbsoluteOrientation(RIGHT)],
        lambda at: [
            oracles.absolute_position(at, LEFT),
            oracles.absolute_orientation(at, RIGHT),
        ],
    ),
    "poses in two frames": Case(
        OnPoses(),
        [
            BOTH_HANDS,
            Stack(
                AbsolutePosition(LEFT),
                AbsoluteOrientation(LEFT),
                AbsolutePosition(RIGHT),
                AbsoluteOrientation(RIGHT),
            ),
            Canonical(),
        ],
        lambda at: [
            both_hands(at),
            oracles.stack(
                oracles.absolute_position(at, LEFT),
                oracles.absolute_orientation(at, LEFT),
                oracles.absolute_position(at, RIGHT),
                oracles.absolute_orientation(at, RIGHT),
            ),
            oracles.canonical(at),
        ],
    ),
}
