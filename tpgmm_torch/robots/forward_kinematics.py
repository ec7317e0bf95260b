"""Poses and Jacobians of the links of a tree, for a batch of joint vectors at once.

Each joint turns or slides along the z axis of its own frame, so that its axis is a column of
the frame's pose, and the pose of a frame in its parent is linear in the sine and the cosine of
the joint (or in the joint itself, where it slides). So is Hbar of its unit quaternion in those
of half the joint: as ``eps_parent * eps = Hbar(eps) eps_parent``, its transpose takes the
parent's quaternion, a row, to the frame's own. Poses and turns are 4 x 4 matrices alike.
One batch of matrix products multiplies all of them by their parents; every further one doubles
the number of joints that are behind: ten joints in a row need four. That costs more arithmetic
and fewer operations than going from joint to joint, which is what a controller wants. Many
robots at once go level by level, in the end with only the rows that are wanted: three of a
pose, one of a turn. Inside, the B robots stand in the last dimension; one robot has none.
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

#: Joint vectors at once from which arithmetic costs more than the number of operations.
MANY = 16

#: ... and from which it is worth two runs to leave out the rows that are not wanted.
PLENTY = 128


class TreeKinematics:
    """Forward kinematics and geometric Jacobians of a :class:`MovingTree`.

    Parameters
    ----------
    tree : MovingTree
    n_joints : int
        Length of the joint vector.
    dtype : torch.dtype
    device : torch.device or str
    """

    def __init__(
        self, tree: MovingTree, n_joints: int, dtype: torch.dtype, device: torch.device | str
    ) -> None:
        def constant(values: Any) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values)).to(device, dtype)

        def index(values: Any) -> Tensor:
            return torch.tensor(values, dtype=torch.long, device=device)

        # bodies are the moving frames and, fixed to them, the links; behind the base's and
        # theirs, in order of depth, stand the matrices that turn
        frames, links = tree.frames, tree.links
        carriers = [frame.parent for frame in frames] + [link.frame for link in links]
        depths = [1 + len(tree.moved_by(carrier)) for carrier in carriers]
        order = np.argsort(depths, kind="stable").tolist()
        row = {-1: 0} | {body: 1 + place for place, body in enumerate(order)}
        count = len(row)
        factors = np.zeros((4, 2 * count, 4, 4))  # of 1, sine, cosine, joint
        factors[0, [0, count]] = np.eye(4)
        follow, shift = np.zeros((2 * count, n_joints)), np.zeros(2 * count)
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

        # (N, 4, 4) each, for one robot, and with a dimension for many
        one = constant(factors)
        self._factors = {3: one.unbind(0), 4: one.unsqueeze(-1).unbind(0)}
        self._follow, self._shift = constant(follow), constant(shift)  # (N, n), (N,)
        hops = _hops(parents)
        self._hops = [index(hop + [count + parent for parent in hop]) for hop in hops]
        # of one robot, number by number, which is sooner done than row by row
        numbers = torch.arange(16, device=device).view(4, 4)
        self._hops_of_one = [16 * hop.view(-1, 1, 1) + numbers for hop in self._hops]
        # level by level: how many bodies there are, and whom they are carried by
        self._counts = [1, *np.bincount(depths)[1:].tolist()]
        self._parents: list[Tensor | None] = []
        first, start = 0, 1
        for before, number in itertools.pairwise(self._counts):
            places = [parent - first for parent in parents[start : start + number]]
            first, start = start, start + number
            self._parents.append(None if places == list(range(before)) else index(places))

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
            numbers = [
                pose_size * pose + 4 * line + place
                for poses, place in (
                    (bodies, 3),  # where links are
                    (movers, 3),  # where the frames that move columns are,
                    (movers, 2),  # and their axes
                )
                for pose in poses
                for line in range(3)
            ]
            turns = [pose_size * count + turn_size * body for body in bodies]
            return index(numbers + [turn + place for turn in turns for place in range(4)])

        self._in_matrices, self._in_rows = wanted(16, 16), wanted(12, 4)
        self._sizes = 3 * len(bodies), 3 * len(movers), 3 * len(movers), 4 * len(bodies)
        moved = [[float(c in tree.moved_by(link.frame)) for link in links] for c in columns]
        mask = np.reshape(moved, (len(columns), len(links), 1))
        slide = np.array([c >= 0 and frames[c].prismatic for c in columns]).reshape(-1, 1, 1)

        def both(values: Any) -> dict[int, Tensor]:
            """(C, L, 1) for one robot, and with a dimension for many."""
            return {3: constant(values), 4: constant(values).unsqueeze(-1)}

        self._turns, self._slides = both(mask * ~slide), None
        if slide.any():
            self._slides = both(mask * slide)

    def __call__(self, joints: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Poses and Jacobians in the base frame.

        Parameters
        ----------
        joints : Tensor of shape (B, n_joints), or (n_joints,)

        Returns
        -------
        positions : Tensor of shape (B, L, 3), or (L, 3)
        orientations : Tensor of shape (B, L, 4), or (L, 4)
            Unit quaternions, real part not negative.
        jacobians : Tensor of shape (B, L, 6, n_joints), or (L, 6, n_joints)
            Linear rows above angular rows.
        """
        batch = joints.shape[:-1]
        if torch.compiler.is_compiling():  # a sum is a loop that others can join
            moved = self._shift.unsqueeze(-1) + (self._follow.unsqueeze(-1) * joints.T).sum(1)
        elif batch:
            moved = torch.addmm(self._shift.unsqueeze(-1), self._follow, joints.T)  # (N, B)
        else:
            moved = torch.addmv(self._shift, self._follow, joints)
        local = self._local(moved.view(len(moved), 1, 1, *batch))
        numbers = self._products(local, batch)
        position, origin, axis, quaternion = numbers.split(self._sizes)
        columns, links = self._turns[3].shape[:2]
        position = position.view(links, 3, *batch)
        quaternion = quaternion.view(links, 4, *batch)
        quaternion = quaternion * quaternions.hemisphere_sign(quaternion[:, :1])
        origin, axis = (x.view(columns, 1, 3, *batch) for x in (origin, axis))
        turning = axis * self._turns[axis.ndim]  # (C, L, 3[, B])
        linear = _cross(turning, position - origin)
        if self._slides is not None:
            linear = linear + axis * self._slides[axis.ndim]
        jacobians = torch.cat((linear, turning), 2)
        if batch:
            position, quaternion = position.permute(2, 0, 1), quaternion.permute(2, 0, 1)
            jacobians = jacobians.permute(3, 1, 2, 0)  # (B, L, 6, C)
        else:
            jacobians = jacobians.permute(1, 2, 0)
        if self._mimic is not None:
            jacobians = jacobians @ self._mimic
        return position, quaternion, jacobians

    def _local(self, moved: Tensor) -> Tensor:
        """The matrices of all bodies in their carriers, the base first, (N, 4, 4[, B])."""
        constant, sine, cosine, sliding = self._factors[moved.ndim]
        local = torch.addcmul(constant, sine, moved.sin())
        local = torch.addcmul(local, cosine, moved.cos())
        return torch.addcmul(local, sliding, moved) if self._slides is not None else local

    def _products(self, local: Tensor, batch: torch.Size) -> Tensor:
        """The numbers that are wanted of the products along the tree, (W[, B])."""
        if not batch:
            for numbers in self._hops_of_one:
                local = torch.bmm(local.take(numbers), local)
            return local.view(-1).index_select(0, self._in_matrices)
        count = PLENTY if torch.compiler.is_compiling() else batch.numel()
        if count < MANY:
            for hop in self._hops:
                local = _product(local.index_select(0, hop), local)
            return local.reshape(16 * len(local), *batch).index_select(0, self._in_matrices)
        halves = local.view(2, -1, 4, 4, *batch)
        if count < PLENTY:
            matrices = self._down(halves, 4)
            return matrices.view(-1, *batch).index_select(0, self._in_matrices)
        parts = (self._down(halves[:1], 3), self._down(halves[1:], 1))
        numbers = torch.cat([part.view(-1, *batch) for part in parts])
        return numbers.index_select(0, self._in_rows)

    def _down(self, local: Tensor, rows: int) -> Tensor:
        """The first rows of the products, level by level; local is (H, N, 4, 4, B)."""
        base, *others = local.split(self._counts, 1)
        level = base[:, :, :rows]
        levels = [level]
        for parents, matrices in zip(self._parents, others, strict=True):
            if parents is not None:
                level = level.index_select(1, parents)
            level = _product(level, matrices)
            levels.append(level)
        return torch.cat(levels, 1)


def _product(first: Tensor, second: Tensor) -> Tensor:
    """Products of matrices (..., 4, 4, B)."""
    return (first.unsqueeze(-2) * second.unsqueeze(-4)).sum(-3)


def _cross(first: Tensor, second: Tensor) -> Tensor:
    """Cross products along the third dimension of (C, L, 3), or (C, L, 3, B)."""
    few = first.ndim == 3 or first.shape[-1] < MANY
    if few and not torch.compiler.is_compiling():
        return torch.linalg.cross(first, second, dim=2)
    x, y, z = first.unbind(2)
    u, v, w = second.unbind(2)
    return torch.stack((y * w - z * v, z * u - x * w, x * v - y * u), 2)


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
