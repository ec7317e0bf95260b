"""Skills in a closed loop: measured, bounded, among people and obstacles.

The layer above :mod:`tpgmm_torch`, which never imports it.
"""

from typing import TYPE_CHECKING

from tpgmm_torch.late import load_late

# loaded when it is first asked for, as in tpgmm_torch: a clock's text needs no PyTorch
if TYPE_CHECKING:
    from tpgmm_control.loop.clock import Clock
    from tpgmm_control.loop.command import Command, Status
    from tpgmm_control.loop.controller import Controller
    from tpgmm_control.loop.rollout import rollout

__all__ = ["Clock", "Command", "Controller", "Status", "rollout"]

__getattr__, __dir__ = load_late(
    globals(),
    {
        ".loop.clock": ("Clock",),
        ".loop.command": ("Command", "Status"),
        ".loop.controller": ("Controller",),
        ".loop.rollout": ("rollout",),
    },
)
