"""LeRobot data sets in and out, and generated demonstrations.

Needs the extra ``data`` (pandas, pyarrow); LeRobot itself is never imported.
"""

from importlib import import_module
from typing import TYPE_CHECKING

# what needs pandas and PyTorch is loaded when it is first asked for, so that the commands
# here are quick to look up
if TYPE_CHECKING:
    from tpgmm_datasets.checks.check import check
    from tpgmm_datasets.conversion.poses import FramePose, LinkPose
    from tpgmm_datasets.conversion.timing import resample, trim
    from tpgmm_datasets.description import DatasetInfo, describe_lerobot
    from tpgmm_datasets.episode_batches import EpisodeBatches
    from tpgmm_datasets.errors import CHECKS, DatasetError, DatasetWarning
    from tpgmm_datasets.motors import MotorMap, estimate_motor_map
    from tpgmm_datasets.reader import iter_lerobot, load_lerobot
    from tpgmm_datasets.units import Scale
    from tpgmm_datasets.writer import add_frames, save_lerobot
    from tpgmm_torch.training.outlying_demonstrations import drop_outliers

__all__ = [
    "CHECKS",
    "DatasetError",
    "DatasetInfo",
    "DatasetWarning",
    "EpisodeBatches",
    "FramePose",
    "LinkPose",
    "MotorMap",
    "Scale",
    "add_frames",
    "check",
    "describe_lerobot",
    "drop_outliers",
    "estimate_motor_map",
    "iter_lerobot",
    "load_lerobot",
    "resample",
    "save_lerobot",
    "trim",
]

_HOMES = {
    ".checks.check": ("check",),
    "tpgmm_torch.training.outlying_demonstrations": ("drop_outliers",),
    ".conversion.poses": ("FramePose", "LinkPose"),
    ".conversion.timing": ("resample", "trim"),
    ".description": ("DatasetInfo", "describe_lerobot"),
    ".episode_batches": ("EpisodeBatches",),
    ".errors": ("CHECKS", "DatasetError", "DatasetWarning"),
    ".motors": ("MotorMap", "estimate_motor_map"),
    ".reader": ("iter_lerobot", "load_lerobot"),
    ".units": ("Scale",),
    ".writer": ("add_frames", "save_lerobot"),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> object:
    """Load a public name when it is first asked for."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        module = import_module(_HOME[name], __name__)
    except ModuleNotFoundError as error:
        if error.name not in ("pandas", "pyarrow"):
            raise
        from tpgmm_torch.exceptions import DependencyError

        raise DependencyError(
            f"data sets need {error.name}: pip install 'tpgmm-torch[data]'"
        ) from None
    globals()[name] = getattr(module, name)
    return globals()[name]


def __dir__() -> list[str]:
    """List public names, whether or not they are loaded yet."""
    return sorted({*globals(), *__all__})
