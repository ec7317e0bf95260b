"""The tasks of Meta-World, and how hard they are: needs no Meta-World."""

from __future__ import annotations

from tpgmm_torch.exceptions import UnknownNameError

#: Groups that publications report by (Seo et al., Masked World Models, CoRL 2022).
DIFFICULTIES: dict[str, tuple[str, ...]] = {
    "easy": (
        "button-press-topdown-v3", "button-press-topdown-wall-v3", "button-press-v3",
        "button-press-wall-v3", "coffee-button-v3", "dial-turn-v3", "door-close-v3",
        "door-lock-v3", "door-open-v3", "door-unlock-v3", "drawer-close-v3", "drawer-open-v3",
        "faucet-close-v3", "faucet-open-v3", "handle-press-side-v3", "handle-press-v3",
        "handle-pull-side-v3", "handle-pull-v3", "lever-pull-v3", "peg-unplug-side-v3",
        "plate-slide-back-side-v3", "plate-slide-back-v3", "plate-slide-side-v3",
        "plate-slide-v3", "reach-v3", "reach-wall-v3", "window-close-v3", "window-open-v3",
    ),
    "medium": (
        "basketball-v3", "bin-picking-v3", "box-close-v3", "coffee-pull-v3", "coffee-push-v3",
        "hammer-v3", "peg-insert-side-v3", "push-wall-v3", "soccer-v3", "sweep-into-v3",
        "sweep-v3",
    ),
    "hard": (
        "assembly-v3", "hand-insert-v3", "pick-out-of-hole-v3", "pick-place-v3", "push-back-v3",
        "push-v3",
    ),
    "very hard": (
        "disassemble-v3", "pick-place-wall-v3", "shelf-place-v3", "stick-pull-v3",
        "stick-push-v3",
    ),
}  # fmt: skip
#: All 50, in alphabetical order.
TASKS = tuple(sorted(name for names in DIFFICULTIES.values() for name in names))
#: Every second task: what is chosen is chosen on these, and the others are held out.
TUNED = TASKS[::2]


def check_task(name: str) -> str:
    """Check the name of a task, and return it.

    Raises
    ------
    UnknownNameError
        If Meta-World has no such task.
    """
    if name not in TASKS:
        raise UnknownNameError("task", name, "Meta-World", TASKS)
    return name


def difficulty(name: str) -> str:
    """Find the group of :data:`DIFFICULTIES` that the task of a name is in."""
    check_task(name)
    return next(group for group, names in DIFFICULTIES.items() if name in names)
