"""What differs between episodes of bottle shaking."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from lerobot_env_bimanual.base import finite_vector
from lerobot_env_bimanual.start import Start, check_start
from tpgmm_datasets.bottle.skill import BottleShaking, BottleSkill

__all__ = ["Conditions", "skill"]

#: The bottle's mass [kg]: a light one, up to one with a litre in it.
MASS = (0.5, 1.5)


@functools.cache
def skill() -> BottleShaking:
    """The generator of the demonstrations, made once: building its robot takes a while."""
    return BottleShaking(steady_rhythm=True)


@dataclass(frozen=True)
class Conditions(Start):
    """What an episode with the bottle draws from its seed.

    Parameters
    ----------
    joints, delay, pushed, push_start, push_length, push_torque, misperception
        As of :class:`Start`.
    bottle : ndarray of shape (7,)
        Initial position [m] and orientation, a unit quaternion.
    mass : float
        Of the bottle [kg].
    """

    bottle: NDArray[np.float64]
    mass: float

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Self:
        """Draw, first what ``BottleShaking.situations(1, seed)`` draws."""
        return cls(**cls._with_bottle(rng, skill()))

    @classmethod
    def _with_bottle(cls, rng: np.random.Generator, skill: BottleSkill) -> dict[str, Any]:
        bottle = skill.bottle_poses(1, rng)[0]
        return dict(
            bottle=np.concatenate((bottle.position, bottle.orientation)),
            joints=skill.start_postures(1, rng)[0].numpy(),
            mass=rng.uniform(*MASS),
            **cls.drawn(rng, skill.robot),
        )

    def with_start(self, options: Mapping[str, Any]) -> Self:
        """Replace the objects' poses or the start posture.

        Parameters
        ----------
        options : mapping
            ``"joints"``, ``"bottle"`` and what else there is are looked at, if they are there.

        Raises
        ------
        DataError
            If a value has another shape, is not finite, is no unit quaternion, or is out of the
            joints' ranges.
        """
        given: dict[str, Any] = {
            name: finite_vector(name, options[name], len(getattr(self, name)))
            for name in ("bottle", "joints", "tray", "slide")
            if name in options and hasattr(self, name)
        }
        for name in given.keys() - {"slide"}:
            check_start(name, given[name], skill().robot)
        return dataclasses.replace(self, **given)
