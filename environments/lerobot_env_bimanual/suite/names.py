"""The tasks of the suite, their objects, and who does them, known without MuJoCo."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

#: Who does the tasks unless another is named.
UPPER_BODY = "upper_body"
#: How many joints each robot has.
ROBOTS: Mapping[str, int] = MappingProxyType({UPPER_BODY: 17, "viperx": 12, "g1": 17})

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
#: The same of tasks that are in no comparison.
MORE: Mapping[str, tuple[str, ...]] = MappingProxyType({"pick_place": ("baton", "stand")})
#: The same of tasks with an obstacle that experts know nothing of, placed for the upper body.
OBSTRUCTED: Mapping[str, tuple[str, ...]] = MappingProxyType({"shelf": ("baton", "stand")})


def tasks_of(robot: str) -> Mapping[str, tuple[str, ...]]:
    """Observed objects of each task that a robot does, by the names of the tasks."""
    return {**SUITE, **MORE, **(OBSTRUCTED if robot == UPPER_BODY else {})}
