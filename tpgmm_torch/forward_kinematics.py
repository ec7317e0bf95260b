"""Poses and Jacobians of the links of a tree, for a batch of joint vectors at once.

Each joint turns or slides along the z axis of its own frame, so that its axis is a column of
the frame's pose, and the pose of a frame in its parent is linear in the sine and the cosine of
the joint (or in the joint itself, where it slides). The poses in the base frame are the
products along the tree. One batch of matrix products multiplies all frames by their parents;
every further one doubles the number of joints that are behind: ten joints in a row need four.
That costs more arithmetic and fewer operations than going from joint to joint, which is what
a controller wants; many robots at once go level by level.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.trees import MovingTree

__all__ = ["TreeKinematics"]

#: Joint vectors at once from which arithmetic costs more than the number of operations.
MANY = 16


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
        depth = [len(tree.moved_by(index)) for index in range(len(tree.frames))]
        order = sorted(range(len(tree.frames)), key=depth.__getitem__)
        frames = [tree.frames[frame] for frame in order]
        # the base is row 0, moving frames follow by their depth
        row = {-1: 0} | {frame: place for place, frame in enumerate(order, start=1)}
        parents = [0, *(row[frame.parent] for frame in frames)]
        count = len(parents)

        turned = {-1: np.eye(4)} | {f: _z_to(tree.frames[f].axis) for f in order}
        parts = np.zeros((4, count, 4, 4))  # constant, sine, cosine, joint
        parts[0, 0] = np.eye(4)
        follow, shift = np.zeros((count, n_joints)), np.zeros((count, 1))
        for place, (name, frame) in enumerate(zip(order, frames, strict=True), start=1):
            offset = turned[frame.parent].T @ frame.offset @ turned[name]
            motions = SLIDE if frame.prismatic else TURN
            parts[:, place] = offset @ motions
            follow[place, frame.joint], shift[place] = frame.multiplier, frame.shift
        slides = np.array([False] + [frame.prismatic for frame in frames])

        def constant(values: Any) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values)).to(device, dtype)

        def index(values: Any) -> Tensor:
            return torch.tensor(values, dtype=torch.long, device=device)

        self._constant, self._sine, self._cosine, sliding = constant(parts)[:, :, None]
        self._sliding = sliding if slides.any() else None  # (M, 1, 4, 4)
        self._follow, self._shift = constant(follow), constant(shift)  # (M, n), (M, 1)
        self._hops = [index(hop) for hop in _hops(parents)]
        ends = np.cumsum(np.bincount([0, *(depth[frame] for frame in order)])).tolist()
        self._levels = [
            (index([p - first for p in parents[start:end]]), start, end)
            for first, start, end in zip([0, *ends], ends, ends[1:], strict=False)
        ]
        self._links = index([row[link.frame] for link in tree.links])
        tools = [turned[link.frame].T @ link.pose for link in tree.links]
        self._tools = constant(np.reshape(tools, (-1, 1, 4, 4)))  # (L, 1, 4, 4)

        moved = np.zeros((len(tree.links), count))
        for link, attachment in enumerate(tree.links):
            moved[link, [row[frame] for frame in tree.moved_by(attachment.frame)]] = 1
        self._build_columns(moved, follow, slides, constant, index)

    def _build_columns(
        self,
        moved: NDArray[np.float64],
        follow: NDArray[np.float64],
        slides: NDArray[np.bool_],
        constant: Any,
        index: Any,
    ) -> None:
        """Which frame moves each column of the Jacobians; the base stands for none."""
        alone = ((follow != 0).sum(0) <= 1).all() and (follow[follow != 0] == 1).all()
        columns = follow.argmax(0) * (follow != 0).any(0) if alone else np.arange(len(follow))
        self._columns = index(columns.tolist())  # (C,)
        mask = moved[:, columns]
        still, slide = mask * ~slides[columns], mask * slides[columns]
        # how an axis that turns and one that slides enter the six rows
        self._turns = constant(np.repeat(still[:, :, None, None], 6, axis=-1))  # (L, C, 1, 6)
        self._slides = constant(slide[:, :, None, None]) if slides.any() else None
        twist = np.zeros((4, 3, 6))
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            twist[j, i, k], twist[i, j, k] = 1.0, -1.0
            twist[3, i, 3 + i] = 1.0
        self._twist, self._plain = (
            constant(twist.reshape(12, 6)),
            constant([1.0, 1.0, 1.0, 0.0]),
        )
        # where joints mimic others, several frames add up to one column
        self._mimic = None if alone else constant(follow)  # (M, n)

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
        frames = self._frames(joints)  # (M, B, 4, 4)
        links = frames.index_select(0, self._links) @ self._tools  # (L, B, 4, 4)
        moving = frames.index_select(0, self._columns)  # (C, B, 4, 4)
        axis = moving.select(-1, 2).narrow(-1, 0, 3)
        position = links.select(-1, 3)  # (x, 1)
        # z x (x - p) and z are linear in the products of z with (x - p, 1)
        lever = position.unsqueeze(1) - moving.select(-1, 3) * self._plain  # (L, C, B, 4)
        products = lever.unsqueeze(-1) * axis.unsqueeze(-2)
        twists = (products.flatten(-2) @ self._twist) * self._turns
        if self._slides is not None:
            twists = twists + torch.nn.functional.pad(axis * self._slides, (0, 3))
        jacobians = twists.permute(2, 0, 3, 1)  # (B, L, 6, C)
        if self._mimic is not None:
            jacobians = jacobians @ self._mimic
        orientations = quaternions.of_poses(links)
        position = position.narrow(-1, 0, 3).transpose(0, 1)
        return position, orientations.transpose(0, 1), jacobians

    def _frames(self, joints: Tensor) -> Tensor:
        """Poses of the moving frames, the base first, shape (M, B, 4, 4)."""
        moved = torch.addmm(self._shift, self._follow, joints.T)
        moved = moved.view(*moved.shape, 1, 1)
        local = torch.addcmul(self._constant, self._sine, moved.sin())
        local = torch.addcmul(local, self._cosine, moved.cos())
        if self._sliding is not None:
            local = torch.addcmul(local, self._sliding, moved)
        if len(joints) == 1:  # the fewer dimensions, the less each operation costs
            local = local.squeeze(1)
            for hop in self._hops:
                local = torch.bmm(local.index_select(0, hop), local)
            return local.unsqueeze(1)
        if len(joints) < MANY:
            for hop in self._hops:
                local = local.index_select(0, hop) @ local
            return local
        levels = [local[:1]]
        for parents, start, end in self._levels:
            levels.append(levels[-1].index_select(0, parents) @ local[start:end])
        return torch.cat(levels)


#: A frame's pose after its joint's motion, as the factors of 1, of the joint's sine and cosine,
#: and of the joint itself: a turn about the z axis, and a way along it.
TURN = np.zeros((4, 4, 4))
TURN[0, [2, 3], [2, 3]] = 1.0
TURN[1, [1, 0], [0, 1]] = 1.0, -1.0
TURN[2, [0, 1], [0, 1]] = 1.0
SLIDE = np.zeros((4, 4, 4))
SLIDE[0] = np.eye(4)
SLIDE[3, 2, 3] = 1.0


def _z_to(axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """A rotation, as a matrix (4, 4), whose z axis is the given unit vector."""
    helper = np.eye(3)[np.abs(axis).argmin()]
    first = np.cross(helper, axis)
    first /= np.linalg.norm(first)
    matrix = np.eye(4)
    matrix[:3, :3] = np.column_stack((first, np.cross(axis, first), axis))
    return matrix


def _hops(parents: Sequence[int]) -> list[list[int]]:
    """Whom each frame is multiplied by: its parent, its ancestor of degree 2, 4, ..."""
    hops, ahead = [], list(parents)
    while any(ahead):
        hops.append(ahead)
        ahead = [ahead[frame] for frame in ahead]
    return hops
