"""The poses of an object over a whole episode, smoothed by looking both ways in time.

Where the object is at rest, the robust mean of all its frames counts; where it moves, what was
measured. Gaps are filled where it is known what the object did: it stood still before and
after, a hand carried it, or the gap is short. Elsewhere the last pose is repeated, and said to
be unknown.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation, Slerp

from tpgmm_torch.exceptions import DataError
from tpgmm_vision.poses import Array, inverse, mean_pose

#: Poses are as far apart as three points on their axes are in the mean, which are so far from
#: the origin: an object is about as large [m].
LEVER = 0.05
#: What moves by less, or by less than so many times the noise of a frame, is at rest [m].
REST_DISTANCE, REST_NOISE = 0.003, 3.0
#: A rest takes this long [s], and has so many frames; so many frames elsewhere end it.
REST_TIME, REST_FRAMES, ELSEWHERE = 0.3, 5, 3
#: Of a hand that carries an object so many frames must tell, over a way of so many times that
#: by which its place in the hand may change, as for ``find_holds`` [m].
CARRIED_FRAMES, CARRIED_WAY, SLIP = 3, 3.0, 0.01
#: A gap in a motion that is interpolated, as long as a hand's motion is nearly straight [s].
SHORT_GAP = 0.2
#: An object that is seen later was hidden for long [s]; a hand that was nearer to it before may
#: have moved it [m].
LATE, NEAR = 0.5, 0.15


class Track:
    """Where an object was in an episode.

    Parameters
    ----------
    time : ndarray of shape (T,)
        Of the rows [s].

    Attributes
    ----------
    poses : ndarray of shape (T, 4, 4)
        In the base frame.
    seen, known : ndarray of bool, shape (T,)
        Whether it was measured in a row; whether it was measured or inferred.
    residuals : ndarray of shape (T,)
        Of the corners, where it was seen [pixels].
    reasons : list of str
        Why it was not seen in a row.
    spread : float
        How far measured positions are from the means of rests, root mean square [m].
    """

    def __init__(self, time: Array) -> None:
        self.time, rows = time, len(time)
        self.poses = np.tile(np.eye(4), (rows, 1, 1))
        self.residuals = np.zeros(rows, np.float32)
        self.seen, self.known = np.zeros((2, rows), dtype=bool)
        self.reasons = [""] * rows
        self._rest, self._tolerance, self.spread = np.full(rows, -1), REST_DISTANCE, 0.0

    def smooth(self, hands: Mapping[str, Array]) -> None:
        """Smooth the poses that were seen, and fill gaps.

        Parameters
        ----------
        hands : mapping of str to ndarray of shape (T, 4, 4)
            Poses of links that may carry it.

        Raises
        ------
        DataError
            If it was never seen, or first seen late.
        """
        index = np.flatnonzero(self.seen)
        if not len(index):
            raise DataError(f"it was never seen: {self.reasons[-1]}")
        runs = np.split(index, np.flatnonzero(np.diff(self.time[index]) > LATE) + 1)
        for run in runs[1:]:
            self.seen[run] = len(run) >= CARRIED_FRAMES  # fewer, alone for long, may be wrong
        self._fill_rests(np.flatnonzero(self.seen))
        self._begin(hands)
        known = np.flatnonzero(self.known)
        for a, b in pairwise(known.tolist()):
            if b > a + 1:
                self._bridge(a, b, hands)
        last = int(known[-1])
        rest = slice(last + 1, len(self.time))
        self.poses[rest] = self.poses[last]
        held = [(*self._held(hand, last), hand) for hand in hands.values()]
        count, grasp, hand = max(held, key=lambda one: one[0], default=(0, *self.poses[:2]))
        if count and self._rest[last] < 0:
            self._fill(rest, hand[rest] @ grasp)

    def _fill_rests(self, index: NDArray[np.intp]) -> None:
        """Find rests among the rows in which the object was seen, and fill them."""
        points, self.known = _points(self.poses[index]), self.seen.copy()
        jumps = np.linalg.norm(np.diff(points, 2, axis=0), axis=1)  # of a motion next to none
        noise = float(np.median(jumps)) / np.sqrt(6) if len(jumps) else 0.0
        self._tolerance = max(REST_DISTANCE, REST_NOISE * noise)
        squares = [np.zeros(0)]
        for number, inside in enumerate(_rests(self.time[index], points, self._tolerance)):
            rows = index[inside]
            mean, agree = mean_pose(list(self.poses[rows]))
            squares.append(np.square(self.poses[rows, :3, 3] - mean[:3, 3]).sum(axis=1))
            stretch = slice(rows[agree][0], rows[agree][-1] + 1)
            self._rest[stretch] = number
            self._fill(stretch, mean)
        self.spread = float(np.sqrt(np.concatenate(squares).mean())) if squares[1:] else 0.0

    def _begin(self, hands: Mapping[str, Array]) -> None:
        """Fill the rows before the object was first seen."""
        first, rests = int(self.known.argmax()), np.flatnonzero(self._rest >= 0)
        if len(rests):  # some frames before may be worse: seen by one tag, or half covered
            early = np.flatnonzero(self.known[: rests[0]])
            away = _points(self.poses[early]) - _points(self.poses[rests[0]])
            if (np.linalg.norm(away, axis=1) <= self._tolerance).all():
                self._rest[first : rests[0]] = self._rest[rests[0]]
                self._fill(slice(first, rests[0]), self.poses[rests[0]])
        pose, time, still = self.poses[first], self.time[first], self._rest[first] >= 0
        ways = [hand[: first + 1, :3, 3] - pose[:3, 3] for hand in hands.values()]
        near = min((float(np.linalg.norm(way, axis=1).min()) for way in ways), default=0.0)
        if first and not (still and (time <= LATE or near > NEAR)):
            how = "standing, and a hand may have moved it before" if still else "moving"
            raise DataError(f"it was first seen {time:.2f} s after the start, {how}")
        self._fill(slice(0, first), pose)

    def _fill(self, rows: slice, poses: Array) -> None:
        self.poses[rows], self.known[rows] = poses, True

    def _bridge(self, a: int, b: int, hands: Mapping[str, Array]) -> None:
        """Fill the gap between two known rows."""
        ends, gap = self.poses[[a, b]], slice(a + 1, b)
        apart = np.linalg.norm(np.diff(_points(ends), axis=0))
        if min(self._rest[[a, b]]) >= 0 and apart < self._tolerance:
            self._fill(gap, ends[0])
        elif self.time[b] - self.time[a] <= SHORT_GAP:
            self._fill(gap, _between(self.time[a : b + 1], ends))
        else:
            self.poses[gap] = ends[0]
            found = [self._explain_gap(hand, a, b) for hand in hands.values()]
            nothing = np.inf, a, b, ends
            off, taken, put, poses = min(found, key=lambda one: one[0], default=nothing)
            if off <= SLIP:
                self._fill(gap, poses[gap])
                self._fill(slice(a + 1, taken + 1), ends[0])
                self._fill(slice(put, b), ends[1])

    def _explain_gap(self, hand: Array, a: int, b: int) -> tuple[float, int, int, Array]:
        """Score how well a hand explains a gap; from and to when it carried, and the poses."""
        taken, before = self._grasps(hand, a, np.arange(a, b), -1)
        put, after = self._grasps(hand, b, np.arange(a + 1, b + 1), 1)
        away = cdist(_points(before), _points(after))
        away[(taken[:, None] >= put) | np.isnan(away)] = np.inf
        i, j = np.unravel_index(away.argmin(), away.shape)
        return float(away[i, j]), int(taken[i]), int(put[j]), hand @ before[i]

    def _grasps(self, hand: Array, at: int, gap: Any, way: int) -> tuple[Any, Array]:
        """Rows in which a hand may have taken or put down the object, and its poses in it."""
        if self._rest[at] >= 0:
            return gap, inverse(hand[gap]) @ self.poses[at]
        rows = self._next(at, way)[: 2 * ELSEWHERE + 1]
        return np.array([at]), mean_pose(list(inverse(hand[rows]) @ self.poses[rows]))[0][None]

    def _next(self, at: int, way: int) -> Any:
        """Known rows, beginning with one, and before (-1) or after it (1)."""
        rows = np.flatnonzero(self.known)
        return rows[rows <= at][::-1] if way < 0 else rows[rows >= at]

    def _held(self, hand: Array, at: int) -> tuple[int, Array]:
        """For how many rows up to one a hand carries the object; its pose, or NaN."""
        rows = self._next(at, -1)
        inside = inverse(hand[rows]) @ self.poses[rows]
        points = _points(inside)
        middle = np.median(points[: 2 * ELSEWHERE + 1], axis=0)
        away = np.linalg.norm(points - middle, axis=1) > SLIP
        lost = np.convolve(away, np.ones(ELSEWHERE), "valid") == ELSEWHERE
        count = int(np.append(lost, True).argmax())
        held = np.flatnonzero(~away[:count])
        way = _points(self.poses[rows[held]]) - _points(self.poses[at])
        moved = np.linalg.norm(way, axis=1)
        if len(held) < CARRIED_FRAMES or moved.max() < CARRIED_WAY * SLIP:
            return 0, np.full((4, 4), np.nan)
        return count, mean_pose(list(inside[held[: 4 * CARRIED_FRAMES]]))[0]


def _points(poses: Array) -> Array:
    """Poses (..., 4, 4) as points (..., 9), whose distances are those of poses."""
    points = poses[..., :3, 3:] + LEVER * poses[..., :3, :3]
    return np.asarray(points.reshape(*poses.shape[:-2], 9) / np.sqrt(3))


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


def _between(time: Array, ends: Array) -> Array:
    """Poses (T - 2, 4, 4) at the times (T,) between two poses."""
    share = ((time[1:-1] - time[0]) / (time[-1] - time[0]))[:, None, None]
    found = (1 - share) * ends[0] + share * ends[1]
    turns = Slerp(time[[0, -1]], Rotation.from_matrix(ends[:, :3, :3]))
    found[:, :3, :3] = turns(time[1:-1]).as_matrix()
    return np.asarray(found)
