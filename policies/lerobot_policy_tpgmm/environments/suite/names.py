"""The tasks of the suite and their objects, known without MuJoCo."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

__all__ = ["SUITE"]

#: What is observed in each task, in that order.
SUITE: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "handover": ("baton", "stand"),
        "lid": ("box",),
        "peg_in_hole": ("peg", "block"),
        "pour": ("cup", "jug"),
        "wipe": ("board",),
    }
)
