"""Small skills whose reproduction is known, and the paper's one at a low rate."""

from collections.abc import Mapping
from functools import cache

import numpy as np
import torch
from torch import Tensor

from tests.support.worlds import upper_body
from tpgmm_datasets.bottle.skill import BottleShaking, bottle_operators
from tpgmm_torch import (
    Demonstration,
    Frame,
    RelativeOrientation,
    RelativePosition,
    Situation,
    Stack,
    TaskParameterizedGMM,
    quaternions,
)
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.operators import Operator
from tpgmm_torch.robots import Poses

JOINT_NAMES = ("a", "b", "c")
HANDS = Poses(("left", "right"))
LAST = 2.0


def wave(time: Tensor, shift: float = 0.0) -> Tensor:
    """Three joints, (T, 3)."""
    parts = torch.sin(3 * time), torch.cos(2 * time), 0.5 * time
    return torch.stack(parts, dim=-1) + shift


def waves(
    n: int = 4, length: int = 30, names: tuple[str, ...] | None = JOINT_NAMES
) -> list[Demonstration]:
    """The same motion at different offsets: joint space alone, one common time grid."""
    time = torch.linspace(0, LAST, length, dtype=torch.float64)
    shifts = np.linspace(-0.1, 0.1, n)
    return [Demonstration(time, wave(time, shift), joint_names=names) for shift in shifts]


def placed(base: Frame, point: Tensor, turn: Tensor) -> Frame:
    """The pose that is ``point``, ``exp(turn)`` as seen from ``base``."""
    orientation = quaternions.product(base.orientation, quaternions.exp(turn))
    return Frame(base.transform(point), orientation)


def handling(cup: Frame, time: Tensor) -> Tensor:
    """Joint vectors (T, 14): the left hand moves about the cup, the right about the left."""
    if not cup.batch_shape:
        steps = len(time)
        cup = Frame(cup.position.expand(steps, 3), cup.orientation.expand(steps, 4))
    one = torch.ones_like(time)
    reach = torch.stack((0.3 * torch.cos(time), 0.2 * torch.sin(time), 0.1 * time), dim=-1)
    left = placed(cup, reach, torch.stack((0.3 * time, 0 * one, 0.2 * one), dim=-1))
    apart = torch.stack((0.1 * one, 0.4 - 0.1 * time, 0 * one), dim=-1)
    right = placed(left, apart, torch.stack((0 * one, 0.4 * time, 0.1 * one), dim=-1))
    return Poses.joints({"left": left, "right": right})


def cups(n: int, seed: int = 0) -> Frame:
    """Random places, turned by up to a quarter."""
    rng = np.random.default_rng(seed)
    turns = torch.from_numpy(rng.uniform(-0.7, 0.7, (n, 3)))
    return Frame(rng.uniform(-0.4, 0.4, (n, 3)), quaternions.exp(turns))


def moving(cup: Frame, time: Tensor) -> Frame:
    """The cup drifts away and turns."""
    drift = time[:, None] * torch.tensor([0.1, -0.05, 0.02], dtype=torch.float64)
    turn = quaternions.exp(drift[:, [2, 1, 0]])
    return Frame(cup.position + drift, quaternions.product(turn, cup.orientation))


def handlings(
    n: int = 4, length: int = 30, noise: float = 1e-3, moves: bool = False
) -> list[Demonstration]:
    """Two tracked hands and a cup, without a robot; paths differ by some noise [m]."""
    time = torch.linspace(0, LAST, length, dtype=torch.float64)
    rng = np.random.default_rng(1)
    result = []
    for cup in cups(n):
        shift = torch.zeros(14, dtype=torch.float64)
        shift[[0, 1, 2, 7, 8, 9]] = torch.from_numpy(noise * rng.standard_normal(6))
        frame = moving(cup, time) if moves else cup
        joints = handling(frame, time) + shift
        result.append(Demonstration(time, joints, {"cup": frame}, HANDS.joint_names))
    return result


def pose(link: str, frame: str) -> Stack:
    return Stack(RelativePosition(link, frame), RelativeOrientation(link, frame))


HANDLING: tuple[Operator, ...] = (pose("left", "cup"), pose("right", "left"))


def hands_model(**options: object) -> TaskParameterizedGMM:
    """A model for :func:`handlings`, unfitted."""
    settings = {"n_components": 6, "operators": list(HANDLING), "robot": HANDS}
    return TaskParameterizedGMM(**{**settings, **options})


@cache
def hands() -> TaskParameterizedGMM:
    """Fitted; not to be changed."""
    return hands_model().fit(handlings())


@cache
def generator() -> BottleShaking:
    return BottleShaking(rate=20, robot=upper_body())


@cache
def bottle_demonstrations() -> tuple[Demonstration, ...]:
    """Ten demonstrations of the paper's skill, aligned."""
    recorded = generator().demonstrations(10, seed=0)
    return tuple(DynamicTimeWarping(robot=upper_body()).fit_transform(recorded))


def thinned(demonstration: Demonstration, every: int) -> Demonstration:
    return Demonstration(
        demonstration.time[::every],
        demonstration.joints[::every],
        demonstration.frames,
        demonstration.joint_names,
    )


@cache
def few_bottles() -> tuple[Demonstration, ...]:
    """Four of them with few time steps."""
    return tuple(thinned(item, 8) for item in bottle_demonstrations()[:4])


def bottle_model(n_components: int = 20, **options: object) -> TaskParameterizedGMM:
    """The paper's model, unfitted."""
    return TaskParameterizedGMM(n_components, bottle_operators(), upper_body(), **options)


@cache
def bottle() -> TaskParameterizedGMM:
    """Fitted to all ten; not to be changed."""
    return bottle_model().fit(bottle_demonstrations())


@cache
def small_bottle() -> TaskParameterizedGMM:
    """Fitted to the few; not to be changed."""
    return bottle_model(8, tol=1e-2).fit(few_bottles())


def tensors(thing: object) -> list[Tensor]:
    """Every tensor in demonstrations and situations, copied."""
    if isinstance(thing, Tensor):
        return [thing.clone()]
    if isinstance(thing, Frame):
        return tensors([thing.position, thing.orientation])
    if isinstance(thing, Demonstration | Situation):
        return tensors([thing.time, thing.joints, *thing.frames.values()])
    assert isinstance(thing, list | tuple | Mapping) or thing is None
    return [found for part in thing or () for found in tensors(part)]


def canonical(**options: object) -> TaskParameterizedGMM:
    """A model for :func:`waves`, unfitted."""
    return TaskParameterizedGMM(**{"n_components": 6, **options})


def new_handling(moves: bool = False, seed: int = 7) -> tuple[Situation, torch.Tensor]:
    """A situation never seen, and the motion that fits it."""
    time = torch.linspace(0, LAST, 30, dtype=torch.float64)
    cup = cups(1, seed)[0]
    cup = moving(cup, time) if moves else cup
    wanted = handling(cup, time)
    return Situation(wanted[0], {"cup": cup}, time), wanted


def same(a: TaskParameterizedGMM, b: TaskParameterizedGMM, tolerance: float = 0.0) -> None:
    """Two models are one, to a relative tolerance."""
    close = {"rtol": tolerance, "atol": tolerance}
    torch.testing.assert_close(a.weights_, b.weights_, **close)
    torch.testing.assert_close(a.means_, b.means_, **close)
    torch.testing.assert_close(a.covariances_, b.covariances_, **close)


def apart(a, b) -> float:
    return float((a.double() - b.double()).abs().max())
