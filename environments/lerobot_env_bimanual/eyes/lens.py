"""Pictures as real cameras take them: lens distortion, blur, noise, motion, compression.

An ideal picture of twice the resolution is drawn first, bent as the lens bends it, and averaged
over the area of each pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tpgmm_torch.exceptions import DataError
from tpgmm_vision.camera import Camera

Picture = NDArray[np.uint8]
#: Of a usual webcam: focal length and the principal point's distance from the middle as shares
#: of the width, and the distortion of its lens, k1 k2 p1 p2 k3.
FOCAL, OFF_CENTRE = 0.8656, (0.0047, -0.0031)
DISTORTION = (0.08, -0.15, 0.0006, -0.0004, 0.0)
#: How many pixels of the ideal picture are averaged into one along each side, and how much
#: wider than the real picture it is on each side, as a share, because the lens bends it.
OVERSAMPLING, MARGIN = 2, 0.08


def usual_camera(width: int = 640, height: int = 480) -> Camera:
    """Make a camera of 60 degrees with the lens of a usual webcam.

    Parameters
    ----------
    width, height : int
        Of its pictures [pixels].
    """
    (right, down), focal_length = OFF_CENTRE, FOCAL * width
    middle = (width - 1) / 2 + right * width, (height - 1) / 2 + down * width
    return Camera(width, height, (focal_length, focal_length), middle, DISTORTION)


class Lens:
    """Makes the picture of a camera from an ideal one.

    Parameters
    ----------
    camera : Camera

    Attributes
    ----------
    size : (int, int)
        Width and height of the ideal picture [pixels].
    fovy : float
        Its vertical field of view [deg].

    Raises
    ------
    DataError
        If the lens bends what is in its picture to beyond the ideal one.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera, n, sides = camera, OVERSAMPLING, (camera.width, camera.height)
        width, height = (round(n * side * (1 + 2 * MARGIN)) for side in sides)
        self.size = width, height
        focal_length = n * math.sqrt(camera.focal_length[0] * camera.focal_length[1])
        self.fovy = 2 * math.degrees(math.atan(height / 2 / focal_length))
        grid = np.meshgrid(*((np.arange(n * side) + 0.5) / n - 0.5 for side in sides))
        rays = camera.rays(np.stack(grid, axis=-1).reshape(-1, 2)).reshape(*grid[0].shape, 2)
        places = rays * focal_length + (np.array(self.size) - 1) / 2
        if places.min() < 0 or (places.max(axis=(0, 1)) > np.array(self.size) - 1).any():
            raise DataError(
                f"a lens with the distortion {camera.distortion} and the principal point "
                f"{camera.principal_point} cannot be drawn: it sees further than {MARGIN:.0%} "
                "beyond the picture of a camera without these"
            )
        x, y = np.moveaxis(places.astype(np.float32), -1, 0)
        self._maps = cv2.convertMaps(x, y, cv2.CV_16SC2)

    def __call__(self, ideal: Picture) -> Picture:
        """Bend an ideal picture of ``size`` and ``fovy``; shape (height, width, 3)."""
        x, y = self._maps
        bent = cv2.remap(ideal, x, y, cv2.INTER_LINEAR)
        size = self.camera.width, self.camera.height
        return np.asarray(cv2.resize(bent, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


@dataclass(frozen=True)
class Imperfections:
    """Imperfections of a camera's pictures.

    Parameters
    ----------
    blur : float, default=0.6
        Standard deviation of the blur of lens and sensor [pixels].
    noise : float, default=3
        Standard deviation of each value of each pixel [grey levels of 255].
    """

    blur: float = 0.6
    noise: float = 3.0

    def __call__(self, picture: Picture, rng: np.random.Generator) -> Picture:
        """Spoil a picture (height, width, 3)."""
        seen: Any = picture
        if self.blur:
            seen = cv2.GaussianBlur(seen, (0, 0), self.blur)
        if self.noise:
            noise = self.noise * rng.standard_normal(seen.shape, dtype=np.float32)
            seen = cv2.add(seen, noise, dtype=cv2.CV_8U)
        return np.asarray(seen, dtype=np.uint8)
