"""Poses and Jacobians of the links of a tree, for a batch of joint vectors at once.

Each joint turns or slides along the z axis of its frame, so that its axis is a column of the
frame's pose, and the pose of a frame in its parent is linear in the sine and the cosine of the
joint (or in the joint itself, where it slides). So is Hbar of its unit quaternion in those of
half the joint: as ``eps_parent * eps = Hbar(eps) eps_parent``, its transpose takes the
parent's quaternion, a row, to that of the frame. Poses and turns are 4 x 4 matrices alike.

Their products along the tree are taken in two ways. Many robots go level by level, with only
the rows that are wanted: three of a pose, one of a turn. For few, the number of operations
counts: one batch of matrix products multiplies all matrices by their parents, and every
further one doubles the number of joints that are behind: ten joints in a row need four.
"""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.robots.kinematic_tree import MovingTree

__all__ = ["TreeKinematics"]

#: Joint vectors at once up to which the number of operations costs more than arithmetic.
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

        def index(values: Any) -> Tensor:
            return torch.tensor(values, dtype=torch.long, device=device)

        # bodies are the base, the moving frames and, fixed to them, the links, in order of
        # depth; behind the N matrices of their poses stand the N that turn
        frames, links = tree.frames, tree.links
        carriers = [frame.parent for frame in frames] + [link.frame for link in links]
        depths = [1 + len(tree.moved_by(carrier)) for carrier in carriers]
        order = np.argsort(depths, kind="stable").tolist()
        row = {-1: 0} | {body: 1 + place for place, body in enumerate(order)}
        count = len(row)
        factors = np.zeros((4, 2 * count, 4, 4))  # of 1, sine, cosine, joint
        factors[0, [0, count]] = np.eye(4)
        follow, shift = np.zeros((2 * count, n_joints)), np.zeros((2 * count, 1))
        parents = [0] * count
        turned = {-1: np.eye(4)} | {f: _z_to(frame.axis) for f, frame in enumerate(frames)}
        for body, carrier in enumerate(carriers):
            pose, turn = row[body], count + row[body]
            parents[pose] = row[carrier]
            if body >= len(frames):
                offset = turned[carrier].T @ links[body - len(frames)].pose
                factors[0, pose], factors[0, turn] = offset, _turn(offset)
                continue
            frame = frames[body]
            offset = turned[carrier].T @ frame.offset @ turned[body]
            factors[:, pose] = offset @ (SLIDE if frame.prismatic else TURN)
            factors[:, turn] = _turn(offset) @ (STAY if frame.prismatic else HALF_TURN)
            follow[pose, frame.joint], shift[pose] = frame.multiplier, frame.shift
            follow[turn], shift[turn] = follow[pose] / 2, shift[pose] / 2
        self._factors = constant(factors).unsqueeze(-1).unbind(0)  # (2N, 4, 4, 1) each
        self._follow, self._shift = constant(follow), constant(shift)  # (2N, n), (2N, 1)

        # for few robots: each matrix's ancestor of degree 1, 2, 4, ..., all robots' in one list
        self._ancestors = [
            [
                index(
                    [
                        first + place
                        for first in range(0, 2 * count * few, count)
                        for place in hop
                    ]
                )
                for hop in _hops(parents)
            ]
            for few in range(FEW + 1)
        ]
        # for many: how many bodies each level has, and which of the one before carry them;
        # None for each its own
        self._counts = [1, *np.bincount(depths)[1:].tolist()]
        self._carriers: list[Tensor | None] = []
        first, start = 0, 1
        for before, number in itertools.pairwise(self._counts):
            places = [parent - first for parent in parents[start : start + number]]
            first, start = start, start + number
            self._carriers.append(None if places == list(range(before)) else index(places))

        # each column of the Jacobians is moved by a frame, or by none
        column = {frame.joint: f for f, frame in enumerate(frames)}
        columns = [column.get(joint, -1) for joint in range(n_joints)]
        self._mimic = None
        if len(column) < len(frames) or any(frame.multiplier != 1 for frame in frames):
            # where joints mimic others, several frames add up to one column
            columns = list(range(len(frames)))
            self._mimic = constant(follow[[row[c] for c in columns]])  # (C, n)
        # which numbers of the matrices are wanted: columns of poses, and the rows that turn
        bodies = [row[len(frames) + link] for link in range(len(links))]
        movers = [row[c] for c in columns]

        def wanted(pose_size: int, turn_size: int) -> Tensor:
            columns = [(body, 3) for body in bodies]  # where links are,
            columns += [(mover, 3) for mover in movers]  # where what moves them is,
            columns += [(mover, 2) for mover in movers]  # and about which axis
            poses = [
                pose_size * pose + 4 * line + at for pose, at in columns for line in range(3)
            ]
            turns = [pose_size * count + turn_size * body for body in bodies]
            return index(poses + [turn + place for turn in turns for place in range(4)])

        self._in_matrices, self._in_rows = wanted(16, 16), wanted(12, 4)
        self._sizes = 3 * len(bodies), 3 * len(movers), 3 * len(movers), 4 * len(bodies)
        moved = [[float(c in tree.moved_by(link.frame)) for link in links] for c in columns]
        mask = np.reshape(moved, (len(columns), len(links), 1, 1))
        slide = np.array([c >= 0 and frames[c].prismatic for c in columns], bool)
        slide = slide.reshape(-1, 1, 1, 1)
        self._turns = constant(mask * ~slide)  # (C, L, 1, 1)
        self._slides = constant(mask * slide) if slide.any() else None

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
        # inside, robots are the last dimension
        count = len(joints)
        few = 0 < count <= FEW and not torch.compiler.is_compiling()
        if torch.compiler.is_compiling():  # a sum is a loop that others can join
            moved = self._shift + (self._follow.unsqueeze(-1) * joints.T).sum(1)
        else:
            moved = torch.addmm(self._shift, self._follow, joints.T)  # (2N, B)
        local = self._local(moved.view(len(moved), 1, 1, count))
        numbers = self._products_of_few(local) if few else self._products(local)
        position, origin, axis, quaternion = numbers.split(self._sizes)
        columns, links = self._turns.shape[:2]
        position = position.view(links, 3, count)
        quaternion = quaternion.view(links, 4, count)
        quaternion = quaternion * quaternions.hemisphere_sign(quaternion.narrow(1, 0, 1))
        origin, axis = origin.view(columns, 1, 3, count), axis.view(columns, 1, 3, count)
        turning = axis * self._turns  # (C, L, 3, B)
        linear = (_cross_of_few if few else _cross)(turning, position - origin)
        if self._slides is not None:
            linear = linear + axis * self._slides
        jacobians = torch.cat((linear, turning), 2).permute(3, 1, 2, 0)  # (B, L, 6, C)
        if self._mimic is not None:
            jacobians = jacobians @ self._mimic
        return position.permute(2, 0, 1), quaternion.permute(2, 0, 1), jacobians

    def _local(self, moved: Tensor) -> Tensor:
        """The matrices of all bodies in what carries them, (2N, 4, 4, B)."""
        constant, sine, cosine, sliding = self._factors
        local = torch.addcmul(constant, sine, moved.sin())
        local = torch.addcmul(local, cosine, moved.cos())
        return torch.addcmul(local, sliding, moved) if self._slides is not None else local

    def _products(self, local: Tensor) -> Tensor:
        """The numbers that are wanted of the products along the tree, (W, B)."""
        poses, turns = local.chunk(2)
        numbers = torch.cat((self._level_by_level(poses, 3), self._level_by_level(turns, 1)))
        return numbers.index_select(0, self._in_rows)

    def _level_by_level(self, local: Tensor, rows: int) -> Tensor:
        """The first rows of the products, (N * rows * 4, B)."""
        base, *others = local.split(self._counts)
        levels = [base[:, :rows]]
        for carriers, matrices in zip(self._carriers, others, strict=True):
            level = levels[-1] if carriers is None else levels[-1].index_select(0, carriers)
            levels.append((level.unsqueeze(-2) * matrices.unsqueeze(-4)).sum(-3))
        return torch.cat(levels).flatten(0, 2)

    def _products_of_few(self, local: Tensor) -> Tensor:
        """The same for few robots."""
        count = local.shape[-1]
        local = local.movedim(-1, 0).reshape(-1, 4, 4)  # (B * 2N, 4, 4)
        for ancestors in self._ancestors[count]:
            local = torch.bmm(local.index_select(0, ancestors), local)
        return local.view(count, -1).index_select(1, self._in_matrices).T


