"""The tasks of the suite by their names."""

from __future__ import annotations

import functools

from lerobot_env_bimanual.suite.handover import Handover
from lerobot_env_bimanual.suite.lid import Lid
from lerobot_env_bimanual.suite.names import UPPER_BODY, tasks_of
from lerobot_env_bimanual.suite.peg_in_hole import PegInHole
from lerobot_env_bimanual.suite.pick_place import PickPlace, Shelf
from lerobot_env_bimanual.suite.pour import Pour
from lerobot_env_bimanual.suite.robots.embodiments import embodiment
from lerobot_env_bimanual.suite.task import SuiteTask
from lerobot_env_bimanual.suite.wipe import Wipe
from tpgmm_torch.exceptions import UnknownNameError

TASKS: dict[str, type[SuiteTask]] = {
    task.name: task for task in (Handover, Lid, PegInHole, Pour, Wipe, PickPlace, Shelf)
}


@functools.cache
def suite_task(name: str, robot: str = UPPER_BODY) -> SuiteTask:
    """Make a task by its name, and that of the robot that does it.

    Raises
    ------
    UnknownNameError
        If it does not exist, or the robot does not do it.
    DependencyError
        If the robot's description is in a package that is not installed.
    """
    body, known = embodiment(robot), tasks_of(robot)
    if name not in known:
        raise UnknownNameError("task", name, f"the suite of {robot!r}", known)
    return TASKS[name](body)
