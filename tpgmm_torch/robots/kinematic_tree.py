"""The part of a URDF that moves some links with respect to a base: a tree of bodies.

:func:`reduce` hangs the tree on the base link, whichever it is, keeps the joints on the way
from there to the wanted links, and folds all that does not move (fixed and locked joints,
tools) into constant matrices. Seen from the base a joint on the way *up* to the root turns
the other way round, so a base that is itself moved by joints needs no formulas of its own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tpgmm_torch.data.arrays import Array
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.robots.urdf import FREEDOMS, Mimic, UrdfJoint, UrdfModel, motion


@dataclass(frozen=True, eq=False)
class Body:
    """A frame in that of another body; if a joint moves it, about or along its z axis.

    Its pose is the parent's pose times ``pose`` times the motion by
    ``multiplier * q[joint] + shift``.

    Attributes
    ----------
    parent : int
        Index of the body that carries it; 0 is the base, which carries itself.
    pose : ndarray of shape (4, 4)
        In the parent's frame, where the motion is zero.
    joint : int or None
        Index in the joint vector of what moves it; None if it is fixed to its parent.
    slides : bool
        Whether it moves along its axis, instead of about it.
    multiplier, shift : float
        How it follows that joint; 1 and 0 unless it mimics.
    """

    parent: int
    pose: Array
    joint: int | None = None
    slides: bool = False
    multiplier: float = 1.0
    shift: float = 0.0


def reduce(
    model: UrdfModel,
    base: str,
    links: Sequence[tuple[str, Array]],
    joints: Mapping[str, int],
    locked: Mapping[str, float],
) -> tuple[Body, ...]:
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

    Returns
    -------
    tuple of Body
        The base, what joints move, parents first, and the wanted links.

    Raises
    ------
    DataError
        If a joint of several degrees of freedom lies between the base and a link, or one of
        which nothing is known.
    """
    bodies = [Body(0, np.eye(4))]
    places = {base: (0, np.eye(4))}  # of each link, the body that it is fixed to, and where
    steps = _steps_from(model, base)
    for link, _ in links:
        way = [link]
        while way[-1] not in places:
            way.append(steps[way[-1]][1])
        for far in reversed(way[:-1]):
            joint, near = steps[far]
            carrier, pose = places[near]
            before, axis, after = _joint_transform(joint, near)
            leader = model.leader(joint.name) if joint.movable else None
            if leader and leader.joint in joints:
                turn = _z_to(axis)
                column, slides = joints[leader.joint], joint.type == "prismatic"
                follow = column, slides, leader.multiplier, leader.offset
                bodies.append(Body(carrier, pose @ before @ turn, *follow))
                places[far] = len(bodies) - 1, turn.T @ after
            else:
                at = _locked_position(leader, locked, link) if leader else 0.0
                places[far] = carrier, pose @ before @ motion(joint.type, axis, at) @ after
    ends = [(places[link], pose) for link, pose in links]
    return (*bodies, *(Body(carrier, place @ pose) for (carrier, place), pose in ends))


def _locked_position(leader: Mimic, locked: Mapping[str, float], link: str) -> float:
    """Return the position of a joint that is not in the joint vector."""
    if leader.joint not in locked:
        raise DataError(
            f"joint {leader.joint!r} moves link {link!r}: it is measured in radians (or "
            "metres), and cannot be a coordinate in a unit of its own"
        )
    return leader.multiplier * locked[leader.joint] + leader.offset


def _steps_from(model: UrdfModel, base: str) -> dict[str, tuple[UrdfJoint, str]]:
    """Find the last step from the base to each link: a joint, and the link before it."""
    above = {joint.child: joint for joint in model.joints}
    steps = {child: (joint, joint.parent) for child, joint in above.items()}
    steps.pop(base, None)
    near = base
    while near in above:  # towards the root, joints are crossed from child to parent
        joint = above[near]
        steps[joint.parent] = joint, near
        near = joint.parent
    return steps


def _joint_transform(joint: UrdfJoint, near: str) -> tuple[Array, Array, Array]:
    """Cross a joint from its near link to the far one: a pose, the axis, a pose."""
    if FREEDOMS[joint.type] > 1:
        raise DataError(
            f"joint {joint.name!r} of type {joint.type!r} lies between the base and the links: "
            "joints of several degrees of freedom are not supported; give a base beyond it, "
            f"base={joint.child!r} or below, or describe it by prismatic and revolute joints"
        )
    if joint.parent == near:
        return joint.origin, joint.axis, np.eye(4)
    back = np.asarray(np.linalg.inv(joint.origin), np.float64)
    return np.eye(4), -joint.axis, back


def _z_to(axis: Array) -> Array:
    """Rotate the z axis to a unit vector: a homogeneous matrix."""
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    matrix = np.eye(4)
    matrix[:3, :3] = np.column_stack((first, np.cross(axis, first), axis))
    return matrix
