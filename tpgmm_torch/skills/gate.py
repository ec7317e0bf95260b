"""Gates: times of a skill beyond which it does not go on until a condition is met."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from tpgmm_torch.data.holds import Hold

#: Conditions by name; ``contact:LINK`` is one too.
CONDITIONS = ("arrived", "held", "free")
CONTACT = "contact:"
#: Share of a fade in which a separate skill takes over: none while the gate is closed.
SWITCH = 0.01
#: The name of one, or a function of a :class:`~tpgmm_control.loop.gates.Moment`.
Condition = str | Callable[[Any], Any]


@dataclass(frozen=True)
class Gate:
    """A time of a skill beyond which it does not go on until conditions are met.

    Parameters
    ----------
    time : float
        In the skill [s].
    until : tuple of str or callable, default=()
        The conditions, all of which have to be met; none is always met.
    timeout : float, default=2.0
        How long they are waited for [s].
    retries : int, default=0
        How often the skill goes back when they are not met by then; after that it holds.
    back : float, default=0.0
        To which time of the skill it goes back [s].
    fade : float, default=0.0
        If a skill follows that was learned separately: how long it takes to its beginning,
        which counts with the objects where they are by now, those in a hand too [s].
    holds : tuple of (str, Hold), default=()
        Which objects the conditions ``held`` and ``free`` ask for, and the links.
    name : str, default=""
        Of the skill that ends here.
    """

    time: float
    until: tuple[Condition, ...] = ()
    timeout: float = 2.0
    retries: int = 0
    back: float = 0.0
    fade: float = 0.0
    holds: tuple[tuple[str, Hold], ...] = ()
    name: str = ""

    @property
    def onward(self) -> float:
        """Time from which the next skill takes over when the gate opens [s]."""
        return self.time + SWITCH * self.fade
