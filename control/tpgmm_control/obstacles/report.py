"""Report of a motion among obstacles: what touches what, from when to when, and how deep."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from tpgmm_control.obstacles.scene import Scene
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.robots.held_objects import held_objects

__all__ = ["Contact", "find_contacts"]


@dataclass(frozen=True)
class Contact:
    """Two solids that overlap for a while.

    Parameters
    ----------
    one, other : str
        Names of links, objects or obstacles; the first is one that the robot moves.
    begin, end : float
        The first and the last instant [s].
    time : float
        When they overlap most [s].
    depth : float
        How much then [m].

    Examples
    --------
    >>> print(Contact("l_forearm", "table", 1.9, 2.4, 2.1, 0.008))
    l_forearm 8 mm inside table at 2.1 s
    """

    one: str
    other: str
    begin: float
    end: float
    time: float
    depth: float

    def __str__(self) -> str:
        return f"{self.one} {1e3 * self.depth:.0f} mm inside {self.other} at {self.time:.1f} s"


def find_contacts(
    scene: Scene,
    time: Any,
    joints: Any,
    frames: Mapping[str, Frame] | None = None,
    holds: Sequence[Hold] = (),
) -> list[Contact]:
    """Contacts in a motion, in the order of time.

    Parameters
    ----------
    scene : Scene
    time : array-like of shape (T,)
        In seconds.
    joints : array-like of shape (T, n_joints)
        References, or a recording [rad or m].
    frames : mapping of str to Frame, optional
        Poses of the objects, of shape () or (T,); of held ones where they were taken.
    holds : sequence of Hold
        What the robot holds meanwhile: it is part of the hand.

    Returns
    -------
    list of Contact
        One for each stretch of instants at which a pair overlaps.

    Raises
    ------
    ShapeError, DataError
        If the motion is not one of this robot, or a pose is missing.
    """
    postures = scene.robot.joint_tensor(joints)
    instants = torch.as_tensor(time, dtype=torch.float64)
    state, places = held_objects(scene.robot.state(postures), instants, frames or {}, holds)
    seconds, found = instants.numpy(), []
    for pair, distance in scene.distances(postures, places, 1e-3, state).items():
        names = scene.links_first(pair)
        inside = np.flatnonzero(distance < 0)
        for run in np.split(inside, np.flatnonzero(np.diff(inside) > 1) + 1):
            if len(run):
                deepest = run[distance[run].argmin()]
                begin, end, at = (float(seconds[row]) for row in (run[0], run[-1], deepest))
                found.append(Contact(*names, begin, end, at, float(-distance[deepest])))
    return sorted(found, key=lambda one: (one.begin, -one.depth))
