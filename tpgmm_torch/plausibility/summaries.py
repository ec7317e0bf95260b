"""What the checks of plausibility keep of a demonstration: small, whatever its length."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tpgmm_torch.data.affine import Affine
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.pose_names import quaternion_groups

__all__ = ["PHASES", "EpisodeSummary", "PoseSummary", "poses_among", "quaternion_columns"]

#: Instants of equal phase at which paths are kept and compared.
PHASES = 21
#: Shortest run at an end of a joint's range that may be a clipped one.
SHORTEST_PLATEAU = 4
#: A step is a jump if it is so many times the 98 % quantile of the joint's steps ...
JUMP = 10.0
#: ... and this share of its range.
JUMP_SHARE = 0.2


@dataclass(frozen=True)
class PoseSummary:
    """The way of one frame: at equal phases, or once where it stands still.

    Parameters
    ----------
    positions : array of shape (P, 3)
    orientations : array of shape (P, 4)
    jump : tuple of float
        The largest distance between two steps [m], the 98 % quantile of them, and when [s].
    """

    positions: Array
    orientations: Array
    jump: tuple[float, float, float]

    @classmethod
    def of(cls, frame: Frame, time: Array) -> PoseSummary:
        """Look at the poses of a frame at the instants ``time`` (T,)."""
        positions, orientations = as_array(frame.position), as_array(frame.orientation)
        if not frame.batch_shape:
            return cls(positions[None], orientations[None], (0.0, 0.0, 0.0))
        chosen = _phases(len(time))
        jump = (0.0, 0.0, 0.0)
        if len(time) > 1:
            steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
            at = int(steps.argmax())
            jump = (float(steps[at]), float(np.quantile(steps, 0.98)), float(time[at + 1]))
        return cls(positions[chosen], orientations[chosen], jump)


@dataclass(frozen=True)
class EpisodeSummary:
    """What is kept of a demonstration.

    Parameters
    ----------
    begin, duration : float
        When it begins, and how long it is [s].
    n_steps : int
    step, longest : float
        Median and largest step of time [s].
    gap : float
        Where the largest begins [s].
    joint_names : tuple of str or None
    low, high : array of shape (n_joints,)
        Range of each joint.
    path : array of shape (P, n_joints)
        Joints at equal phases, the first and the last instant among them.
    speed, fastest : array of shape (n_joints,)
        98 % quantile and largest of each joint's speed [rad/s].
    wraps, jumps : tuple of (int, float, float)
        Joint, instant [s] and size [rad] of steps by a whole turn, and of others that are
        like none.
    still : array of shape (n_joints,)
        Share of the longest run in which a joint has one value while others move.
    plateaus : tuple of (int, float)
        Joint and value where a path stops dead at an end of its range, and leaves it so.
    frames : mapping of str to PoseSummary
    events : mapping of str to float
        As shares of the duration.
    digest : str
        Of joints: equal for copies.
    """

    begin: float
    duration: float
    n_steps: int
    step: float
    longest: float
    gap: float
    joint_names: tuple[str, ...] | None
    low: Array
    high: Array
    path: Array
    speed: Array
    fastest: Array
    wraps: tuple[tuple[int, float, float], ...]
    jumps: tuple[tuple[int, float, float], ...]
    still: Array
    plateaus: tuple[tuple[int, float], ...]
    frames: Mapping[str, PoseSummary]
    events: Mapping[str, float]
    digest: str

    @classmethod
    def of(cls, demonstration: Demonstration) -> EpisodeSummary:
        """Look at every step of a demonstration once."""
        time, joints = as_array(demonstration.time), as_array(demonstration.joints)
        periods, steps = np.diff(time), np.diff(joints, axis=0)
        duration = float(time[-1] - time[0])
        n = joints.shape[1]
        speeds = np.abs(steps) / periods[:, None] if len(periods) else np.zeros((1, n))
        wraps, jumps = _jumps(time, joints, steps)
        longest = int(periods.argmax()) if len(periods) else 0
        return cls(
            begin=float(time[0]),
            duration=duration,
            n_steps=len(time),
            step=float(np.median(periods)) if len(periods) else 0.0,
            longest=float(periods[longest]) if len(periods) else 0.0,
            gap=float(time[longest]),
            joint_names=demonstration.joint_names,
            low=joints.min(axis=0),
            high=joints.max(axis=0),
            path=joints[_phases(len(time))],
            speed=np.quantile(speeds, 0.98, axis=0),
            fastest=speeds.max(axis=0),
            wraps=wraps,
            jumps=jumps,
            still=_still(steps),
            plateaus=_plateaus(joints, steps),
            frames={
                name: PoseSummary.of(frame, time)
                for name, frame in poses_among(demonstration.frames).items()
            },
            events={
                name: (at - float(time[0])) / duration if duration else 0.0
                for name, at in demonstration.events.items()
            },
            digest=hashlib.sha256(joints.tobytes()).hexdigest(),
        )


def poses_among(frames: Mapping[str, Frame]) -> dict[str, Frame]:
    """The ``frames`` that are poses: general task parameters A, b are none."""
    return {name: frame for name, frame in frames.items() if not isinstance(frame, Affine)}


def quaternion_columns(
    names: Sequence[str] | None, width: int, starts: Sequence[int] = ()
) -> NDArray[np.bool_]:
    """Which columns of joint vectors hold quaternions.

    Parameters
    ----------
    names : sequence of str or None
        Of the columns, which may tell of quaternions.
    width : int
        How many columns there are.
    starts : sequence of int
        Where the kinematics say that quaternions start.
    """
    mask = np.zeros(width, dtype=bool)
    for start in starts:
        mask[start : start + 4] = True
    for group in quaternion_groups(names):
        mask[list(group)] = True
    return mask


def _phases(length: int) -> NDArray[np.intp]:
    return np.linspace(0, length - 1, PHASES).round().astype(np.intp)


def _jumps(
    time: Array, joints: Array, steps: Array
) -> tuple[tuple[tuple[int, float, float], ...], tuple[tuple[int, float, float], ...]]:
    """Steps by a whole turn, and steps that are like no other of their joint."""
    if len(steps) < 3:
        return (), ()
    sizes = np.abs(steps)
    typical = np.quantile(sizes, 0.98, axis=0)
    turn = (np.abs(sizes - 2 * np.pi) < 0.4) & (sizes > 5 * np.median(sizes, axis=0))
    # what knows a few values only, like a gripper that is commanded open or closed, may jump
    few = np.array([len(np.unique(column)) <= 5 for column in joints.T])
    range_ = np.ptp(joints, axis=0)
    large = (sizes > JUMP * typical) & (sizes > JUMP_SHARE * range_) & (sizes > 0.1) & ~few
    found = []
    for mask in (turn, large & ~turn):
        places = zip(*np.nonzero(mask), strict=True)
        found.append(tuple((int(j), float(time[t + 1]), float(sizes[t, j])) for t, j in places))
    return found[0], found[1]


def _runs(flags: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Beginnings and ends (exclusive) of the runs of True, shape (n, 2)."""
    edges = np.diff(np.concatenate(([False], flags, [False])).astype(np.int8))
    return np.stack((np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)), axis=1)


