"""Where one motion ends and another begins: grippers, contacts and stops, all of them.

The detectors of this package find one event each, that is known by name. Here nothing is named:
what is found is every instant at which a skill may have come to another part.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import isfinite
from typing import Any

import numpy as np
from scipy.ndimage import median_filter, uniform_filter1d
from scipy.signal import find_peaks

from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.pose_names import is_gripper
from tpgmm_torch.events.detection import LEAST_CONFIDENCE
from tpgmm_torch.events.movement import ObjectMoves
from tpgmm_torch.events.signals import SPIKE, gripper_groups, level_changes
from tpgmm_torch.training.hold_detection import find_holds

__all__ = ["Boundary", "find_boundaries", "find_contacts", "find_gripper_changes", "find_stops"]

#: A robot rests below this share of the smaller one of its peak speeds before and after.
REST = 0.15
#: Slower than this share of the demonstration's peak speed is noise.
NOISE = 0.005
#: It moves above this share of it.
MOTION = 0.5
#: It rests for this share of the time in which it does not move: 0.47 where minimum-jerk
#: motions meet, 0.29 where a sinusoid turns back.
DWELL = 0.35
#: So far from a stop, as a share of the duration, something happens at the stop.
NEAR = 0.05
#: Speeds are means over so long [s], and over this share of the duration, at least.
SMOOTHING, SHARE = 0.15, 0.015
#: What turning a link by one radian counts as [m].
LEVER = 0.2


@dataclass(frozen=True)
class Boundary:
    """An instant between two parts of one demonstration.

    Parameters
    ----------
    time : float
        On the demonstration's clock [s].
    reason : str
        What happens then: ``"r_gripper closes"``, ``"cup is taken"``, ``"stop"``.
    begin, end : float
        From when to when it happens: a gripper takes time to close, a stop lasts [s].
    prepares : bool, default=False
        Whether it is none unless the robot stops: a gripper that was closed from the start
        opens to take something.
    """

    time: float
    reason: str
    begin: float
    end: float
    prepares: bool = False


def find_boundaries(demonstration: Demonstration, robot: Any = None) -> list[Boundary]:
    """All instants at which one part may end and another begin, in the order of time.

    A stop at which a gripper moves or something is taken or let go is one boundary with these.

    Parameters
    ----------
    demonstration : Demonstration
        Of at least two time steps.
    robot : Kinematics, optional
        Where links are; without it there are no contacts.

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
    margin = NEAR * demonstration.duration
    for stop in find_stops(demonstration, robot):
        early, late = stop.begin - margin, stop.end + margin
        near = [i for i, one in enumerate(found) if early <= one.time <= late]
        for i in near:  # poses alone tell a contact less exactly than a stop
            exact = found[i].begin < found[i].end and stop.begin <= found[i].time <= stop.end
            time = found[i].time if exact else stop.time
            reason = f"{found[i].reason}, stop"
            found[i] = replace(found[i], time=time, reason=reason, prepares=False)
        if not near:
            found.append(stop)
    return sorted((one for one in found if not one.prepares), key=lambda one: one.time)


def find_gripper_changes(demonstration: Demonstration) -> list[Boundary]:
    """Each closing and opening of each gripper, known by the names of the signals.

    Parameters
    ----------
    demonstration : Demonstration
    """
    time, values = as_array(demonstration.time), as_array(demonstration.joints)
    names = demonstration.joint_names or ()
    half = max(1, round(SPIKE / 2 / float(np.median(np.diff(time)))))
    found = []
    for name, columns in gripper_groups(names).items():
        signal = median_filter(values[:, columns], size=(2 * half + 1, 1), mode="nearest")
        first = True
        for begin, end, falls in level_changes(time, signal):
            reason = f"{name} {'closes' if falls else 'opens'}"
            prepares, first = first and not falls, False
            found.append(Boundary((begin + end) / 2, reason, begin, end, prepares))
    return found


