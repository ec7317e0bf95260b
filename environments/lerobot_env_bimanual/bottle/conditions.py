"""Conditions of episodes with the bottle."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from lerobot_env_bimanual.start import Start
from tpgmm_datasets.bottle.skill import BottleShaking, BottleSkill

#: The bottle's mass [kg]: a light one, up to one with a litre in it.
MASS = (0.5, 1.5)


@functools.cache
def skill() -> BottleShaking:
    """Make the generator of the demonstrations once: building its robot takes a while."""
    return BottleShaking(steady_rhythm=True)


def draw_start(rng: np.random.Generator, task: BottleSkill) -> Start:
    """Draw an episode with the bottle: first what ``task.situations(1, seed)`` draws."""
    bottle: Any = task.bottle_poses(1, rng)[0]
    return Start(
        poses={"bottle": np.concatenate((bottle.position, bottle.orientation))},
        joints=task.start_postures(1, rng)[0].numpy(),
        mass=rng.uniform(*MASS),
        **Start.drawn(rng, task.robot),
    )
