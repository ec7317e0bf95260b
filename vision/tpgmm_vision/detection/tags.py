"""Tags in a picture: found by OpenCV, their corners refined by comparing the whole pattern.

OpenCV's own refinement of corners looks at each corner alone. Here the tag as it would be seen,
a homography of its pattern, blurred, is fitted to the grey values of all its pixels by
Gauss-Newton: all edges of the pattern count, and what is left tells how far to trust it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from tpgmm_torch.exceptions import DataError
from tpgmm_vision.poses import Array, Picture
from tpgmm_vision.targets import FAMILIES, modules_of

#: Pixels of the pattern on a side of a module, and white modules around its square.
TEXTURE, QUIET = 8, 1
#: What is compared reaches this far beyond the black square [modules].
MARGIN = 0.35
#: Blur of a picture: the variance that a fit begins with, the least and the most [pixels^2].
BLUR, LEAST_BLUR, MOST_BLUR = 0.5, 0.1, 6.0
#: Steps of Gauss-Newton, and a step of all corners that ends it [pixels].
STEPS, SMALL_STEP = 8, 0.02
#: A fit is refused that moves a corner further than this [share of an edge], explains less than
#: this share of the variance of the grey values, or leaves a corner less certain than this
#: [pixels].
FARTHEST, LEAST_EXPLAINED, MOST_UNCERTAIN = 0.2, 0.8, 0.3
#: A tag of fewer pixels is not fitted: there are 17 unknowns.
LEAST_PIXELS = 60
#: What noise does not explain: the lens, the print, the light [pixels].
MODEL_ERROR = 0.05

#: Grey values of a part of a picture.
Grey = NDArray[np.float32]
#: A part of a picture: left, top, right and bottom [pixels].
Box = tuple[int, int, int, int]
#: Corners (4, 2) and their covariance (8, 8).
Refined = tuple[Array, Array]


@dataclass(frozen=True)
class Detections:
    """Tags that were found in a picture.

    Parameters
    ----------
    corners : mapping of int to ndarray of shape (4, 2)
        By number: top left, top right, bottom right, bottom left [pixels].
    covariances : mapping of int to ndarray of shape (8, 8)
        Of the corners, x and y in turns [pixels^2].
    twice : frozenset of int
        Numbers that were found more than once, which are not among ``corners``.
    """

    corners: Mapping[int, Array] = field(default_factory=dict)
    covariances: Mapping[int, Array] = field(default_factory=dict)
    twice: frozenset[int] = frozenset()


def grey(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the grey values (height, width) of an RGB or grey picture.

    Raises
    ------
    DataError
        If it is no picture of 8 bits.
    """
    if picture.dtype != np.uint8 or picture.ndim not in (2, 3) or 0 in picture.shape:
        raise DataError(
            "a picture has shape (height, width, 3) or (height, width) and type uint8, got "
            f"{picture.shape}, {picture.dtype}"
        )
    return picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)


