"""Detectors of events in demonstrations: grippers close, objects move, links stop."""

from __future__ import annotations

import abc
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
import torch

from tpgmm_datasets.checks.check import PACKAGE
from tpgmm_torch.checks.report import Finding, Report
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import SMOOTHING, Demonstration
from tpgmm_torch.data.frames import STILL
from tpgmm_torch.data.pose_names import words
from tpgmm_torch.events import (
    LEAST_CONFIDENCE,
    ON,
    between_levels,
    crossing_time,
    gripper_groups,
    high_stretches,
    move_start,
    smooth_speed,
    without_spikes,
)
from tpgmm_torch.exceptions import DataError, UnknownNameError

__all__ = ["find_events", "parse_event"]

#: A link rests below the first share of its peak speed, and moves above the second.
REST, MOTION = 0.1, 0.3
#: Edge and level of the events of signals.
SIGNALS = {
    "closing": ("begin", "low"),
    "opening": ("end", "low"),
    "contact": ("begin", "high"),
    "release": ("end", "high"),
}
SIDES = {"left", "right"}
#: First row of each, and the row behind it.
Stretches = Sequence[tuple[int, int]]
GRAMMAR = (
    "closing:SIGNALS and opening:SIGNALS (begin and end of the longest time that a gripper is "
    "low), contact:SIGNALS and release:SIGNALS (of the longest time that a force is high, "
    "a link's wrench too; also "
    "of grippers that are high when closed), each with names or patterns joined by commas; "
    "moving:FRAME (an object starts to move); stop:LINK, stop:LINK:2 (a link comes to rest: "
    "the longest time, the second time)"
)


@dataclass(frozen=True)
class Detection:
    """When an event was, if it was one.

    Parameters
    ----------
    time : float
        On the demonstration's clock [s]; NaN where nothing like it happens.
    confidence : float
        From 0 (nothing, or noise) to 1 (once, at once, and nothing else like it).
    """

    time: float
    confidence: float

    @property
    def certain(self) -> bool:
        """Tell whether it counts as an event."""
        return math.isfinite(self.time) and self.confidence >= LEAST_CONFIDENCE


NOTHING = Detection(math.nan, 0.0)


class Detector(abc.ABC):
    """Finds one event in a demonstration."""

    @abc.abstractmethod
    def find(self, demonstration: Demonstration, robot: Any = None) -> Detection:
        """Find when it happens, and the confidence in that.

        Parameters
        ----------
        demonstration : Demonstration
            Of two time steps or more.
        robot : Kinematics, optional
            Where links are.

        Raises
        ------
        DataError
            If what the event is about is not there.
        """


@dataclass(frozen=True)
class SignalEvent(Detector):
    """Begin or end of the longest stretch in which signals are low, or high.

    Several signals, like the fingers of a hand, count as one
    (:func:`~tpgmm_torch.events.between_levels`). A stretch begins where the signal has come
    65 % of the way from one level to the other, and lasts until it is back at 35 %. Stretches
    that begin within the demonstration come first: a hand that is closed from the start has not
    closed.

    The confidence is the product of the contrast of both levels; of steepness, one less twice
    the time that the change takes, relative to the stretch; and of uniqueness, one less the
    second longest stretch over the longest.

    Parameters
    ----------
    signals : tuple of str
        Joints, or links of which the size of the force counts, by name or patterns with ``*``.
    edge : {"begin", "end"}
        Of the stretch.
    level : {"low", "high"}
        What the signals are in it. LeRobot's grippers are 0 when they are closed.

    Raises
    ------
    DataError
        If there are no signals, or edge or level are others.

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
        time = _time(demonstration)
        values = self._values(demonstration)
        share, contrast = between_levels(without_spikes(values, time))
        share = 1 - share if self.level == "low" else share
        chosen = self._choose_stretches(high_stretches(share, ON, 1 - ON), len(share))
        if not chosen:
            return NOTHING
        lengths = np.array([time[stop - 1] - time[start] for start, stop in chosen])
        longest = int(lengths.argmax())
        at, change = crossing_time(time, share, *chosen[longest], self.edge)
        steepness = max(0.0, 1 - 2 * change / max(lengths[longest], 1e-9))
        return Detection(at, float(contrast * steepness * _uniqueness(lengths, longest)))

    def _choose_stretches(self, stretches: Stretches, total: int) -> Stretches:
        """Choose stretches whose edge is seen, and if any is, whose begin is seen too."""
        begun = [(start, stop) for start, stop in stretches if start > 0]
        if self.edge == "begin":
            return begun
        ended = [(start, stop) for start, stop in stretches if stop < total]
        return [stretch for stretch in ended if stretch in begun] or ended

    def _values(self, demonstration: Demonstration) -> Array:
        """Return the joints, and the sizes of forces of the links, of these names."""
        forces = demonstration.wrenches
        names = (*(demonstration.joint_names or ()), *forces)
        sizes = [force[:, :3].norm(dim=1, keepdim=True) for force in forces.values()]
        unnamed = demonstration.joints[:, : 0 if demonstration.joint_names is None else None]
        values: Array = as_array(torch.cat((unnamed, *sizes), 1))
        return values[:, self._columns(names)]

    def _columns(self, names: Sequence[str]) -> list[int]:
        columns: set[int] = set()
        for pattern in self.signals:
            fits = {i for i, n in enumerate(names) if n == pattern or fnmatchcase(n, pattern)}
            if not fits:
                raise DataError(f"no signal is called {pattern!r}; there are {list(names)}")
            columns |= fits
        return sorted(columns)


@dataclass(frozen=True)
class ObjectMoves(Detector):
    """An object that lay still starts to move (:func:`~tpgmm_torch.events.move_start`).

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
        time, frame = _time(demonstration), demonstration.frame(self.frame)
        if not frame.batch_shape:
            once = "was recorded once: when it starts to move is not known"
            raise DataError(f"frame {self.frame!r} {once}")
        return Detection(*move_start(as_array(frame.position), time))


