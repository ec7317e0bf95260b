"""Poses and Jacobians of the links of a tree, for a batch of joint vectors at once.

Each joint turns or slides along the z axis of its body, so that its axis is a column of the
body's pose, and the pose of a body in its parent is linear in the sine and the cosine of the
joint (or in the joint itself, where it slides). So is Hbar of its unit quaternion in those of
half the joint: as ``eps_parent * eps = Hbar(eps) eps_parent``, its transpose takes the
parent's quaternion, a row, to that of the body. Poses and turns are 4 x 4 matrices alike.

Their products along the tree are taken level by level. For few robots the number of operations
counts: one batch of matrix products multiplies all matrices by their parents, and every
further one doubles the number of joints that are behind: ten joints in a row need four.
"""

import itertools
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.robots.kinematic_tree import Body

#: Robots up to which fewer operations are faster: one takes 64 us in place of 93, and 2000
#: would take 32 ms in place of 13.
FEW = 8


class TreeKinematics:
    """Forward kinematics and geometric Jacobians of L links.

    Parameters
    ----------
    bodies : sequence of Body
        Bodies that move the links, the base first; the links are the last.
    n_links, n_joints : int
        L, and the length of the joint vector.
    dtype, device : torch.dtype, torch.device or str
        Of all results.
    """

    def __init__(
        self,
        bodies: Sequence[Body],
        n_links: int,
        n_joints: int,
        dtype: torch.dtype,
        device: torch.device | str,
    ) -> None:
        self._options: dict[str, Any] = {"dtype": dtype, "device": device}
        factors, follow, shift = tabulate_motions(bodies, n_joints)
        self._factors = self._constant(factors.reshape(4, -1, 16)).unbind(0)
        self._follow, self._shift = self._constant(follow), self._constant(shift)
        parents = [body.parent for body in bodies]
        parents += [len(bodies) + parent for parent in parents]
        # each matrix's ancestor of degree 1, 2, 4, ...; by level, the matrices and where their
        # carriers stand among those of the level before; and where each comes to stand
        self._ancestors = [self._index(ancestors) for ancestors in _ancestors_by_power(parents)]
        levels = _levels(parents)
        self._levels = [self._index(level) for level in levels]
        self._carriers = [
            self._index(before.index(parents[body]) for body in level)
            for before, level in itertools.pairwise(levels)
        ]
        self._order = self._index(np.argsort(np.concatenate(levels)).tolist())

        columns, are_joints = find_columns(bodies, n_joints)
        self._mimic = None if are_joints else self._constant(follow[:, columns].T)  # (C, n)
        self._select_entries(bodies, n_links, columns)

    def _select_entries(
        self, bodies: Sequence[Body], n_links: int, columns: NDArray[np.int64]
    ) -> None:
        """Choose the numbers of the 2 N matrices that are wanted, as they stand in memory.

        Where links are, where what moves each column is, about which axis, line by line, and
        the rows that turn the links.
        """
        links = np.arange(len(bodies) - n_links, len(bodies))
        entries = np.arange(2 * len(bodies) * 16).reshape(-1, 4, 4)
        origins, axes = entries[columns][:, :3, 3].T, entries[columns][:, :3, 2].T
        wanted = entries[links][:, :3, 3], origins, axes, entries[len(bodies) + links][:, 0]
        self._wanted = self._index(np.concatenate([part.ravel() for part in wanted]).tolist())
        self._sizes = [part.size for part in wanted]
        turns, slides = find_movers(bodies, n_links, columns)
        self._turns = self._constant(turns)
        self._slides = self._constant(slides) if slides.any() else None

    def _constant(self, values: Array) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(**self._options)

    def _index(self, values: Iterable[int]) -> Tensor:
        return torch.tensor([*values], dtype=torch.long, device=self._options["device"])

    def __call__(self, joints: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Compute poses and Jacobians in the base frame.

        Parameters
        ----------
        joints : Tensor of shape (B, n_joints)
            Joint vectors [rad or m].

        Returns
        -------
        positions : Tensor of shape (B, L, 3)
        orientations : Tensor of shape (B, L, 4)
            Unit quaternions, real part not negative.
        jacobians : Tensor of shape (B, L, 6, n_joints)
            Linear rows above angular rows.
        """
        links, _, columns = self._turns.shape
        moved = torch.addmm(self._shift, joints, self._follow).unsqueeze(-1)
        constant, sine, cosine, sliding = self._factors
        local = torch.addcmul(constant, sine, moved.sin())
        local = torch.addcmul(local, cosine, moved.cos())
        if self._slides is not None:
            local = torch.addcmul(local, sliding, moved)
        numbers = self._products(local.view(*local.shape[:-1], 4, 4)).flatten(1)
        numbers = numbers.index_select(1, self._wanted)
        position, origin, axis, quaternion = numbers.split_with_sizes(self._sizes, 1)
        position = position.view(-1, links, 3)
        quaternion = quaternion.view(-1, links, 4)
        quaternion = quaternion * quaternions.hemisphere_sign(quaternion.narrow(-1, 0, 1))
        origin, axis = (part.view(-1, 1, 3, columns) for part in (origin, axis))
        turning = axis * self._turns  # (B, L, 3, C)
        linear = torch.linalg.cross(turning, position.unsqueeze(-1) - origin, dim=2)
        if self._slides is not None:
            linear = linear + axis * self._slides
        jacobians = torch.cat((linear, turning), 2)
        if self._mimic is not None:
            jacobians = jacobians @ self._mimic
        return position, quaternion, jacobians

    def _products(self, local: Tensor) -> Tensor:
        """Multiply matrices (B, 2 N, 4, 4), each given in its carrier, along the tree."""
        if local.shape[0] <= FEW or torch.compiler.is_compiling():
            for ancestors in self._ancestors:
                local = _product(local.index_select(1, ancestors), local)
            return local
        done = [local.index_select(1, self._levels[0])]
        for carriers, level in zip(self._carriers, self._levels[1:], strict=True):
            done.append(done[-1].index_select(1, carriers) @ local.index_select(1, level))
        return torch.cat(done, 1).index_select(1, self._order)


def _product(first: Tensor, second: Tensor) -> Tensor:
    """Compute ``first @ second``; for a compiler as a sum, a loop that others can join."""
    if torch.compiler.is_compiling():
        return (first.unsqueeze(-1) * second.unsqueeze(-3)).sum(-2)
    return first @ second


def find_columns(bodies: Sequence[Body], n_joints: int) -> tuple[NDArray[np.int64], bool]:
    """Find the body that moves each column of the Jacobians; tell if columns are joints.

    The base moves none. Where joints mimic others, several bodies add up to one joint.

    Parameters
    ----------
    bodies : sequence of Body
    n_joints : int
        Length of the joint vector.
    """
    moving = [at for at, body in enumerate(bodies) if body.joint is not None]
    movers = {bodies[at].joint: at for at in moving}
    are_joints = len(movers) == len(moving) and all(bodies[at].multiplier == 1 for at in moving)
    columns = [movers.get(joint, 0) for joint in range(n_joints)] if are_joints else moving
    return np.array(columns, np.int64), are_joints


def find_movers(
    bodies: Sequence[Body], n_links: int, columns: NDArray[np.int64]
) -> tuple[Array, Array]:
    """Find which columns turn each of L links, and which slide it: 1 or 0, (L, 1, C) both.

    Parameters
    ----------
    bodies : sequence of Body
        The links are the last.
    n_links : int
        L.
    columns : ndarray of int, of shape (C,)
        The body that moves each column.
    """
    links = range(len(bodies) - n_links, len(bodies))
    mask = np.zeros((n_links, 1, len(columns)), bool)
    for row, at in zip(mask, links, strict=True):
        while at := bodies[at].parent:
            row |= columns == at
    slide = np.array([bodies[at].slides for at in columns], bool)
    return (mask & ~slide).astype(float), (mask & slide).astype(float)


def tabulate_motions(bodies: Sequence[Body], n_joints: int) -> tuple[Array, Array, Array]:
    """Tabulate how N matrices of poses, then N of turns, depend on the joints.

    Parameters
    ----------
    bodies : sequence of Body
        N bodies.
    n_joints : int

    Returns
    -------
    factors : ndarray of shape (4, 2 N, 4, 4)
        Of 1, the sine, the cosine and the joint.
    follow, shift : ndarray of shape (n_joints, 2 N) and (2 N,)
        ``joints @ follow + shift`` moves each matrix.
    """
    count = len(bodies)
    factors = np.zeros((4, 2 * count, 4, 4))
    follow, shift = np.zeros((n_joints, 2 * count)), np.zeros(2 * count)
    for at, body in enumerate(bodies):
        moved, turn = MOTIONS[None if body.joint is None else body.slides]
        rotation = torch.from_numpy(np.ascontiguousarray(body.pose[:3, :3]))
        turned = quaternions.right_matrix(quaternions.from_matrix(rotation)).mT.numpy()
        factors[:, at], factors[:, count + at] = body.pose @ moved, turned @ turn
        if body.joint is not None:  # turns follow half the joint
            both = [at, count + at]
            follow[body.joint, both] = body.multiplier, body.multiplier / 2
            shift[both] = body.shift, body.shift / 2
    return factors, follow, shift


def _ancestors_by_power(parents: Sequence[int]) -> list[list[int]]:
    """List each matrix's ancestors of degree 1, 2, 4, ..., by degree."""
    hops, ahead = [], list(parents)
    while not set(ahead) <= {0, len(parents) // 2}:  # the base stands still
        hops.append(ahead)
        ahead = [ahead[node] for node in ahead]
    return hops


def _levels(parents: Sequence[int]) -> list[list[int]]:
    """Sort the nodes of a forest by their depth."""
    levels = [[node for node, parent in enumerate(parents) if node == parent]]
    while below := [
        node for node, parent in enumerate(parents) if parent in levels[-1] and node != parent
    ]:
        levels.append(below)
    return levels


#: A body's pose after its joint's motion, as the factors of 1, of the joint's sine and cosine,
#: and of the joint itself: a turn about the z axis, and a way along it. Then the transposed
#: Hbar of the same, in the sine and the cosine of half the joint.
TURN = np.zeros((4, 4, 4))
TURN[0, [2, 3], [2, 3]] = 1.0
TURN[1, [1, 0], [0, 1]] = 1.0, -1.0
TURN[2, [0, 1], [0, 1]] = 1.0
STAY = np.zeros((4, 4, 4))
STAY[0] = np.eye(4)
SLIDE = STAY.copy()
SLIDE[3, 2, 3] = 1.0
HALF_TURN = np.zeros((4, 4, 4))
HALF_TURN[1, [3, 2, 1, 0], [0, 1, 2, 3]] = -1.0, 1.0, -1.0, 1.0
HALF_TURN[2] = np.eye(4)
#: By kind of joint, slides or turns or none, how the pose and the turn of a body move.
MOTIONS = {True: (SLIDE, STAY), False: (TURN, HALF_TURN), None: (STAY, STAY)}