class TagDetector:
    """Finds the tags of a family in pictures.

    Parameters
    ----------
    family : str, default="apriltag_36h11"
        Of :data:`tpgmm_vision.targets.FAMILIES`.
    magnify : int, default=1
        How much pictures are magnified before tags are looked for: 2 finds tags of 12 pixels,
        in four times the time.
    """

    def __init__(self, family: str = "apriltag_36h11", magnify: int = 1) -> None:
        self._dictionary = cv2.aruco.getPredefinedDictionary(FAMILIES[family])
        self._modules, self._magnify = modules_of(family), magnify
        settings = cv2.aruco.DetectorParameters()
        settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
        settings.minMarkerPerimeterRate = 0.02
        settings.adaptiveThreshWinSizeMin, settings.adaptiveThreshWinSizeMax = 5, 25
        settings.adaptiveThreshWinSizeStep = 10
        self._detector = cv2.aruco.ArucoDetector(self._dictionary, settings)
        self._patterns: dict[int, Grey] = {}

    def __call__(self, picture: Picture, boxes: Sequence[Box] | None = None) -> Detections:
        """Find the tags in a picture.

        Parameters
        ----------
        picture : ndarray of uint8, shape (height, width, 3) or (height, width)
        boxes : sequence of (left, top, right, bottom), optional
            Where tags are looked for [pixels]; by default everywhere.
        """
        image = grey(picture)
        rough, twice = self._search(image, boxes)
        found = {n: self._refine(image, n, c) for n, c in rough.items() if n not in twice}
        good = {n: fit for n, fit in found.items() if fit is not None}
        corners, covariances = ({n: fit[k] for n, fit in good.items()} for k in (0, 1))
        return Detections(corners, covariances, frozenset(twice))

    def _search(
        self, image: Picture, boxes: Sequence[Box] | None
    ) -> tuple[dict[int, Array], set[int]]:
        """Search boxes for tags: their corners, and the numbers found in two places."""
        height, width = image.shape
        rough: dict[int, Array] = {}
        twice = set[int]()
        for left, top, right, bottom in [(0, 0, width, height)] if boxes is None else boxes:
            left, top = max(left, 0), max(top, 0)
            part = image[top:bottom, left:right]
            if min(part.shape, default=0) < self._modules:
                continue
            for number, corners in self._rough(part):
                corners += np.array([left, top])
                if number in rough and np.abs(rough[number] - corners).max() > 2:
                    twice.add(number)
                rough.setdefault(number, corners)
        return rough, twice

    def _rough(self, image: Picture) -> list[tuple[int, Array]]:
        """Numbers and corners as OpenCV finds them."""
        times = self._magnify
        if times > 1:
            image = cv2.resize(image, None, fx=times, fy=times, interpolation=cv2.INTER_CUBIC)
        squares, numbers, _ = self._detector.detectMarkers(image)
        if numbers is None:
            return []
        corners = [(one.reshape(4, 2).astype(float) + 0.5) / times - 0.5 for one in squares]
        return list(zip(map(int, numbers.ravel()), corners, strict=True))

    def _pattern(self, number: int) -> Grey:
        """Draw the tag and white around it, 0 to 1."""
        if number not in self._patterns:
            size = self._modules * TEXTURE
            drawn = cv2.aruco.generateImageMarker(self._dictionary, number, size)
            white = np.pad(drawn, QUIET * TEXTURE, constant_values=255)
            self._patterns[number] = np.asarray(white / 255, dtype=np.float32)
        return self._patterns[number]

    def _refine(self, image: Picture, number: int, corners: Array) -> Refined | None:
        """Corners and their covariance; None where the pattern does not fit."""
        size = float(np.linalg.norm(corners - np.roll(corners, -1, 0), axis=1).min())
        reach = 3 + 0.3 * size
        low = np.maximum(np.floor(corners.min(0) - reach).astype(int), 0)
        high = np.minimum(np.ceil(corners.max(0) + reach).astype(int) + 1, image.shape[::-1])
        patch = image[low[1] : high[1], low[0] : high[0]].astype(np.float32)
        if min(patch.shape) < self._modules:
            return None
        fit = _Fit(patch, self._pattern(number), self._modules)
        found = fit.run(corners - low)
        if found is None or np.abs(found[0] + low - corners).max() > max(FARTHEST * size, 1):
            return None
        return found[0] + low, found[1]


