"""Findings about joints: units, speeds, wraps, jumps, clipped and stuck values."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

import numpy as np

from tpgmm_datasets.checks.places import report_at
from tpgmm_datasets.checks.recording_summaries import RecordingSummary
from tpgmm_datasets.units import LARGEST_ANGLE
from tpgmm_torch.checks.report import Finding, shorten_list
from tpgmm_torch.checks.training import FAR, IMPOSSIBLE, ranges
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.pose_names import is_gripper, pose_groups, quaternion_groups
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.robots.tracked_poses import Poses

#: Differences of noisy positions are larger than speeds: by so much the 98 % quantile and the
#: largest may be.
FAST, FASTEST = 1.2, 3.0
#: Joints that usually move by this [rad or m] are stuck if they keep one value for this share
#: of an episode, and usually less than for the second.
MOVING, STUCK, USUALLY_STILL = 0.1, 0.4, 0.1
#: Joints that move by less were not recorded, or do not move [rad or m].
UNMOVED = 1e-9


def quaternion_columns(
    names: Sequence[str] | None, robot: Kinematics | None
) -> list[list[int]]:
    """List the columns of the quaternions among joints, known by names or by the robot."""
    starts = robot.quaternion_starts if robot is not None else ()
    groups = {tuple(range(start, start + 4)) for start in starts} | {*quaternion_groups(names)}
    return [list(group) for group in sorted(groups)]


def joint_findings(
    episodes: Sequence[RecordingSummary], robot: Kinematics | None, raw: Collection[str]
) -> Iterator[Finding]:
    """Find other units, speeds, wraps, jumps, clipped, stuck and still values.

    Parameters
    ----------
    episodes : sequence of RecordingSummary
        With their joints in the robot's order.
    robot : Kinematics, optional
        Whose limits hold.
    raw : collection of str
        Joints in a unit of their own, which are no angles.
    """
    low = np.min([episode.low for episode in episodes], axis=0)
    high = np.max([episode.high for episode in episodes], axis=0)
    named = episodes[0] if robot is None else robot
    names = named.joint_names or tuple(f"joint {i}" for i in range(len(low)))
    quaternion = set().union(*quaternion_columns(names, robot))
    angles = _select_angles(names, raw, quaternion)
    yield from _check_limits(episodes, names, (low, high), angles, robot)
    small = np.maximum(-low, high) <= LARGEST_ANGLE
    yield from _check_steps(episodes, names, [i for i in angles if small[i]])
    yield from _check_plateaus(episodes, names, angles)
    yield from _check_stuck(episodes, names)
    if not isinstance(robot, Poses):  # hands may stay in a plane
        yield from _check_idle(episodes, names, quaternion)


def _select_angles(
    names: Sequence[str], raw: Collection[str], quaternion: Collection[int]
) -> list[int]:
    """Select the joints that are in radians or metres, and no part of a quaternion."""
    others = {i for i, name in enumerate(names) if name in raw or is_gripper(name)}
    return sorted({*range(len(names))} - others.union(quaternion))


def _check_limits(
    episodes: Sequence[RecordingSummary],
    names: Sequence[str],
    extremes: tuple[Array, Array],
    angles: Sequence[int],
    robot: Kinematics | None,
) -> Iterator[Finding]:
    """Find other units where no limits are known, and speeds that the robot cannot reach."""
    low, high = extremes
    limits: Array = np.full((2, len(low)), [[-np.inf], [np.inf]])
    if robot is not None:
        limits = np.stack((as_array(robot.lower), as_array(robot.upper)))
    excess = np.maximum(limits[0] - low, high - limits[1])
    if not np.isfinite(limits).any():
        limit = FAR if isinstance(robot, Poses) else LARGEST_ANGLE
        yield from _check_units(names, low, high, angles, limit)
    if robot is not None and excess.max(initial=0) <= IMPOSSIBLE:  # else speeds are wrong too
        yield from _check_speeds(episodes, names, as_array(robot.velocity))


def _check_idle(
    episodes: Sequence[RecordingSummary], names: Sequence[str], quaternion: Collection[int]
) -> Iterator[Finding]:
    """Find joints, not parts of poses, that never move."""
    moved = np.max([episode.high - episode.low for episode in episodes], axis=0)
    in_poses = {i for group in pose_groups(names).values() for i in group}.union(quaternion)
    idle = [n for i, n in enumerate(names) if moved[i] <= UNMOVED and i not in in_poses]
    if idle:
        message = f"joints never move, in any demonstration: {shorten_list(idle)}"
        remedy = "Were they recorded? Leave out those that the skill does not need"
        yield Finding("still", message, remedy, tuple(idle))


def _check_units(
    names: Sequence[str], low: Array, high: Array, angles: Sequence[int], limit: float
) -> Iterator[Finding]:
    """Find values that are hardly radians, or metres of tracked links, without limits."""
    largest = np.maximum(-low, high)
    odd = sorted((i for i in angles if largest[i] > limit), key=lambda i: -largest[i])
    if odd:
        places = ranges(names, odd, low, high, np.full((2, len(low)), np.inf))
        message = (
            f"joints are in radians (metres, where they slide), these hardly are: {places}"
        )
        remedy = (
            "Are they in degrees, ticks or millimetres? If one joint is, all are: convert the "
            "whole joint vector, and positions of frames"
        )
        yield Finding("units", message, remedy, tuple(names[i] for i in odd))


def _check_speeds(
    episodes: Sequence[RecordingSummary], names: Sequence[str], velocity: Array
) -> Iterator[Finding]:
    fastest = np.stack([one.fastest for one in episodes])
    over = np.stack([one.speed for one in episodes]) > FAST * velocity
    over |= fastest > FASTEST * velocity
    odd, about = np.flatnonzero(over.any(axis=0)), np.flatnonzero(over.any(axis=1)).tolist()
    if len(odd):
        most = fastest.max(axis=0)
        places = shorten_list(
            [f"{names[j]!r} {most[j]:.3g}, limit {velocity[j]:.3g}" for j in odd]
        )
        message = (
            f"joints move faster than the robot can, up to [rad/s or m/s]: {places} "
            f"(demonstrations {shorten_list([str(i) for i in about])})"
        )
        remedy = "Is time in seconds, are values lost, or did warping squeeze a motion?"
        yield Finding("speed", message, remedy, tuple(names[j] for j in odd), tuple(about))


def _check_steps(
    episodes: Sequence[RecordingSummary], names: Sequence[str], angles: Sequence[int]
) -> Iterator[Finding]:
    """Find wraps and jumps."""
    lost = "Were values lost, or the recording stopped? Repair or leave out the episode"
    kinds = {
        "wraps": ("by a whole turn", "Unwrap the joints (np.unwrap(joints, axis=0))"),
        "jumps": ("like no other of that joint", lost),
    }
    for check, (what, remedy) in kinds.items():
        places = [
            (f"{names[j]!r} by {size:.3g} at {at:.4g} s of demonstration {i}", i, names[j])
            for i, episode in enumerate(episodes)
            for j, at, size in getattr(episode, check)
            if j in angles
        ]
        yield from report_at(check, f"there are steps {what}:", remedy, places)


def _check_plateaus(
    episodes: Sequence[RecordingSummary], names: Sequence[str], angles: Sequence[int]
) -> Iterator[Finding]:
    """Find ends of a range that are run into and left at full speed more than once."""
    ends: dict[tuple[str, float], list[int]] = {}
    for index, episode in enumerate(episodes):
        for joint, value, _ in episode.plateaus:
            if joint in angles:
                ends.setdefault((names[joint], value), []).append(index)
    if odd := {end: indices for end, indices in ends.items() if len(indices) > 1}:
        places = [f"{name!r} at {v:.4g}, {len(i)} times" for (name, v), i in odd.items()]
        message = f"motions stop dead at one value and go on from it: {shorten_list(places)}"
        remedy = "Was the recording cut off at a limit, or a sensor saturated?"
        about = sorted(set().union(*odd.values()))
        joints = dict.fromkeys(name for name, _ in odd)
        yield Finding("clipped", message, remedy, tuple(joints), tuple(about))


def _check_stuck(
    episodes: Sequence[RecordingSummary], names: Sequence[str]
) -> Iterator[Finding]:
    """Find joints that keep one value in one episode and move in the others."""
    if len(episodes) < 3:
        return
    ranges = np.stack([one.high - one.low for one in episodes])
    still = np.where(ranges <= 1e-9, 1.0, np.stack([one.still for one in episodes]))
    usual = np.median(ranges, axis=0)
    stuck = (still > STUCK) & (np.median(still, axis=0) < USUALLY_STILL) & (usual > MOVING)
    shares = [f"for {share:.0%} of it, usually moves by" for share in still[stuck]]
    places = [
        (f"{names[j]!r} of demonstration {e} {share} {usual[j]:.2g}", e, names[j])
        for share, (e, j) in zip(shares, np.argwhere(stuck).tolist(), strict=True)
    ]
    remedy = "Was a sensor or a motor off? Leave the episode out"
    yield from report_at("stuck", "joints keep one value while others move:", remedy, places)