def find_contacts(demonstration: Demonstration, robot: Any = None) -> list[Boundary]:
    """When objects that were recorded over time are taken and let go, or begin to move.

    Parameters
    ----------
    demonstration : Demonstration
    robot : Kinematics, optional
        Whose links take them.
    """
    begin, end = float(demonstration.time[0]), float(demonstration.time[-1])
    holds = () if robot is None else find_holds([demonstration], robot)
    found = []
    for hold in holds:
        for time, does in ((hold.begin, "is taken"), (hold.end, "is let go")):
            if isfinite(time) and begin < time < end:
                found.append(Boundary(time, f"{hold.frame} {does}", time, time))
    held = {hold.frame for hold in holds}
    for name, frame in demonstration.frames.items():
        if name in held or not frame.batch_shape:
            continue
        at = ObjectMoves(name).find(demonstration)
        if at.confidence >= LEAST_CONFIDENCE and begin < at.time < end:
            found.append(Boundary(at.time, f"{name} moves", at.time, at.time))
    return found


def find_stops(
    demonstration: Demonstration, robot: Any = None, *, dwell: float = DWELL
) -> list[Boundary]:
    """When the whole robot comes to rest between two motions; rhythms go on.

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
        it stops; 0 also finds where rhythms turn back.

    References
    ----------
    Hogan, Sternad: On rhythmic and discrete movements: reflections, definitions and
    implications for motor control, Experimental Brain Research 181 (2007).
    """
    time, speed = as_array(demonstration.time), _speed(demonstration, robot)
    peak = float(np.quantile(speed, 0.98))
    if peak <= 0:
        return []
    level = np.log(speed + NOISE * peak)
    level -= 1e-9 * np.arange(len(level))  # of two rests at which all stands, one is the lower
    lows = find_peaks(-level, prominence=-np.log(REST))[0].tolist()
    edges = [0, *lows, len(time)]
    found = []
    for number, low in enumerate(lows):
        before = speed[edges[number] : low].max()
        least = min(before, speed[low + 1 : edges[number + 2]].max())
        moves = np.flatnonzero(speed > MOTION * least)
        leaves, comes = moves[moves < low][-1], moves[moves > low][0]
        rests = leaves + np.flatnonzero(speed[leaves : comes + 1] <= REST * least)
        begin, last = _crossing(time, speed, rests[0], -1, REST * least), rests[-1]
        end = _crossing(time, speed, last, 1, REST * least)
        still = _crossing(time, speed, comes - 1, 1, MOTION * least)
        still -= _crossing(time, speed, leaves + 1, -1, MOTION * least)
        if end - begin >= dwell * still:
            found.append(Boundary((begin + end) / 2, "stop", begin, end))
    return found


def _crossing(time: Array, speed: Array, below: int, way: int, limit: float) -> float:
    """When a limit is crossed between a step that is below it and the one before or after."""
    pair = [below, below + way]
    return float(np.interp(limit, speed[pair], time[pair]))


def _speed(demonstration: Demonstration, robot: Any) -> Array:
    """Of all links together, of the joints but for grippers without links, smoothed, (T,)."""
    time, names = as_array(demonstration.time), demonstration.joint_names or ()
    if robot is not None and robot.links:
        state = robot.state(demonstration.reordered(robot.joint_names).joints)
        columns = [as_array(state.position(link)) for link in robot.links]
        if getattr(robot, "orientation", True):  # tracked points have none
            turns = [quaternions.continuous(state.orientation(link)) for link in robot.links]
            columns += [2 * LEVER * as_array(turn) for turn in turns]  # half the angle
        values = np.concatenate(columns, axis=1)
    else:
        joints = as_array(demonstration.joints)
        grippers = {j for j, name in enumerate(names) if is_gripper(name)}
        values = joints[:, [j for j in range(joints.shape[1]) if j not in grippers]]
    length = max(SMOOTHING, SHARE * float(time[-1] - time[0]))
    half = max(1, round(length / 2 / float(np.median(np.diff(time)))))
    rates = np.gradient(values, time, axis=0)
    smooth = uniform_filter1d(rates, 2 * half + 1, axis=0, mode="nearest")
    speed: Array = np.linalg.norm(smooth, axis=1)
    return speed