@dataclass(frozen=True)
class Stop(Detector):
    """A link comes to rest between two motions.

    It rests from where its speed falls below 10 % of its peak (98 % quantile) until it is above
    30 % again. The confidence is the product of contrast, one less its mean speed at rest over
    those 30 %; of uniqueness, unless ``number`` says which: one less the second longest rest
    over the longest; and of the way to the stop, in proportion below 2 cm.

    Parameters
    ----------
    link : str
        A link of the robot.
    number : int, optional
        Which of its stops, from 1; by default the longest.

    Raises
    ------
    DataError
        If the number is below 1.
    """

    link: str
    number: int | None = None

    def __post_init__(self) -> None:
        if self.number is not None and self.number < 1:
            raise DataError(f"stops are counted from 1, got {self.number}")

    def find(self, demonstration: Demonstration, robot: Any = None) -> Detection:
        """See :meth:`Detector.find`."""
        time = _time(demonstration)
        if robot is None:
            raise DataError(f"a stop of link {self.link!r} needs the robot")
        if self.link not in robot.links:
            raise UnknownNameError("link", self.link, "the robot", robot.links)
        state = robot.state(demonstration.reorder(robot.joint_names).joints)
        position = as_array(state.position(self.link))
        speed = smooth_speed(position, time, SMOOTHING)
        peak = float(np.quantile(speed, 0.98))
        rests = _find_rests(speed, peak)
        if len(rests) < (self.number or 1):
            return NOTHING
        lengths = np.array([time[stop - 1] - time[start] for start, stop in rests])
        chosen = int(lengths.argmax()) if self.number is None else self.number - 1
        start, stop = rests[chosen]
        contrast = max(0.0, 1 - float(speed[start:stop].mean()) / (MOTION * peak))
        way = float(np.linalg.norm(np.diff(position[: start + 1], axis=0), axis=1).sum())
        unique = _uniqueness(lengths, chosen) if self.number is None else 1.0
        return Detection(float(time[start]), contrast * unique * min(1.0, way / STILL))


def find_events(
    demonstrations: Iterable[Demonstration], events: Mapping[str, Detector], robot: Any = None
) -> list[Demonstration]:
    """Find events in demonstrations, and add them.

    Parameters
    ----------
    demonstrations : iterable of Demonstration
    events : mapping of str to Detector
        By the event's name; :func:`parse_event` makes them of text.
    robot : Kinematics, optional
        Where links are.

    Raises
    ------
    DataError
        If what a detector is about is not there.

    Warns
    -----
    PlausibilityWarning
        Once, with the demonstrations in which an event is found with a confidence below 0.2:
        it is left out.

    Examples
    --------
    >>> time = np.arange(100) / 10
    >>> opening = np.where((time > 3) & (time < 8), 0.0, 1.0)
    >>> shown = Demonstration(time, opening[:, None], joint_names=["gripper"])
    >>> [found] = find_events([shown], {"close": parse_event("closing:gripper")})
    >>> round(found.events["close"], 1)
    3.1
    """
    completed, doubtful = [], []
    for index, demonstration in enumerate(demonstrations):
        found = {name: d.find(demonstration, robot) for name, d in events.items()}
        sure = {name: at.time for name, at in found.items() if at.certain}
        doubtful += [(index, n, at.confidence) for n, at in found.items() if n not in sure]
        completed.append(replace(demonstration, events={**demonstration.events, **sure}))
    findings = doubtful_events(doubtful)
    Report.of(findings, f"{len(completed)} demonstrations").act(packages=(PACKAGE,))
    return completed


