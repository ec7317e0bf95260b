"""Where corners of tags are expected in pictures, and how calibrated values move them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import block_diag

from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_vision.camera import Camera
from tpgmm_vision.poses import Array, cross_matrix, pose_matrix, rigid

Integers = NDArray[np.int_]


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners of all tags in all pictures, N of them, those of one tag one after another.

    Parameters
    ----------
    pixels : ndarray of shape (N, 2)
    points : ndarray of shape (N, 3)
        In the frames of their targets [m].
    posture, camera, target, number : ndarray of int, shape (N,)
        Of each: the row of the joints, in ascending order; which camera and target, and the
        tag.
    """

    pixels: Array
    points: Array
    posture: Integers
    camera: Integers
    target: Integers
    number: Integers

    def of(self, rows: NDArray[np.bool_]) -> Corners:
        """Some of them."""
        return Corners(**{name: getattr(self, name)[rows] for name in self.__annotations__})


@dataclass(eq=False)
class Reprojection:
    """Corners that are seen, explained by poses, offsets of joints, and scales.

    The state is a vector: the matrices of the poses of the cameras in their carriers, of the
    targets in theirs, and of the bases of other arms, 16 numbers each; then an offset for each
    joint, the logarithm of a scale for each camera's focal length, and of that of all tags.

    Parameters
    ----------
    robot : Kinematics
    joints : ndarray of shape (n, n_joints)
        As measured [rad].
    corners : Corners
    cameras : sequence of Camera
    carriers : sequence of str or None
        The link that carries each camera, then each target; None where it stands still.
    bases : sequence of set of str
        For each arm whose base is not known, its links.
    free : ndarray of bool, shape (n_steps,), optional
        Which entries of a step change: six for each pose, then the other numbers. By default
        all but the scales and the offsets of joints that move nothing.

    Attributes
    ----------
    links, base_of : ndarray of int
        Indices: of the link of each carrier, and of the base of each link, -1 where that is
        known.
    n_poses, n_steps : int
        Number of poses in the state, and of entries of a step.
    offsets, scales : slice
        Entries of a step that are offsets of joints; that are scales, of focal lengths, then
        that of tags.
    """

    robot: Kinematics
    joints: Array
    corners: Corners
    cameras: Sequence[Camera]
    carriers: Sequence[str | None]
    bases: Sequence[set[str]] = ()
    free: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))

    def __post_init__(self) -> None:
        names = self.robot.links
        links = [len(names) if one is None else names.index(one) for one in self.carriers]
        self.links, self.base_of = np.array(links), np.full(len(names) + 1, -1)
        for number, own in enumerate(self.bases):
            self.base_of[[names.index(name) for name in own]] = number
        self.n_poses = len(self.carriers) + len(self.bases)
        self.offsets = slice(6 * self.n_poses, 6 * self.n_poses + self.robot.n_joints)
        self.scales = slice(self.offsets.stop, None)
        self.n_steps = self.offsets.stop + len(self.cameras) + 1
        if not len(self.free):
            self.free = free = np.ones(self.n_steps, dtype=bool)
            jacobians = np.abs(self.place_links(self.nothing)[1][:, self.links])
            free[self.offsets], free[self.scales] = jacobians.max((0, 1, 2)) > 1e-9, False

    def state(self, poses: Array) -> Array:
        """Return the state of poses (n_poses, 4, 4), without offsets and scales."""
        return np.concatenate((poses.ravel(), np.zeros(self.n_steps - 6 * self.n_poses)))

    @property
    def nothing(self) -> Array:
        """The state of poses that move nothing."""
        return self.state(np.tile(np.eye(4), (self.n_poses, 1, 1)))

    def split(self, state: Array) -> tuple[Array, Array, Array]:
        """Poses (n_poses, 4, 4), offsets (n_joints,) and scales of a state."""
        poses, rest = np.split(state, [16 * self.n_poses])
        offsets, scales = np.split(rest, [self.robot.n_joints])
        return poses.reshape(-1, 4, 4), offsets, scales

    def move_state(self, state: Array, step: Array) -> Array:
        """Compute a state after a step: poses of cameras and targets in their own axes."""
        poses, *_ = self.split(state)
        turns = [rigid(one[3:], one[:3]) for one in step[: self.offsets.start].reshape(-1, 6)]
        n = len(self.carriers)
        after = [pose @ turn for pose, turn in zip(poses[:n], turns[:n], strict=True)]
        after += [turn @ pose for pose, turn in zip(poses[n:], turns[n:], strict=True)]
        changed = state[16 * self.n_poses :] + step[self.offsets.start :]
        return np.concatenate((np.ravel(after), changed))

    def place_links(self, state: Array, joints: Array | None = None) -> tuple[Array, Array]:
        """Poses of all links, and one that stands still, in the base frame, and Jacobians.

        Returns
        -------
        poses : ndarray of shape (n, n_links + 1, 4, 4)
        jacobians : ndarray of shape (n, n_links + 1, 6, n_joints)
        """
        poses, offsets, _ = self.split(state)
        joints = (self.joints if joints is None else joints) + offsets
        found = self.robot.state(torch.as_tensor(joints))
        values = torch.cat((found.positions, found.orientations), -1).numpy()
        still = np.tile([0, 0, 0, 1.0, 0, 0, 0], (len(values), 1, 1))
        links = pose_matrix(np.concatenate((values, still), 1))
        jacobians = np.pad(found.jacobians.numpy(), ((0, 0), (0, 1), (0, 0), (0, 0)))
        for number, base in enumerate(poses[len(self.carriers) :]):
            own, turn = self.base_of == number, block_diag(base[:3, :3], base[:3, :3])
            links[:, own], jacobians[:, own] = base @ links[:, own], turn @ jacobians[:, own]
        return links, jacobians

    def place_carried(self, state: Array, joints: Array | None = None) -> Array:
        """Poses (n, n_cameras + n_targets, 4, 4) of cameras and targets in the base frame."""
        n = len(self.carriers)
        return self.place_links(state, joints)[0][:, self.links] @ self.split(state)[0][:n]

    def expect_pixels(self, state: Array) -> tuple[Array, Array, Array]:
        """Predict the pixels of corners, and how steps and joints move them.

        Returns
        -------
        pixels : ndarray of shape (N, 2)
        jacobian : ndarray of shape (N, 2, n_steps)
        seen : ndarray of shape (N, 3, n_steps)
            The Jacobian of the points in their cameras' frames.
        """
        c, (poses, _, scales) = self.corners, self.split(state)
        (links, jacobians), rows = self.place_links(state), np.arange(len(self.corners.pixels))
        of = np.stack((c.camera, len(self.cameras) + c.target))
        camera, target = links[c.posture, self.links[of]] @ poses[of]
        points = c.points * np.exp(scales[-1])
        world = (target[:, :3, :3] @ points[..., None])[..., 0] + target[:, :3, 3]
        back = camera[:, :3, :3].swapaxes(-1, -2)
        local = (back @ (world - camera[:, :3, 3])[..., None])[..., 0]
        moves = np.zeros((len(world), 3, self.n_steps))
        ones = np.tile(np.eye(3), (len(world), 1, 1))
        for sign, part in ((-1.0, of[0]), (1.0, of[1])):
            link = self.links[part]
            arm = world - links[c.posture, link, :3, 3]
            linear, angular = np.split(jacobians[c.posture, link], 2, axis=1)
            moves[..., self.offsets] += sign * (linear - cross_matrix(arm) @ angular)
            base = self.base_of[link]
            there = np.flatnonzero(base >= 0)
            columns = 6 * (len(self.carriers) + base[there, None]) + np.arange(6)
            twist = np.concatenate((ones, -cross_matrix(world)), -1)
            moves[there[:, None], :, columns] += sign * twist[there].swapaxes(1, 2)
        turn = target[:, :3, :3]
        twist = np.concatenate((turn, -turn @ cross_matrix(points)), -1)
        moves[rows[:, None], :, 6 * of[1][:, None] + np.arange(6)] = twist.swapaxes(1, 2)
        moves[..., -1] = (turn @ points[..., None])[..., 0]
        seen = back @ moves
        twist = np.concatenate((-ones, cross_matrix(local)), -1)
        seen[rows[:, None], :, 6 * of[0][:, None] + np.arange(6)] = twist.swapaxes(1, 2)
        pixels, jacobian = np.zeros((len(world), 2)), np.zeros((len(world), 2, self.n_steps))
        for number, one in enumerate(self.cameras):
            own, scale = c.camera == number, np.exp(scales[number])
            if not own.any():
                continue
            found, rates = one.project_with_rates(local[own])
            away = scale * (found - one.principal_point)
            pixels[own], jacobian[own] = away + one.principal_point, scale * rates @ seen[own]
            jacobian[own, :, self.scales.start + number] = away
        return pixels, jacobian, seen
