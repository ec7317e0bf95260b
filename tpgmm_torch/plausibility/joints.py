"""Whether joint vectors are in radians, in order, within limits, and of a real motion."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.pose_names import is_gripper
from tpgmm_torch.plausibility.findings import Finding, listed
from tpgmm_torch.plausibility.summaries import EpisodeSummary, quaternion_columns
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.robots.tracked_poses import Poses

__all__ = ["LARGEST_ANGLE", "check_joints"]

#: Without limits, hardly a joint is turned further [rad], and hardly a recording in degrees
#: stays below.
LARGEST_ANGLE = 4 * math.pi
#: Limits and calibrations are not exact: so far beyond is not worth a word, in shares of the
#: range between the limits, and at most [rad or m].
BEYOND_SHARE, BEYOND = 0.1, 0.1
#: Nothing turns a bounded joint further beyond its limits [rad].
IMPOSSIBLE = 2 * math.pi
#: Differences of noisy positions are larger than speeds: by so much they may be.
FAST, FASTEST = 1.2, 3.0
#: No hand is so far from the base of its robot [m].
FAR = 10.0


def check_joints(
    episodes: Sequence[EpisodeSummary], robot: Kinematics | None
) -> Iterator[Finding]:
    """Units, order, limits, speeds, wraps, jumps, clipped and stuck values.

    Parameters
    ----------
    episodes : sequence of EpisodeSummary
        With their joints in the robot's order.
    robot : Kinematics, optional
        Whose limits hold.

    Yields
    ------
    Finding
    """
    width = len(episodes[0].low)
    given = next((e.joint_names for e in episodes if e.joint_names), None)
    own = robot.joint_names if robot is not None else None
    names = own or given or tuple(f"joint {i}" for i in range(width))
    starts = robot.quaternion_starts if robot is not None else ()
    angles = ~quaternion_columns(names, width, starts)
    low = np.min([e.low for e in episodes], axis=0)
    high = np.max([e.high for e in episodes], axis=0)
    limits: Array = np.full((2, width), [[-np.inf], [np.inf]])
    velocity: Array = np.full(width, np.inf)
    if robot is not None:
        limits, velocity = (
            np.stack((as_array(robot.lower), as_array(robot.upper))),
            as_array(robot.velocity),
        )
    excess = np.maximum(np.maximum(limits[0] - low, high - limits[1]), 0)
    yield from _ranges(names, low, high, limits, excess, given is None)
    if isinstance(robot, Poses):
        yield from _far_hands(names, low, high, angles)
    elif not np.isfinite(limits).any():
        yield from _angles(names, low, high, angles)
    if excess.max(initial=0) <= IMPOSSIBLE:  # else the units are wrong, and all speeds too
        yield from _speeds(episodes, names, velocity)
    turned = np.maximum(np.abs(low), np.abs(high)) <= LARGEST_ANGLE
    turned &= [not is_gripper(name) for name in names]
    yield from _steps(episodes, names, angles & turned)
    yield from _clipped(episodes, names, angles, limits)
    yield from _stuck(episodes, names)


def _ranges(
    names: Sequence[str],
    low: Array,
    high: Array,
    limits: Array,
    excess: Array,
    unnamed: bool,
) -> Iterator[Finding]:
    """Positions beyond the limits: other units, another order, or another robot."""
    order = np.argsort(-excess)
    beyond = [int(j) for j in order if excess[j] > _allowed(limits)[j]]
    if not beyond:
        return
    places = listed(
        [
            f"{names[j]!r} from {low[j]:.4g} to {high[j]:.4g}, limits {limits[0, j]:.4g} to "
            f"{limits[1, j]:.4g}"
            for j in beyond
        ]
    )
    worst, about = float(excess[beyond[0]]), tuple(names[j] for j in beyond)
    if worst > IMPOSSIBLE:
        yield Finding(
            "units",
            "error",
            f"joints are in radians (metres, where they slide), these cannot be: {places}",
            "Are they in degrees? If one joint is, all are: convert the whole joint vector "
            "(np.deg2rad; load_lerobot(..., units='deg'); --units deg)",
            about,
            value=worst,
        )
        return
    if unnamed and (better := _better_order(low, high, limits)) is not None:
        yield Finding(
            "order",
            "unlikely",
            f"the joints are unnamed, and their order does not fit the limits: {places}; "
            f"the columns {better} would fit the joints of the robot",
            "Name the columns: Demonstration(..., joint_names=[...])",
            about,
            value=worst,
        )
        return
    yield Finding(
        "limits",
        "unlikely",
        f"joints are beyond the robot's limits: {places}",
        "Check their zeros, units and order"
        + (", and name them (joint_names=[...])" if unnamed else "")
        + ", or that it is this robot; references will stay within the limits",
        about,
        value=worst,
    )


def _allowed(limits: Array) -> Array:
    """How far beyond its limits each joint may be without a word."""
    allowed: Array = np.minimum(BEYOND_SHARE * (limits[1] - limits[0]), BEYOND)
    return allowed


def _better_order(low: Array, high: Array, limits: Array) -> list[int] | None:
    """Columns for the joints of the robot, in its order, such that all fit their limits."""
    cost = np.maximum(limits[0][:, None] - low[None, :], high[None, :] - limits[1][:, None])
    cost = np.maximum(cost - _allowed(limits)[:, None], 0)
    rows, columns = linear_sum_assignment(cost)
    return [int(c) for c in columns] if cost[rows, columns].sum() == 0 else None


def _angles(
    names: Sequence[str], low: Array, high: Array, angles: NDArray[np.bool_]
) -> Iterator[Finding]:
    """Values that can hardly be angles, where no limits are known."""
    largest = np.maximum(np.abs(low), np.abs(high))
    odd = [
        int(j)
        for j in np.argsort(-largest)
        if angles[j] and largest[j] > LARGEST_ANGLE and not is_gripper(names[j])
    ]
    if odd:
        places = listed([f"{names[j]!r} from {low[j]:.4g} to {high[j]:.4g}" for j in odd])
        yield Finding(
            "units",
            "unlikely",
            f"joints are in radians (metres, where they slide), these hardly are: {places}",
            "Are they in degrees, ticks or millimetres? If one joint is, all are: convert the "
            "whole joint vector",
            tuple(names[j] for j in odd),
            value=float(largest[odd[0]]),
        )


def _far_hands(
    names: Sequence[str], low: Array, high: Array, places: NDArray[np.bool_]
) -> Iterator[Finding]:
    """Tracked positions that are too far away to be metres."""
    largest = np.where(places, np.maximum(np.abs(low), np.abs(high)), 0)
    if largest.max() > FAR:
        j = int(largest.argmax())
        yield Finding(
            "units",
            "unlikely",
            f"poses are in metres, {names[j]!r} goes from {low[j]:.4g} to {high[j]:.4g}",
            "Are they in millimetres or centimetres? Convert all positions, of frames too",
            (names[j],),
            value=float(largest[j]),
        )


def _speeds(
    episodes: Sequence[EpisodeSummary], names: Sequence[str], velocity: Array
) -> Iterator[Finding]:
    odd: dict[int, list[int]] = {}
    fastest = np.max([e.fastest for e in episodes], axis=0)
    for index, episode in enumerate(episodes):
        over = (episode.speed > FAST * velocity) | (episode.fastest > FASTEST * velocity)
        for joint in np.flatnonzero(over):
            odd.setdefault(int(joint), []).append(index)
    if odd:
        places = listed(
            [f"{names[j]!r} {fastest[j]:.3g}, limit {velocity[j]:.3g}" for j in odd]
        )
        about = sorted({index for indices in odd.values() for index in indices})
        yield Finding(
            "speed",
            "unlikely",
            f"joints move faster than the robot can, up to [rad/s or m/s]: {places} "
            f"(demonstrations {listed([str(i) for i in about])})",
            "Is time in seconds, are values lost, or did warping squeeze a motion?",
            tuple(names[j] for j in odd),
            tuple(about),
            max(float(fastest[j] / velocity[j]) for j in odd),
        )


def _steps(
    episodes: Sequence[EpisodeSummary], names: Sequence[str], angles: NDArray[np.bool_]
) -> Iterator[Finding]:
    """Wraps and jumps."""
    kinds = (
        ("wraps", "steps by a whole turn", "Unwrap the joints (np.unwrap(joints, axis=0))"),
        (
            "jumps",
            "steps like no other of that joint",
            "Were values lost, or the recording stopped? Repair or leave out the episode",
        ),
    )
    for check, what, remedy in kinds:
        found = [
            (index, joint, at, size)
            for index, episode in enumerate(episodes)
            for joint, at, size in getattr(episode, check)
            if angles[joint]
        ]
        if found:
            places = [
                f"{names[joint]!r} by {size:.3g} at {at:.4g} s of demonstration {index}"
                for index, joint, at, size in found
            ]
            yield Finding(
                check,
                "unlikely",
                f"there are {what}: {listed(places)}",
                remedy,
                tuple(dict.fromkeys(names[joint] for _, joint, _, _ in found)),
                tuple(dict.fromkeys(index for index, *_ in found)),
                max(size for *_, size in found),
            )


def _clipped(
    episodes: Sequence[EpisodeSummary],
    names: Sequence[str],
    angles: NDArray[np.bool_],
    limits: Array,
) -> Iterator[Finding]:
    """The same end of a range, run into and left at full speed more than once."""
    ends: dict[tuple[int, float], list[int]] = {}
    for index, episode in enumerate(episodes):
        for joint, value in episode.plateaus:
            if angles[joint] and not is_gripper(names[joint]):
                ends.setdefault((joint, value), []).append(index)
    odd = {end: indices for end, indices in ends.items() if len(indices) > 1}
    if odd:
        places = [f"{names[j]!r} at {v:.4g}, {len(i)} times" for (j, v), i in odd.items()]
        yield Finding(
            "clipped",
            "unlikely",
            f"motions stop dead at one value and go on from it: {listed(places)}",
            "Was the recording cut off at a limit, or a sensor saturated?",
            tuple(dict.fromkeys(names[j] for j, _ in odd)),
            tuple(sorted({index for indices in odd.values() for index in indices})),
            float(next(iter(odd))[1]),
        )


def _stuck(episodes: Sequence[EpisodeSummary], names: Sequence[str]) -> Iterator[Finding]:
    """A joint that stands still in one episode and moves in the others."""
    if len(episodes) < 3:
        return
    ranges = np.array([e.high - e.low for e in episodes])
    still = np.array([e.still for e in episodes])
    usual = np.median(ranges, axis=0)
    dead = (ranges <= 1e-9) & (usual > 0.1)
    frozen = (still > 0.4) & (np.median(still, axis=0) < 0.1) & (usual > 0.1)
    odd = [(int(e), int(j)) for e, j in zip(*np.nonzero(dead | frozen), strict=True)]
    if odd:
        places = [
            f"{names[j]!r} of demonstration {e} for {max(still[e, j], dead[e, j]):.0%} of it, "
            f"usually it moves by {usual[j]:.2g}"
            for e, j in odd
        ]
        yield Finding(
            "stuck",
            "unlikely",
            f"joints keep one value while the others move: {listed(places)}",
            "Was a sensor or a motor off? Leave the episode out",
            tuple(dict.fromkeys(names[j] for _, j in odd)),
            tuple(dict.fromkeys(e for e, _ in odd)),
            float(max(still[e, j] for e, j in odd)),
        )
