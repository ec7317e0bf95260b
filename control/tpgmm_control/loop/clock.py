"""How the time of a running skill goes on, as an object and as text."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, fields
from typing import Any, Self

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
            if name in settings or name not in {field.name for field in fields(cls)}:
                raise DataError(
                    f"clock {text!r}: {name!r} is no option or given twice; there are speed, "
                    "initial, arrivals and wait_limit, each written as NAME=VALUE"
                )
            settings[name] = value.split("/") if name == "arrivals" else value
        return cls(**settings)

    def __str__(self) -> str:
        """The inverse of :meth:`parse`; defaults are left out."""
        options = []
        for field in fields(self)[1:]:
            value = getattr(self, field.name)
            if value != field.default:
                several = value if isinstance(value, tuple) else (value,)
                texts = (str(one).removesuffix(".0") for one in several)
                options.append(f"{field.name}={'/'.join(texts)}")
        return ":".join([self.kind, ",".join(options)] if options else [self.kind])
