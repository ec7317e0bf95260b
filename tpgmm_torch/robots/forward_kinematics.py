"""Poses and Jacobians of the links of a tree, for a batch of joint vectors at once.

Each joint turns or slides along the z axis of its frame, so that its axis is a column of the
frame's pose, and the pose of a frame in its parent is linear in the sine and the cosine of the
joint (or in the joint itself, where it slides). So is Hbar of its unit quaternion in those of
half the joint: as ``eps_parent * eps = Hbar(eps) eps_parent``, its transpose takes the
parent's quaternion, a row, to that of the frame. Poses and turns are 4 x 4 matrices alike.

Their products along the tree are taken level by level. For few robots the number of operations
counts: one batch of matrix products multiplies all matrices by their parents, and every
further one doubles the number of joints that are behind: ten joints in a row need four.
"""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.robots.kinematic_tree import MovingTree

__all__ = ["TreeKinematics"]

#: Robots up to which fewer operations are faster; of 4096, level by level takes 60 ms on one
#: core in place of 130.
FEW = 8


class TreeKinematics:
    """Forward kinematics and geometric Jacobians of a :class:`MovingTree`.

    Parameters
    ----------
    tree : MovingTree
        What moves the L links.
    n_joints : int
        Length of the joint vector.
    dtype, device : torch.dtype, torch.device or str
        Of all results.
    """

    def __init__(
        self, tree: MovingTree, n_joints: int, dtype: torch.dtype, device: torch.device | str
    ) -> None:
        self._options: dict[str, Any] = {"dtype": dtype, "device": device}
        factors, follow, shift, parents = _motions(tree, n_joints)
        self._factors = self._constant(factors.reshape(4, -1, 16)).unbind(0)
        self._follow, self._shift = self._constant(follow), self._constant(shift)
        # each matrix's ancestor of degree 1, 2, 4, ...; by level, the matrices and where their
        # carriers stand among those of the level before; and where each comes to stand
        self._ancestors = [self._index(ancestors) for ancestors in _doubled(parents)]
        levels = _levels(parents)
        self._levels = [self._index(level) for level in levels]
        self._carriers = [
            self._index(before.index(parents[body]) for body in level)
            for before, level in itertools.pairwise(levels)
        ]
        self._order = self._index(np.argsort(np.concatenate(levels)).tolist())

        self._select_columns(tree, follow)

    def _select_columns(self, tree: MovingTree, follow: Array) -> None:
        """What moves each column of the Jacobians: a frame, or none.

        Where joints mimic others, several frames add up to one.
        """
        frames, links = tree.frames, tree.links
        movers = {frame.joint: body for body, frame in enumerate(frames, 1)}
        columns = [movers.get(joint, 0) for joint in range(len(follow))]
        self._mimic = None
        if len(movers) < len(frames) or any(frame.multiplier != 1 for frame in frames):
            columns = list(range(1, 1 + len(frames)))
            self._mimic = self._constant(follow[:, columns].T)  # (C, n)
        self._wanted = self._index(_entries(columns, len(frames), len(links)))
        self._sizes = [3 * len(links), 3 * len(columns), 3 * len(columns), 4 * len(links)]
        moved = [[c - 1 in tree.moved_by(link.frame) for c in columns] for link in links]
        mask = np.array(moved, bool).reshape(len(links), 1, len(columns))
        slide = np.array([False, *(frame.prismatic for frame in frames)])[columns]
        self._turns = self._constant(1.0 * (mask & ~slide))  # (L, 1, C)
        self._slides = self._constant(1.0 * (mask & slide)) if slide.any() else None

    def _constant(self, values: Array) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(**self._options)

    def _index(self, values: Iterable[int]) -> Tensor:
        return torch.tensor([*values], dtype=torch.long, device=self._options["device"])

    def __call__(self, joints: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Poses and Jacobians in the base frame.

        Parameters
        ----------
        joints : Tensor of shape (B, n_joints)

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
        local = local.unflatten(-1, (4, 4))  # (B, 2N, 4, 4): each in what carries it
        if len(joints) <= FEW or torch.compiler.is_compiling():
            for ancestors in self._ancestors:
                local = _product(local.index_select(1, ancestors), local)
        else:
            first, *others = (local.index_select(1, level) for level in self._levels)
            done = [first]
            for carriers, level in zip(self._carriers, others, strict=True):
                done.append(done[-1].index_select(1, carriers) @ level)
            local = torch.cat(done, 1).index_select(1, self._order)
        numbers = local.flatten(1).index_select(1, self._wanted)
        position, origin, axis, quaternion = numbers.split(self._sizes, 1)
        position = position.unflatten(1, (links, 3))
        quaternion = quaternion.unflatten(1, (links, 4))
        quaternion = quaternion * quaternions.hemisphere_sign(quaternion.narrow(-1, 0, 1))
        origin, axis = (part.unflatten(1, (1, 3, columns)) for part in (origin, axis))
        turning = axis * self._turns  # (B, L, 3, C)
        linear = torch.linalg.cross(turning, position.unsqueeze(-1) - origin, dim=2)
        if self._slides is not None:
            linear = linear + axis * self._slides
        jacobians = torch.cat((linear, turning), 2)
        if self._mimic is not None:
            jacobians = jacobians @ self._mimic
        return position, quaternion, jacobians


def _product(first: Tensor, second: Tensor) -> Tensor:
    """``first @ second``; for a compiler a sum: a loop that others can join."""
    if torch.compiler.is_compiling():
        return (first.unsqueeze(-1) * second.unsqueeze(-3)).sum(-2)
    return first @ second


def _motions(tree: MovingTree, n_joints: int) -> tuple[Array, Array, Array, list[int]]:
    """How N matrices of poses, and behind them N of turns, depend on the joints.

    Bodies are the base, the moving frames and, fixed to these, the links.

    Returns
    -------
    factors : ndarray of shape (4, 2 N, 4, 4)
        Of 1, the sine, the cosine and the joint.
    follow, shift : ndarray of shape (n_joints, 2 N) and (2 N,)
        ``joints @ follow + shift`` moves each matrix.
    parents : list of int
        What carries each; the base itself.
    """
    frames = tree.frames
    turned = [np.eye(4), *(_z_to(frame.axis) for frame in frames)]
    offsets = [frame.offset @ own for frame, own in zip(frames, turned[1:], strict=True)]
    offsets += [link.pose for link in tree.links]
    carriers = [
        *(1 + frame.parent for frame in frames),
        *(1 + link.frame for link in tree.links),
    ]
    count = 1 + len(carriers)
    factors = np.zeros((4, 2 * count, 4, 4))
    factors[0, [0, count]] = np.eye(4)
    for body, (carrier, offset) in enumerate(zip(carriers, offsets, strict=True), 1):
        kind = frames[body - 1].prismatic if body <= len(frames) else None
        moved, turn = MOTIONS[kind]
        pose = turned[carrier].T @ offset
        factors[:, body], factors[:, count + body] = pose @ moved, _turn(pose) @ turn
    follow, shift = np.zeros((n_joints, 2, count)), np.zeros((2, count))
    for body, frame in enumerate(frames, 1):  # turns follow half the joint
        follow[frame.joint, :, body] = frame.multiplier, frame.multiplier / 2
        shift[:, body] = frame.shift, frame.shift / 2
    parents = [0, *carriers, count, *(count + carrier for carrier in carriers)]
    width = follow.size // max(n_joints, 1)  # without joints a width cannot be inferred
    return factors, follow.reshape(n_joints, width), shift.reshape(-1), parents


def _entries(columns: Sequence[int], n_frames: int, n_links: int) -> Iterator[int]:
    """Which numbers of the 2 N matrices are wanted, as they stand in memory.

    Where links are, where what moves each column is, about which axis, line by line, and the
    rows that turn the links.
    """
    links, count = range(1 + n_frames, 1 + n_frames + n_links), 1 + n_frames + n_links
    yield from (16 * link + 4 * line + 3 for link in links for line in range(3))
    for entry in (3, 2):
        yield from (16 * mover + 4 * line + entry for line in range(3) for mover in columns)
    yield from (16 * (count + link) + place for link in links for place in range(4))


def _z_to(axis: Array) -> Array:
    """A rotation that takes the z axis to a unit vector, as a homogeneous matrix."""
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    matrix = np.eye(4)
    matrix[:3, :3] = np.column_stack((first, np.cross(axis, first), axis))
    return matrix


def _turn(pose: Array) -> Array:
    """The transpose of ``Hbar`` of a pose's unit quaternion."""
    rotation = torch.from_numpy(np.ascontiguousarray(pose[:3, :3]))
    return quaternions.right_matrix(quaternions.from_matrix(rotation)).mT.numpy()


def _doubled(parents: Sequence[int]) -> list[list[int]]:
    """Whom each matrix is multiplied by: its parent, its ancestor of degree 2, 4, ..."""
    hops, ahead = [], list(parents)
    while not set(ahead) <= {0, len(parents) // 2}:  # the base stands still
        hops.append(ahead)
        ahead = [ahead[node] for node in ahead]
    return hops


def _levels(parents: Sequence[int]) -> list[list[int]]:
    """The nodes of a forest by their depth."""
    levels = [[node for node, parent in enumerate(parents) if node == parent]]
    while below := [
        node for node, parent in enumerate(parents) if parent in levels[-1] and node != parent
    ]:
        levels.append(below)
    return levels


#: A frame's pose after its joint's motion, as the factors of 1, of the joint's sine and cosine,
#: and of the joint itself: a turn about the z axis, and a way along it. Then the transposed
#: Hbar of the same, in the sine and the cosine of half the joint.
TURN = np.zeros((4, 4, 4))
TURN[0, [2, 3], [2, 3]] = 1.0
TURN[1, [1, 0], [0, 1]] = 1.0, -1.0
TURN[2, [0, 1], [0, 1]] = 1.0
SLIDE = np.zeros((4, 4, 4))
SLIDE[0] = np.eye(4)
SLIDE[3, 2, 3] = 1.0
HALF_TURN = np.zeros((4, 4, 4))
HALF_TURN[1, [3, 2, 1, 0], [0, 1, 2, 3]] = -1.0, 1.0, -1.0, 1.0
HALF_TURN[2] = np.eye(4)
STAY = np.zeros((4, 4, 4))
STAY[0] = np.eye(4)
#: By kind of joint, slides or turns or none, how the pose and the turn of a frame move.
MOTIONS = {True: (SLIDE, STAY), False: (TURN, HALF_TURN), None: (STAY, STAY)}
