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

__all__ = ["Imperfections", "Lens", "usual_camera"]

Picture = NDArray[np.uint8]
#: Of a usual webcam: focal length and the principal point's distance from the middle as shares
#: of the width, and the distortion of its lens, k1 k2 p1 p2 k3.
FOCAL, OFF_CENTRE = 0.8656, (0.0047, -0.0031)
DISTORTION = (0.08, -0.15, 0.0006, -0.0004, 0.0)
#: How many pixels of the ideal picture are averaged into one along each side, and how much
#: wider than the real picture it is on each side, as a share, because the lens bends it.
OVERSAMPLING, MARGIN = 2, 0.08


def usual_camera(width: int = 640, height: int = 480) -> Camera:
    """A camera of 60 degrees with the lens of a usual webcam.

    Parameters
    ----------
    width, height : int
        Of its pictures [pixels].
    """
    middle = [
        (n - 1) / 2 + off * width for n, off in zip((width, height), OFF_CENTRE, strict=True)
    ]
    focal_length = FOCAL * width
    return Camera(
        width, height, (focal_length, focal_length), (middle[0], middle[1]), DISTORTION
    )


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
        n, (fx, fy) = OVERSAMPLING, camera.focal_length
        self.camera = camera
        width, height = (
            round(n * one * (1 + 2 * MARGIN)) for one in (camera.width, camera.height)
        )
        self.size = width, height
        focal_length = n * math.sqrt(fx * fy)
        self.fovy = 2 * math.degrees(math.atan(height / 2 / focal_length))
        columns, rows = (
            (np.arange(n * one) + 0.5) / n - 0.5 for one in (camera.width, camera.height)
        )
        rays = camera.rays(np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2))
        x, y = (
            (rays[:, k] * focal_length + (side - 1) / 2).reshape(len(rows), -1)
            for k, side in enumerate(self.size)
        )
        if min(x.min(), y.min()) < 0 or x.max() > width - 1 or y.max() > height - 1:
            raise DataError(
                f"a camera with the distortion {camera.distortion}, the principal point "
                f"{camera.principal_point} and different focal lengths cannot be drawn: its "
                f"picture is more than {MARGIN:.0%} wider than one without these"
            )
        self._maps = cv2.convertMaps(x.astype(np.float32), y.astype(np.float32), cv2.CV_16SC2)

    def __call__(self, ideal: Picture) -> Picture:
        """The picture (height, width, 3) of an ideal one that has ``size`` and ``fovy``."""
        bent = cv2.remap(ideal, *self._maps, cv2.INTER_LINEAR)
        size = self.camera.width, self.camera.height
        return np.asarray(cv2.resize(bent, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


@dataclass(frozen=True)
class Imperfections:
    """What spoils the pictures of a camera.

    Parameters
    ----------
    blur : float, default=0.6
        Standard deviation of the blur of lens and sensor [pixels].
    noise : float, default=3
        Standard deviation of each value of each pixel [grey levels of 255].
    motion : float, default=0
        How far everything moves while the shutter is open, in a direction that is drawn
        [pixels].
    gain : float, default=1
        By what values are multiplied: below 1 in the dark.
    jpeg : int, optional
        Quality at which pictures are compressed, 1 to 100.
    """

    blur: float = 0.6
    noise: float = 3.0
    motion: float = 0.0
    gain: float = 1.0
    jpeg: int | None = None

    def __call__(self, picture: Picture, rng: np.random.Generator) -> Picture:
        """A picture (height, width, 3), spoiled."""
        seen: Any = picture
        if self.gain != 1:
            seen = cv2.convertScaleAbs(seen, alpha=self.gain)
        if self.motion:
            seen = cv2.filter2D(seen, -1, _streak(self.motion, rng.uniform(0, math.pi)))
        if self.blur:
            seen = cv2.GaussianBlur(seen, (0, 0), self.blur)
        if self.noise:
            drawn = rng.standard_normal(seen.shape, dtype=np.float32)
            np.multiply(drawn, self.noise, out=drawn)
            seen = cv2.add(seen, drawn, dtype=cv2.CV_8U)
        if self.jpeg is not None:
            quality = [cv2.IMWRITE_JPEG_QUALITY, self.jpeg]
            seen = cv2.imdecode(cv2.imencode(".jpg", seen, quality)[1], cv2.IMREAD_COLOR)
        return np.asarray(seen, dtype=np.uint8)


def _streak(length: float, angle: float) -> NDArray[np.float32]:
    """A kernel that spreads a point over a line [pixels, rad]."""
    half = math.ceil(length / 2) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    for along in np.linspace(-length / 2, length / 2, 8 * half + 1):
        x, y = half + along * math.cos(angle), half + along * math.sin(angle)
        column, row = math.floor(x), math.floor(y)
        right, down = x - column, y - row
        kernel[row : row + 2, column : column + 2] += np.outer(
            (1 - down, down), (1 - right, right)
        )
    return kernel / kernel.sum()
