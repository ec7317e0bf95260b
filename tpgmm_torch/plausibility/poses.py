"""Whether frames are poses in metres and (w, x, y, z), near the robot and like each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch

from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.plausibility.findings import Finding, listed
from tpgmm_torch.plausibility.outliers import set_apart
from tpgmm_torch.plausibility.summaries import EpisodeSummary
from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["FAR", "angles_to", "check_poses", "mean_orientation", "other_order"]

#: Nothing that a robot handles is so far from its base [m].
FAR = 10.0
#: With a robot: nor so far from its links, in reaches of it, and at least [m].
REACHES, FAR_FROM_LINKS = 5.0, 5.0
#: Objects within this distance [m] or angle [rad] of the usual place are where others are.
NEAR, LIKE = 0.15, float(np.deg2rad(60.0))
#: A tracker that jumps does so by this [m], at this speed [m/s].
JUMP, JUMP_SPEED = 0.1, 5.0


def check_poses(
    episodes: Sequence[EpisodeSummary], robot: Kinematics | None
) -> Iterator[Finding]:
    """Units, quaternion order, lost trackers, jumps, and places unlike the others.

    Parameters
    ----------
    episodes : sequence of EpisodeSummary
        With their joints in the robot's order.
    robot : Kinematics, optional
        Whose links come near what they handle.

    Yields
    ------
    Finding
    """
    for name in episodes[0].frames:
        far = list(_far(name, episodes, robot))
        yield from far
        if not far:
            yield from _unlike(name, episodes)
            yield from _jumps(name, episodes)
        yield from _quaternion_order(name, episodes)


def mean_orientation(orientations: Array) -> Array:
    """The quaternion nearest to all of (M, 4), whatever their signs.

    It is the eigenvector of the largest eigenvalue of ``sum q q^T`` [1]_.

    Parameters
    ----------
    orientations : array of shape (M, 4)

    References
    ----------
    .. [1] F. L. Markley et al.: Averaging Quaternions. Journal of Guidance, Control, and
       Dynamics 30 (2007), eq. (12).
    """
    vectors = np.linalg.eigh(orientations.T @ orientations)[1]
    mean: Array = vectors[:, -1]
    return mean


def angles_to(orientations: Array, reference: Array) -> Array:
    """Angles [rad] of the rotations from ``reference`` (4,) to ``orientations`` (..., 4)."""
    angles: Array = 2 * np.arccos(np.clip(np.abs(orientations @ reference), 0, 1))
    return angles


def other_order(orientations: Array) -> Array:
    """What ``orientations`` (..., 4) mean if they are (x, y, z, w), not (w, x, y, z)."""
    return np.roll(orientations, 1, axis=-1)


def _far(
    name: str, episodes: Sequence[EpisodeSummary], robot: Kinematics | None
) -> Iterator[Finding]:
    """A frame that is so far away that it must be in another unit."""
    positions = [e.frames[name].positions for e in episodes]
    distances = np.array([np.linalg.norm(p, axis=1).min() for p in positions])
    limit, place = FAR, "the base"
    if robot is not None and robot.links:
        paths = np.stack([e.path for e in episodes])
        with torch.no_grad():
            links = as_array(robot.state(torch.from_numpy(paths)).positions)
        apart = [
            np.linalg.norm(p[:, None, None] - x[None], axis=-1).min()
            for p, x in zip(positions, links, strict=True)
        ]
        reach = float(np.linalg.norm(links, axis=-1).max())
        if reach < FAR:  # else the links are in another unit, and were found
            distances, place = np.array(apart), "every link of the robot"
            limit = max(FAR_FROM_LINKS, REACHES * reach)
    if np.median(distances) > limit:
        low, high = (f(np.concatenate(positions)) for f in (np.min, np.max))
        yield Finding(
            "units",
            "unlikely",
            f"frame {name!r} is {np.median(distances):.4g} m away from {place}: its positions "
            f"are numbers from {low:.4g} to {high:.4g}",
            "Positions are in metres: are these in millimetres or centimetres? "
            "(load_lerobot: FramePose(..., scale=0.001))",
            (name,),
            value=float(np.median(distances)),
        )


def _unlike(name: str, episodes: Sequence[EpisodeSummary]) -> Iterator[Finding]:
    """Episodes in which the object is where it never is otherwise."""
    first = np.stack([e.frames[name].positions[0] for e in episodes])
    turns = np.stack([e.frames[name].orientations[0] for e in episodes])
    distances = np.linalg.norm(first - np.median(first, axis=0), axis=1)
    lost = np.flatnonzero((first == 0).all(axis=1))
    odd = set_apart(distances, NEAR)
    if 0 < len(lost) < len(episodes) / 2:
        odd = sorted({*odd, *(int(i) for i in lost)})
    if odd:
        within = float(np.delete(distances, odd).max())
        usual = ", ".join(f"{x:.3g}" for x in np.median(first, axis=0))
        places = [
            f"{distances[i]:.3g} m away in demonstration {i} "
            f"({', '.join(f'{x:.3g}' for x in first[i])})"
            for i in odd
        ]
        yield Finding(
            "frames",
            "unlikely",
            f"frame {name!r} is usually within {within:.2g} m of ({usual}), but "
            f"{listed(places)}",
            "Was the object tracked, and in the same base frame? Leave the episode out",
            (name,),
            tuple(odd),
            float(distances[odd].max()),
        )
    angles = angles_to(turns, _median_orientation(turns))
    if odd := set_apart(angles, LIKE):
        places = [f"by {np.rad2deg(angles[i]):.0f} deg in demonstration {i}" for i in odd]
        yield Finding(
            "frames",
            "unlikely",
            f"frame {name!r} is turned unlike in the others, {listed(places)}, usually within "
            f"{np.rad2deg(np.delete(angles, odd).max()):.0f} deg",
            "Was the object tracked, and are all quaternions (w, x, y, z)? Leave it out",
            (name,),
            tuple(odd),
            float(angles[odd].max()),
        )


def _median_orientation(turns: Array) -> Array:
    """That of the (first) episodes to which the others are nearest."""
    turns = turns[:500]
    apart = np.stack([angles_to(turns, turn) for turn in turns])
    nearest: Array = turns[np.median(apart, axis=1).argmin()]
    return nearest


def _jumps(name: str, episodes: Sequence[EpisodeSummary]) -> Iterator[Finding]:
    odd = []
    for index, episode in enumerate(episodes):
        size, typical, _ = episode.frames[name].jump
        if size > max(JUMP, 10 * typical, JUMP_SPEED * episode.step):
            odd.append(index)
    if odd:
        jumps = [episodes[i].frames[name].jump for i in odd]
        places = [
            f"by {size:.3g} m at {at:.4g} s of demonstration {i}"
            for i, (size, _, at) in zip(odd, jumps, strict=True)
        ]
        yield Finding(
            "frames",
            "unlikely",
            f"frame {name!r} jumps {listed(places)}",
            "Did the tracker lose it? Leave the episode out, or give one pose for all of it",
            (name,),
            tuple(odd),
            max(size for size, *_ in jumps),
        )


def _quaternion_order(name: str, episodes: Sequence[EpisodeSummary]) -> Iterator[Finding]:
    """Half-turns that would be turns about the vertical, were w the last number."""
    given = np.concatenate([e.frames[name].orientations for e in episodes])
    meant = other_order(given)
    spread = angles_to(given, mean_orientation(given))
    if (
        np.sqrt(np.mean(spread**2)) > np.deg2rad(2)
        and _upright(meant) > 0.97
        and _upright(given) < 0.5
        and np.median(np.abs(given[:, 0])) < 0.2
    ):
        yield Finding(
            "quaternions",
            "unlikely",
            f"frame {name!r} is turned by half turns about ever other axes; read as "
            "(x, y, z, w), its quaternions are turns about the vertical",
            "Quaternions are (w, x, y, z): give q[..., [3, 0, 1, 2]] "
            "(load_lerobot: FramePose(..., rotation='xyzw'))",
            (name,),
            value=float(np.rad2deg(np.sqrt(np.mean(spread**2)))),
        )


def _upright(orientations: Array) -> float:
    """Share of the scatter of orientations that is about the vertical axis."""
    mean = torch.from_numpy(mean_orientation(orientations).copy())
    relative = quaternions.product(torch.from_numpy(orientations), quaternions.conjugate(mean))
    turns = as_array(quaternions.log(relative)) ** 2
    return float(turns[:, 2].sum() / max(turns.sum(), 1e-12))