def _still(steps: Array) -> Array:
    """Share of the longest run in which one joint keeps its value and most others do not."""
    shares = np.zeros(steps.shape[1])
    if len(steps) < 10:
        return shares
    moving = steps != 0
    for joint in range(steps.shape[1]):
        runs = _runs(~moving[:, joint])
        if not len(runs):
            continue
        begin, end = runs[(runs[:, 1] - runs[:, 0]).argmax()]
        others = np.delete(moving[begin:end], joint, axis=1).any(axis=1)
        if others.mean() > 0.8:
            shares[joint] = (end - begin) / len(steps)
    return shares


def _plateaus(joints: Array, steps: Array) -> tuple[tuple[int, float], ...]:
    """Where a path runs into an end of its range at full speed, stays, and leaves it so.

    A motion that comes to rest slows down before; one that is cut off does not.
    """
    if len(steps) < 10:
        return ()
    found = []
    sizes = np.abs(steps)
    low, high = joints.min(axis=0), joints.max(axis=0)
    for joint in range(joints.shape[1]):
        column, size = joints[:, joint], sizes[:, joint]
        typical = np.quantile(size, 0.75)
        if high[joint] - low[joint] < 0.02 or typical == 0 or len(np.unique(column)) <= 5:
            continue
        for end in (low[joint], high[joint]):
            for begin, stop in _runs(column == end):
                # the steps onto the plateau and from it are cut off too: look one further
                inside = begin > 1 and stop < len(column) - 1
                if not inside or stop - begin < SHORTEST_PLATEAU:
                    continue
                if min(size[begin - 2], size[stop]) > 0.5 * typical:
                    found.append((joint, float(end)))
    return tuple(found)
