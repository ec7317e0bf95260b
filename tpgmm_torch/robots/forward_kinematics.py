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
from collections.abc import Iterable, Sequence
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
        def constant(values: Any) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values)).to(device, dtype)

        def index(values: Iterable[int]) -> Tensor:
            return torch.tensor([*values], dtype=torch.long, device=device)

        # bodies are the base, the moving frames and, fixed to them, the L links; behind the N
        # matrices of their poses stand the N that turn
        frames, links = tree.frames, tree.links
        count, first_link = 1 + len(frames) + len(links), 1 + len(frames)
        factors = np.zeros((4, 2 * count, 4, 4))  # of 1, sine, cosine, joint
        factors[0, [0, count]] = np.eye(4)
        follow, shift = np.zeros((n_joints, 2 * count)), np.zeros(2 * count)
        parents = [0] * count + [count] * count
        turned = [np.eye(4), *(_z_to(frame.axis) for frame in frames)]
        for body, frame in enumerate(frames, 1):
            parents[body], parents[count + body] = 1 + frame.parent, count + 1 + frame.parent
            offset = turned[1 + frame.parent].T @ frame.offset @ turned[body]
            factors[:, body] = offset @ (SLIDE if frame.prismatic else TURN)
            factors[:, count + body] = _turn(offset) @ (STAY if frame.prismatic else HALF_TURN)
            follow[frame.joint, body], shift[body] = frame.multiplier, frame.shift
            follow[:, count + body], shift[count + body] = follow[:, body] / 2, shift[body] / 2
        for body, link in enumerate(links, first_link):
            parents[body], parents[count + body] = 1 + link.frame, count + 1 + link.frame
            offset = turned[1 + link.frame].T @ link.pose
            factors[0, body], factors[0, count + body] = offset, _turn(offset)
        self._factors = constant(factors.reshape(4, 2 * count, 16)).unbind(0)
        self._follow, self._shift = constant(follow), constant(shift)
        # each matrix's ancestor of degree 1, 2, 4, ...; by level, the matrices and where their
        # carriers stand among those of the level before; and where each comes to stand
        self._ancestors = [index(ancestors) for ancestors in _doubled(parents)]
        levels = _levels(parents)
        self._levels = [index(level) for level in levels]
        self._carriers = [
            index(before.index(parents[body]) for body in level)
            for before, level in itertools.pairwise(levels)
        ]
        self._order = index(np.argsort(np.concatenate(levels)).tolist())

        # each column of the Jacobians is moved by a frame, or by none; where joints mimic
        # others, several frames add up to one
        movers = {frame.joint: body for body, frame in enumerate(frames, 1)}
        columns = [movers.get(joint, 0) for joint in range(n_joints)]
        self._mimic = None
        if len(movers) < len(frames) or any(frame.multiplier != 1 for frame in frames):
            columns = list(range(1, first_link))
            self._mimic = constant(follow[:, columns].T)  # (C, n)
        # which numbers of the matrices are wanted: where links are, where what moves them is,
        # about which axis, line by line, and the rows that turn
        bodies = range(first_link, count)
        wanted = [16 * body + 4 * line + 3 for body in bodies for line in range(3)]
        for column in (3, 2):
            wanted += [16 * mover + 4 * line + column for line in range(3) for mover in columns]
        wanted += [16 * (count + body) + place for body in bodies for place in range(4)]
        self._wanted, n = index(wanted), len(columns)
        self._sizes = 3 * len(links), 3 * n, 3 * n, 4 * len(links)
        moved = [[c - 1 in tree.moved_by(link.frame) for c in columns] for link in links]
        slide = np.array([c > 0 and frames[c - 1].prismatic for c in columns], bool)
        mask = np.array(moved, bool).reshape(len(links), 1, n)
        self._turns = constant(1.0 * (mask & ~slide))  # (L, 1, C)
        self._slides = constant(1.0 * (mask & slide)) if slide.any() else None

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
        position, quaternion = (
            position.unflatten(1, (links, 3)),
            quaternion.unflatten(1, (links, 4)),
        )
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
