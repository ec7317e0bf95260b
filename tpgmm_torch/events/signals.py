"""Events of signals with two levels: grippers that close and open, forces of a contact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
from scipy.ndimage import median_filter

from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.pose_names import is_gripper, pose_groups, words
from tpgmm_torch.events.detection import (
    LEAST_CONFIDENCE,
    NOTHING,
    Detection,
    Detector,
    at_least_two_steps,
    hysteresis,
    uniqueness,
)
from tpgmm_torch.exceptions import DataError

__all__ = ["SignalEvent", "gripper_groups", "gripper_signals", "level_changes"]

#: From one level (0) to the other (1): there from here on, and no more below this.
ON, OFF = 0.65, 0.35
#: Spikes of half this length are no change of state [s].
SPIKE = 0.1
#: A swing is as large as it can be at this share of the signal's size; less is drift.
LARGE = 0.2
SIDES = {"left", "right"}


@dataclass(frozen=True)
class SignalEvent(Detector):
    """Begin or end of the longest stretch in which signals are low, or high.

    Several signals, like the fingers of a hand, count as one: their first principal
    component. Its two levels are the medians of the two classes of Otsu [1]_; a stretch
    begins where the signal has come 65 % of the way from one level to the other, and lasts
    until it is back at 35 %. Stretches that begin within the demonstration come first: a
    hand that is closed from the start has not closed.

    The confidence is the product of

    - contrast: one less twice the standard deviation within the classes, relative to the
      distance of the levels, which itself counts in proportion below a fifth of the signal's
      largest magnitude;
    - steepness: one less twice the time that the change takes, relative to the stretch;
    - uniqueness: one less the second longest stretch over the longest.

    Parameters
    ----------
    signals : tuple of str
        Joints by name, or patterns with ``*``.
    edge : {"begin", "end"}
        Of the stretch.
    level : {"low", "high"}
        What the signals are in it. LeRobot's grippers are 0 when they are closed.

    Raises
    ------
    DataError
        If there are no signals, or edge or level are others.

    References
    ----------
    .. [1] N. Otsu: A Threshold Selection Method from Gray-Level Histograms. IEEE Transactions
       on Systems, Man, and Cybernetics 9 (1979).

    Examples
    --------
    >>> time = np.arange(100) / 10
    >>> opening = np.where((time > 3) & (time < 8), 2.0, 40.0)
    >>> shown = Demonstration(time, opening[:, None], joint_names=["gripper"])
    >>> found = SignalEvent(("gripper",), "end").find(shown)
    >>> round(found.time, 2), round(found.confidence, 2)
    (7.94, 0.97)
    """

    signals: tuple[str, ...]
    edge: str = "begin"
    level: str = "low"

    def __post_init__(self) -> None:
        if not self.signals or not all(self.signals):
            raise DataError("an event of signals needs their names")
        for name, choices in (("edge", ("begin", "end")), ("level", ("low", "high"))):
            if getattr(self, name) not in choices:
                raise DataError(f"{name} is one of {choices}, got {getattr(self, name)!r}")

    def find(self, demonstration: Demonstration, robot: Any = None) -> Detection:
        """See :meth:`Detector.find`."""
        at_least_two_steps(demonstration)
        time = as_array(demonstration.time)
        signal = _principal(as_array(demonstration.joints)[:, self._columns(demonstration)])
        half = max(1, round(SPIKE / 2 / float(np.median(np.diff(time)))))
        signal = median_filter(signal, size=2 * half + 1, mode="nearest")
        share, contrast = _between_levels(signal)
        share = 1 - share if self.level == "low" else share
        stretches = hysteresis(share, ON, OFF)
        begun = [(start, stop) for start, stop in stretches if start > 0]
        if self.edge == "end":
            ended = [(start, stop) for start, stop in stretches if stop < len(share)]
            begun = [stretch for stretch in ended if stretch in begun] or ended
        if not begun:
            return NOTHING
        lengths = np.array([time[stop - 1] - time[start] for start, stop in begun])
        longest = int(lengths.argmax())
        at, change = _edge(time, share, *begun[longest], self.edge)
        steepness = max(0.0, 1 - 2 * change / max(lengths[longest], 1e-9))
        return Detection(at, float(contrast * steepness * uniqueness(lengths, longest)))

    def _columns(self, demonstration: Demonstration) -> list[int]:
        names = demonstration.joint_names or ()
        columns = []
        for pattern in self.signals:
            fits = [i for i, n in enumerate(names) if n == pattern or fnmatchcase(n, pattern)]
            if not fits:
                raise DataError(f"no signal is called {pattern!r}; there are {list(names)}")
            columns += fits
        return sorted(set(columns))


def gripper_signals(names: Sequence[str], link: str | None = None) -> tuple[str, ...]:
    """The signals of a gripper, or of a hand's fingers, known by their names.

    Parameters
    ----------
    names : sequence of str
        Of all signals.
    link : str, optional
        If it has a side (``right_hand``, ``r_wrist``), only that side's.

    Raises
    ------
    DataError
        If there are none, or those of both sides.

    Examples
    --------
    >>> gripper_signals(["l_elbow.pos", "l_gripper.pos", "r_gripper.pos"], "right_hand")
    ('r_gripper.pos',)
    """
    posed = {i for columns in pose_groups(names).values() for i in columns}
    found = [n for i, n in enumerate(names) if i not in posed and is_gripper(n)]
    side = SIDES & {*words(link or "")}
    if side:
        found = [name for name in found if side & {*words(name)}] or [
            name for name in found if not SIDES & {*words(name)}
        ]
    if not found or {word for name in found for word in words(name)} >= SIDES:
        problem = f"{found} are of both hands" if found else "no signal is called a gripper's"
        raise DataError(
            f"{problem} (there are {list(names)}): say which it is, as in "
            "--event close=closing:SIGNAL, events={'close': 'closing:SIGNAL'}"
        )
    return tuple(found)


def gripper_groups(names: Sequence[str]) -> dict[str, list[int]]:
    """Columns of the signals of each gripper; the fingers of one side's hand are one.

    Parameters
    ----------
    names : sequence of str
        Of all signals.

    Examples
    --------
    >>> gripper_groups(["l_elbow.pos", "l_gripper.pos", "r_gripper.pos"])
    {'l_gripper.pos': [1], 'r_gripper.pos': [2]}
    """
    posed = {i for columns in pose_groups(names).values() for i in columns}
    groups: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        if i not in posed and is_gripper(name):
            side = "".join(sorted(SIDES & {*words(name)}))
            groups.setdefault(side, []).append(i)
    return {
        names[own[0]] if len(own) == 1 else f"{side} hand".strip(): own
        for side, own in groups.items()
    }


def level_changes(time: Array, values: Array) -> list[tuple[float, float, bool]]:
    """All changes of signals between their two levels.

    Parameters
    ----------
    time : array of shape (T,)
    values : array of shape (T, n)
        Which count as one, as for :class:`SignalEvent`.

    Returns
    -------
    list of (float, float, bool)
        When each begins and ends (35 % and 65 % of the way), and whether it falls; none where
        the two levels do not stand out.
    """
    share, contrast = _between_levels(_principal(values))
    if contrast < LEAST_CONFIDENCE:
        return []
    share = 1 - share  # 1 where it is low
    found = []
    for start, stop in hysteresis(share, ON, OFF):
        if start > 0:
            at, change = _edge(time, share, start, stop, "begin")
            found.append((at - change, at, True))
        if stop < len(share):
            at, change = _edge(time, share, start, stop, "end")
            found.append((at, at + change, False))
    return found


def _principal(values: Array) -> Array:
    """One signal of shape (T,) for several (T, n): what most of them do, they do."""
    if values.shape[1] == 1:
        return values[:, 0]
    weights = np.linalg.svd(values - values.mean(axis=0), full_matrices=False)[2][0]
    summed: Array = values @ (weights if weights.sum() >= 0 else -weights)
    return summed


def _between_levels(signal: Array) -> tuple[Array, float]:
    """Where a signal (T,) is from its low level (0) to its high one (1), and how plainly.

    The second is 0 where there is one level only, and at most 1.
    """
    low, high, within = _levels(signal)
    swing, size = high - low, float(np.abs(signal).max())
    if swing <= 1e-9 * size:
        return np.zeros_like(signal), 0.0
    contrast = max(0.0, 1 - 2 * within / swing) * min(1.0, swing / (LARGE * size))
    return (signal - low) / swing, contrast


def _levels(values: Array) -> tuple[float, float, float]:
    """Medians of the two classes that differ most, and the deviation within them."""
    ordered = np.sort(values)
    count = np.arange(1, len(ordered))
    sums = ordered.cumsum()
    below, above = sums[:-1] / count, (sums[-1] - sums[:-1]) / count[::-1]
    cut = int((count * count[::-1] * (above - below) ** 2).argmax()) + 1
    low, high = ordered[:cut], ordered[cut:]
    squares = ((low - low.mean()) ** 2).sum() + ((high - high.mean()) ** 2).sum()
    return float(np.median(low)), float(np.median(high)), float(np.sqrt(squares / len(values)))


def _edge(time: Array, share: Array, start: int, stop: int, edge: str) -> tuple[float, float]:
    """When a signal passes ``ON`` at an edge, and how long that took from ``OFF``."""
    if edge == "begin":
        at = float(np.interp(ON, share[start - 1 : start + 1], time[start - 1 : start + 1]))
        away = np.flatnonzero(share[:start] <= OFF)
        return at, at - float(time[away[-1]] if len(away) else time[0])
    last = start + int(np.flatnonzero(share[start:stop] >= ON)[-1])
    at = float(np.interp(-ON, -share[last : last + 2], time[last : last + 2]))
    return at, float(time[stop]) - at
