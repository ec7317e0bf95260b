"""Check of demonstrations by ``fit``: units, one clock, enough of them, objects held."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from tpgmm_torch.checks.report import Finding, Report, shorten_list
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import LEVER, STILL, Frame
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.exceptions import ShapeError
from tpgmm_torch.operators import Operator
from tpgmm_torch.operators.base import carried_objects, frame_names, leaves
from tpgmm_torch.operators.text import format_operator
from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["check"]

#: Nothing turns a joint so far beyond its limits [rad]: the values are in another unit.
IMPOSSIBLE = 2 * math.pi
#: Limits and calibrations are not exact: values may be beyond by this share of the range, of
#: at most 1 rad or m of it.
BEYOND = 0.1
#: Nothing that a robot handles is so far from its base [m].
FAR = 10.0
#: No robot is recorded so slowly [s]; a set in milliseconds, or in numbers of frames, is.
SLOWEST_STEP = 0.5
#: Demonstrations on one clock begin together and last equally, up to this share.
ONE_CLOCK = 0.05
#: Postures that a skill keeps of its demonstrations: of 3,000 of two robots, links are as near
#: each other in these as in all, within 2 mm.
POSTURES = 50


@dataclass(frozen=True)
class PathSummary:
    """Poses of a frame in one demonstration.

    Parameters
    ----------
    position, orientation : array of shape (3,), (4,)
        The first.
    low, high : array of shape (3,)
        Range of the position [m].
    moves : bool
        Whether it moves by more than a tracker's noise.
    recorded : bool
        Whether there is a pose for each time step.
    at : str or None
        As of the frame: the link and event whose pose it is.
    """

    position: Array
    orientation: Array
    low: Array
    high: Array
    moves: bool
    recorded: bool
    at: str | None = None

    @classmethod
    def of(cls, frame: Frame) -> PathSummary:
        """Summarise a frame."""
        positions = np.atleast_2d(as_array(frame.position))
        first = frame[0] if frame.batch_shape else frame
        return cls(
            positions[0],
            as_array(first.orientation),
            positions.min(axis=0),
            positions.max(axis=0),
            bool((first.change(frame, STILL, STILL / LEVER) > 1).any()),
            bool(frame.batch_shape),
            frame.at,
        )


@dataclass(frozen=True)
class EpisodeSummary:
    """Summary of one demonstration, of any length, for the checks and the summary of a model.

    Parameters
    ----------
    begin, duration, step : float
        When it begins, its length, and its median step of time [s].
    joint_names : tuple of str or None
        As of the demonstration.
    start, low, high : array of shape (n_joints,)
        Start posture, and range of each joint.
    frames : mapping of str to PathSummary
        Those that are poses.
    events : mapping of str to float
        As shares of the duration.
    postures : array of shape (P, n_joints)
        Some that differ, at most ``POSTURES``.
    """

    begin: float
    duration: float
    step: float
    joint_names: tuple[str, ...] | None
    start: Array
    low: Array
    high: Array
    frames: Mapping[str, PathSummary]
    events: Mapping[str, float]
    postures: Array

    @classmethod
    def of(cls, demonstration: Demonstration) -> EpisodeSummary:
        """Summarise a demonstration."""
        time, joints = as_array(demonstration.time), as_array(demonstration.joints)
        begin, duration = float(time[0]), float(time[-1] - time[0])
        whole = duration or math.inf
        return cls(
            begin,
            duration,
            float(np.median(np.diff(time))) if len(time) > 1 else 0.0,
            demonstration.joint_names,
            joints[0],
            joints.min(axis=0),
            joints.max(axis=0),
            {name: PathSummary.of(frame) for name, frame in demonstration.frames.items()},
            {name: (at - begin) / whole for name, at in demonstration.events.items()},
            differing(joints),
        )


def differing(postures: Array) -> Array:
    """Select at most ``POSTURES`` postures, each as far as can be from those before it.

    Parameters
    ----------
    postures : ndarray of shape (N, n_joints)
        Of which the largest difference of a joint is the distance.

    Returns
    -------
    ndarray of shape (P, n_joints)
    """
    columns = np.ascontiguousarray(postures.T)  # of which the largest is sooner found
    away, chosen = np.abs(columns - columns[:, :1]).max(0), [0]
    while len(chosen) < POSTURES and away.max(initial=0.0) > 0:
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.abs(columns - columns[:, chosen[-1:]]).max(0))
    return postures[chosen]


def summarize(
    demonstrations: Sequence[Demonstration], kinematics: Kinematics | None
) -> list[EpisodeSummary]:
    """Summarise demonstrations, with the joints in the order of the kinematics.

    Raises
    ------
    ShapeError, UnknownNameError
        If a joint of the robot is missing.
    """
    return [EpisodeSummary.of(one) for one in in_order(demonstrations, kinematics)]


def in_order(
    demonstrations: Sequence[Demonstration], kinematics: Kinematics | None
) -> list[Demonstration]:
    """Bring the joints of demonstrations into the order of the kinematics.

    Raises
    ------
    ShapeError, UnknownNameError
        If a joint of the robot is missing.
    """
    if kinematics is None:
        return list(demonstrations)
    names, n = kinematics.joint_names, kinematics.n_joints
    for index, one in enumerate(demonstrations):
        if one.n_joints < n or (one.n_joints > n and one.joint_names is None):
            raise ShapeError(
                f"demonstration {index} has {one.n_joints} joints, the robot has {n}: {names}"
            )
    return [one.reorder(names) for one in demonstrations]


def check(
    episodes: Sequence[EpisodeSummary],
    kinematics: Kinematics,
    operators: Sequence[Operator] = (),
    holds: Sequence[Hold] = (),
    *,
    correlated: bool = False,
) -> Report:
    """Check demonstrations that are to be learned from.

    Joints beyond their limits by more than a turn are an error. Unlikely are joints and frames
    in other units, time in other units, demonstrations that are not on one clock, one or two
    demonstrations, and operators of objects that nothing holds.

    Parameters
    ----------
    episodes : sequence of EpisodeSummary
        As :func:`summarize` gives them.
    kinematics : Kinematics
        Whose limits and links count.
    operators : sequence of Operator
        What is learned.
    holds : sequence of Hold
        What links carry.
    correlated : bool, default=False
        Whether correlations of coordinates are learned without shrinkage.
    """
    findings = [
        *unit_findings(episodes, kinematics),
        *_clock(episodes),
        *_freedom(len(episodes), operators, kinematics, correlated),
        *_operators_without_effect(operators, kinematics, holds),
    ]
    count = len(episodes)
    return Report.of(findings, f"{count} demonstration{'s' if count > 1 else ''}")


def unit_findings(
    episodes: Sequence[EpisodeSummary], kinematics: Kinematics | None
) -> Iterator[Finding]:
    """Find joints beyond limits, frames hardly in metres, time not in seconds.

    Parameters
    ----------
    episodes : sequence of EpisodeSummary
        With their joints in the order of the kinematics.
    kinematics : Kinematics or None
        Whose limits hold; None knows of none.
    """
    if kinematics is not None:
        yield from _limits(episodes, kinematics)
    for name in episodes[0].frames:
        first = [one.frames[name].position for one in episodes if name in one.frames]
        distance = float(np.median(np.linalg.norm(first, axis=1)))
        if distance > FAR:
            message = f"frame {name!r} is {distance:.4g} m away from the base of the robot"
            remedy = (
                "Positions are in metres: are these in millimetres or centimetres? "
                "(load_lerobot: FramePose(..., scale=0.001))"
            )
            yield Finding("units", message, remedy, (name,), value=distance)
    step = float(np.median([episode.step for episode in episodes]))
    if step >= SLOWEST_STEP:
        message = f"time is in seconds, and a typical step of it is {step:.3g} s"
        remedy = "Is it in milliseconds, or numbers of frames? Convert it"
        yield Finding("time", message, remedy, value=step)


def _limits(episodes: Sequence[EpisodeSummary], kinematics: Kinematics) -> Iterator[Finding]:
    """Find joints beyond the limits: in another unit or order, or of another robot."""
    low, high = _joint_ranges(episodes)
    limits = np.stack((as_array(kinematics.lower), as_array(kinematics.upper)))
    allowed = BEYOND * np.minimum(limits[1] - limits[0], 1.0)
    # of the joints of the robot (rows) in the columns that were given
    excess = np.maximum(limits[0][:, None] - low, high - limits[1][:, None])
    overshoot, names = excess.diagonal(), kinematics.joint_names
    impossible, unnamed = overshoot.max(initial=0) > IMPOSSIBLE, episodes[0].joint_names is None
    least = np.full_like(allowed, IMPOSSIBLE) if impossible else allowed
    beyond = [int(j) for j in np.argsort(-overshoot) if overshoot[j] > least[j]]
    if not beyond:
        return
    about, value = tuple(names[j] for j in beyond), float(overshoot[beyond[0]])
    places = ranges(names, beyond, low, high, limits)
    cost = (excess - allowed[:, None]).clip(min=0)
    rows, columns = linear_sum_assignment(cost)
    if impossible:
        check = "units"
        message = f"joints are in radians (metres, where they slide), these cannot be: {places}"
        remedy = (
            "Are they in degrees? If one joint is, all are: convert the whole joint vector "
            "(np.deg2rad; load_lerobot(..., units='deg'); --units deg)"
        )
    elif unnamed and not cost[rows, columns].any():
        check = "order"
        message = (
            f"the joints are unnamed, and their order does not fit the limits: {places}; the "
            f"columns {columns.tolist()} would fit the joints of the robot"
        )
        remedy = "Name the columns: Demonstration(..., joint_names=[...])"
    else:
        check, message = "limits", f"joints are beyond the robot's limits: {places}"
        remedy = (
            "Check their zeros, units and order, that it is this robot; name unnamed joints "
            "(joint_names=[...])"
        )
    yield Finding(check, message, remedy, about, value=value, impossible=bool(impossible))


def _joint_ranges(episodes: Sequence[EpisodeSummary]) -> tuple[Array, Array]:
    """Compute the least and largest value of each joint."""
    low = np.min([episode.low for episode in episodes], axis=0)
    return low, np.max([episode.high for episode in episodes], axis=0)


def ranges(
    names: Sequence[str], columns: Sequence[int], low: Array, high: Array, limits: Array
) -> str:
    """Describe ranges of some joints, beside their limits (2, n_joints) where there are any.

    Parameters
    ----------
    names : sequence of str
        Of all joints.
    columns : sequence of int
        Which joints to list.
    low, high : array of shape (n_joints,)
        Range of each joint.
    limits : array of shape (2, n_joints)
        Lower and upper of each joint; infinite where there are none.
    """
    places = [f"{names[j]!r} from {low[j]:.4g} to {high[j]:.4g}" for j in columns]
    bounds = [f", limits {a:.4g} to {b:.4g}" for a, b in limits.T[list(columns)]]
    known = bool(np.isfinite(limits).any())
    return shorten_list([a + b * known for a, b in zip(places, bounds, strict=True)])


def _clock(episodes: Sequence[EpisodeSummary]) -> Iterator[Finding]:
    """Find demonstrations that show different things at one time.

    Segments of the skill in its time, such as corrections, begin later than most and end
    within them; they are on the clock.
    """
    begins = np.array([episode.begin for episode in episodes])
    ends = begins + [episode.duration for episode in episodes]
    tolerance = ONE_CLOCK * float(np.median(ends - begins))
    segment = (begins > np.median(begins) + tolerance) & (ends < np.median(ends) + tolerance)
    begins, durations = begins[~segment], (ends - begins)[~segment]
    values = durations
    message = "last from {:.4g} to {:.4g} s: at one time they show other things"
    if np.ptp(durations) <= tolerance:
        values, message = begins, "begin at different times, from {:.6g} to {:.6g} s"
    if np.ptp(values) > tolerance:
        message = f"the demonstrations {message.format(values.min(), values.max())}"
        remedy = (
            "Let each begin at 0, and align them: "
            "DynamicTimeWarping().fit_transform(demonstrations)"
        )
        yield Finding("alignment", message, remedy, value=float(np.ptp(values)))


def _freedom(
    count: int, operators: Sequence[Operator], kinematics: Kinematics, correlated: bool
) -> Iterator[Finding]:
    """Find too few demonstrations to estimate variances and correlations."""
    widest = max((operator.dimension(kinematics) for operator in operators), default=0)
    placed = widest > 2 and frame_names(operators, kinematics)
    remedy = "Show the skill 5 times or more, from other starts and places"
    if count == 1:
        message = "one demonstration does not show what may vary"
        yield Finding("freedom", message, remedy, value=1.0)
    elif count == 2 and correlated and placed:
        yield Finding(
            "freedom",
            f"two demonstrations differ in one direction, and the covariances of {widest} "
            "coordinates would have to distinguish all",
            f"{remedy}, or learn with covariance_shrinkage='auto'",
            value=2.0,
        )


def _operators_without_effect(
    operators: Sequence[Operator], kinematics: Kinematics, holds: Sequence[Hold]
) -> Iterator[Finding]:
    """Find operators that constrain no joint: their objects never move with a link."""
    links = {*kinematics.links}
    moved = links.union(hold.frame for hold in holds)
    inactive = [
        operator
        for operator in leaves(operators)
        if operator.links()
        and moved.isdisjoint(operator.links())
        and links.isdisjoint(operator.references())
    ]
    if inactive:
        names = carried_objects(inactive, kinematics)
        texts = [format_operator(operator) for operator in inactive]
        yield Finding(
            "holds",
            f"no link holds {' and '.join(names)}: {shorten_list(texts)} says nothing of the "
            "joints",
            "Say who holds what: attach_holds(demonstrations, robot) finds it where poses of "
            "objects are recorded over time; Demonstration(..., holds=[Hold("
            f"{names[0]!r}, LINK, BEGIN, END)]) (--hold {names[0]}@LINK:BEGIN-END) gives it. "
            "Or leave such operators out",
            names,
        )
