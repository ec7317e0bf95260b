"""Rigid poses as matrices (4, 4), and as the seven values of data sets.

``base_from_camera`` maps what is given in the camera's frame into the base frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from tpgmm_torch.exceptions import DataError

Array = NDArray[np.float64]
#: Of shape (height, width, 3), RGB, or (height, width).
Picture = NDArray[np.uint8]
#: Poses further than this from the middle of all, or this many times their median distance, do
#: not count in a mean: [m], [rad], and the share.
INLIER_DISTANCE, INLIER_ANGLE, INLIER_SHARE = 0.002, np.radians(2.0), 3.0
#: How far the norm of a quaternion may be from 1.
NORM_TOLERANCE = 1e-3


def rigid(rotation: ArrayLike, position: ArrayLike) -> Array:
    """Make a pose (4, 4).

    Parameters
    ----------
    rotation : array-like of shape (3,) or (3, 3)
        A rotation vector [rad] or a matrix.
    position : array-like of shape (3,)
        [m]
    """
    pose, rotation = np.eye(4), np.asarray(rotation, dtype=float)
    if rotation.shape != (3, 3):
        rotation = Rotation.from_rotvec(rotation.ravel()).as_matrix()
    pose[:3, :3], pose[:3, 3] = rotation, np.ravel(position)
    return pose


def inverse(pose: Array) -> Array:
    """Invert poses (..., 4, 4)."""
    back = np.zeros_like(pose)
    back[..., :3, :3] = pose[..., :3, :3].swapaxes(-1, -2)
    back[..., :3, 3:] = -back[..., :3, :3] @ pose[..., :3, 3:]
    back[..., 3, 3] = 1
    return back


def transform(pose: Array, points: ArrayLike) -> Array:
    """Points (n, 3) of one frame in another [m]."""
    return np.asarray(points, dtype=float) @ pose[:3, :3].T + pose[:3, 3]


def pose_matrix(values: ArrayLike) -> Array:
    """Poses (..., 4, 4) of values ``x y z qw qx qy qz``.

    Raises
    ------
    DataError
        If there are not seven finite values with a quaternion of norm 1.

    Examples
    --------
    >>> pose_matrix([1, 2, 3, 1, 0, 0, 0])[:3, 3]
    array([1., 2., 3.])
    """
    values = np.asarray(values, dtype=float)
    if values.shape[-1:] != (7,) or not np.isfinite(values).all():
        raise DataError(f"a pose is seven finite values x y z qw qx qy qz, got {values}")
    norm = np.linalg.norm(values[..., 3:], axis=-1)
    if (np.abs(norm - 1) > NORM_TOLERANCE).any():
        raise DataError(f"a quaternion qw qx qy qz has norm 1, got {values[..., 3:]}")
    flat = values.reshape(-1, 7)
    poses = np.tile(np.eye(4), (len(flat), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(np.roll(flat[:, 3:], -1, axis=-1)).as_matrix()
    poses[:, :3, 3] = flat[:, :3]
    return poses.reshape(*values.shape[:-1], 4, 4)


def pose_vector(pose: Array) -> Array:
    """Values ``x y z qw qx qy qz`` (..., 7) of poses (..., 4, 4), with qw >= 0."""
    flat = np.asarray(pose, dtype=float).reshape(-1, 4, 4)
    turn = np.roll(Rotation.from_matrix(flat[:, :3, :3]).as_quat(canonical=True), 1, axis=-1)
    return np.concatenate((flat[:, :3, 3], turn), axis=-1).reshape(*pose.shape[:-2], 7)


def cross_matrix(vectors: Array) -> Array:
    """Make the matrices of cross products ``v x .`` (..., 3, 3)."""
    made = np.zeros((*vectors.shape, 3))
    made[..., [2, 0, 1], [1, 2, 0]], made[..., [1, 2, 0], [2, 0, 1]] = vectors, -vectors
    return made


def angle_between(one: Array, other: Array) -> float:
    """Angle of the rotation that takes the one pose's axes to the other's [rad]."""
    return float(Rotation.from_matrix(one[:3, :3].T @ other[:3, :3]).magnitude())


def mean_pose(poses: Sequence[Array] | Array) -> tuple[Array, NDArray[np.bool_]]:
    """Mean of those poses that agree, and which those are.

    Poses are left out that are further than 2 mm or 2 degrees, and further than three times the
    median, from the median position or the orientation nearest to all.

    Parameters
    ----------
    poses : sequence of ndarray of shape (4, 4)
        At least one.

    Returns
    -------
    mean : ndarray of shape (4, 4)
    agree : ndarray of bool, shape (n,)
    """
    stack = np.asarray(poses, dtype=float)
    turns = Rotation.from_matrix(stack[:, :3, :3])
    angles = np.array([(one.inv() * turns).magnitude() for one in turns])
    middle = int(np.median(angles, axis=1).argmin())
    away = np.linalg.norm(stack[:, :3, 3] - np.median(stack[:, :3, 3], axis=0), axis=1)
    agree = (away <= max(INLIER_DISTANCE, INLIER_SHARE * float(np.median(away)))) & (
        angles[middle] <= max(INLIER_ANGLE, INLIER_SHARE * float(np.median(angles[middle])))
    )
    if not agree.any():
        agree[middle] = True
    mean = rigid(turns[agree].mean().as_matrix(), stack[agree, :3, 3].mean(axis=0))
    return mean, agree