class _Fit:
    """A pattern fitted to the grey values of a patch."""

    def __init__(self, patch: Grey, pattern: Grey, modules: int) -> None:
        self.patch, self.pattern = patch, pattern
        edge = QUIET * TEXTURE
        low, high = edge - 0.5, edge + modules * TEXTURE - 0.5
        square = [[low, low], [high, low], [high, high], [low, high]]
        self.square = np.array(square, dtype=np.float32)
        self.outer = 1 + 2 * MARGIN / modules
        height, width = patch.shape
        self.centre = np.array([width - 1, height - 1]) / 2
        self.scale = max(width, height) / 2
        v, u = np.mgrid[:height, :width]
        self.blur = BLUR * np.eye(2)
        self.x, self.y = (u - self.centre[0]) / self.scale, (v - self.centre[1]) / self.scale

    def predict_pixels(self, corners: Array) -> Grey:
        """Predict how the pattern is seen with its corners there."""
        height, width = self.patch.shape
        fine = 3 if max(height, width) < 64 else 2 if max(height, width) < 200 else 1
        target = ((corners + 0.5) * fine - 0.5).astype(np.float32)
        homography = cv2.getPerspectiveTransform(self.square, target)
        seen = cv2.warpPerspective(
            self.pattern, homography, (width * fine, height * fine),
            flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        if fine > 1:
            seen = cv2.resize(seen, (width, height), interpolation=cv2.INTER_AREA)
        return np.asarray(cv2.filter2D(seen, -1, _gaussian(self.blur)))

    def run(self, corners: Array) -> Refined | None:
        """Gauss-Newton on a projective motion of the corners, on the blur and on the light."""
        middle, mask = corners.mean(0), np.zeros(self.patch.shape, np.uint8)
        outline = np.round(middle + self.outer * (corners - middle)).astype(np.int32)
        cv2.fillConvexPoly(mask, outline, 1)
        inside = mask > 0
        values, u, v = self.patch[inside], self.x[inside], self.y[inside]
        if len(values) < LEAST_PIXELS:
            return None
        for _ in range(STEPS):
            seen = self.predict_pixels(corners)
            # first and second derivatives along x and y
            orders = ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
            gx, gy, xx, xy, yy = (
                cv2.Sobel(seen, cv2.CV_32F, *order, scale=2.0 ** (sum(order) - 4))[inside]
                for order in orders
            )
            m = seen[inside]
            light = np.stack((m, m * u, m * v, np.ones_like(m), u, v))
            shades = np.linalg.solve(light @ light.T, light @ values)
            contrast = shades[0] + shades[1] * u + shades[2] * v
            gx, gy = -self.scale * gx * contrast, -self.scale * gy * contrast
            along = -(gx * u + gy * v)
            # a blur's covariance changes a picture by half its second derivatives
            bends = xx * contrast / 2, xy * contrast, yy * contrast / 2
            motions = gx * u, gx * v, gx, gy * u, gy * v, gy, along * u, along * v
            system = np.stack((*motions, *bends, *light))
            normal, residual = system @ system.T, values - shades @ light
            normal[np.diag_indices_from(normal)] *= 1 + 1e-9
            step = np.linalg.solve(normal, system @ residual)
            corners, moved = self._move_corners(corners, step[:8])
            self._update_blur(step[8:11])
            if moved < SMALL_STEP:
                break
        left = residual - step @ system
        noise = float(left @ left) / max(len(left) - len(system), 1)
        if contrast.min() <= 0 or noise > (1 - LEAST_EXPLAINED) * float(values.var()):
            return None
        covariance = np.linalg.pinv(normal, hermitian=True)[:8, :8] * noise
        rates = self._rates(corners)
        covariance = rates @ covariance @ rates.T + MODEL_ERROR**2 * np.eye(8)
        if float(np.diag(covariance).max()) > MOST_UNCERTAIN**2:
            return None
        return corners, covariance

    def _move_corners(self, corners: Array, step: Array) -> tuple[Array, float]:
        """Corners after a projective motion in coordinates of the patch, and the furthest."""
        motion = np.eye(3) + np.append(step, 0).reshape(3, 3)
        points = np.column_stack(((corners - self.centre) / self.scale, np.ones(4))) @ motion.T
        new = points[:, :2] / points[:, 2:] * self.scale + self.centre
        return new, float(np.abs(new - corners).max())

    def _update_blur(self, step: Array) -> None:
        """Change the blur, within what a picture may have."""
        values, axes = np.linalg.eigh(self.blur + step[[0, 1, 1, 2]].reshape(2, 2))
        self.blur = axes * np.clip(values, LEAST_BLUR, MOST_BLUR) @ axes.T

    def _rates(self, corners: Array) -> Array:
        """Compute the Jacobian of the corners by the motion (8, 8)."""
        (u, v), zero, one = ((corners - self.centre) / self.scale).T, np.zeros(4), np.ones(4)
        rows = np.empty((4, 2, 8))
        rows[:, 0] = np.stack((u, v, one, zero, zero, zero, -u * u, -u * v), axis=1)
        rows[:, 1] = np.stack((zero, zero, zero, u, v, one, -u * v, -v * v), axis=1)
        return self.scale * rows.reshape(8, 8)


def _gaussian(covariance: Array) -> Array:
    """Compute a kernel of that covariance [pixels^2]."""
    reach = int(np.ceil(3 * np.sqrt(float(np.diag(covariance).max()))))
    line = np.arange(-reach, reach + 1)
    (a, b), (_, c) = np.linalg.inv(covariance)
    across = b * line * line[:, None]
    kernel = np.exp(-0.5 * (a * line**2 + c * line[:, None] ** 2) - across)
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)
