"""A skill of a planar arm with two joints: touch an object wherever it is, then wave.

The smallest skill in which first the task and then the posture matters; its joint space can be
drawn on paper.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch import (
    Canonical,
    Demonstration,
    Frame,
    RelativePosition,
    Robot,
    Situation,
    TaskParameterizedGMM,
)
from tpgmm_torch.motion.minimum_jerk import minimum_jerk

__all__ = ["LENGTHS", "TOUCH", "WAVE", "arm", "chain", "demonstrations", "model", "situation"]

#: Length of both links [m], when the object is touched, and when the waving begins [s].
LENGTHS = (0.5, 0.4)
TOUCH, WAVE, END = 1.0, 2.0, 4.0
REST, START = torch.tensor([0.9, 0.9]), torch.tensor([-0.4, 1.9])
STEPS_PER_SECOND = 50

LINK = '<link name="{name}"/>'
JOINT = (
    '<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
    '<origin xyz="{x} 0 0"/><axis xyz="0 0 1"/>'
    '<limit lower="-3" upper="3" velocity="10" effort="1"/></joint>'
)


def arm() -> Robot:
    """Shoulder and elbow, both about z; the links of interest are ``elbow`` and ``hand``."""
    parts = [LINK.format(name=name) for name in ("base", "elbow_link", "elbow", "hand")]
    for name, kind, parent, child, x in (
        ("q1", "revolute", "base", "elbow_link", 0),
        ("q2", "revolute", "elbow_link", "elbow", LENGTHS[0]),
        ("wrist", "fixed", "elbow", "hand", LENGTHS[1]),
    ):
        parts.append(JOINT.format(name=name, kind=kind, parent=parent, child=child, x=x))
    text = f'<robot name="planar arm">{"".join(parts)}</robot>'
    return Robot.from_urdf(text, links=("elbow", "hand"))


def demonstrations(n: int = 6, seed: int = 3) -> list[Demonstration]:
    """``n`` demonstrations with the object in different places."""
    rng = np.random.default_rng(seed)
    return [_demonstration(_place(rng), rng) for _ in range(n)]


def situation(seed: int = 8) -> Situation:
    """A place of the object that no demonstration had."""
    rng = np.random.default_rng(seed)
    return Situation(_start(rng), {"object": Frame(_place(rng))})


def model(skill: list[Demonstration]) -> TaskParameterizedGMM:
    """What is learned of it: the hand seen from the object, and the joints."""
    operators = [RelativePosition("hand", "object"), Canonical()]
    return TaskParameterizedGMM(14, operators, arm()).fit(skill)


def chain(joints: Tensor) -> np.ndarray:
    """Base, elbow and hand in the plane, for drawing; shape (3, 2)."""
    state = arm().state(joints)
    return np.vstack((np.zeros(2), *(state.position(link)[:2] for link in state.links)))


def _place(rng: np.random.Generator) -> np.ndarray:
    return np.append(rng.uniform((0.45, -0.35), (0.75, 0.15)), 0.0)


def _start(rng: np.random.Generator) -> Tensor:
    return START + torch.from_numpy(rng.uniform(-0.25, 0.25, 2))


def _demonstration(place: np.ndarray, rng: np.random.Generator) -> Demonstration:
    time = torch.arange(0, END + 1e-9, 1 / STEPS_PER_SECOND, dtype=torch.float64)
    start = _start(rng)
    # nobody is exact: the touch is off by up to 1 cm, the waving posture by 0.05 rad
    goal = torch.from_numpy(place[:2] + rng.uniform(-0.01, 0.01, 2))
    rest = REST + torch.from_numpy(rng.uniform(-0.05, 0.05, 2))
    touch = _inverse(goal)
    reach = minimum_jerk(time / TOUCH)[:, None]
    back = minimum_jerk((time - TOUCH) / (WAVE - TOUCH))[:, None]
    # the hand goes straight to the object, then the joints to where they wave
    hand = torch.from_numpy(chain(start)[-1])
    path = hand + reach * (goal - hand)
    joints = torch.where(time[:, None] <= TOUCH, _inverse(path), touch + back * (rest - touch))
    swing = 0.35 * torch.sin(2 * torch.pi * (time - WAVE)) * (time > WAVE)
    wave = torch.stack((swing, -swing), dim=1)
    return Demonstration(time, joints + wave, {"object": Frame(place)}, ("q1", "q2"))


def _inverse(hand: Tensor) -> Tensor:
    """Joints (..., 2) that bring the hand to points (..., 2), elbow to the right."""
    a, b = LENGTHS
    square = hand.square().sum(-1)
    elbow = torch.acos(((square - a**2 - b**2) / (2 * a * b)).clamp(-1, 1))
    side = torch.atan2(b * torch.sin(elbow), a + b * torch.cos(elbow))
    return torch.stack((torch.atan2(hand[..., 1], hand[..., 0]) - side, elbow), dim=-1)
