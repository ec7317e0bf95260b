"""Events of demonstrations: grippers that close and open, objects that move, robots that stop.

:func:`find_boundaries` finds every instant at which a skill may come to another part.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter, uniform_filter1d
from scipy.signal import find_peaks

from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import SMOOTHING, Demonstration
from tpgmm_torch.data.frames import LEVER, STILL
from tpgmm_torch.data.pose_names import is_gripper, pose_groups, words
from tpgmm_torch.training.hold_detection import find_holds

#: Confidence, from 0 to 1, below which nothing is an event.
LEAST_CONFIDENCE = 0.2
#: Slower than this share of the peak speed is noise.
NOISE = 0.005
#: A signal has come to its high level (1) above this share of the way, and is back at its low
#: one (0) below the rest of it.
ON = 0.65
#: A swing counts fully from this share of the signal's magnitude on; less may be drift.
LARGE_SWING = 0.2


@dataclass(frozen=True)
class Boundary:
    """An instant between two parts of one demonstration.

    Parameters
    ----------
    time : float
        On the demonstration's clock [s].
    reason : str
        For example ``"r_gripper closes"``, ``"cup is taken"``, ``"stop"``.
    begin, end : float
        From when to when it happens: a gripper takes time to close, a stop lasts [s].
    prepares : bool, default=False
        Whether it counts only where the robot stops: a gripper that was closed from the start
        opens to take something.
    """

    time: float
    reason: str
    begin: float
    end: float
    prepares: bool = False

    def join_stop(self, stop: Boundary) -> Boundary:
        """Join the boundary with a ``stop`` at which it happens."""
        # poses alone locate a contact less exactly than a stop
        exact = self.begin < self.end and stop.begin <= self.time <= stop.end
        time = self.time if exact else stop.time
        return replace(self, time=time, reason=f"{self.reason}, stop", prepares=False)


def find_boundaries(
    demonstration: Demonstration, robot: Any = None, *, margin: float = 0.05
) -> list[Boundary]:
    """Find all instants at which one part may end and another begin, in order.

    A stop at which a gripper moves or something is taken or let go is one boundary with these.

    Parameters
    ----------
    demonstration : Demonstration
        Of at least two time steps.
    robot : Kinematics, optional
        Where links are; without it there are no contacts.
    margin : float, default=0.05
        Events so far from a stop, as a share of the duration, happen at the stop.

    Examples
    --------
    >>> time = np.arange(121) / 20
    >>> u = np.clip([time / 2.5, (time - 3.5) / 2.5], 0, 1)
    >>> joints = (u**3 * (10 - 15 * u + 6 * u**2)).sum(0)[:, None]
    >>> [stop] = find_boundaries(Demonstration(time, joints))
    >>> stop.reason, round(stop.time, 1)
    ('stop', 3.0)
    """
    if len(demonstration) < 5:
        return []
    found = find_gripper_changes(demonstration) + find_contacts(demonstration, robot)
    near_by = margin * demonstration.duration
    for stop in find_stops(demonstration, robot):
        early, late = stop.begin - near_by, stop.end + near_by
        near = [i for i, one in enumerate(found) if early <= one.time <= late]
        for i in near:
            found[i] = found[i].join_stop(stop)
        if not near:
            found.append(stop)
    return sorted((one for one in found if not one.prepares), key=lambda one: one.time)


def find_gripper_changes(demonstration: Demonstration) -> list[Boundary]:
    """Find each closing and opening of each gripper, known by the names of the signals.

    Parameters
    ----------
    demonstration : Demonstration
        Of at least two time steps.
    """
    time, values = as_array(demonstration.time), as_array(demonstration.joints)
    names = demonstration.joint_names or ()
    found = []
    for name, columns in gripper_groups(names).items():
        signal = without_spikes(values[:, columns], time)
        first = True
        for begin, end, falls in level_changes(time, signal):
            reason = f"{name} {'closes' if falls else 'opens'}"
            prepares, first = first and not falls, False
            found.append(Boundary((begin + end) / 2, reason, begin, end, prepares))
    return found


def find_contacts(demonstration: Demonstration, robot: Any = None) -> list[Boundary]:
    """Find when objects that were recorded over time are taken and let go, or begin to move.

    Parameters
    ----------
    demonstration : Demonstration
        Of at least two time steps.
    robot : Kinematics, optional
        Whose links take them.
    """
    begin, end = float(demonstration.time[0]), float(demonstration.time[-1])
    holds = () if robot is None else find_holds([demonstration], robot)
    happen = [(hold.begin, f"{hold.frame} is taken") for hold in holds]
    happen += [(hold.end, f"{hold.frame} is let go") for hold in holds]
    happen += _object_moves(demonstration, {hold.frame for hold in holds})
    return [Boundary(at, reason, at, at) for at, reason in happen if begin < at < end]


def _object_moves(
    demonstration: Demonstration, others: Collection[str]
) -> Iterator[tuple[float, str]]:
    """Yield when each object begins to move that is not among others, and the reason."""
    for name, frame in demonstration.frames.items():
        if name not in others and frame.batch_shape:
            at, sure = move_start(as_array(frame.position), as_array(demonstration.time))
            if sure >= LEAST_CONFIDENCE:
                yield at, f"{name} moves"


def find_stops(
    demonstration: Demonstration,
    robot: Any = None,
    *,
    dwell: float = 0.35,
    rest: float = 0.15,
    motion: float = 0.5,
) -> list[Boundary]:
    """Find when the whole robot comes to rest between two motions; rhythms go on.

    A rhythm has no speed where it turns back either, but does not stay there: how long there is
    next to none, of the time in which there is little, tells them apart.

    Parameters
    ----------
    demonstration : Demonstration
        Of at least five time steps.
    robot : Kinematics, optional
        Its links are what rests; without it, the joints but for grippers.
    dwell : float, default=0.35
        Where the robot rests for this share of the time in which it does not move, at least,
        it stops; 0 also finds where rhythms turn back. The share is 0.47 where minimum-jerk
        motions meet, and 0.29 where a sinusoid turns back.
    rest, motion : float, default=0.15, 0.5
        It rests below the first share of the smaller one of its peak speeds before and after,
        and moves above the second.

    References
    ----------
    Hogan, Sternad: On rhythmic and discrete movements: reflections, definitions and
    implications for motor control, Experimental Brain Research 181 (2007).
    """
    time, speed = as_array(demonstration.time), _robot_speed(demonstration, robot)
    peak = float(np.quantile(speed, 0.98))
    if peak <= 0:
        return []
    level = np.log(speed + NOISE * peak)
    level -= 1e-9 * np.arange(len(level))  # of two rests at which all stands, one is the lower
    lows = find_peaks(-level, prominence=-np.log(rest))[0].tolist()
    edges = [0, *lows, len(time)]
    found = []
    for number, low in enumerate(lows):
        before = speed[edges[number] : low].max()
        least = min(before, speed[low + 1 : edges[number + 2]].max())
        moves = np.flatnonzero(speed > motion * least)
        leaves, comes = moves[moves < low][-1], moves[moves > low][0]
        rests = leaves + np.flatnonzero(speed[leaves : comes + 1] <= rest * least)
        begin, last = _crossing(time, speed, rests[0], -1, rest * least), rests[-1]
        end = _crossing(time, speed, last, 1, rest * least)
        still = _crossing(time, speed, comes - 1, 1, motion * least)
        still -= _crossing(time, speed, leaves + 1, -1, motion * least)
        if end - begin >= dwell * still:
            found.append(Boundary((begin + end) / 2, "stop", begin, end))
    return found


def _crossing(time: Array, speed: Array, below: int, way: int, limit: float) -> float:
    """Find when a limit is crossed between a step below it and the one before or after."""
    pair = [below, below + way]
    return float(np.interp(limit, speed[pair], time[pair]))


def _robot_speed(demonstration: Demonstration, robot: Any) -> Array:
    """Compute the speed of all links together, or of joints but for grippers, (T,)."""
    if robot is not None and robot.links:
        values = _link_coordinates(demonstration, robot)
    else:
        joints, names = as_array(demonstration.joints), demonstration.joint_names or ()
        grippers = [j for j, name in enumerate(names) if is_gripper(name)]
        values = np.delete(joints, grippers, axis=1)
    return smooth_speed(values, as_array(demonstration.time), SMOOTHING)


def _link_coordinates(demonstration: Demonstration, robot: Any) -> Array:
    """Compute positions of all links, and their orientations as lengths, (T, D)."""
    state = robot.state(demonstration.reorder(robot.joint_names).joints)
    columns = [as_array(state.position(link)) for link in robot.links]
    if getattr(robot, "orientation", True):  # tracked points have none
        turns = [quaternions.continuous(state.orientation(link)) for link in robot.links]
        columns += [2 * LEVER * as_array(turn) for turn in turns]  # half the angle
    return np.concatenate(columns, axis=1)


def smooth_speed(values: Array, time: Array, length: float) -> Array:
    """Compute the norm of rates of change (T,) of values (T, n), over a length of time [s]."""
    half = max(1, round(length / 2 / float(np.median(np.diff(time)))))
    rates = np.gradient(values, time, axis=0)
    smooth = uniform_filter1d(rates, 2 * half + 1, axis=0, mode="nearest")
    return np.asarray(np.linalg.norm(smooth, axis=1))


def move_start(
    position: Array, time: Array, *, left: float = 0.02, away: float = 0.1
) -> tuple[float, float]:
    """Find when an object with ``position`` (T, 3) leaves its place, and the confidence.

    It is the last instant at which the object was within the share ``left`` of its largest
    distance from where it lay, before it came to ``away``. The confidence is the product of

    - contrast: one less its scatter while it lay still, relative to ``away``;
    - the share of the time after the event that it stays away;
    - its largest distance, in proportion below 2 cm.
    """
    distance = np.linalg.norm(position - position[0], axis=1)
    largest = float(distance.max())
    if largest <= 0:
        return float("nan"), 0.0
    came = int(np.flatnonzero(distance >= away * largest)[0])
    went = int(np.flatnonzero(distance[:came] <= left * largest)[-1])
    contrast = max(0.0, 1 - float(distance[: went + 1].std()) / (away * largest))
    stays = float((distance[came:] >= away * largest).mean())
    return float(time[went]), contrast * stays * min(1.0, largest / STILL)


def without_spikes(values: Array, time: Array, length: float = 0.1) -> Array:
    """Filter signals ``values`` (T, n) at ``time`` (T,) by medians over a ``length`` [s]."""
    half = max(1, round(length / 2 / float(np.median(np.diff(time)))))
    return np.asarray(median_filter(values, size=(2 * half + 1, 1), mode="nearest"))


def gripper_groups(names: Sequence[str]) -> dict[str, list[int]]:
    """Group signals by gripper; the fingers of one side's hand are one.

    Parameters
    ----------
    names : sequence of str
        Of all signals.

    Examples
    --------
    >>> gripper_groups(["l_elbow.pos", "l_gripper.pos", "r_gripper.pos"])
    {'l_gripper.pos': [1], 'r_gripper.pos': [2]}
    """
    posed = {i for columns in pose_groups(names).values() for i in columns}
    groups: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        if i not in posed and is_gripper(name):
            side = "".join(sorted({"left", "right"} & {*words(name)}))
            groups.setdefault(side, []).append(i)
    return {
        names[columns[0]] if len(columns) == 1 else f"{side} hand".strip(): columns
        for side, columns in groups.items()
    }


def level_changes(time: Array, values: Array) -> list[tuple[float, float, bool]]:
    """Find all changes of signals between their two levels.

    Parameters
    ----------
    time : array of shape (T,)
        Ascending instants [s].
    values : array of shape (T, n)
        Which count as one: their first principal component.

    Returns
    -------
    list of (float, float, bool)
        When each begins and ends (35 % and 65 % of the way), and whether it falls; none where
        the two levels do not stand out.
    """
    share, contrast = between_levels(values)
    if contrast < LEAST_CONFIDENCE:
        return []
    share = 1 - share  # 1 where it is low
    found = []
    for start, stop in high_stretches(share, ON, 1 - ON):
        if start > 0:
            at, change = crossing_time(time, share, start, stop, "begin")
            found.append((at - change, at, True))
        if stop < len(share):
            at, change = crossing_time(time, share, start, stop, "end")
            found.append((at, at + change, False))
    return found


def _principal(values: Array) -> Array:
    """Compute one signal of shape (T,) for several (T, n): what most of them do."""
    if values.shape[1] == 1:
        return values[:, 0]
    weights = np.linalg.svd(values - values.mean(axis=0), full_matrices=False)[2][0]
    return np.asarray(values @ (weights if weights.sum() >= 0 else -weights))


def between_levels(values: Array) -> tuple[Array, float]:
    """Scale signals ``values`` (T, n) from the low level (0) to the high one (1); contrast.

    Several count as one, their first principal component. Its levels are the medians of the two
    classes of Otsu [1]_. The contrast is one less twice the standard deviation within the
    classes, relative to the distance of the levels, which itself counts in proportion below a
    fifth of the signal's largest magnitude; 0 where there is one level only.

    References
    ----------
    .. [1] N. Otsu: A Threshold Selection Method from Gray-Level Histograms. IEEE Transactions
       on Systems, Man, and Cybernetics 9 (1979).
    """
    signal = _principal(values)
    low, high, within = _levels(signal)
    swing, size = high - low, float(np.abs(signal).max())
    if swing <= 1e-9 * size:
        return np.zeros_like(signal), 0.0
    contrast = max(0.0, 1 - 2 * within / swing) * min(1.0, swing / (LARGE_SWING * size))
    return (signal - low) / swing, contrast


def _levels(values: Array) -> tuple[float, float, float]:
    """Find medians of the two classes that differ most, and the deviation within them."""
    ordered = np.sort(values)
    count = np.arange(1, len(ordered))
    sums = ordered.cumsum()
    below, above = sums[:-1] / count, (sums[-1] - sums[:-1]) / count[::-1]
    cut = int((count * count[::-1] * (above - below) ** 2).argmax()) + 1
    low, high = ordered[:cut], ordered[cut:]
    squares = ((low - low.mean()) ** 2).sum() + ((high - high.mean()) ** 2).sum()
    return float(np.median(low)), float(np.median(high)), float(np.sqrt(squares / len(values)))


def crossing_time(
    time: Array, share: Array, start: int, stop: int, edge: str
) -> tuple[float, float]:
    """Find when a signal passes ``ON`` at an edge [s], and how long that took.

    Parameters
    ----------
    time, share : array of shape (T,)
        Where the signal is between its levels.
    start, stop : int
        A stretch as :func:`high_stretches` gives it.
    edge : {"begin", "end"}
        Of the stretch.
    """
    if edge == "begin":
        at = float(np.interp(ON, share[start - 1 : start + 1], time[start - 1 : start + 1]))
        away = np.flatnonzero(share[:start] <= 1 - ON)
        return at, at - float(time[away[-1]] if len(away) else time[0])
    last = start + int(np.flatnonzero(share[start:stop] >= ON)[-1])
    at = float(np.interp(-ON, -share[last : last + 2], time[last : last + 2]))
    return at, float(time[stop]) - at


def high_stretches(values: Array, on: float, off: float) -> list[tuple[int, int]]:
    """Find stretches from where values reach ``on`` until they are below ``off``.

    Parameters
    ----------
    values : array of shape (T,)
        A signal.
    on, off : float
        The larger and the smaller threshold; between them nothing changes.

    Returns
    -------
    list of (int, int)
        First step of each, and the first after it, which is T where it lasts to the end.

    Examples
    --------
    >>> high_stretches(np.array([0.0, 0.5, 0.7, 0.4, 0.7, 0.2, 0.5]), on=0.6, off=0.3)
    [(2, 5)]
    """
    sign = np.where(values >= on, 1, np.where(values <= off, -1, 0))
    last: NDArray[np.intp] = np.maximum.accumulate(
        np.where(sign != 0, np.arange(len(sign)), -1)
    )
    state = (last >= 0) & (sign[last] == 1)
    edges = np.diff(np.concatenate(([False], state, [False])).astype(np.int8))
    starts, stops = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    return list(zip(starts.tolist(), stops.tolist(), strict=True))
