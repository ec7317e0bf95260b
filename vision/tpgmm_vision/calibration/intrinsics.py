"""Intrinsics of a camera from pictures of a ChArUco board."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from tpgmm_torch.exceptions import DataError
from tpgmm_vision.camera import Camera
from tpgmm_vision.detection.tags import grey
from tpgmm_vision.poses import Array, Picture
from tpgmm_vision.targets import Board

__all__ = ["calibrate_camera"]

#: Pictures at least, corners in each at least, and parts left out in turns.
LEAST_PICTURES, LEAST_CORNERS, FOLDS = 8, 8, 4
#: The picture is divided into so many fields to a side, of which so many must have corners.
FIELDS, LEAST_COVERED = 4, 12
#: Sides from which the board is seen differ at least by this, root mean square [rad]: seen from
#: one side, a longer focal length looks like a greater distance.
LEAST_TILT = np.radians(8.0)
#: Standard deviation of the focal length at most, as a share.
MOST_UNCERTAIN = 0.005
#: k3 is free if it lowers the error on pictures left out to this share.
HELPS = 0.98
#: A picture this many times worse than the median does not count.
BLURRED = 3.0
#: The same in both directions up to this, focal lengths are those of square pixels.
SQUARE = 0.005

#: Half a window in which a corner is refined, as a share of its distance to the next tag.
WINDOW = 0.9
ENDS = cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 1e-6

Views = Mapping[str, tuple[Array, Array]]


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """Intrinsics, and how well they explain pictures that they were not fitted to.

    Parameters
    ----------
    camera : Camera
    pixel_error : float
        Of corners in pictures left out, root mean square [pixels].
    pictures : tuple of str
        Those that count.
    problems : tuple of str
        What is doubtful, and its remedy.
    """

    camera: Camera
    pixel_error: float
    pictures: tuple[str, ...]
    problems: tuple[str, ...]

    def __str__(self) -> str:
        fx, fy = self.camera.focal_length
        return (
            f"focal length {fx:.1f}, {fy:.1f} pixels, from {len(self.pictures)} pictures; on "
            f"others {self.pixel_error:.2f} pixels off, {1e3 * self.pixel_error / fx:.2f} mm/m"
        )


def calibrate_camera(pictures: Mapping[str, Picture], board: Board) -> CameraCalibration:
    """Estimate the intrinsics of a camera.

    Parameters
    ----------
    pictures : mapping of str to ndarray of uint8, shape (height, width, 3) or (height, width)
        By name.
    board : Board
        Its size does not matter, its shape does.

    Raises
    ------
    DataError
        If pictures do not tell the intrinsics; the message says what is missing.
    """
    sizes = {name: picture.shape[1::-1] for name, picture in pictures.items()}
    if len(set(sizes.values())) > 1:
        raise DataError(f"pictures of one camera have one size [pixels], got {sizes}")
    views, without = _views(pictures, board)
    if len(views) < LEAST_PICTURES:
        raise DataError(
            f"{len(views)} of {len(pictures)} pictures show the board, {LEAST_PICTURES} are "
            f"needed, 20 are good; it is missing in {without}: are columns, rows and family "
            "those of the print, and is it flat, whole, sharp and lit evenly?"
        )
    size = next(iter(sizes.values()))
    _check_covered(views, size)
    fixed = cv2.CALIB_FIX_K3
    views, blurred = _drop_blurred(views, size, fixed)
    errors = {flags: _left_out(views, size, flags) for flags in (fixed, 0)}
    flags = 0 if errors[0] < HELPS * errors[fixed] else fixed
    camera, _, turns, uncertain = _fit_camera(views, size, flags)
    _check_tilt(turns, uncertain)
    skipped = f"no board in {without}, a blurred one in {blurred}: they do not count"
    problems = [skipped] if without or blurred else []
    fx, fy = camera.focal_length
    if abs(fx / fy - 1) > SQUARE:
        problems.append(f"focal lengths {fx:.1f} and {fy:.1f} differ: is the print stretched? "
                        "Measure both of its edges with a ruler")  # fmt: skip
    return CameraCalibration(camera, errors[flags], tuple(views), tuple(problems))


def _views(pictures: Mapping[str, Picture], board: Board) -> tuple[Views, list[str]]:
    """Points of the board and their pixels in pictures that show it, and the others."""
    drawn = board.drawn
    detector, found, without = cv2.aruco.CharucoDetector(drawn), {}, list[str]()
    share = WINDOW * (board.square - board.marker) / 2 / board.square
    for name, picture in pictures.items():
        image = grey(picture)
        corners, numbers, _, _ = detector.detectBoard(image)
        if numbers is None or len(numbers) < LEAST_CORNERS:
            without.append(name)
            continue
        points, _ = drawn.matchImagePoints(corners, numbers)
        between = np.linalg.norm(corners - corners[:, 0][:, None].swapaxes(0, 1), axis=-1)
        window = int(np.clip(between[between > 0].min() * share, 2, 10))
        # OpenCV's board corners lie half a pixel to the right and below
        start = np.ascontiguousarray(corners - np.float32(0.5))
        pixels = cv2.cornerSubPix(image, start, (window, window), (-1, -1), ENDS)
        found[name] = points.reshape(-1, 3), pixels.reshape(-1, 2)
    return found, without


def _check_covered(views: Views, size: Sequence[int]) -> None:
    """Refuse corners that leave parts of the picture to extrapolation."""
    pixels = np.concatenate([pixels for _, pixels in views.values()])
    fields = np.minimum(pixels / size * FIELDS, FIELDS - 1).astype(int).clip(0)
    covered = len(np.unique(fields, axis=0))
    if covered < LEAST_COVERED:
        raise DataError(
            f"the board was seen in {covered} of the picture's {FIELDS} x {FIELDS} fields, "
            f"{LEAST_COVERED} are needed: take pictures of it near the edges and corners"
        )


def _drop_blurred(views: Views, size: Sequence[int], flags: int) -> tuple[Views, list[str]]:
    """Drop pictures that a camera explains far worse than the others; return their names."""
    errors = _fit_camera(views, size, flags)[1]
    limit = BLURRED * np.median([*errors.values()])
    blurred = [name for name, error in errors.items() if error > limit]
    return {name: view for name, view in views.items() if name not in blurred}, blurred


def _check_tilt(turns: Array, uncertain: float) -> None:
    """Refuse rotations of the board that do not tell the focal length."""
    sides = Rotation.from_rotvec(turns).as_matrix()[:, :, 2]
    tilt = float(np.sqrt(sides.var(axis=0).sum()))
    if tilt < LEAST_TILT or uncertain > MOST_UNCERTAIN:
        raise DataError(
            f"the pictures do not tell the focal length (to {100 * uncertain:.1f} %): the "
            f"board is seen from sides that differ by {np.degrees(tilt):.0f} deg only; tilt it "
            "by 30 deg and more to the left, to the right, up and down"
        )


def _fit_camera(
    views: Views, size: Sequence[int], flags: int
) -> tuple[Camera, dict[str, float], Array, float]:
    """Camera, error of each picture [pixels], rotations, and the share of f that is unsure."""
    points, pixels = ([part[k] for part in views.values()] for k in (0, 1))
    fit: Any = cv2.calibrateCameraExtended
    found = fit(points, pixels, size, None, None, flags=flags, criteria=ENDS)
    _, matrix, lens, turns, _, spread, _, errors = found
    lengths, centre = np.diag(matrix)[:2], matrix[:2, 2]
    camera = Camera(size[0], size[1], tuple(lengths), tuple(centre), tuple(lens.ravel()[:5]))
    uncertain = float((spread.ravel()[:2] / lengths).max())
    per_picture = dict(zip(views, errors.ravel().tolist(), strict=True))
    return camera, per_picture, np.array(turns).reshape(-1, 3), uncertain


def _left_out(views: Views, size: Sequence[int], flags: int) -> float:
    """Root mean square error of pictures that a camera was not fitted to [pixels]."""
    squares, names = list[Array](), list(views)
    for fold in range(FOLDS):
        kept = {n: views[n] for k, n in enumerate(names) if k % FOLDS != fold}
        camera, *_ = _fit_camera(kept, size, flags)
        for name in names[fold::FOLDS]:
            points, pixels = views[name]
            lens = camera.matrix, np.array(camera.distortion)
            _, turn, place = cv2.solvePnP(points, pixels, *lens)
            expected, _ = cv2.projectPoints(points, turn, place, *lens)
            squares.append(((expected[:, 0] - pixels) ** 2).sum(1))
    return float(np.sqrt(np.concatenate(squares).mean()))
