"""LeRobot's training loop in small: real data sets, batches, and policies told of them."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_policy, make_pre_post_processors

from lerobot_policy_tpgmm.configuration_tpgmm import TPGMMConfig
from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from tests.support.policies import grouped
from tests.support.skills import HANDLING, HANDS, handlings, wave
from tpgmm_datasets import save_lerobot
from tpgmm_torch import Demonstration
from tpgmm_torch.persistence import encode

FPS = 15
NAMES = ("a", "b", "c")
#: What ``waves_set`` and ``handlings_set`` are learned with.
WAVES = {"n_components": 5}
HANDLINGS = {
    "n_components": 5,
    "robot": encode(HANDS),
    "operators": [encode(operator) for operator in HANDLING],
}


def slow_waves() -> list[Demonstration]:
    """The same motion at different offsets and speeds, with noise."""
    rng = np.random.default_rng(0)
    result = []
    for shift, length in ((-0.1, 28), (0.05, 31), (0.0, 34), (0.1, 30)):
        time = torch.arange(length, dtype=torch.float64) / FPS
        joints = wave(time * 30 / (length - 1), shift)
        joints += torch.from_numpy(5e-3 * rng.standard_normal(joints.shape))
        result.append(Demonstration(time, joints, joint_names=NAMES))
    return result


def waves_set(path: Path) -> Path:
    save_lerobot(slow_waves(), path, fps=FPS, task="wave")
    return path


def noisy_handlings() -> list[Demonstration]:
    """Two hands and a cup, with noise on every coordinate."""
    rng = np.random.default_rng(0)
    result = []
    for one in handlings(length=31):
        joints = one.joints + torch.from_numpy(1e-3 * rng.standard_normal(one.joints.shape))
        result.append(replace(one, joints=HANDS.retract(joints)))
    return result


def handlings_set(path: Path) -> Path:
    save_lerobot(noisy_handlings(), path, fps=FPS, task="handle")
    return path


def dataset(path: Path, episodes: Sequence[int] | None = None) -> LeRobotDataset:
    return LeRobotDataset("local/set", root=path, episodes=episodes)


def fresh(data: LeRobotDataset, **options: object) -> TPGMMPolicy:
    """As lerobot-train makes it: not fitted, in training mode."""
    config = TPGMMConfig(device="cpu", push_to_hub=False, **grouped(**options))
    return make_policy(config, ds_meta=data.meta).train()


def batches(data: LeRobotDataset, size: int, seed: int = 0) -> Iterator[dict]:
    """Shuffled epochs, one after the other, behind the preprocessor."""
    preprocess, _ = make_pre_post_processors(TPGMMConfig(device="cpu", push_to_hub=False))
    generator = torch.Generator().manual_seed(seed)
    loader = torch.utils.data.DataLoader(data, size, shuffle=True, generator=generator)
    while True:
        for batch in loader:
            yield preprocess(batch)


def epoch(data: LeRobotDataset, size: int, seed: int = 0) -> list[dict]:
    """One of them."""
    ready = batches(data, size, seed)
    return [next(ready) for _ in range(-(-len(data) // size))]


def trained(data: LeRobotDataset, **options: object) -> TPGMMPolicy:
    """A policy after its first epoch."""
    policy = fresh(data, **options)
    for batch in epoch(data, 32):
        policy.forward(batch)
    return policy.eval()


def resumed(path: Path, data: LeRobotDataset, **options: object) -> TPGMMPolicy:
    """As lerobot-train makes it from a saved one."""
    config = PreTrainedConfig.from_pretrained(path)
    config.pretrained_path = path
    for name, value in grouped(**options).items():
        setattr(config, name, value)
    return make_policy(config, ds_meta=data.meta).train()
