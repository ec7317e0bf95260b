"""LeRobot data sets in and out, and generated demonstrations.

Needs the extra ``data`` (pandas, pyarrow); LeRobot itself is never imported.
"""

from typing import TYPE_CHECKING

from tpgmm_torch.late import load_late

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
_load, __dir__ = load_late(globals(), _HOMES)


def __getattr__(name: str) -> object:
    """Load a public name when it is first asked for."""
    try:
        return _load(name)
    except ModuleNotFoundError as error:
        if error.name not in ("pandas", "pyarrow"):
            raise
        from tpgmm_torch.exceptions import DependencyError

        raise DependencyError(
            f"data sets need {error.name}: pip install 'tpgmm-torch[data]'"
        ) from None
