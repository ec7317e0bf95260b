from dataclasses import dataclass
from pathlib import Path

from lerobot.robots import RobotConfig


@RobotConfig.register_subclass("bimanual")
@dataclass(kw_only=True)
class BimanualConfig(RobotConfig):
    """``start`` holds what is observed by name, ``log`` will hold the actions.

    After ``stuck_after`` actions it stands. Its camera ``front`` always sees the same
    ``picture``, a file of numpy's.
    """

    start: Path
    log: Path
    stuck_after: int = 10**6
    picture: Path | None = None
