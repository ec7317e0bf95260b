"""Events of movement: an object is moved, a link comes to rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter1d

from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.events.detection import (
    NOTHING,
    Detection,
    Detector,
    at_least_two_steps,
    hysteresis,
    uniqueness,
)
from tpgmm_torch.exceptions import DataError, UnknownNameError

__all__ = ["ObjectMoves", "Stop"]

#: An object is on its way at this share of its largest distance; it left where it lay before.
AWAY, LEFT = 0.1, 0.02
#: A smaller way of an object or link counts in proportion: it may be noise [m].
SMALL = 0.02
#: A link rests below this share of its peak speed; it moves above the other.
REST, MOTION = 0.1, 0.3
#: The peak is this quantile of the speed: one step does not make it.
PEAK = 0.98
#: Speeds are means over so long [s].
SMOOTHING = 0.2


@dataclass(frozen=True)
class ObjectMoves(Detector):
    """An object that lay still starts to move: a contact.

    It is the last instant at which the object was within 2 % of its largest distance from
    where it lay, before it came to 10 %. The confidence is the product of

    - contrast: one less its scatter while it lay still, relative to these 10 %;
    - the share of the time after the event that it stays away;
    - its largest distance, in proportion below 2 cm.

    Parameters
    ----------
    frame : str
        The object's frame, recorded over time.

    Examples
    --------
    >>> time = np.arange(100) / 10
    >>> from tpgmm_torch import Frame
    >>> lifted = np.outer(np.clip(time - 4, 0, 2), [0, 0, 0.1])
    >>> shown = Demonstration(time, time[:, None], {"cup": Frame(lifted)})
    >>> ObjectMoves("cup").find(shown).confidence > 0.9
    True
    """

    frame: str

    def find(self, demonstration: Demonstration, robot: Any = None) -> Detection:
        """See :meth:`Detector.find`."""
        at_least_two_steps(demonstration)
        frame = demonstration.frame(self.frame)
        if not frame.batch_shape:
            raise DataError(
                f"frame {self.frame!r} was recorded once: when it starts to move is not known"
            )
        position, time = as_array(frame.position), as_array(demonstration.time)
        distance = np.linalg.norm(position - position[0], axis=1)
        largest = float(distance.max())
        if largest <= 0:
            return NOTHING
        away = int(np.flatnonzero(distance >= AWAY * largest)[0])
        lying = np.flatnonzero(distance[:away] <= LEFT * largest)
        left = int(lying[-1]) if len(lying) else 0
        scatter = float(distance[: left + 1].std())
        contrast = max(0.0, 1 - scatter / (AWAY * largest))
        stays = float((distance[away:] >= AWAY * largest).mean())
        return Detection(float(time[left]), contrast * stays * min(1.0, largest / SMALL))


@dataclass(frozen=True)
class Stop(Detector):
    """A link comes to rest between two motions.

    It rests from where its speed falls below 10 % of its peak until it is above 30 % again.
    The confidence is the product of

    - contrast: one less its mean speed at rest over those 30 %;
    - uniqueness, unless ``number`` says which: one less the second longest rest over the
      longest;
    - the way from the beginning to the stop, in proportion below 2 cm.

    Parameters
    ----------
    link : str
        A link of the robot.
    number : int, optional
        Which of its stops, from 1; by default the longest.

    Raises
    ------
    DataError
        If the number is none.
    """

    link: str
    number: int | None = None

    def __post_init__(self) -> None:
        if self.number is not None and self.number < 1:
            raise DataError(f"stops are counted from 1, got {self.number}")

    def find(self, demonstration: Demonstration, robot: Any = None) -> Detection:
        """See :meth:`Detector.find`."""
        at_least_two_steps(demonstration)
        if robot is None:
            raise DataError(f"a stop of link {self.link!r} needs the robot")
        if self.link not in robot.links:
            raise UnknownNameError("link", self.link, "the robot", robot.links)
        state = robot.state(demonstration.reordered(robot.joint_names).joints)
        position, time = as_array(state.position(self.link)), as_array(demonstration.time)
        speed = _speed(position, time)
        peak = float(np.quantile(speed, PEAK))
        if peak <= 0:
            return NOTHING
        rests = [
            (start, stop)
            for start, stop in hysteresis(-speed, -REST * peak, -MOTION * peak)
            if (speed[:start] > MOTION * peak).any() and stop < len(speed)
        ]
        if len(rests) < (self.number or 1):
            return NOTHING
        lengths = np.array([time[stop - 1] - time[start] for start, stop in rests])
        chosen = int(lengths.argmax()) if self.number is None else self.number - 1
        start, stop = rests[chosen]
        contrast = max(0.0, 1 - float(speed[start:stop].mean()) / (MOTION * peak))
        way = float(np.linalg.norm(np.diff(position[: start + 1], axis=0), axis=1).sum())
        unique = uniqueness(lengths, chosen) if self.number is None else 1.0
        return Detection(float(time[start]), contrast * unique * min(1.0, way / SMALL))


def _speed(position: Array, time: Array) -> Array:
    """Smoothed speed [m/s] at each instant."""
    half = max(1, round(SMOOTHING / 2 / float(np.median(np.diff(time)))))
    rates = np.gradient(position, time, axis=0)
    smooth = uniform_filter1d(rates, 2 * half + 1, axis=0, mode="nearest")
    speed: Array = np.linalg.norm(smooth, axis=1)
    return speed