def _cross(first: Tensor, second: Tensor) -> Tensor:
    """Cross products along the third dimension of (C, L, 3, B)."""
    x, y, z = first.unbind(2)
    u, v, w = second.unbind(2)
    return torch.stack((y * w - z * v, z * u - x * w, x * v - y * u), 2)


def _cross_of_few(first: Tensor, second: Tensor) -> Tensor:
    """The same in one operation, which takes six times as long for many robots."""
    return torch.linalg.cross(first, second, dim=2)


def _z_to(axis: Array) -> Array:
    """A rotation, as a matrix (4, 4), whose z axis is the given unit vector."""
    helper = np.eye(3)[np.abs(axis).argmin()]
    first = np.cross(helper, axis)
    first /= np.linalg.norm(first)
    matrix = np.eye(4)
    matrix[:3, :3] = np.column_stack((first, np.cross(axis, first), axis))
    return matrix


def _turn(pose: Array) -> Array:
    """The transpose of ``Hbar`` of a pose's unit quaternion."""
    rotation = torch.from_numpy(np.ascontiguousarray(pose[:3, :3]))
    return quaternions.right_matrix(quaternions.from_matrix(rotation)).mT.numpy()


def _hops(parents: Sequence[int]) -> list[list[int]]:
    """Whom each matrix is multiplied by: its parent, its ancestor of degree 2, 4, ..."""
    hops, ahead = [], list(parents)
    while any(ahead):
        hops.append(ahead)
        ahead = [ahead[node] for node in ahead]
    return hops


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
