"""Detectors of events written as short text, for command lines and configurations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from tpgmm_torch.events.detection import Detector
from tpgmm_torch.events.movement import ObjectMoves, Stop
from tpgmm_torch.events.signals import SignalEvent, gripper_signals
from tpgmm_torch.exceptions import DataError

__all__ = ["GRAMMAR", "parse_event", "usual_event"]

#: Edge and level of the events of signals.
SIGNALS = {
    "closing": ("begin", "low"),
    "opening": ("end", "low"),
    "contact": ("begin", "high"),
    "release": ("end", "high"),
}
#: Which kinds of detectors there are, and what follows the colon.
GRAMMAR = (
    "closing:SIGNALS and opening:SIGNALS (begin and end of the longest time that a gripper is "
    "low), contact:SIGNALS and release:SIGNALS (of the longest time that a force is high; also "
    "of grippers that are high when closed), each with names or patterns joined by commas; "
    "moving:FRAME (an object starts to move); stop:LINK, stop:LINK:2 (a link comes to rest: "
    "the longest time, the second time)"
)
#: Events that need no text: their names say what they are.
USUAL: Mapping[str, Callable[[str, Sequence[str]], Detector]] = {
    "close": lambda link, names: SignalEvent(gripper_signals(names, link)),
    "open": lambda link, names: SignalEvent(gripper_signals(names, link), "end"),
    "stop": lambda link, names: Stop(link),
}


def parse_event(text: str) -> Detector:
    """The detector that a text stands for.

    Parameters
    ----------
    text : str
        A kind, and behind a colon what is looked at: ``closing:SIGNALS``,
        ``opening:SIGNALS``, ``contact:SIGNALS``, ``release:SIGNALS``, with names or patterns
        joined by commas; ``moving:FRAME``; ``stop:LINK`` or ``stop:LINK:NUMBER``.

    Raises
    ------
    DataError
        If it is none of these; the message says what there is.

    Examples
    --------
    >>> parse_event("closing:right_gripper")
    SignalEvent(signals=('right_gripper',), edge='begin', level='low')
    >>> parse_event("stop:l_hand:2")
    Stop(link='l_hand', number=2)
    """
    kind, _, rest = (part.strip() for part in text.partition(":"))
    if kind in SIGNALS and rest:
        return SignalEvent(tuple(n.strip() for n in rest.split(",")), *SIGNALS[kind])
    if kind == "moving" and rest:
        return ObjectMoves(rest)
    if kind == "stop" and rest:
        link, colon, number = rest.rpartition(":")
        if not colon:
            return Stop(rest)
        if link and number.isdecimal():
            return Stop(link, int(number))
    raise DataError(f"event {text!r} is none that can be found. There are {GRAMMAR}")


def usual_event(event: str, link: str, names: Sequence[str]) -> Detector | None:
    """The detector of an event whose name says what it is: close, open or stop.

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
    return USUAL[event](link, names) if event in USUAL else None
