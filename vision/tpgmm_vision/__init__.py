"""Poses of objects from cameras: printed tags, calibration by the robot itself, tracking."""

from tpgmm_torch.exceptions import DependencyError

try:
    import cv2 as _  # noqa: F401
except ImportError as error:
    raise DependencyError(
        "poses from cameras need OpenCV: pip install 'tpgmm-torch[vision]'"
    ) from error
