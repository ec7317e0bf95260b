"""The paper's skill as a gymnasium environment: take a bottle, lift it, shake it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from lerobot_env_bimanual.bottle.conditions import draw_start, skill
from lerobot_env_bimanual.bottle.handling import BottleEnv
from lerobot_env_bimanual.bottle.measures import find_shaking, successful
from lerobot_env_bimanual.bottle.scene import TABLE_LOW, BottleScene
from lerobot_env_bimanual.disturbances import Course
from lerobot_env_bimanual.start import Start
from tpgmm_datasets.bottle.skill import FOOT, PHASES, SHOULDERS, TASK, BottleShaking
from tpgmm_torch.exceptions import DataError

__all__ = ["BottleShakingEnv"]

#: Of the demonstrations with a steady rhythm [Hz, rad].
FREQUENCY = BottleShaking.cycles / PHASES["shake"]
AMPLITUDE = BottleShaking.amplitude
#: How long an episode takes [s]; the slowest demonstration takes 15.3.
DURATION = 16.0
#: Shaking begins at 8 s; half a second later there are two whole periods left to judge.
COURSE = Course(grasp=4.0, latest=8.5, end=12.0)


class BottleShakingEnv(BottleEnv):
    """A 17-joint upper body that should take a bottle with both hands, lift and shake it.

    ``observation.timestamp`` is the time since the beginning [s].

    An action is a reference for each joint [rad]. References are limited to the joints' ranges
    and speeds (``info["clipped_rad"]`` is by how much, at most), interpolated to 1 kHz, and
    reach the joints' position control some milliseconds later.

    The bottle stands on a lifting table, and moves if it is pushed. Both hands close when both
    palms have arrived at it
    (:class:`~lerobot_env_bimanual.bottle.measures.Closing` is the rule), once per
    episode. The bottle is then attached to them just as it lies in them, and the table sinks.
    Both hands lose it when one is pulled from it by more than 100 N, or without dynamics by
    more than 30 mm.

    An episode takes its full length, and is then judged. At its end ``info`` holds

    - ``grasp_mm``, ``grasp_deg``: how far the worse hand was from its grasp pose when the hands
      closed; if they never did, when they were nearest to the bottle;
    - ``lift_mm``: height of the bottle above the table, the least from the shaking to the end;
      0 if it is not held at the end;
    - ``frequency_hz``, ``amplitude_rad``: of the shoulders' pitch after the grasp, in the two
      periods that are most like a sinusoid; the amplitude that is farther off of both;
    - ``frequency_error``, ``amplitude_error``: relative to what is asked for; 1 if there was no
      grasp, or no time left for two periods;
    - ``peak_speed``, ``peak_acceleration``: the largest of any joint from tick to tick, as
      measured, while the robot was not stopped [rad/s, rad/s^2];

    and ``is_success``: errors of at most 10 mm, 5 deg, 10 % and 20 %, and at least 50 mm.

    The seed draws the bottle's pose and the start posture (like the generator of the
    demonstrations), the bottle's mass (0.5 to 1.5 kg), the control's delay (1 to 8 ms) and what
    the options below need; the same at every ``fps`` and in every mode.

    Parameters
    ----------
    frequency, amplitude : float
        What the shaking should have [Hz, rad]; by default what demonstrations with a steady
        rhythm have.
    **options
        Those of :class:`~lerobot_env_bimanual.controlled.ControlledEnv`; an episode takes 16 s
        by default.

    Raises
    ------
    DataError
        If an option is not one of the above.
    """

    task = TASK
    task_description = "take the bottle with both hands, lift it and shake it"

    def __init__(
        self, *, frequency: float = FREQUENCY, amplitude: float = AMPLITUDE, **options: Any
    ) -> None:
        self.frequency, self.amplitude = frequency, amplitude
        super().__init__(BottleScene(), DURATION, COURSE, **options)
        self._pitches = [self.joint_names.index(name) for name in SHOULDERS]

    def _check_options(self) -> None:
        super()._check_options()
        for name in ("frequency", "amplitude"):
            if not 0 < getattr(self, name) < math.inf:
                raise DataError(f"{name} is finite and above 0, got {getattr(self, name)!r}")

    def figures(self) -> dict[str, float]:
        """Measure how well the episode goes, so far; the class describes each figure."""
        distance, angle = self.grasp()
        motion = self._since_grasp()
        shaking = find_shaking(motion[:, self._pitches], self.fps, self.frequency)
        worse = np.abs(shaking.amplitudes / self.amplitude - 1).argmax()
        amplitude = float(shaking.amplitudes[worse])
        lift = 0.0
        if self._scene.held:
            lift = float(motion[shaking.start :, -1].min()) - FOOT - TABLE_LOW
        return {
            "grasp_mm": distance,
            "grasp_deg": angle,
            "lift_mm": 1e3 * lift,
            "frequency_hz": shaking.frequency,
            "amplitude_rad": amplitude,
            "frequency_error": abs(shaking.frequency / self.frequency - 1),
            "amplitude_error": abs(amplitude / self.amplitude - 1),
        }

    def _successful(self, figures: Mapping[str, float]) -> bool:
        return successful(figures)

    def _draw(self, options: Mapping[str, Any]) -> Start:
        return draw_start(self.np_random, skill()).given(options, skill().robot)

    def _generator(self) -> BottleShaking:
        return skill()
