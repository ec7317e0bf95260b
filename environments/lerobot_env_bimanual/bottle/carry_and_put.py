"""Carry and put, generated: take a bottle with both hands and put it on a tray.

The bottle slides in the hands while they close, by another distance each time: where the hands
have to go with it follows from where it then is, not from where it was expected.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_datasets.bottle.skill import (
    APPROACH_POINT,
    FOOT,
    GRASP_POINT,
    HANDS,
    BottleSkill,
    approach_bottle,
    between,
    either,
    place_hand,
    pose_error,
    upright,
)
from tpgmm_torch import Demonstration, Frame, Situation, quaternions

__all__ = ["CarryAndPut"]

#: What LeRobot data sets of the skill call it.
TASK = "put the bottle on the tray"
#: Nominal seconds of each phase; 12.3 in all.
PHASES = MappingProxyType(
    dict(reach=2.5, close=1.5, hold=0.8, lift=1.0, carry=2.5)
    | dict(lower=1.5, open=0.8, leave=1.2, rest=0.5)
)
#: When the bottle slides, after the hands have arrived, and how long [s].
SLIDE = (0.2, 0.2)
#: How high the bottle is carried above where it stood and above where it is put [m].
LIFT = 0.05
#: The bottle's place on a tray.
FOOT_ON_TRAY = Frame((0.0, 0.0, FOOT))


@dataclass(frozen=True)
class CarryAndPut(BottleSkill):
    """Generator of demonstrations and situations of bringing a bottle to a tray.

    Bottles stand in a box of 8 x 4 x 6 cm on the left, trays are on the right, as far from the
    middle, on the same table: both turned by up to 10 degrees. In the middle of the tray, which
    is flat, is the bottle's place, turned as the tray is.

    Parameters
    ----------
    rate, stretch, start_spread
        As for :class:`~tpgmm_datasets.bottle.skill.BottleShaking`.
    slide : float, default=0.03
        By how much the bottle slides between the palms, forwards or backwards, at most [m].
    turn : float, default=10
        By how much it turns there about its axis, to either side, at most [deg].

    Examples
    --------
    >>> [situation] = CarryAndPut().situations(1, seed=0)
    >>> list(situation.frames)
    ['bottle', 'tray']
    """

    phases: ClassVar[Mapping[str, float]] = PHASES
    lowest: ClassVar[tuple[float, float, float]] = (0.24, 0.02, 0.09)
    highest: ClassVar[tuple[float, float, float]] = (0.32, 0.06, 0.15)
    yaw: ClassVar[float] = 10.0

    slide: float = 0.03
    turn: float = 10.0

    def tray_poses(self, bottles: Frame, rng: np.random.Generator) -> Frame:
        """Draw a tray for each bottle (n,), anywhere on the right of its table."""
        (x, y, _), (far, wide, _) = self.lowest, self.highest
        trays = upright(rng, (x, -wide, 0.0), (far, -y, 0.0), self.yaw, len(bottles.position))
        trays.position[:, 2] = bottles.position[:, 2] - FOOT
        return trays

    def slides(self, n: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """Draw how far bottles slide [m] and turn [rad] in the hands, shape (n, 2)."""
        most = self.slide, math.radians(self.turn)
        return rng.uniform(-1, 1, (n, 2)) * most

    def situations(self, n: int, seed: int = 0) -> list[Situation]:
        """New poses of bottle and tray, and start postures.

        Parameters
        ----------
        n : int
        seed : int, default=0

        Returns
        -------
        list of Situation
        """
        rng = np.random.default_rng(seed)
        bottles, starts = self.bottle_poses(n, rng), self.start_postures(n, rng)
        trays = self.tray_poses(bottles, rng)
        return [
            Situation(starts[i], {"bottle": bottles[i], "tray": trays[i]}) for i in range(n)
        ]

    def demonstrations(self, n: int = 10, seed: int = 0) -> list[Demonstration]:
        """Demonstrations with different objects, slides, start postures and timing.

        Parameters
        ----------
        n : int, default=10
        seed : int, default=0

        Returns
        -------
        list of Demonstration
            With the frames ``"bottle"``, where it is at each time step, and ``"tray"``, and the
            events ``"grasp"``, ``"put"`` and ``"rest"``.
        """
        situations = self.situations(n, seed)
        rng = np.random.default_rng((seed, 1))
        return self._demonstrations(situations, self.slides(n, rng), self._phase_ends(n, rng))

    def nominal(
        self, situations: Sequence[Situation], slides: NDArray[np.float64] | None = None
    ) -> list[Demonstration]:
        """Perform the skill in given situations, without its spread in timing.

        Parameters
        ----------
        situations : sequence of Situation
            With the frames ``"bottle"`` and ``"tray"``.
        slides : ndarray of shape (n, 2), optional
            As :meth:`slides` draws them; none by default.

        Returns
        -------
        list of Demonstration
            As :meth:`demonstrations` gives them, of 12.3 s.
        """
        n = len(situations)
        slides = np.zeros((n, 2)) if slides is None else slides
        return self._demonstrations(situations, slides, self._timing.nominal_ends(n))

    def put_error(self, bottle: Frame, tray: Frame) -> tuple[Tensor, Tensor]:
        """Measure how far a bottle is from its place on a tray.

        Returns
        -------
        position : Tensor of shape (...)
            In metres.
        orientation : Tensor of shape (...)
            In radians.
        """
        return pose_error(bottle, tray.compose(FOOT_ON_TRAY))

    def _demonstrations(
        self, situations: Sequence[Situation], slides: NDArray[np.float64], ends: Tensor
    ) -> list[Demonstration]:
        starts = torch.stack([situation.joints for situation in situations])
        bottles, trays = (
            Frame.stack([situation.frames[name] for situation in situations])
            for name in ("bottle", "tray")
        )
        state = self.robot.state(starts)
        first = {hand: state.pose(hand) for hand in HANDS}

        arrived = ends[:, list(self.phases).index("close")]
        grasped, place = bottles.compose(slide(slides)), trays.compose(FOOT_ON_TRAY)
        ways = {"lift": _above(grasped), "carry": _above(place), "lower": place}

        times = self._times(ends)
        progress = self._timing.progress(times[:, None], ends)
        slid = ((times[:, None] - arrived - SLIDE[0]) / SLIDE[1]).clamp(0, 1)
        path = between(bottles, grasped, slid)
        for phase, end in ways.items():
            path = between(path, end, progress[phase])
        held, wanted = before_sliding(path, slides), []
        for hand in HANDS:
            away = place_hand(held, APPROACH_POINT[hand])
            leaving = between(place_hand(held, GRASP_POINT[hand]), away, progress["leave"])
            pose = approach_bottle(first[hand], hand, bottles, progress)
            wanted.append(either(progress["lift"] > 0, leaving, pose))
        joints = self._follow(starts, wanted)
        return self._record(times, joints, ends, {"bottle": path, "tray": trays})

    def _events(self, end: Mapping[str, float]) -> dict[str, float]:
        return {"grasp": end["hold"], "put": end["lower"], "rest": end["leave"]}


def slide(slides: NDArray[np.float64]) -> Frame:
    """Return the bottle's pose seen from where it stood before it slid by (..., 2) [m, rad]."""
    given = torch.as_tensor(slides, dtype=torch.float64)
    zero = torch.zeros_like(given[..., 0])
    half = given[..., 1] / 2
    return Frame(
        torch.stack((given[..., 0], zero, zero), dim=-1),
        torch.stack((half.cos(), zero, zero, half.sin()), dim=-1),
    )


def slid(demonstration: Demonstration) -> NDArray[np.float64]:
    """Measure how far the bottle of a demonstration slides [m] and turns [rad], shape (2,)."""
    bottle, time = demonstration.frame("bottle"), demonstration.time
    grasped = bottle[int(torch.searchsorted(time, demonstration.events["grasp"]))]
    turn = quaternions.product(
        quaternions.conjugate(bottle[0].orientation), grasped.orientation
    )
    forwards = bottle[0].inverse_transform(grasped.position)[0]
    return np.array((float(forwards), 2 * math.atan2(float(turn[3]), float(turn[0]))))


def before_sliding(bottle: Frame, slides: NDArray[np.float64]) -> Frame:
    """Return where a bottle that has slid would be in the same hands if it had not."""
    slid = slide(slides)
    turn = quaternions.product(bottle.orientation, quaternions.conjugate(slid.orientation))
    return Frame(bottle.position - quaternions.rotate(turn, slid.position), turn)


def _above(pose: Frame) -> Frame:
    return Frame(pose.position + pose.position.new_tensor((0, 0, LIFT)), pose.orientation)
