"""A camera: how points before it become pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from tpgmm_torch.exceptions import DataError
from tpgmm_vision.poses import Array

__all__ = ["Camera"]

#: Undistortion ends after so many steps, or where a ray moves less.
ENDS = cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 1e-10


@dataclass(frozen=True)
class Camera:
    """Intrinsics of a camera in OpenCV's model: a pinhole with a distorting lens.

    The camera looks along z; x points to the right of the picture, y down. The middle of the
    first pixel is (0, 0).

    Parameters
    ----------
    width, height : int
        Of its pictures [pixels].
    focal_length, principal_point : (float, float)
        [pixels]
    distortion : tuple of float, default=(0, 0, 0, 0, 0)
        ``k1 k2 p1 p2 k3``.

    Raises
    ------
    DataError
        If these are not a camera's.
    """

    width: int
    height: int
    focal_length: tuple[float, float]
    principal_point: tuple[float, float]
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        counts = {"focal_length": 2, "principal_point": 2, "distortion": 5}
        for name, n in counts.items():
            values = np.asarray(getattr(self, name), dtype=float)
            if values.shape != (n,) or not np.isfinite(values).all():
                raise DataError(f"{name} of a camera is {n} finite numbers, got {values}")
            object.__setattr__(self, name, tuple(values.tolist()))
        if min(self.width, self.height) < 1 or min(self.focal_length) <= 0:
            raise DataError(f"a camera has sizes and focal lengths above 0, got {self}")

    @property
    def matrix(self) -> Array:
        """OpenCV's camera matrix (3, 3)."""
        (fx, fy), (cx, cy) = self.focal_length, self.principal_point
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])

    def project(self, points: ArrayLike) -> Array:
        """Pixels (n, 2) of points (n, 3) in the camera's frame [m]."""
        return self.project_with_rates(points)[0]

    def project_with_rates(self, points: ArrayLike) -> tuple[Array, Array]:
        """Pixels (n, 2) of points (n, 3), and how they move with the points (n, 2, 3)."""
        zero, points = np.zeros(3), np.asarray(points, dtype=float).reshape(-1, 1, 3)
        lens = np.array(self.distortion)
        pixels, rates = cv2.projectPoints(points, zero, zero, self.matrix, lens)
        moved = rates[:, 3:6].reshape(-1, 2, 3)
        return np.asarray(pixels.reshape(-1, 2), dtype=float), np.asarray(moved, dtype=float)

    def rays(self, pixels: ArrayLike) -> Array:
        """Intersect the rays of pixels (n, 2) with the plane z = 1: x and y (n, 2)."""
        points = np.asarray(pixels, dtype=float).reshape(-1, 1, 2)
        lens = self.matrix, np.array(self.distortion)
        found = cv2.undistortPointsIter(points, *lens, None, None, ENDS)
        return np.asarray(found.reshape(-1, 2), dtype=float)

    def check(self, picture: Any, name: str) -> None:
        """Refuse a picture of another size.

        Raises
        ------
        DataError
        """
        if picture.shape[:2] != (self.height, self.width):
            raise DataError(
                f"camera {name!r} was calibrated for {self.width} x {self.height} pixels, got "
                f"{picture.shape[1]} x {picture.shape[0]}: calibrate it again, or change it"
            )
