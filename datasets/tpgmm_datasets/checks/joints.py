"""Findings about joints: units, speeds, wraps, jumps, clipped and stuck values."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from tpgmm_datasets.checks.places import Findings, report_at
from tpgmm_datasets.checks.recording_summaries import Recordings
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

Names = Sequence[str]


def quaternion_columns(names: Names | None, robot: Kinematics | None) -> list[list[int]]:
    """List the columns of the quaternions among joints, known by names or by the robot."""
    starts = robot.quaternion_starts if robot is not None else ()
    groups = {tuple(range(start, start + 4)) for start in starts} | {*quaternion_groups(names)}
    return [list(group) for group in sorted(groups)]


def joint_findings(
    episodes: Recordings, robot: Kinematics | None, raw: Collection[str]
) -> Findings:
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
    joints = _Joints(episodes, robot, raw)
    yield from joints.check_limits()
    yield from joints.check_steps()
    yield from joints.check_plateaus()
    yield from joints.check_stuck()
    if not isinstance(robot, Poses):  # hands may stay in a plane
        yield from joints.check_idle()


class _Joints:
    """Joints of recordings: their names and ranges, and what is looked for in them.

    ``angles`` are those in radians or metres, and no part of a ``quaternion``.
    """

    def __init__(
        self, episodes: Recordings, robot: Kinematics | None, raw: Collection[str]
    ) -> None:
        self.episodes, self.robot = episodes, robot
        self.low: Array = np.min([episode.low for episode in episodes], axis=0)
        self.high: Array = np.max([episode.high for episode in episodes], axis=0)
        named = episodes[0] if robot is None else robot
        self.names: Names = named.joint_names or [f"joint {i}" for i in range(len(self.low))]
        self.quaternion = set[int]().union(*quaternion_columns(self.names, robot))
        others = {i for i, name in enumerate(self.names) if name in raw or is_gripper(name)}
        self.angles = sorted({*range(len(self.names))} - others - self.quaternion)

    def check_limits(self) -> Findings:
        """Find units where no limits are known, and speeds that the robot cannot reach."""
        robot = self.robot
        limits: Array = np.full((2, len(self.low)), [[-np.inf], [np.inf]])
        if robot is not None:
            limits = np.stack((as_array(robot.lower), as_array(robot.upper)))
        excess = np.maximum(limits[0] - self.low, self.high - limits[1])
        if not np.isfinite(limits).any():
            yield from self._check_units(FAR if isinstance(robot, Poses) else LARGEST_ANGLE)
        if robot is not None and excess.max(initial=0) <= IMPOSSIBLE:
            yield from self._check_speeds(as_array(robot.velocity))  # else they are wrong too

    def check_idle(self) -> Findings:
        """Find joints, not parts of poses, that never move."""
        moved = np.max([episode.high - episode.low for episode in self.episodes], axis=0)
        still = {i for i in range(len(moved)) if moved[i] <= UNMOVED}
        parts = self.quaternion.union(*pose_groups(self.names).values())
        if idle := [self.names[i] for i in sorted(still - parts)]:
            message = f"joints never move, in any demonstration: {shorten_list(idle)}"
            remedy = "Were they recorded? Leave out those that the skill does not need"
            yield Finding("still", message, remedy, tuple(idle))

    def _check_units(self, limit: float) -> Findings:
        """Find values that are hardly radians, or metres of tracked links, without limits."""
        low, high, largest = self.low, self.high, np.maximum(-self.low, self.high)
        odd = sorted((i for i in self.angles if largest[i] > limit), key=lambda i: -largest[i])
        if odd:
            places = ranges(self.names, odd, low, high, np.full((2, len(low)), np.inf))
            usual = "joints are in radians (metres, where they slide)"
            remedy = (
                "Are they in degrees, ticks or millimetres? If one joint is, all are: convert "
                "the whole joint vector, and positions of frames"
            )
            names = tuple(self.names[i] for i in odd)
            yield Finding("units", f"{usual}, these hardly are: {places}", remedy, names)

    def _check_speeds(self, velocity: Array) -> Findings:
        fastest = np.stack([one.fastest for one in self.episodes])
        over = np.stack([one.speed for one in self.episodes]) > FAST * velocity
        over |= fastest > FASTEST * velocity
        odd, about = np.flatnonzero(over.any(axis=0)), np.flatnonzero(over.any(axis=1)).tolist()
        if len(odd):
            most, names = fastest.max(axis=0), tuple(self.names[j] for j in odd)
            places = [f"{self.names[j]!r} {most[j]:.3g}, limit {velocity[j]:.3g}" for j in odd]
            message = (
                "joints move faster than the robot can, up to [rad/s or m/s]: "
                f"{shorten_list(places)} (demonstrations {shorten_list([*map(str, about)])})"
            )
            remedy = "Is time in seconds, are values lost, or did warping squeeze a motion?"
            yield Finding("speed", message, remedy, names, tuple(about))

    def check_steps(self) -> Findings:
        """Find wraps and jumps."""
        lost = "Were values lost, or the recording stopped? Repair or leave out the episode"
        kinds = {
            "wraps": ("by a whole turn", "Unwrap the joints (np.unwrap(joints, axis=0))"),
            "jumps": ("like no other of that joint", lost),
        }
        names, largest = self.names, np.maximum(-self.low, self.high)
        angles = [i for i in self.angles if largest[i] <= LARGEST_ANGLE]
        for check, (what, remedy) in kinds.items():
            places = [
                (f"{names[j]!r} by {size:.3g} at {at:.4g} s of demonstration {i}", i, names[j])
                for i, episode in enumerate(self.episodes)
                for j, at, size in getattr(episode, check)
                if j in angles
            ]
            yield from report_at(check, f"there are steps {what}:", remedy, places)

    def check_plateaus(self) -> Findings:
        """Find ends of a range that are run into and left at full speed more than once."""
        ends: dict[tuple[str, float], list[int]] = {}
        for index, episode in enumerate(self.episodes):
            for joint, value, _ in episode.plateaus:
                if joint in self.angles:
                    ends.setdefault((self.names[joint], value), []).append(index)
        if odd := {end: indices for end, indices in ends.items() if len(indices) > 1}:
            places = [f"{name!r} at {v:.4g}, {len(i)} times" for (name, v), i in odd.items()]
            ends_at = shorten_list(places)
            message = f"motions stop dead at one value and go on from it: {ends_at}"
            remedy = "Was the recording cut off at a limit, or a sensor saturated?"
            about = sorted(set().union(*odd.values()))
            joints = dict.fromkeys(name for name, _ in odd)
            yield Finding("clipped", message, remedy, tuple(joints), tuple(about))

    def check_stuck(self) -> Findings:
        """Find joints that keep one value in one episode and move in the others."""
        episodes, names = self.episodes, self.names
        if len(episodes) < 3:
            return
        widths = np.stack([one.high - one.low for one in episodes])
        still = np.where(widths <= 1e-9, 1.0, np.stack([one.still for one in episodes]))
        usual = np.median(widths, axis=0)
        stuck = (still > STUCK) & (np.median(still, axis=0) < USUALLY_STILL) & (usual > MOVING)
        shares = [f"for {share:.0%} of it, usually moves by" for share in still[stuck]]
        places = [
            (f"{names[j]!r} of demonstration {e} {share} {usual[j]:.2g}", e, names[j])
            for share, (e, j) in zip(shares, np.argwhere(stuck).tolist(), strict=True)
        ]
        remedy = "Was a sensor or a motor off? Leave the episode out"
        yield from report_at(
            "stuck", "joints keep one value while others move:", remedy, places
        )
