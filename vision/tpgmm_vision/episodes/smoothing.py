"""Smooth the measured poses of an object over a whole episode, looking both ways in time.

Where the object is at rest, the robust mean of all its frames counts; where it moves, what was
measured. Gaps are filled where it is known what the object did: it stood still before and
after, a hand carried it, or the gap is short. Elsewhere the last pose is repeated, and said to
be unknown.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation, Slerp

from tpgmm_torch.exceptions import DataError
from tpgmm_vision.poses import Array, inverse, mean_pose

__all__ = ["Track", "smoothed"]

Flags = NDArray[np.bool_]
#: Poses are as far apart as three points on their axes are in the mean, which are so far from
#: the origin: an object is about as large [m].
LEVER = 0.05
#: What moves by less, or by less than so many times the noise of a frame, is at rest [m].
REST_DISTANCE, REST_NOISE = 0.003, 3.0
#: A rest takes this long [s], and has so many frames; so many frames elsewhere end it.
REST_TIME, REST_FRAMES, ELSEWHERE = 0.3, 5, 3
#: Of a hand that carries an object so many frames must tell, over a way of so many times what
#: counts as rest; an object is put down to twice that.
CARRIED_FRAMES, CARRIED_WAY, PUT = 3, 3.0, 2.0
#: A gap in a motion that is interpolated, as long as a hand's motion is nearly straight [s].
SHORT_GAP = 0.2
#: By when an object must have been seen at rest: a robot hardly reaches it earlier [s].
LATE = 0.5


@dataclass(frozen=True)
class Track:
    """Where an object was in an episode.

    Parameters
    ----------
    poses : ndarray of shape (T, 4, 4)
        In the base frame.
    seen, known : ndarray of bool, shape (T,)
        Whether it was measured in that row; whether it was measured or inferred.
    spread : float
        How far measured frames are from the means of rests, root mean square [m].
    """

    poses: Array
    seen: Flags
    known: Flags
    spread: float


def smoothed(
    time: Array, measured: Array, seen: Flags, hands: Mapping[str, Array] | None = None
) -> Track:
    """Smooth the poses of an object, and fill gaps.

    Parameters
    ----------
    time : ndarray of shape (T,)
        [s]
    measured : ndarray of shape (T, 4, 4)
        Poses in the base frame.
    seen : ndarray of bool, shape (T,)
        Which of them were measured.
    hands : mapping of str to ndarray of shape (T, 4, 4), optional
        Poses of links that may carry it.

    Raises
    ------
    DataError
        If it was never seen, or first seen late.
    """
    if not seen.any():
        raise DataError("it was never seen")
    track = _Smoother(time, measured.copy(), seen, hands or {})
    first, last = track.marked[[0, -1]]
    if first > 0:
        if time[first] > LATE or track.rest[first] < 0:
            moves = "" if track.rest[first] >= 0 else ", and moves then"
            raise DataError(f"it was first seen {time[first]:.2f} s after the start{moves}")
        track.fill(slice(0, first), track.poses[first])
    for a, b in pairwise(track.marked):
        if b > a + 1:
            track.bridge(int(a), int(b))
    track.finish(int(last))
    return Track(track.poses, seen, track.known, track.spread)


def _points(poses: Array) -> Array:
    """Poses (..., 4, 4) as points (..., 9), whose distances are those of poses."""
    points = poses[..., :3, 3:] + LEVER * poses[..., :3, :3]
    return np.asarray(points.reshape(*poses.shape[:-2], 9) / np.sqrt(3))


class _Smoother:
    """Poses of an object while they are smoothed."""

    def __init__(
        self, time: Array, poses: Array, seen: Flags, hands: Mapping[str, Array]
    ) -> None:
        self.time, self.poses, self.seen, self.hands = time, poses, seen, hands
        index = np.flatnonzero(seen)
        points = _points(poses[index])
        jumps = np.linalg.norm(np.diff(points, 2, axis=0), axis=1)  # of a motion next to none
        noise = float(np.median(jumps)) / np.sqrt(6) if len(jumps) else 0.0
        self.tolerance = max(REST_DISTANCE, REST_NOISE * noise)
        self.rest, self.known = np.full(len(time), -1), seen.copy()
        squares = []
        for number, inside in enumerate(_rests(time[index], points, self.tolerance)):
            mean, agree = mean_pose(list(poses[index[inside]]))
            rows = index[inside][agree]
            stretch = slice(rows[0], rows[-1] + 1)
            at = poses[stretch][seen[stretch], :3, 3]
            squares.append(np.square(at - mean[:3, 3]).sum(axis=1))
            self.rest[stretch] = number
            self.fill(stretch, mean)
        self.spread = float(np.sqrt(np.concatenate(squares).mean())) if squares else 0.0
        self.marked = np.flatnonzero(self.known)

    def fill(self, rows: slice, poses: Array) -> None:
        """Take poses for known."""
        self.poses[rows], self.known[rows] = poses, True

    def bridge(self, a: int, b: int) -> None:
        """Fill the gap between two known rows."""
        poses, gap = self.poses, slice(a + 1, b)
        resting = self.rest[a] >= 0 and self.rest[b] >= 0
        if resting and np.linalg.norm(np.diff(_points(poses[[a, b]]), axis=0)) < self.tolerance:
            return self.fill(gap, poses[a])
        if self.time[b] - self.time[a] <= SHORT_GAP:
            return self.fill(gap, _between(self.time, poses, a, b))
        found = [one for link in self.hands if (one := self._carried(link, a, b)) is not None]
        if not found:
            poses[gap] = poses[a]
            return None
        _, taken, put, hand, grasp = min(found, key=lambda one: one[0])
        self.fill(slice(a + 1, taken + 1), poses[a])
        self.fill(slice(put, b), poses[b])
        return self.fill(
            slice(max(taken, a + 1), min(put + 1, b)),
            (hand @ grasp)[max(taken, a + 1) : min(put + 1, b)],
        )

    def _carried(
        self, link: str, a: int, b: int
    ) -> tuple[float, int, int, Array, Array] | None:
        """When a link took the object in a gap, and put it down, and how far that is off."""
        hand = self.hands[link]
        taken, grasps = self._grasps(link, a, range(a, b), -1)
        put, later = self._grasps(link, b, range(a + 1, b + 1), 1)
        if not len(taken) or not len(put):
            return None
        away = cdist(_points(grasps), _points(later))
        away[np.asarray(taken)[:, None] >= np.asarray(put)] = np.inf
        i, j = np.unravel_index(away.argmin(), away.shape)
        if away[i, j] > PUT * self.tolerance:
            return None
        return float(away[i, j]), taken[i], put[j], hand, grasps[i]

    def _grasps(self, link: str, at: int, gap: range, way: int) -> tuple[list[int], Array]:
        """Rows at which a link may have taken or put down the object, and its pose in it."""
        if self.rest[at] >= 0:
            return list(gap), inverse(self.hands[link][gap.start : gap.stop]) @ self.poses[at]
        _, grasp = self._held(link, at, way)
        return ([], np.empty((0, 4, 4))) if grasp is None else ([at], grasp[None])

    def _held(self, link: str, at: int, way: int) -> tuple[int, Array | None]:
        """Pose of the object in a link that carries it before (-1) or after (1) a row."""
        rows = (
            self.marked[self.marked <= at][::-1] if way < 0 else self.marked[self.marked >= at]
        )
        inside = inverse(self.hands[link][rows]) @ self.poses[rows]
        points = _points(inside)
        near = np.median(points[:CARRIED_FRAMES], axis=0)
        away = np.linalg.norm(points - near, axis=1) > self.tolerance
        count = int(away.argmax()) if away.any() else len(rows)
        way_length = np.linalg.norm(
            _points(self.poses[rows[:count]]) - _points(self.poses[at]), axis=1
        )
        if count < CARRIED_FRAMES or way_length.max() < CARRIED_WAY * self.tolerance:
            return count, None
        return count, mean_pose(list(inside[: min(count, 4 * CARRIED_FRAMES)]))[0]

    def finish(self, last: int) -> None:
        """Fill what follows the last known row."""
        rows = slice(last + 1, len(self.time))
        self.poses[rows] = self.poses[last]
        if self.rest[last] >= 0:
            return
        found = [(*self._held(link, last, -1), hand) for link, hand in self.hands.items()]
        held = [
            (count, hand[rows] @ grasp) for count, grasp, hand in found if grasp is not None
        ]
        if held:
            self.fill(rows, max(held, key=lambda one: one[0])[1])


def _rests(time: Array, points: Array, tolerance: float) -> list[list[int]]:
    """Frames of which each rest consists, among those that were seen."""
    found, start = list[list[int]](), 0
    while start < len(points):
        inside, at = [start], start + 1
        while at < len(points) and at - inside[-1] <= ELSEWHERE:
            middle = np.median(points[inside[:: 1 + len(inside) // 64]], axis=0)
            if np.linalg.norm(points[at] - middle) <= tolerance:
                inside.append(at)
            at += 1
        third = max(len(inside) // 3, 1)
        drift = np.median(points[inside[:third]], 0) - np.median(points[inside[-third:]], 0)
        lasts = time[inside[-1]] - time[inside[0]] >= REST_TIME and len(inside) >= REST_FRAMES
        if lasts and np.linalg.norm(drift) <= tolerance / 2:
            found.append(inside)
            start = inside[-1] + 1
        else:
            start += 1 + len(inside) // 8
    return found


def _between(time: Array, poses: Array, a: int, b: int) -> Array:
    """Interpolated poses of the rows between two."""
    ends, inside = time[[a, b]], time[a + 1 : b]
    found = np.tile(np.eye(4), (b - a - 1, 1, 1))
    found[:, :3, :3] = Slerp(ends, Rotation.from_matrix(poses[[a, b], :3, :3]))(
        inside
    ).as_matrix()
    share = ((inside - ends[0]) / (ends[1] - ends[0]))[:, None]
    found[:, :3, 3] = (1 - share) * poses[a, :3, 3] + share * poses[b, :3, 3]
    return found
