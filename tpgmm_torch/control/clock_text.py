"""Clocks as text, for command lines and configuration files."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from tpgmm_torch.control.clocks import Clock, EvenClock, WaitingClock
from tpgmm_torch.control.localizing_clock import LocalizingClock
from tpgmm_torch.exceptions import DataError

__all__ = ["format_clock", "parse_clock"]

CLOCKS: Mapping[str, type[EvenClock] | type[WaitingClock]] = {
    "even": EvenClock,
    "waiting": WaitingClock,
    "localizing": LocalizingClock,
}


def parse_clock(text: str | Clock) -> Clock:
    """A clock from text.

    Parameters
    ----------
    text : str or Clock
        A kind, ``even``, ``waiting`` or ``localizing``; with options
        behind a colon, separated by commas. A clock stands for itself.

    Raises
    ------
    DataError
        If there is no such clock or option, or its value is no number; the message lists what
        exists.

    Examples
    --------
    >>> parse_clock("even")
    EvenClock(speed=1.0)
    >>> parse_clock("waiting:tolerance=3,lag=0.05").lag
    0.05
    """
    if isinstance(text, Clock):
        return text
    if not isinstance(text, str):
        raise DataError(
            f"a clock is one of {list(CLOCKS)}, as text or as an object, got {text!r}"
        )
    kind, *options = re.split("[:,]", text)
    clock = CLOCKS.get(kind.strip())
    if clock is None:
        raise DataError(
            f"clock {text!r}: there is no {kind.strip()!r}; there are {list(CLOCKS)}, each "
            "with options behind a colon, as in 'waiting:tolerance=3,lag=0.05'"
        )
    known = {field.name: field.default for field in fields(clock)}
    settings: dict[str, Any] = {}
    for option in options:
        name, value = map(str.strip, option.partition("=")[::2])
        if name not in known or name in settings:
            problem = "is given twice" if name in settings else "is no option"
            raise DataError(
                f"clock {text!r}: {name!r} {problem}; {kind.strip()!r} has {list(known)}, each "
                "written as NAME=VALUE"
            )
        settings[name] = _value(text, name, value, known[name])
    return clock(**settings)


def _value(text: str, name: str, value: str, default: Any) -> Any:
    """An option in the type of its default."""
    if isinstance(default, str):
        return value
    several = isinstance(default, tuple)
    try:
        return tuple(map(float, value.split("/"))) if several else float(value)
    except ValueError:
        form = "numbers joined by '/'" if several else "a number"
        raise DataError(f"clock {text!r}: {name} takes {form}, got {value!r}") from None


def format_clock(clock: Clock) -> str:
    """The inverse of :func:`parse_clock`; defaults are left out.

    Parameters
    ----------
    clock : Clock
        A user's own is given by its ``repr``.

    Examples
    --------
    >>> format_clock(WaitingClock(tolerance=3))
    'waiting:tolerance=3'
    """
    for kind, known in CLOCKS.items():
        if type(clock) is known:
            changed = [
                f"{field.name}={_text(value)}"
                for field in fields(known)
                if (value := getattr(clock, field.name)) != field.default
            ]
            return ":".join([kind, ",".join(changed)] if changed else [kind])
    return repr(clock)


def _text(value: Any) -> str:
    return (
        "/".join(map(_text, value))
        if isinstance(value, tuple)
        else str(value).removesuffix(".0")
    )
