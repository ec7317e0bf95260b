"""Skills in a closed loop: measured, bounded, among people and obstacles.

The layer above :mod:`tpgmm_torch`, which never imports it.
"""

from importlib import import_module
from typing import TYPE_CHECKING

# loaded when it is first asked for, as in tpgmm_torch: a clock's text needs no PyTorch
if TYPE_CHECKING:
    from tpgmm_control.loop.clock import Clock
    from tpgmm_control.loop.command import Command, Status
    from tpgmm_control.loop.controller import Controller
    from tpgmm_control.loop.rollout import rollout

__all__ = ["Clock", "Command", "Controller", "Status", "rollout"]

_HOMES = {
    "Clock": "loop.clock",
    "Command": "loop.command",
    "Controller": "loop.controller",
    "Status": "loop.command",
    "rollout": "loop.rollout",
}


def __getattr__(name: str) -> object:
    """Load a public name when it is first asked for (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List public names, whether or not they are loaded yet."""
    return sorted({*globals(), *__all__})
