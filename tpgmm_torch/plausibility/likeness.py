"""Whether demonstrations are of one skill, each its own, and enough for what is learned."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch

from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.data.pose_names import quaternion_groups
from tpgmm_torch.operators import Operator
from tpgmm_torch.operators.base import carried_objects, frame_names
from tpgmm_torch.operators.stack import leaves
from tpgmm_torch.operators.text import format_operator
from tpgmm_torch.plausibility.findings import Finding, listed
from tpgmm_torch.plausibility.outliers import outliers
from tpgmm_torch.plausibility.summaries import EpisodeSummary
from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["check_carried_things", "check_freedom", "check_likeness"]

#: Paths that differ by less of the joints' ranges, on average, are like each other.
LIKE = 0.5
#: Joints that hardly move are compared by this range [rad or m].
SMALLEST_RANGE = 0.2


def check_likeness(
    episodes: Sequence[EpisodeSummary], robot: Kinematics | None
) -> Iterator[Finding]:
    """Copies, and episodes whose path is not like the others.

    Parameters
    ----------
    episodes : sequence of EpisodeSummary
    robot : Kinematics, optional
        Tells which of its joints are quaternions.

    Yields
    ------
    Finding
    """
    first: dict[str, int] = {}
    pairs = []
    for index, episode in enumerate(episodes):
        if index != first.setdefault(episode.digest, index) and np.ptp(episode.path) > 0:
            pairs.append((index, first[episode.digest]))
    if pairs:
        places = [f"demonstration {b} is a copy of {a}" for b, a in pairs]
        yield Finding(
            "copies",
            "unlikely",
            f"some were recorded once and counted twice: {listed(places)}",
            "Leave the copies out: they make the model more certain than it may be",
            episodes=tuple(b for b, _ in pairs),
        )
    if len(episodes) < 5:
        return
    paths = _paths(episodes, robot)
    middle = np.median(paths, axis=0)
    scale = np.maximum(np.median(np.ptp(paths, axis=1), axis=0), SMALLEST_RANGE)
    distances = np.sqrt((((paths - middle) / scale) ** 2).mean(axis=(1, 2)))
    odd = [i for i in outliers(distances, floor=LIKE) if distances[i] > np.median(distances)]
    if odd:
        joints = np.sqrt((((paths - middle) / scale) ** 2).mean(axis=1))
        names = episodes[0].joint_names or tuple(f"joint {j}" for j in range(len(scale)))
        places = [
            f"demonstration {i} by {distances[i]:.2g} (most {names[joints[i].argmax()]!r})"
            for i in odd
        ]
        yield Finding(
            "episodes",
            "unlikely",
            "paths differ from the median path, in ranges of the joints, by about "
            f"{np.median(distances):.2g}, but {listed(places)}",
            "Is it the same skill, with the columns in the same order and unit? Leave it out",
            tuple(dict.fromkeys(names[joints[i].argmax()] for i in odd)),
            tuple(odd),
            float(distances[odd[0]]),
        )


def _paths(episodes: Sequence[EpisodeSummary], robot: Kinematics | None) -> Array:
    """Paths (E, P, n_joints); of quaternions each on the side of their mean."""
    paths = np.stack([episode.path for episode in episodes])
    starts = robot.quaternion_starts if robot is not None else ()
    groups = [list(range(start, start + 4)) for start in starts]
    groups += [list(group) for group in quaternion_groups(episodes[0].joint_names)]
    for columns in groups:
        turns = quaternions.continuous(torch.from_numpy(paths[..., columns]))
        mean = quaternions.continuous(quaternions.mean(turns.movedim(0, 1)))
        along = (turns * mean).sum((1, 2))[:, None, None]
        paths[..., columns] = (turns * quaternions.hemisphere_sign(along)).numpy()
    return paths


def check_freedom(
    n_demonstrations: int,
    operators: Sequence[Operator],
    kinematics: Kinematics,
    correlated: bool,
) -> Iterator[Finding]:
    """Fewer demonstrations than it takes to tell what varies together from what does not.

    Parameters
    ----------
    n_demonstrations : int
    operators : sequence of Operator
        What is learned.
    kinematics : Kinematics
        What they act on.
    correlated : bool
        Whether correlations of coordinates are learned, and not shrunk.

    Yields
    ------
    Finding
    """
    widest = max(operator.dimension(kinematics) for operator in operators)
    if n_demonstrations == 1:
        yield Finding(
            "freedom",
            "unlikely",
            "one demonstration does not show what may vary: every covariance is of its path "
            "alone",
            "Show the skill again from other starts and places, 5 times or more",
            value=1.0,
        )
    elif (
        n_demonstrations == 2
        and correlated
        and widest > 2
        and frame_names(operators, kinematics)
    ):
        yield Finding(
            "freedom",
            "unlikely",
            f"two demonstrations differ in one direction, and the covariances of {widest} "
            "coordinates would have to tell all apart",
            "Show the skill 5 times or more, or learn with covariance_shrinkage='auto'",
            value=2.0,
        )


def check_carried_things(
    operators: Sequence[Operator], kinematics: Kinematics, holds: Sequence[Hold]
) -> Iterator[Finding]:
    """Operators that say nothing at any time: what they look at never moves with the joints.

    Parameters
    ----------
    operators : sequence of Operator
        What is learned.
    kinematics : Kinematics
        Whose links move.
    holds : sequence of Hold
        What links carry.

    Yields
    ------
    Finding
    """
    links = {*kinematics.links}
    moved = links.union(hold.frame for hold in holds)
    silent = [
        operator
        for operator in leaves(operators)
        if operator.links()
        and moved.isdisjoint(operator.links())
        and links.isdisjoint(operator.references())
    ]
    if silent:
        names = carried_objects(silent, kinematics)
        texts = [format_operator(operator) for operator in silent]
        yield Finding(
            "holds",
            "unlikely",
            f"no link holds {' and '.join(names)}: {listed(texts)} says nothing of the joints",
            f"Say who holds what, holds=[Hold({names[0]!r}, LINK, BEGIN, END)] "
            f"(--hold {names[0]}@LINK:BEGIN-END), or leave such operators out; holds='auto' "
            "finds them where poses of objects are recorded over time",
            names,
        )
