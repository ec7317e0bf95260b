"""Small LeRobot sets that the baselines of the comparison learn from, and what they then do."""

from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import torch
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from lerobot_env_bimanual.bottle.carry_and_put import CarryAndPut
from tests.support.worlds import upper_body
from tpgmm_datasets import save_lerobot
from tpgmm_datasets.bottle.skill import BottleShaking, BottleSkill
from tpgmm_evaluation.policies.aligned import Aligned
from tpgmm_torch import Demonstration, Frame

RATE = 25


@cache
def shaking() -> BottleShaking:
    return BottleShaking(rate=RATE, robot=upper_body(), steady_rhythm=True)


@cache
def carrying() -> CarryAndPut:
    return CarryAndPut(rate=RATE, robot=upper_body())


def pose(frame: Frame) -> Tensor:
    return torch.cat((frame.position, frame.orientation), dim=-1)


@cache
def recorded(skill: BottleSkill, n: int = 4) -> Path:
    """Demonstrations as a set whose actions are the joints one step ahead."""
    motions = skill.demonstrations(n, seed=0)
    path = Path(mkdtemp()) / "set"
    return save_lerobot(
        motions,
        path,
        fps=RATE,
        task="test",
        actions=[torch.cat((m.joints[1:], m.joints[-1:])) for m in motions],
        robot_type="upper_body",
    )


@cache
def aligned(skill: BottleSkill, n: int = 3) -> Aligned:
    return Aligned.read(recorded(skill), skill.robot, n)


def observed(joints: Tensor, *objects: Frame) -> dict[str, Tensor]:
    """What LeRobot observes of one robot."""
    seen = torch.cat([pose(frame) for frame in objects])
    return {OBS_STATE: joints[None].float(), OBS_ENV_STATE: seen[None].float()}


def played(policy: object, start: Tensor, *objects: Frame, steps: int) -> Tensor:
    """References (T, n_joints) of a robot that does as it is told, among objects at rest."""
    policy.reset()
    joints, every = start, []
    for _ in range(steps):
        joints = policy.select_action(observed(joints, *objects))[0].double()
        every.append(joints)
    return torch.stack(every)


def references(demonstration: Demonstration) -> Tensor:
    return torch.cat((demonstration.joints[1:], demonstration.joints[-1:]))
