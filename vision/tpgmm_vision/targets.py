"""Printed targets: where the corners of their tags are.

The frame of a tag has its origin in the middle, x to the right, y up, z out of the print. Its
corners are those of the black square: top left, top right, bottom right, bottom left.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from tpgmm_torch.exceptions import DataError
from tpgmm_vision.poses import Array, pose_matrix, transform

__all__ = ["Board", "Target", "cube", "tag"]

#: Families of tags that OpenCV decodes, by name.
FAMILIES: dict[str, int] = {
    "apriltag_36h11": cv2.aruco.DICT_APRILTAG_36h11,
    "apriltag_25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "apriltag_16h5": cv2.aruco.DICT_APRILTAG_16h5,
    "aruco_4x4": cv2.aruco.DICT_4X4_50,
    "aruco_5x5": cv2.aruco.DICT_5X5_100,
    "aruco_6x6": cv2.aruco.DICT_6X6_250,
    "aruco_original": cv2.aruco.DICT_ARUCO_ORIGINAL,
}
DEFAULT_FAMILY = "apriltag_36h11"
#: Faces of a cube in the order of its tags: where they look, and what is up on them.
FACES = (
    ((1, 0, 0), (0, 0, 1)), ((-1, 0, 0), (0, 0, 1)), ((0, 1, 0), (0, 0, 1)),
    ((0, -1, 0), (0, 0, 1)), ((0, 0, 1), (-1, 0, 0)), ((0, 0, -1), (1, 0, 0)),
)  # fmt: skip


def dictionary_of(family: str) -> Any:
    """OpenCV's dictionary of a family.

    Raises
    ------
    DataError
        If it is not known.
    """
    if family not in FAMILIES:
        raise DataError(f"tags of family {family!r} are not known; there are {list(FAMILIES)}")
    return cv2.aruco.getPredefinedDictionary(FAMILIES[family])


def modules_of(family: str) -> int:
    """Modules on a side of a tag's black square."""
    return int(dictionary_of(family).markerSize) + 2


@dataclass(frozen=True, eq=False)
class Target:
    """Tags that are fixed to one another.

    Parameters
    ----------
    corners : mapping of int to ndarray of shape (4, 3)
        By the number of the tag: its corners in the frame of the target [m]. Empty for what has
        no tags.
    family : str
        Of :data:`FAMILIES`.
    """

    corners: Mapping[int, Array]
    family: str = DEFAULT_FAMILY

    def __post_init__(self) -> None:
        count, numbers = len(dictionary_of(self.family).bytesList), list(self.corners)
        if any(not 0 <= number < count for number in numbers):
            wanted = f"tags 0 to {count - 1} of {self.family}"
            raise DataError(f"a target has {wanted}, got {numbers}")


def _square(size: float) -> Array:
    """Corners of a tag in its own frame."""
    if not 0 < size < 10:
        raise DataError(f"the size of a tag is its black square's edge in metres, got {size}")
    return size / 2 * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])


def tag(number: int, size: float, family: str = DEFAULT_FAMILY) -> Target:
    """One flat tag, whose frame is that of the target.

    Parameters
    ----------
    number : int
    size : float
        Edge of the black square [m].

    Examples
    --------
    >>> tag(3, 0.06).corners[3][0].tolist()
    [-0.03, 0.03, 0.0]
    """
    return Target({number: _square(size)}, family)


def cube(
    numbers: Sequence[int], size: float, side: float | None = None, family: str = DEFAULT_FAMILY
) -> Target:
    """Tags on the faces of a cube, the origin in its middle.

    Parameters
    ----------
    numbers : sequence of int
        On the faces +x, -x, +y, -y, +z and -z; five leave the last one free. On the faces at
        the sides z is up, on the top -x.
    size : float
        Edge of the black squares [m].
    side : float, optional
        Of the cube [m]; by default it leaves one module of white around each tag.
    """
    if not 1 <= len(numbers) <= len(FACES) or len(set(numbers)) < len(numbers):
        raise DataError(f"a cube has one to six different tags, got {list(numbers)}")
    modules = modules_of(family)
    side = size * (modules + 2) / modules if side is None else side
    if side < size:
        raise DataError(f"tags of {size} m do not fit on a cube of {side} m")
    corners = {}
    for number, face in zip(numbers, FACES, strict=False):
        z, y = np.array(face, dtype=float)
        turn = np.stack((np.cross(y, z), y, z), axis=1)
        corners[int(number)] = _square(size) @ turn.T + side / 2 * z
    return Target(corners, family)


def bundle(poses: Mapping[int, ArrayLike], size: float, family: str = DEFAULT_FAMILY) -> Target:
    """Tags at known poses.

    Parameters
    ----------
    poses : mapping of int to sequence of seven floats
        ``x y z qw qx qy qz`` of each tag in the frame of the target [m].
    size : float
        Edge of the black squares [m].
    """
    if not poses:
        raise DataError("a bundle has at least one tag, got none")
    places = {int(number): pose_matrix(pose) for number, pose in poses.items()}
    return Target({n: transform(pose, _square(size)) for n, pose in places.items()}, family)


@dataclass(frozen=True)
class Board:
    """A ChArUco board: a chessboard with tags in its white squares.

    Parameters
    ----------
    columns, rows : int, default=8, 5
        Squares.
    square, marker : float, default=0.033, 0.024
        Edges of the squares and of the tags in them [m].
    family : str, default="aruco_5x5"
        Of :data:`FAMILIES`.
    """

    columns: int = 8
    rows: int = 5
    square: float = 0.033
    marker: float = 0.024
    family: str = "aruco_5x5"

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3 or not 0 < self.marker < self.square:
            raise DataError(f"a board has 3 x 3 squares and more, larger than tags, got {self}")
        dictionary_of(self.family)

    @property
    def drawn(self) -> Any:
        """OpenCV's board."""
        size, dictionary = (self.columns, self.rows), dictionary_of(self.family)
        return cv2.aruco.CharucoBoard(size, self.square, self.marker, dictionary)


def target_from(entry: Mapping[str, Any], where: str = "a target") -> Target:
    """Make a target as a cell file describes it.

    Parameters
    ----------
    entry : mapping
        ``{"tag": 3, "size": 0.06}``, ``{"cube": [10, 11, 12, 13, 14], "size": 0.04}`` (and
        ``"side"``), or ``{"bundle": {"1": [x, y, z, qw, qx, qy, qz], ...}, "size": 0.04}``;
        ``"family"`` where it is not AprilTag 36h11.
    where : str
        What the entry is, for errors.

    Raises
    ------
    DataError
        If it is another kind; the message begins with ``where``.
    """
    makers: dict[str, Any] = {"tag": tag, "cube": cube, "bundle": bundle}
    kinds = [kind for kind in makers if kind in entry]
    extra = entry.keys() - {*makers, "size", "side", "family"}
    if len(kinds) != 1 or "size" not in entry or extra or ("side" in entry) > ("cube" in entry):
        raise DataError(
            f"{where} is described by one of tag, cube and bundle, and size in metres; family, "
            f"and side of a cube, where they are not usual; got {dict(entry)}"
        )
    options = {name: entry[name] for name in ("side", "family") if name in entry}
    try:
        return makers[kinds[0]](entry[kinds[0]], entry["size"], **options)
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        raise DataError(f"{where}: {error}") from error
