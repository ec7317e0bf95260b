"""From when to when which link of the robot holds which object."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace
from typing import Any, Self

from tpgmm_torch.exceptions import DataError, UnknownNameError

__all__ = ["Hold"]

NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
TEXT = re.compile(
    r"(?P<frame>[^\s:@+]+)@(?P<link>[^\s:@+]+)"
    rf"(?::(?P<begin>{NUMBER})?-(?P<end>{NUMBER})?)?"
)


@dataclass(frozen=True)
class Hold:
    """A link holds an object: its frame moves with the joints meanwhile.

    Parameters
    ----------
    frame : str
        Name of the object's frame.
    link : str
        Name of the link that carries it. Where two hands hold an object, one of them is the
        holder, and the other keeps its pose relative to the object (the closed chain).
    begin, end : float
        From when to when [s], in the time of the skill; by default from its beginning to its
        end, and beyond.

    Raises
    ------
    DataError
        If a name is not text, a time is not finite, or the end is not after the beginning.

    Examples
    --------
    >>> Hold.parse("bottle@l_hand:4.3-")
    Hold(frame='bottle', link='l_hand', begin=4.3, end=inf)
    >>> str(Hold("cup", "r_hand", 1.5, 6.0))
    'cup@r_hand:1.5-6.0'
    """

    frame: str
    link: str
    begin: float = -math.inf
    end: float = math.inf

    def __post_init__(self) -> None:
        for name, value in (("frame", self.frame), ("link", self.link)):
            if not isinstance(value, str) or not value:
                raise DataError(f"the {name} of a hold is a name, got {value!r}")
        if self.frame == self.link:
            raise DataError(
                f"{self.frame!r} cannot hold itself: a hold is of a frame by a link"
            )
        for name in ("begin", "end"):
            try:
                object.__setattr__(self, name, float(getattr(self, name)))
            except (TypeError, ValueError):
                object.__setattr__(self, name, math.nan)
            if math.isnan(getattr(self, name)):
                raise DataError(f"the {name} of {self._names} is a number of seconds")
        if not self.begin < self.end:
            raise DataError(
                f"{self._names} is held from {self.begin:g} to {self.end:g} s: the end must be "
                "after the beginning"
            )

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse a text, ``FRAME@LINK:BEGIN-END``.

        Parameters
        ----------
        text : str
            Without begin, end, or both, it is held from the beginning or to the end of the
            skill: ``bottle@l_hand:4.3-``, ``bottle@l_hand``.

        Raises
        ------
        DataError
            If it is no such text.
        """
        match = TEXT.fullmatch(text.strip())
        if match is None:
            raise DataError(
                f"hold {text!r} is not of the form FRAME@LINK:BEGIN-END, as in "
                "'bottle@l_hand:4.3-9.1' or, to the end of the skill, 'bottle@l_hand:4.3-'"
            )
        begin, end = match["begin"] or -math.inf, match["end"] or math.inf
        return cls(match["frame"], match["link"], float(begin), float(end))

    def __str__(self) -> str:
        begin, end = ("" if math.isinf(at) else repr(at) for at in (self.begin, self.end))
        return f"{self._names}:{begin}-{end}" if begin or end else self._names

    def retime(self, clock: Callable[[float], float]) -> Self:
        """Put the hold on another clock.

        Parameters
        ----------
        clock : callable
            Gives the new time of an instant [s]; strictly increasing. Open ends stay open.
        """
        begin, end = (at if math.isinf(at) else clock(at) for at in (self.begin, self.end))
        return replace(self, begin=begin, end=end)

    @property
    def _names(self) -> str:
        return f"{self.frame}@{self.link}"


def check_holds(
    holds: Iterable[Any], frames: Collection[str], links: Collection[str] | None = None
) -> tuple[Hold, ...]:
    """Check that holds are possible, and sort them by their beginnings.

    Parameters
    ----------
    holds : iterable of Hold
        What links hold, in any order.
    frames : collection of str
        The objects that there are.
    links : collection of str
        The links of the robot.

    Raises
    ------
    UnknownNameError
        If there is no such frame or link.
    DataError
        If something is no hold, or an object is held by two links at once.
    """
    checked = tuple(holds)
    for hold in checked:
        if not isinstance(hold, Hold):
            raise DataError(
                f"holds are Hold objects, got {hold!r}: Hold(frame, link, begin, end), or "
                "Hold.parse('bottle@l_hand:4.3-')"
            )
        where = f"the demonstration (hold {hold})"
        if hold.frame not in frames:
            raise UnknownNameError("frame", hold.frame, where, frames)
        if links is not None and hold.link not in links:
            raise UnknownNameError("link", hold.link, f"the robot (hold {hold})", links)
    checked = tuple(sorted(checked, key=lambda hold: (hold.begin, hold.end)))
    last: dict[str, Hold] = {}
    for hold in checked:
        before = last.setdefault(hold.frame, hold)
        if before is not hold and hold.begin < before.end:
            raise DataError(
                f"{hold.frame!r} is held twice at once, {before} and {hold}: one link is the "
                "holder; the other hand keeps its pose relative to the object by an "
                "operator with held=True"
            )
        last[hold.frame] = hold
    return checked
