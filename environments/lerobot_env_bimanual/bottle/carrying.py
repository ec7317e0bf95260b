"""Carry and put as a gymnasium environment: bring a bottle to a tray, however it is held."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import torch

from lerobot_env_bimanual.bottle.carry_and_put import SLIDE, TASK, CarryAndPut, slide
from lerobot_env_bimanual.bottle.conditions import draw_start, skill
from lerobot_env_bimanual.bottle.handling import BottleEnv
from lerobot_env_bimanual.bottle.measures import PUT_FIGURES, Closing, successful
from lerobot_env_bimanual.bottle.scene import CARRIERS, TrayScene
from lerobot_env_bimanual.disturbances import Course
from lerobot_env_bimanual.start import Start
from tpgmm_datasets.bottle.skill import FOOT
from tpgmm_torch import Frame

__all__ = ["CarryAndPutEnv"]

#: How long an episode takes [s]; the slowest demonstration takes 14.5.
DURATION = 15.5
COURSE = Course(grasp=4.0, latest=8.0, end=9.8)
#: Higher than this above the table the bottle has been lifted [m].
LIFTED = 0.02
#: Nearer than this to the table, and coming no nearer, it is put down [m].
PUT = 0.01
#: A bottle that leans more than this does not stand [deg].
UPRIGHT = 5.0


@functools.cache
def carrying() -> CarryAndPut:
    """Make the generator, on the robot of the other tasks."""
    return CarryAndPut(robot=skill().robot)


class CarryAndPutEnv(BottleEnv):
    """A 17-joint upper body that should put a bottle on a tray with both hands.

    Robot, actions and hands are those of
    :class:`~lerobot_env_bimanual.bottle.shaking.BottleShakingEnv`.
    ``observation.environment_state`` has the poses of the bottle and of the tray, always the
    present ones. The tray lies flat on the table and is not moved.

    While the hands close, for 0.2 s, the bottle slides between the palms by up to 3 cm forwards
    or backwards and turns by up to 10 degrees, as the episode's seed decides; then it is
    attached to them just as it lies. Once it has been lifted by 2 cm, the hands open when it
    has come within 1 cm of the table and comes no nearer for 0.2 s.

    An episode takes its full length, and is then judged. At its end ``info`` holds

    - ``put_mm``, ``put_deg``: how far the bottle is from its place in the middle of the tray,
      turned as the tray is;
    - ``standing``: 1 if the hands have put it down and it stands, else 0;
    - ``grasp_mm``, ``grasp_deg``: how far the worse hand was from its grasp pose when the hands
      began to close; if they never did, when they were nearest to the bottle;
    - ``peak_speed``, ``peak_acceleration``: as for bottle shaking;

    and ``is_success``: it stands, off by at most 5 mm and 3 deg.

    Parameters
    ----------
    **options
        Those of :class:`~lerobot_env_bimanual.controlled.ControlledEnv`, but for ``track``; an
        episode takes 15.5 s by default.

    Raises
    ------
    DataError
        If an option is not one of the above.
    """

    task = TASK
    task_description = "take the bottle with both hands and put it on the tray"
    _scene: TrayScene
    carriers: ClassVar = CARRIERS

    def __init__(self, **options: Any) -> None:
        super().__init__(TrayScene(), DURATION, COURSE, track=True, **options)

    def figures(self) -> dict[str, float]:
        """Measure how well the episode goes, so far; the class describes each figure."""
        bottle, tray = (torch.from_numpy(pose) for pose in self._scene.objects)
        distance, angle = carrying().put_error(
            Frame(bottle[:3], bottle[3:]), Frame(tray[:3], tray[3:])
        )
        grasp_mm, grasp_deg = self.grasp()
        return {
            "put_mm": 1e3 * float(distance),
            "put_deg": math.degrees(float(angle)),
            "standing": float(self._put and self._leaning() < UPRIGHT),
            "grasp_mm": grasp_mm,
            "grasp_deg": grasp_deg,
        }

    def _leaning(self) -> float:
        """Return the bottle's angle with the vertical [deg]."""
        x, y = self._scene.bottle[4:6]
        return math.degrees(2 * math.asin(min(1.0, math.hypot(x, y))))

    def _successful(self, figures: Mapping[str, float]) -> bool:
        return successful(figures, PUT_FIGURES)

    def _draw(self, options: Mapping[str, Any]) -> Start:
        rng, task = self.np_random, carrying()
        start = draw_start(rng, task)
        place = Frame(torch.from_numpy(start.poses["bottle"][None, :3]))
        tray: Any = task.tray_poses(place, rng)[0]
        start = replace(
            start,
            poses={**start.poses, "tray": np.concatenate((tray.position, tray.orientation))},
            slide=task.slides(1, rng)[0],
            misperception=np.append(start.misperception, rng.standard_normal(6)),
        ).given(options, task.robot)
        self._closed: float | None = None  # when the hands began to close
        self._opening, self._lifted, self._put = Closing(reach=PUT), False, False
        return start

    def _close(self, at_once: bool) -> None:
        super()._close(at_once)
        self._change_hands(
            self._scene.let_go
        )  # not yet; but from now on the palms do not push it
        self._closed = self._free - (SLIDE[1] if at_once else 0.0)
        self._let_slide()

    def _let_slide(self) -> None:
        """Move the bottle between the palms; in the end it is held."""
        assert self._closed is not None
        done = min((self._free - self._closed) / SLIDE[1] + 1e-9, 1.0)
        stood = Frame(*np.split(self._contact[1], [3]))
        pose = stood.compose(slide(done * self._start.slide))
        self._scene.put("bottle", torch.cat((pose.position, pose.orientation)).numpy())
        if done == 1.0:
            self._closed = None
            self._change_hands(self._scene.hold)

    def _use_hands(self, stopped: bool) -> None:
        super()._use_hands(stopped)
        if stopped:
            return
        if self._closed is not None:
            self._let_slide()
        elif self._scene.held:
            height = self._scene.bottle[2] - self._scene.table - FOOT
            self._lifted |= height > LIFTED
            if self._lifted and self._opening.update(self._free, max(height, 0.0)):
                self._put = True
                self._change_hands(self._scene.let_go)

    def _restore(self, before: Any) -> None:
        super()._restore(before)
        self._opening, self._closed = Closing(reach=PUT), None
        self._lifted &= self._grasp_step is not None
        self._put &= not self._scene.held and self._lifted

    def _generator(self) -> CarryAndPut:
        return carrying()

    def _slides(self) -> tuple[float, ...]:
        return tuple(self._start.slide)
