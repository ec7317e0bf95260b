"""Poses and Jacobians of the links of a tree in one posture, in numpy.

The same bodies as :mod:`~tpgmm_torch.robots.forward_kinematics` has for batches: of few numbers
numpy takes half the time that torch takes. Orientations are read from the matrices of poses.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from tpgmm_torch.data.arrays import Array
from tpgmm_torch.robots.forward_kinematics import find_columns, find_movers, tabulate_motions
from tpgmm_torch.robots.kinematic_tree import Body

#: x, y, z, x, y: rows 1 to 3 and 2 to 4 are what a cross product takes of the first three.
CYCLE = [0, 1, 2, 0, 1]


class OnePosture:
    """Forward kinematics and geometric Jacobians of L links, of one joint vector.

    Parameters
    ----------
    bodies : sequence of Body
        Bodies that move the links, the base first; the links are the last.
    n_links, n_joints : int
        L, and the length of the joint vector.
    """

    def __init__(self, bodies: Sequence[Body], n_links: int, n_joints: int) -> None:
        count = len(bodies)
        factors, follow, shift = tabulate_motions(bodies, n_joints)
        self._constant, self._sine, self._cosine, sliding = factors[:, :count].reshape(
            4, count, 16
        )
        self._follow, self._shift = follow[:, :count].copy(), shift[:count].copy()
        self._sliding = sliding if sliding.any() else None
        self._ancestors: list[Any] = []
        ahead = np.array([body.parent for body in bodies])
        while ahead.any():  # each matrix's ancestor of degree 1, 2, 4, ...
            self._ancestors.append(ahead)
            ahead = ahead[ahead]
        columns, are_joints = find_columns(bodies, n_joints)
        self._mimic = None if are_joints else follow[:, columns].T.copy()
        entries = np.arange(16 * count).reshape(count, 4, 4)
        links = np.arange(count - n_links, count)
        self._axes = entries[columns][:, CYCLE, 2].T.copy()
        self._origins = entries[columns][:, CYCLE, 3].T.copy()
        self._places = entries[links][:, CYCLE, 3].copy()
        self._turned = entries[links][:, :3, :3].reshape(n_links, 9)
        turns, slides = find_movers(bodies, n_links, columns)
        self._turns, self._slides = turns, slides if slides.any() else None

    def __call__(self, joints: Array) -> tuple[Array, Array, Array]:
        """Compute poses and Jacobians in the base frame.

        Parameters
        ----------
        joints : ndarray of shape (n_joints,)
            [rad or m].

        Returns
        -------
        positions : ndarray of shape (L, 3)
        orientations : ndarray of shape (L, 4)
            Unit quaternions, real part not negative.
        rows : ndarray of shape (2 L + 1, 3, n_joints)
            Of each link, how it moves and how it turns; three rows of zeros at the end.
        """
        moved = (joints @ self._follow + self._shift)[:, None]
        local = self._sine * np.sin(moved)
        local += self._cosine * np.cos(moved)
        local += self._constant
        if self._sliding is not None:
            local += self._sliding * moved
        poses: Array = local.reshape(-1, 4, 4)
        for ancestors in self._ancestors:
            poses = poses.take(ancestors, 0) @ poses
        numbers = poses.reshape(-1)
        axes, place = numbers.take(self._axes), numbers.take(self._places)
        arms = place[:, :, None] - numbers.take(self._origins)
        count, _, size = self._turns.shape
        rows: Array = np.zeros((2 * count + 1, 3, size))
        pairs = rows[:-1].reshape(count, 2, 3, size)
        swing = axes[1:4] * arms[:, 2:] - axes[2:] * arms[:, 1:4]
        np.multiply(swing, self._turns, out=pairs[:, 0])
        np.multiply(axes[:3], self._turns, out=pairs[:, 1])
        if self._slides is not None:
            pairs[:, 0] += axes[:3] * self._slides
        turned = _quaternions(numbers.take(self._turned))
        return place[:, :3], turned, rows if self._mimic is None else rows @ self._mimic


def _tabulate_squares() -> Array:
    """Tabulate ``4 eps eps^T - I``, linear in a rotation matrix: (9, 16)."""
    found = np.zeros((9, 4, 4))
    found[[0, 4, 8], 0, 0] = 1.0
    axes = np.eye(3)
    for i in range(3):
        found[[0, 4, 8], i + 1, i + 1] = 2 * axes[i] - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        found[[3 * k + j, 3 * j + k], 0, i + 1] = 1.0, -1.0
        found[[3 * i + j, 3 * j + i], min(i, j) + 1, max(i, j) + 1] = 1.0
    return np.asarray((found + np.triu(found, 1).swapaxes(1, 2)).reshape(9, 16))


SQUARES, EYE = _tabulate_squares(), np.eye(4).ravel()


def _quaternions(matrices: Array) -> Array:
    """Compute unit quaternions (L, 4) of rotation matrices (L, 9)."""
    found = []
    for squares in (matrices @ SQUARES + EYE).tolist():  # of few numbers Python is faster
        _, at = max((squares[at], at) for at in (0, 5, 10, 15))
        row = squares[at // 5 * 4 : at // 5 * 4 + 4]
        norm = math.copysign(math.hypot(*row), row[0])
        found.append([one / norm for one in row])
    return np.array(found).reshape(-1, 4)