def doubtful_events(
    doubtful: Sequence[tuple[int, str, float]], among: str = "demonstration"
) -> list[Finding]:
    """Report events that were not found, all of one name together.

    Parameters
    ----------
    doubtful : sequence of (int, str, float)
        Index, event and confidence.
    among : str, default="demonstration"
        What the index is of.
    """
    findings = []
    for name in dict.fromkeys(name for _, name, _ in doubtful):
        where = {index: sure for index, other, sure in doubtful if other == name}
        low, high, there = min(where.values()), max(where.values()), ", ".join(map(str, where))
        message = (
            f"{name!r} is not found with confidence {LEAST_CONFIDENCE} in {among}s {there} "
            f"(there {low:.3f} to {high:.3f})"
        )
        remedy = "Leave them out, look for it in other signals, or say when it is"
        findings.append(Finding("events", message, remedy, (name,), tuple(where), low))
    return findings


def gripper_signals(names: Sequence[str], link: str | None = None) -> tuple[str, ...]:
    """Find the signals of a gripper, or of a hand's fingers, known by their names.

    Parameters
    ----------
    names : sequence of str
        Of all signals.
    link : str, optional
        If it has a side (``right_hand``, ``r_wrist``), only that side's.

    Raises
    ------
    DataError
        If no name fits, or names of both sides do.

    Examples
    --------
    >>> gripper_signals(["l_elbow.pos", "l_gripper.pos", "r_gripper.pos"], "right_hand")
    ('r_gripper.pos',)
    """
    columns = sorted(i for group in gripper_groups(names).values() for i in group)
    found = _select_side([names[i] for i in columns], link or "")
    if not found or {word for name in found for word in words(name)} >= SIDES:
        problem = f"{found} are of both hands" if found else "no signal is called a gripper's"
        raise DataError(
            f"{problem} (there are {list(names)}): say which it is, as in "
            "--event close=closing:SIGNAL, events={'close': 'closing:SIGNAL'}"
        )
    return tuple(found)


def _select_side(names: Sequence[str], link: str) -> Sequence[str]:
    """Select the names of a link's side, or where there are none, the names without a side."""
    if not (side := SIDES & {*words(link)}):
        return names
    same = [name for name in names if side & {*words(name)}]
    return same or [name for name in names if not SIDES & {*words(name)}]


def parse_event(text: str) -> Detector:
    """Make the detector that a text stands for.

    Parameters
    ----------
    text : str
        A kind, and behind a colon what it is about: ``closing:SIGNALS``,
        ``opening:SIGNALS``, ``contact:SIGNALS``, ``release:SIGNALS``, with names or patterns
        joined by commas; ``moving:FRAME``; ``stop:LINK`` or ``stop:LINK:NUMBER``.

    Raises
    ------
    DataError
        If it is no event; the message says what there is.

    Examples
    --------
    >>> parse_event("closing:right_gripper")
    SignalEvent(signals=('right_gripper',), edge='begin', level='low')
    >>> parse_event("stop:l_hand:2")
    Stop(link='l_hand', number=2)
    """
    kind, _, rest = map(str.strip, text.partition(":"))
    if kind in SIGNALS and rest:
        return SignalEvent(tuple(map(str.strip, rest.split(","))), *SIGNALS[kind])
    if kind == "moving" and rest:
        return ObjectMoves(rest)
    if kind == "stop" and rest:
        link, colon, number = rest.rpartition(":")
        if not colon:
            return Stop(rest)
        if link and number.isdecimal():
            return Stop(link, int(number))
    raise DataError(f"event {text!r} cannot be found. There are {GRAMMAR}")


def usual_event(event: str, link: str, names: Sequence[str]) -> Detector | None:
    """Make the detector of an event whose name says what it is: close, open or stop.

    Parameters
    ----------
    event : str
    link : str
        Whose gripper it is, or what stops.
    names : sequence of str
        Of all signals.

    Returns
    -------
    Detector or None
        None for events of other names.

    Raises
    ------
    DataError
        If no signal is known to be the gripper's.
    """
    if event in ("close", "open"):
        edge = "begin" if event == "close" else "end"
        return SignalEvent(gripper_signals(names, link), edge)
    return Stop(link) if event == "stop" else None


def _time(demonstration: Demonstration) -> Array:
    if len(demonstration) < 2:
        raise DataError("the demonstration has one time step: nothing happens in it")
    return as_array(demonstration.time)


def _find_rests(speed: Array, peak: float) -> Stretches:
    """Find from which row to which a link rests between two motions."""
    return [
        (start, stop)
        for start, stop in high_stretches(-speed, -REST * peak, -MOTION * peak)
        if peak > 0 and (speed[:start] > MOTION * peak).any() and stop < len(speed)
    ]


def _uniqueness(lengths: Array, chosen: int) -> float:
    """Return one less the second longest over the chosen of some ``lengths`` [s]."""
    if lengths[chosen] <= 0:
        return 0.0
    return max(0.0, 1 - float(np.delete(lengths, chosen).max(initial=0.0) / lengths[chosen]))
