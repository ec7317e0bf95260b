"""How the time of a running skill goes on, and for how long robots are waited for."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self

import numpy as np

from tpgmm_control.sensing.servo import Flags
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.exceptions import DataError

__all__ = ["Clock"]

KINDS = ("localizing", "waiting", "even")
INITIAL = ("beginning", "anywhere")


@dataclass(frozen=True)
class Clock:
    """How the time of a running skill goes on.

    Parameters
    ----------
    kind : {"localizing", "waiting", "even"}, default="localizing"
        ``"waiting"`` waits for robots that do not follow; ``"localizing"`` also goes to another
        time of the skill where a robot was put to a posture of it; ``"even"`` goes on whatever
        robots do.
    speed : float, default=1.0
        Seconds of the skill per second, for robots that follow.
    initial : {"beginning", "anywhere"}, default="beginning"
        Where in the skill robots start. With ``"anywhere"`` that is the earliest of the times
        that explain the start posture best; the beginning if none does, or if it explains it
        too and is not far from there.
    arrivals : tuple of float, default=()
        Times in the skill that are not passed before each joint has come to its reference [s]:
        for a gripper to close when the hand is there, not when it is time.
    wait_limit : float, default=inf
        How long a robot is waited for before it stops for good, with the status ``"stopped"``
        [s].

    Raises
    ------
    DataError
        If there is no such kind or beginning, the speed or the limit is not positive, or an
        arrival no number.

    Examples
    --------
    >>> Clock.parse("waiting:speed=0.5,arrivals=2/3.5")
    Clock(kind='waiting', speed=0.5, initial='beginning', arrivals=(2.0, 3.5))
    >>> str(Clock("even"))
    'even'
    """

    kind: str = "localizing"
    speed: float = 1.0
    initial: str = "beginning"
    arrivals: tuple[float, ...] = ()
    wait_limit: float = math.inf

    def __post_init__(self) -> None:
        for name, choices in (("kind", KINDS), ("initial", INITIAL)):
            if getattr(self, name) not in choices:
                raise DataError(
                    f"{name} of a clock is one of {list(choices)}, got {getattr(self, name)!r}"
                )
        try:
            speed, limit, *arrivals = map(float, (self.speed, self.wait_limit, *self.arrivals))
        except (TypeError, ValueError):
            speed, limit, arrivals = math.nan, math.nan, []
        if not (0 < speed < math.inf and limit > 0 and all(map(math.isfinite, arrivals))):
            raise DataError(
                "a clock has a positive speed, a positive wait_limit and arrivals in seconds, "
                f"got speed={self.speed!r}, wait_limit={self.wait_limit!r}, "
                f"arrivals={self.arrivals!r}"
            )
        object.__setattr__(self, "speed", speed)
        object.__setattr__(self, "wait_limit", limit)
        object.__setattr__(self, "arrivals", tuple(sorted(arrivals)))

    @classmethod
    def parse(cls, text: str | Self) -> Self:
        """A clock from text, for command lines and configuration files.

        Parameters
        ----------
        text : str or Clock
            A kind, with options behind a colon, separated by commas. A clock stands for itself.

        Raises
        ------
        DataError
            If there is no such clock or option, or its value is no number.
        """
        if isinstance(text, cls):
            return text
        kind, *options = re.split("[:,]", text) if isinstance(text, str) else [repr(text)]
        settings: dict[str, Any] = {"kind": kind.strip()}
        for option in options:
            name, value = map(str.strip, option.partition("=")[::2])
            if name in settings or name not in {one.name for one in fields(cls)}:
                raise DataError(
                    f"clock {text!r}: {name!r} is no option or given twice; there are speed, "
                    "initial, arrivals and wait_limit, each written as NAME=VALUE"
                )
            settings[name] = value.split("/") if name == "arrivals" else value
        return cls(**settings)

    def __str__(self) -> str:
        """The inverse of :meth:`parse`; defaults are left out."""
        options = []
        for one in fields(self)[1:]:
            value = getattr(self, one.name)
            if value != one.default:
                several = value if isinstance(value, tuple) else (value,)
                texts = (str(each).removesuffix(".0") for each in several)
                options.append(f"{one.name}={'/'.join(texts)}")
        return ":".join([self.kind, ",".join(options)] if options else [self.kind])


@dataclass(frozen=True, eq=False)
class Patience:
    """How long B robots have been waited for; immutable.

    Parameters
    ----------
    limit : float
        How long a robot is waited for before it stops for good [s].
    waited : array of shape (B,)
        For how long that has been, without a break [s].
    stopped : mapping of int to str
        Robots that have stopped, and why.
    """

    limit: float
    waited: Array
    stopped: Mapping[int, str] = field(default_factory=dict)

    @property
    def stands(self) -> Flags:
        """Robots that have stopped (B,)."""
        stands: Flags = np.zeros(len(self.waited), bool)
        stands[list(self.stopped)] = True
        return stands

    def advance(self, waits: Flags, passed: Array, reasons: Mapping[int, str]) -> Self:
        """Count how long robots are waited for, and stop those that have been too long.

        Parameters
        ----------
        waits : bool array of shape (B,)
            Robots that are waited for at this tick.
        passed : array of shape (B,)
            Duration of the tick [s].
        reasons : mapping of int to str
            Why, by robot.
        """
        waited, stopped = np.where(waits, self.waited + passed, 0.0), dict(self.stopped)
        for row in np.flatnonzero(waited >= self.limit).tolist():
            why = reasons.get(row, "")
            stopped.setdefault(row, f"stopped for good after {self.limit:g} s: {why}")
        return replace(self, waited=waited, stopped=stopped)

    def announce(self, reasons: Mapping[int, str]) -> dict[int, str]:
        """Add when robots will stop to the reasons why they are waited for."""
        left = self.limit - self.waited
        return {
            row: self.stopped.get(row, f"{text}; stops for good in {left[row]:.1f} s")
            for row, text in reasons.items()
        } | dict(self.stopped)
