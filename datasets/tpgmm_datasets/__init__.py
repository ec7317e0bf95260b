"""LeRobot data sets in and out, and generated demonstrations.

Needs the extra ``data`` (pandas, pyarrow); LeRobot itself is never imported.
"""

from tpgmm_torch.exceptions import DependencyError

try:
    import pandas  # noqa: F401
    import pyarrow  # noqa: F401
except ModuleNotFoundError as error:
    raise DependencyError(
        f"data sets need {error.name}: pip install 'tpgmm-torch[data]'"
    ) from None

from tpgmm_datasets.conversion.poses import FramePose, LinkPose
from tpgmm_datasets.conversion.timing import resample, trim
from tpgmm_datasets.description import DatasetInfo, describe_lerobot
from tpgmm_datasets.episode_batches import EpisodeBatches
from tpgmm_datasets.errors import CHECKS, DatasetError, DatasetWarning
from tpgmm_datasets.reader import iter_lerobot, load_lerobot
from tpgmm_datasets.tables import demonstrations_from_frame, demonstrations_to_frame
from tpgmm_datasets.units import Scale
from tpgmm_datasets.writer import save_lerobot

__all__ = [
    "CHECKS",
    "DatasetError",
    "DatasetInfo",
    "DatasetWarning",
    "EpisodeBatches",
    "FramePose",
    "LinkPose",
    "Scale",
    "demonstrations_from_frame",
    "demonstrations_to_frame",
    "describe_lerobot",
    "iter_lerobot",
    "load_lerobot",
    "resample",
    "save_lerobot",
    "trim",
]
