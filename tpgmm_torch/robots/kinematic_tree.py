"""The part of a URDF that moves some links with respect to a base: a tree of moving frames.

:func:`reduce` hangs the tree on the base link, whichever it is, keeps the joints on the way
from there to the wanted links, and folds all that does not move (fixed and locked joints,
tools) into constant matrices. Seen from the base a joint on the way *up* to the root turns
the other way round, so a base that is itself moved by joints needs no formulas of its own.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tpgmm_torch.data.arrays import Array
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.robots.urdf import FREEDOMS, UrdfJoint, UrdfModel

__all__ = ["Attachment", "MovingFrame", "MovingTree", "motion", "reduce"]


@dataclass(frozen=True, eq=False)
class MovingFrame:
    """The frame behind one moving joint.

    Its pose is the parent's pose times ``offset`` times the motion by
    ``multiplier * q[joint] + shift`` about (or, if ``prismatic``, along) ``axis``.

    Attributes
    ----------
    parent, joint : int
        Indices of the moving frame that carries it, -1 the base; and of what moves it in the
        joint vector.
    offset, axis : ndarray of shape (4, 4) and (3,)
        Pose of the joint in the parent frame, and a unit vector in the frame.
    prismatic : bool
        Whether it slides instead of turning.
    multiplier, shift : float
        How it follows that joint; 1 and 0 unless it mimics.
    """

    parent: int
    offset: Array
    axis: Array
    prismatic: bool
    joint: int
    multiplier: float
    shift: float


@dataclass(frozen=True, eq=False)
class Attachment:
    """Where something sits: ``pose`` (4, 4) in the moving frame ``frame``; -1 is the base."""

    frame: int
    pose: Array


@dataclass(frozen=True, eq=False)
class MovingTree:
    """Moving frames, parents first, and where the wanted links sit on them."""

    frames: tuple[MovingFrame, ...]
    links: tuple[Attachment, ...]

    def moved_by(self, frame: int) -> set[int]:
        """Indices of the moving frames from the base to ``frame``, itself included."""
        moving: set[int] = set()
        while frame >= 0:
            moving.add(frame)
            frame = self.frames[frame].parent
        return moving


def reduce(
    model: UrdfModel,
    base: str,
    links: Sequence[tuple[str, Array]],
    joints: Mapping[str, int],
    locked: Mapping[str, float],
) -> MovingTree:
    """Reduce the description ``model`` to what moves ``links`` with respect to ``base``.

    Parameters
    ----------
    model, base : UrdfModel, str
        The description, and its link that stands still.
    links : sequence of (str, ndarray of shape (4, 4))
        The wanted poses: a link and a pose in it.
    joints : mapping of str to int
        Position in the joint vector of each actuated joint that is used.
    locked : mapping of str to float
        Values at which all other actuated joints stand [rad or m].

    Raises
    ------
    DataError
        If a joint of several degrees of freedom lies between the base and a link.
    """
    frames: list[MovingFrame] = []
    places = {base: Attachment(-1, np.eye(4))}
    steps = _steps_from(model, base)
    for link, _ in links:
        way = [link]
        while way[-1] not in places:
            way.append(steps[way[-1]][1])
        for far in reversed(way[:-1]):
            joint, near = steps[far]
            places[far] = _cross(model, joint, near, places[near], joints, locked, frames)
    attached = [
        Attachment(places[link].frame, places[link].pose @ pose) for link, pose in links
    ]
    return MovingTree(tuple(frames), tuple(attached))


def _steps_from(model: UrdfModel, base: str) -> dict[str, tuple[UrdfJoint, str]]:
    """The last step from the base to each other link: the joint, and the link before it."""
    above = {joint.child: joint for joint in model.joints}
    steps = {child: (joint, joint.parent) for child, joint in above.items()}
    steps.pop(base, None)
    near = base
    while near in above:  # towards the root, joints are crossed from child to parent
        joint = above[near]
        steps[joint.parent] = joint, near
        near = joint.parent
    return steps


def _cross(
    model: UrdfModel,
    joint: UrdfJoint,
    near: str,
    place: Attachment,
    joints: Mapping[str, int],
    locked: Mapping[str, float],
    frames: list[MovingFrame],
) -> Attachment:
    """Where the far link of a joint sits; a joint that moves adds its frame to ``frames``."""
    if FREEDOMS[joint.type] > 1:
        raise DataError(
            f"joint {joint.name!r} of type {joint.type!r} lies between the base and the links: "
            "joints of several degrees of freedom are not supported; give a base beyond it, "
            f"base={joint.child!r} or below, or describe it by prismatic and revolute joints"
        )
    downwards = joint.parent == near
    before = place.pose @ joint.origin if downwards else place.pose
    if not joint.movable:
        return Attachment(place.frame, before if downwards else before @ _inverse(joint.origin))
    after = np.eye(4) if downwards else _inverse(joint.origin)
    leader = model.leader(joint.name)
    axis = joint.axis if downwards else -joint.axis
    if leader.joint in joints:
        prismatic, column = joint.type == "prismatic", joints[leader.joint]
        frames.append(
            MovingFrame(
                place.frame, before, axis, prismatic, column, leader.multiplier, leader.offset
            )
        )
        return Attachment(len(frames) - 1, after)
    value = leader.multiplier * locked[leader.joint] + leader.offset
    return Attachment(place.frame, before @ motion(joint.type, axis, value) @ after)


def motion(kind: str, axis: Array, value: float) -> Array:
    """Homogeneous matrix of a joint's motion (Rodrigues' formula, or a translation).

    Parameters
    ----------
    kind : str
        A type of URDF joints; "prismatic" slides, others turn.
    axis : ndarray of shape (3,)
        A unit vector.
    value : float
        Metres or radians.
    """
    matrix = np.eye(4)
    if kind == "prismatic":
        matrix[:3, 3] = value * axis
        return matrix
    cross = np.cross(axis, np.eye(3)).T
    matrix[:3, :3] += math.sin(value) * cross + (1.0 - math.cos(value)) * (cross @ cross)
    return matrix


def _inverse(pose: Array) -> Array:
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse
