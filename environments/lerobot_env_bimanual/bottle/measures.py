"""When the hands close around the bottle, and how well the skill was done."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Figure(NamedTuple):
    """A figure of an episode, which is 0 or more.

    Parameters
    ----------
    heading : str
        What a report calls it, with its unit.
    digits : int
        That a report shows.
    low, high : float
        The smallest and the largest of a success.
    """

    heading: str
    digits: int = 0
    low: float = 0.0
    high: float = math.inf

    @property
    def has_limit(self) -> bool:
        """Dependence of a success on it."""
        return self.low > 0 or self.high < math.inf


#: Of bottle shaking.
FIGURES = MappingProxyType(
    {
        "grasp_mm": Figure("grasp [mm]", 1, high=10.0),
        "grasp_deg": Figure("grasp [deg]", 1, high=5.0),
        "lift_mm": Figure("lift [mm]", low=50.0),
        "frequency_error": Figure("frequency error", 2, high=0.1),
        "amplitude_error": Figure("amplitude error", 2, high=0.2),
    }
)
#: Of a bottle that is put on a tray.
PUT_FIGURES = MappingProxyType(
    {
        "put_mm": Figure("at the tray [mm]", 2, high=5.0),
        "put_deg": Figure("at the tray [deg]", 2, high=3.0),
        "standing": Figure("put down", 0, 1.0, 1.0),
        "grasp_mm": Figure("grasp [mm]", 1),
    }
)


def successful(values: Mapping[str, float], figures: Mapping[str, Figure] = FIGURES) -> bool:
    """Check whether an episode is one of success.

    Parameters
    ----------
    values : mapping of str to float
        Of ``figures``; more are ignored.
    figures : mapping of str to Figure
        What was asked for.
    """
    limited = {name: figure for name, figure in figures.items() if figure.has_limit}
    return all(figure.low <= values[name] <= figure.high for name, figure in limited.items())


@dataclass
class Closing:
    """Decides when two hands close: when both are at the bottle and come no closer.

    Both palms have to be within ``reach`` of the bottle's surface, and the farther of the two
    must not have come closer by more than ``progress`` for ``dwell_time`` seconds. No clock of
    the skill is involved: whoever arrives early or late, or with one hand after the other, is
    waited for; a hand that passes by is gone before that time is over. It does not matter
    how the hands are turned or where along the surface they are: a bad grasp is a grasp.

    Parameters
    ----------
    reach : float, default=0.015
        [m]; more than the 10 mm by which a successful grasp may be off.
    progress : float, default=0.0005
        [m]; also bounds how much too far away hands can be that close before they have quite
        arrived.
    dwell_time : float, default=0.2
        [s]
    """

    reach: float = 0.015
    progress: float = 0.0005
    dwell_time: float = 0.2
    _nearest: float = field(default=math.inf, init=False)
    _since: float = field(default=0.0, init=False)

    def update(self, time: float, gap: float) -> bool:
        """Take notice of the hands.

        Parameters
        ----------
        time : float
            [s]
        gap : float
            Distance of the farther palm from the bottle's surface [m].

        Returns
        -------
        bool
            Whether the hands close now.
        """
        if gap > self.reach:
            self._nearest = math.inf
            return False
        if gap < self._nearest - self.progress:
            self._nearest, self._since = gap, time
        return time - self._since >= self.dwell_time - 1e-6  # times are rounded


@dataclass(frozen=True)
class Shaking:
    """A rhythm found in a motion.

    Parameters
    ----------
    frequency : float
        [Hz]; 0 if the motion is too short.
    amplitudes : ndarray of shape (n_joints,)
        [rad]
    start : int
        The first time step of the window in which it was found.
    """

    frequency: float
    amplitudes: NDArray[np.float64]
    start: int


def find_shaking(joints: NDArray[np.float64], rate: float, nominal: float) -> Shaking:
    """Find the two nominal periods of a motion that are most like a sinusoid, and its rhythm.

    In every window, for every frequency, sinusoids of least squares are fitted to the joints,
    each with an amplitude and a phase of its own, around straight lines. The window and the
    frequency with the largest power explained, less three times the power unexplained, are
    taken: jumps and slow motions leave much unexplained, small motions explain little.

    Parameters
    ----------
    joints : ndarray of shape (T, n_joints)
        [rad]
    rate : float
        Time steps per second.
    nominal : float
        Frequency to look for [Hz]: what is found is between two thirds and twice of it, so that
        a window always holds more than one period.
    """
    length = round(2 * rate / nominal)
    if len(joints) < length:
        return Shaking(0.0, np.zeros(joints.shape[1]), 0)
    hop = max(1, round(rate / 10))
    time = np.arange(length) / rate
    line = np.linalg.qr(np.stack((np.ones(length), time), axis=1))[0]
    windows = np.lib.stride_tricks.sliding_window_view(joints, length, axis=0)[::hop]
    windows = windows - windows @ line @ line.T  # (windows, joints, length)
    power = np.square(windows).sum((1, 2))

    def waves(frequency: float) -> NDArray[np.float64]:
        angle = 2 * np.pi * frequency * time
        pair = np.stack((np.sin(angle), np.cos(angle)), axis=1)
        return pair - line @ (line.T @ pair)

    grid = nominal * np.geomspace(2 / 3, 2, 111)  # in steps of 1 %
    explained = [
        np.square(windows @ np.linalg.qr(waves(frequency))[0]).sum((1, 2)) for frequency in grid
    ]
    scores = 4 * np.array(explained) - 3 * power
    best, window = np.unravel_index(scores.argmax(), scores.shape)
    frequency = float(grid[best])
    if 0 < best < len(grid) - 1:  # the top of the parabola through three points
        below, top, above = scores[best - 1 : best + 2, window]
        shift = (below - above) / (2 * (below - 2 * top + above))
        frequency *= float(grid[1] / grid[0]) ** float(shift)
    fit = np.linalg.lstsq(waves(frequency), windows[window].T, rcond=None)[0]
    return Shaking(frequency, np.hypot(*fit), int(window) * hop)
