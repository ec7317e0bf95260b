"""What differs between episodes of bottle shaking."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from lerobot_policy_tpgmm.environments.base import finite_vector
from tpgmm_datasets.bottle.skill import BottleShaking, BottleSkill
from tpgmm_torch.exceptions import DataError

__all__ = ["Conditions", "skill"]

#: The bottle's mass [kg]: a light one, up to one with a litre in it.
MASS = (0.5, 1.5)
#: From a reference to the motors [ms]: a field bus and the cycles of some controllers.
DELAY = (1, 8)
#: A push's beginning, in a skill of 13 s, and length [s], and its torque [N m], which stays
#: below what the motors can give (50). It is meant for one of the strong joints of the arms.
PUSH_START, PUSH_LENGTH, PUSH_TORQUE = (0.5, 13.0), (0.1, 0.3), (40.0, 50.0)
PUSHED = ("shoulder_pitch", "shoulder_yaw", "elbow")


@functools.cache
def skill() -> BottleShaking:
    """The generator of the demonstrations, made once: building its robot takes a while."""
    return BottleShaking(steady_rhythm=True)


@dataclass(frozen=True)
class Conditions:
    """What an episode draws from its seed: always all of it, in the same order.

    Parameters
    ----------
    bottle : ndarray of shape (7,)
        Initial position [m] and orientation, a unit quaternion.
    joints : ndarray of shape (17,)
        Start posture [rad].
    mass : float
        Of the bottle [kg].
    delay : int
        From a reference to the motors [ms].
    pushed : int
        The joint that is pushed.
    push_start, push_length : float
        [s]
    push_torque : float
        [N m]
    misperception : ndarray of shape (6 * n_objects,)
        Of the objects' initial positions and orientations, in standard deviations.
    """

    bottle: NDArray[np.float64]
    joints: NDArray[np.float64]
    mass: float
    delay: int
    pushed: int
    push_start: float
    push_length: float
    push_torque: float
    misperception: NDArray[np.float64]

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Self:
        """Draw, first what ``BottleShaking.situations(1, seed)`` draws."""
        return cls(**cls._drawn(rng, skill()))

    @staticmethod
    def _drawn(rng: np.random.Generator, skill: BottleSkill) -> dict[str, Any]:
        bottle = skill.bottle_poses(1, rng)[0]
        names = skill.robot.joint_names
        strong = [i for i, name in enumerate(names) if any(part in name for part in PUSHED)]
        return dict(
            bottle=np.concatenate((bottle.position, bottle.orientation)),
            joints=skill.start_postures(1, rng)[0].numpy(),
            mass=rng.uniform(*MASS),
            delay=int(rng.integers(*DELAY, endpoint=True)),
            pushed=int(rng.choice(strong)),
            push_start=rng.uniform(*PUSH_START),
            push_length=rng.uniform(*PUSH_LENGTH),
            push_torque=float(rng.uniform(*PUSH_TORQUE) * rng.choice((-1, 1))),
            misperception=rng.standard_normal(6),
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
        for name in given.keys() & {"bottle", "tray"}:
            if abs(np.linalg.norm(given[name][3:]) - 1) > 1e-3:
                raise DataError(
                    f"{name} is x, y, z and a unit quaternion w, x, y, z; "
                    f"got {given[name].tolist()}"
                )
        if "joints" in given:
            robot = skill().robot
            beyond = np.maximum(
                robot.lower.numpy() - given["joints"], given["joints"] - robot.upper.numpy()
            )
            if beyond.max() > 1e-6:
                name = robot.joint_names[int(beyond.argmax())]
                raise DataError(f"{name} is out of its range by {beyond.max():.3g} rad")
        return dataclasses.replace(self, **given)

    def torques(self, start: int, steps: int) -> NDArray[np.float64]:
        """The push, as torques (steps, 17) of the joints [N m], one for each millisecond."""
        torques = np.zeros((steps, len(self.joints)))
        first = round(1000 * self.push_start) - start
        last = first + round(1000 * self.push_length)
        torques[max(first, 0) : max(last, 0), self.pushed] = self.push_torque
        return torques
