"""Summaries of recordings for the checks: small, however long an episode is."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from tpgmm_torch.checks.training import EpisodeSummary
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame

#: Instants of equal phase at which paths are compared.
PHASES = 21
#: A step is a jump if it is so many times the 98 % quantile of the joint's steps, this share of
#: its range, and larger than this [rad or m].
JUMP, JUMP_SHARE, SMALLEST_JUMP = 10.0, 0.2, 0.1
#: Steps at one end of a joint's range that may be a clipped run, at least.
SHORTEST_PLATEAU = 4
#: Joints with so few values are switched, as a gripper that is commanded open or closed: they
#: may jump and stand still.
FEW_VALUES = 5

#: Joint, instant [s] or value, and size [rad or m] of what happened there.
JointEvent = tuple[int, float, float]
Events = tuple[JointEvent, ...]


@dataclass(frozen=True)
class RecordingSummary(EpisodeSummary):
    """Summary of a recording for the checks, beyond those of ``fit``.

    Parameters
    ----------
    gap : tuple of float
        The largest step of time, and when it begins [s].
    path : array of shape (P, n_joints)
        Joints at equal phases, the first and the last instant among them.
    speed, fastest : array of shape (n_joints,)
        98 % quantile and largest of each joint's speed [rad/s or m/s].
    wraps, jumps : tuple of JointEvent
        Steps by a whole turn, and others that are like none of their joint.
    plateaus : tuple of JointEvent
        Values at which a path stops dead at an end of its range, and goes on from it.
    still : array of shape (n_joints,)
        Share of the longest run in which a joint has one value while others move.
    turns : mapping of str to array of shape (P, 4)
        Orientations of each frame at equal phases, or once.
    leaps : mapping of str to (float, float, float)
        The largest step of each frame [m], the 98 % quantile of its steps, and when [s].
    digest : str
        Digest of the joints, equal for copies.
    """

    gap: tuple[float, float]
    path: Array
    speed: Array
    fastest: Array
    wraps: tuple[JointEvent, ...]
    jumps: tuple[JointEvent, ...]
    plateaus: tuple[JointEvent, ...]
    still: Array
    turns: Mapping[str, Array]
    leaps: Mapping[str, tuple[float, float, float]]
    digest: str

    @classmethod
    def of(cls, demonstration: Demonstration) -> Self:
        """Summarise a recording."""
        time, joints = as_array(demonstration.time), as_array(demonstration.joints)
        periods, steps = np.diff(time), np.diff(joints, axis=0)
        with np.errstate(over="ignore"):  # damaged numbers
            speeds = np.abs(steps) / periods[:, None] if len(periods) else 0 * joints
        longest = int(periods.argmax()) if len(periods) else 0
        phases = np.linspace(0, len(time) - 1, PHASES).round().astype(int)
        poses = demonstration.frames
        wraps, jumps = _find_jumps(time, joints, steps)
        return cls(
            **vars(EpisodeSummary.of(demonstration)),
            gap=(float(periods.max(initial=0)), float(time[longest])),
            path=joints[phases],
            speed=np.quantile(speeds, 0.98, axis=0),
            fastest=speeds.max(axis=0),
            wraps=wraps,
            jumps=jumps,
            plateaus=_find_plateaus(joints, steps),
            still=_measure_still(steps),
            turns={
                name: as_array(frame.orientation[phases if frame.batch_shape else None])
                for name, frame in poses.items()
            },
            leaps={name: _find_leap(frame, time) for name, frame in poses.items()},
            digest=hashlib.sha256(joints.tobytes()).hexdigest(),
        )


Recordings = Sequence[RecordingSummary]


def _find_leap(frame: Frame, time: Array) -> tuple[float, float, float]:
    if not frame.batch_shape or len(time) < 2:
        return 0.0, 0.0, 0.0
    steps = np.linalg.norm(np.diff(as_array(frame.position), axis=0), axis=1)
    at = int(steps.argmax())
    return float(steps[at]), float(np.quantile(steps, 0.98)), float(time[at + 1])


def _find_jumps(time: Array, joints: Array, steps: Array) -> tuple[Events, Events]:
    """Find steps by a whole turn, and steps that are like no other of their joint."""
    if len(steps) < 3:
        return (), ()
    sizes = np.abs(steps)
    turn = (np.abs(sizes - 2 * np.pi) < 0.4) & (sizes > 5 * np.median(sizes, axis=0))
    usual = np.quantile(sizes, 0.98, axis=0)
    least = np.stack((JUMP * usual, JUMP_SHARE * np.ptp(joints, axis=0)))
    large = (sizes > least.max(axis=0, initial=SMALLEST_JUMP)) & ~turn & ~_is_switched(joints)

    def found(mask: NDArray[np.bool_]) -> Iterable[JointEvent]:
        return ((int(j), float(time[t + 1]), float(sizes[t, j])) for t, j in np.argwhere(mask))

    return tuple(found(turn)), tuple(found(large))


def _is_switched(joints: Array) -> NDArray[np.bool_]:
    return np.array([len(np.unique(column)) <= FEW_VALUES for column in joints.T])


def _runs(flags: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Find beginnings and ends (exclusive) of the runs of True, shape (n, 2)."""
    return np.flatnonzero(np.diff(np.concatenate(([False], flags, [False])))).reshape(-1, 2)


def _measure_still(steps: Array) -> Array:
    """Measure the longest run, its share, in which a joint rests and most others do not."""
    shares = np.zeros(steps.shape[1])
    moving = steps != 0
    for joint in range(steps.shape[1]):
        runs = _runs(~moving[:, joint])
        if len(runs):
            begin, end = runs[np.ptp(runs, axis=1).argmax()]
            others = np.delete(moving[begin:end], joint, axis=1).any(axis=1)
            if others.mean() > 0.8:
                shares[joint] = (end - begin) / len(steps)
    return shares


def _find_plateaus(joints: Array, steps: Array) -> tuple[JointEvent, ...]:
    """Find where a path runs into an end of its range at full speed, stays, and leaves it so.

    A motion that comes to rest slows down before; one that is cut off does not.
    """
    found: list[JointEvent] = []
    sizes, moving = np.abs(steps), (np.ptp(joints, axis=0) >= 0.02) & ~_is_switched(joints)
    for joint in np.flatnonzero(moving).tolist():
        column, size = joints[:, joint], sizes[:, joint]
        least = 0.5 * np.quantile(size, 0.75)
        for end in (column.min(), column.max()):
            plateau = joint, float(end), float(np.ptp(column))
            runs = _runs(column == end).tolist()
            found += [plateau for run in runs if _is_cut_off(run, size, least)]
    return tuple(found)


def _is_cut_off(run: Sequence[int], size: Array, least: float) -> bool:
    """Check if steps before and after a run of one value are larger than ``least`` > 0."""
    begin, stop = run
    # the steps onto the plateau and from it are cut off too: look one further
    inside = begin > 1 and stop < len(size)
    if not inside or stop - begin < SHORTEST_PLATEAU or not least:
        return False
    return bool(min(size[begin - 2], size[stop]) > least)
