"""Policies for tests: a small one of the paper's skill, and what it observes."""

import copy
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import make_policy
from torch import Tensor

from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from lerobot_policy_tpgmm.settings import (
    ControlConfig,
    EMConfig,
    FusionConfig,
    TrainingConfig,
)
from tests.support.skills import bottle_demonstrations, small_bottle
from tpgmm_torch import Demonstration, Frame, Situation

STATE, ENVIRONMENT = "observation.state", "observation.environment_state"


@cache
def fitted() -> TPGMMPolicy:
    """Of :func:`small_bottle`; not to be changed."""
    return TPGMMPolicy.from_estimator(small_bottle())


GROUPS = {
    "em": EMConfig,
    "fusion": FusionConfig,
    "control": ControlConfig,
    "training": TrainingConfig,
}


def grouped(**options: object) -> dict[str, object]:
    """Options of a configuration, each in its group."""
    found, groups = {}, {}
    for name, value in options.items():
        kinds = [group for group, kind in GROUPS.items() if name in kind.__annotations__]
        for group in kinds:
            groups.setdefault(group, {})[name] = value
        if not kinds:
            found[name] = value
    return found | {group: GROUPS[group](**values) for group, values in groups.items()}


#: Settings that play a skill as it was at the start.
OPEN = {"closed_loop": False, "follow_frames": False, "clock": "even"}


@cache
def played() -> TPGMMPolicy:
    """The same, open loop; not to be changed."""
    return policy(**OPEN)


def policy(**options: object) -> TPGMMPolicy:
    return TPGMMPolicy.from_estimator(small_bottle(), **grouped(**options))


def pose(frame: Frame) -> Tensor:
    return torch.cat([frame.position, frame.orientation], dim=-1)


def batch(demonstrations: tuple[Demonstration, ...] | None = None) -> dict[str, Tensor]:
    """What LeRobot observes at the starts of demonstrations, by default of two unseen ones."""
    chosen = bottle_demonstrations()[5:7] if demonstrations is None else demonstrations
    return {
        STATE: torch.stack([d.joints[0] for d in chosen]).float(),
        ENVIRONMENT: torch.stack([pose(d.frames["bottle"]) for d in chosen]).float(),
    }


def situations(observed: dict[str, Tensor], time: Tensor | None = None) -> list[Situation]:
    """The same for ``model.predict``."""
    return [
        Situation(state.double(), {"bottle": Frame(at[:3].double(), at[3:].double())}, time)
        for state, at in zip(observed[STATE], observed[ENVIRONMENT], strict=True)
    ]


def seen(given: Sequence[Situation]) -> dict[str, Tensor]:
    """What LeRobot observes in situations of one object."""
    return {
        STATE: torch.stack([one.joints for one in given]).float(),
        ENVIRONMENT: torch.stack([pose(*one.frames.values()) for one in given]).float(),
    }


def act(acting: TPGMMPolicy, observed: dict[str, Tensor], steps: int) -> Tensor:
    """Actions (B, steps, n) as LeRobot asks for them."""
    acting.reset()
    with torch.inference_mode():
        return torch.stack([acting.select_action(observed) for _ in range(steps)], dim=1)


def changed(given: TPGMMPolicy, **fields: object) -> TPGMMPolicy:
    """The same numbers under another configuration."""
    config = copy.deepcopy(given.config)
    for name, value in fields.items():
        owner = [group for group, kind in GROUPS.items() if name in kind.__annotations__]
        setattr(getattr(config, owner[0]) if owner else config, name, value)
    return TPGMMPolicy(config, model=given.to_estimator()).eval()


def loaded(path: Path, *overrides: str, **more: object) -> TPGMMPolicy:
    """As LeRobot's commands load a policy."""
    config = PreTrainedConfig.from_pretrained(path, cli_overrides=list(overrides))
    config.pretrained_path = path
    return make_policy(config, **more)
