"""Check of recordings: whether they can be what they are taken for."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
import torch

from tpgmm_datasets.checks.joints import joint_findings, quaternion_columns
from tpgmm_datasets.checks.outliers import outliers
from tpgmm_datasets.checks.places import Findings, report_at
from tpgmm_datasets.checks.poses import pose_findings
from tpgmm_datasets.checks.recording_summaries import Recordings, RecordingSummary
from tpgmm_torch import quaternions
from tpgmm_torch.checks.report import Finding, Report, shorten_list
from tpgmm_torch.checks.training import in_order, unit_findings
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.demonstrations import Demonstration, check_demonstrations, check_robot
from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["check"]

#: Warnings name the line that called this package.
PACKAGE = str(Path(__file__).parents[1])
#: No robot is recorded more often [s].
QUICKEST_STEP = 1e-5
#: Nothing is missing between steps of less than this [s], or so many usual ones, or this share
#: of the recording.
GAP, GAP_STEPS, GAP_SHARE = 0.25, 10.0, 0.02
#: Durations within this factor, and events within this share of the duration, are alike.
SAME_DURATION, SAME_PHASE = 1.6, 0.15
#: Paths that differ by less of the joints' ranges, on average, are alike; ranges are at least
#: this [rad or m].
SAME_PATH, SMALLEST_RANGE = 0.5, 0.2
#: Fewer recordings do not show what a usual path is.
FEWEST_PATHS, FEWEST_REVERSED = 5, 3
#: A path runs backwards if, turned around, its steps go so much along those of the median path
#: (cosine), by so much more than as it was recorded; where most paths go along it.
ALONG, BACKWARDS = 0.4, 0.2
BY_HAND = "Was the event detected rightly? Give it by hand, or leave the episode out"


def check(
    demonstrations: Iterable[Demonstration], robot: Kinematics | None = None,
    raw: Collection[str] = (),
) -> Report:  # fmt: skip
    """Check whether recordings can be what they are taken for; nothing is changed.

    Checked are units, limits of position and speed, the order of unnamed joints, wraps, jumps,
    clipped, stuck and still values; steps of time, gaps, durations and events; positions,
    orientations and quaternion order of frames; copies, and episodes that run backwards or are
    unlike the others. What is not found is not thereby right.

    Parameters
    ----------
    demonstrations : iterable of Demonstration
        Before or after alignment.
    robot : Kinematics, optional
        Its limits and links tell more.
    raw : collection of str, default=()
        Joints in a unit of their own.

    Returns
    -------
    Report
        Its findings, each with a name, a number and a remedy. ``.act()`` raises a
        ``PlausibilityError`` of what cannot be, and warns once of what is unlikely.

    Raises
    ------
    DataError, ShapeError, UnknownNameError
        If demonstrations do not fit together, or with the robot.

    Examples
    --------
    >>> time = np.linspace(0, 2, 40)
    >>> shown = [Demonstration(time, np.sin(time + n / 9)[:, None]) for n in range(3)]
    >>> print(check(shown))
    3 demonstrations: nothing implausible
    >>> [found] = check([Demonstration(1000 * one.time, one.joints) for one in shown])
    >>> found.check, found.remedy
    ('time', 'Is it in milliseconds, or numbers of frames? Convert it')
    """
    check_robot(robot)
    ordered = in_order(check_demonstrations(demonstrations), robot)
    return check_summaries([RecordingSummary.of(one) for one in ordered], robot, raw)


def check_summaries(
    episodes: Recordings, robot: Kinematics | None = None, raw: Collection[str] = ()
) -> Report:
    """Make the report of :func:`tpgmm_datasets.check` on summaries of recordings.

    Parameters
    ----------
    episodes : sequence of RecordingSummary
        With the joints in the robot's order.
    robot : Kinematics, optional
        Its limits and links tell more.
    raw : collection of str, default=()
        Joints in a unit of their own.
    """
    units = list(unit_findings(episodes, robot))
    findings = [
        *units,
        *_check_time(episodes),
        *_check_phases(episodes),
        *_check_order(episodes),
        *joint_findings(episodes, robot, raw),
        *pose_findings(episodes, {name for found in units for name in found.names}, robot),
        *_check_copies(episodes),
        *_check_paths(episodes, robot),
    ]
    count = len(episodes)
    return Report.of(findings, f"{count} demonstration{'s' if count > 1 else ''}")


def _check_time(episodes: Recordings) -> Findings:
    """Find steps, gaps and durations unlike the others."""
    steps = np.array([episode.step for episode in episodes])
    usual = float(np.median(steps))
    if 0 < usual < QUICKEST_STEP:
        message = f"time is in seconds, and a typical step of it is {usual:.3g} s"
        yield Finding("time", message, "Is it in another unit? Convert it", value=usual)
    gaps = [
        ("{:.3g} s after {:.4g} s of demonstration {}".format(*one.gap, i), i, "")
        for i, one in enumerate(episodes)
        if one.gap[0] > max(GAP_STEPS * one.step, GAP, GAP_SHARE * one.duration)
    ]
    remedy = "Leave the episode out, or cut it"
    yield from report_at("gaps", "nothing was recorded for", remedy, gaps)
    durations = np.array([max(episode.duration, 1e-9) for episode in episodes])
    odd = outliers(np.log(durations), floor=np.log(SAME_DURATION))
    places = [(f"{durations[i]:.4g} s in demonstration {i}", i, "") for i in odd]
    message = f"demonstrations last about {np.median(durations):.4g} s, but"
    remedy = "Is it the same skill, whole, and at the same rate?"
    most = float(durations[odd[0]]) if odd else np.nan
    yield from report_at("durations", message, remedy, places, most)


def _list_events(episodes: Recordings) -> list[str]:
    return list(dict.fromkeys(name for one in episodes for name in one.events))


def _check_phases(episodes: Recordings) -> Findings:
    """Find events that are missing, or at another phase than usual."""
    names = _list_events(episodes)
    places: list[str] = []
    about: set[int] = set()
    for name in names:
        phases = {i: one.events[name] for i, one in enumerate(episodes) if name in one.events}
        usual = float(np.median(list(phases.values())))
        odd = [[*phases][k] for k in outliers([*phases.values()], floor=SAME_PHASE)]
        at = f"usually at {usual:.0%}"
        for i in sorted(odd):
            places.append(f"{name!r} at {phases[i]:.0%} of demonstration {i}, {at}")
        lost = sorted({*range(len(episodes))} - phases.keys())
        if lost and len(lost) < len(phases):
            places.append(f"{name!r} missing in {shorten_list([*map(str, lost)])}")
            odd += lost
        about.update(odd)
    if places:
        message = f"events are not where they usually are: {shorten_list(places)}"
        yield Finding("events", message, BY_HAND, tuple(names), tuple(sorted(about)))


def _check_order(episodes: Recordings) -> Findings:
    """Find pairs of events that are in another order than usual."""
    for first, second in combinations(_list_events(episodes), 2):
        pair = {first, second}
        both = {i: e.events for i, e in enumerate(episodes) if pair <= e.events.keys()}
        ahead = [i for i, at in both.items() if at[first] > at[second]]
        order = first, second
        if 2 * len(ahead) > len(both):
            ahead, order = sorted(both.keys() - {*ahead}), (second, first)
        if 0 < len(ahead) <= len(both) / 4:
            message = f"{order[0]!r} comes before {order[1]!r}, but not in demonstration "
            these = shorten_list([str(i) for i in ahead])
            yield Finding("events", message + these, BY_HAND, order, tuple(ahead))


def _check_copies(episodes: Recordings) -> Findings:
    first: dict[str, int] = {}
    copies = [
        (f"demonstration {i} is a copy of {first[one.digest]}", i, "")
        for i, one in enumerate(episodes)
        if i != first.setdefault(one.digest, i) and np.ptp(one.path) > 0
    ]
    remedy = "Leave the copies out: they make the model more certain than it may be"
    yield from report_at("copies", "some were recorded once and counted twice:", remedy, copies)


def _check_paths(episodes: Recordings, robot: Kinematics | None) -> Findings:
    """Find episodes whose path is far from the median path, or runs backwards along it."""
    if len(episodes) < FEWEST_REVERSED:
        return
    paths = _stack_paths(episodes, robot)
    paths /= np.maximum(np.median(np.ptp(paths, axis=1), axis=0), SMALLEST_RANGE)
    median = np.median(paths, axis=0)
    steps = np.diff(median, axis=0)
    along, turned = (_cosines(np.diff(p, axis=1), steps) for p in (paths, paths[:, ::-1]))
    against = (turned > np.maximum(ALONG, along + BACKWARDS)) & (np.median(along) > ALONG)
    back = np.flatnonzero(against).tolist()
    places = [(f"demonstration {i} ({turned[i]:.2f}, not {along[i]:.2f})", i, "") for i in back]
    message = "paths go along the median path if they run backwards:"
    remedy = "Are they stored in reverse, or another skill? Leave them out"
    yield from report_at("episodes", message, remedy, places)
    if len(episodes) >= FEWEST_PATHS:
        yield from _check_distances(paths - median, episodes[0].joint_names, back)


def _check_distances(
    differences: Array, joint_names: Sequence[str] | None, known: Collection[int]
) -> Findings:
    """Find paths far from the median path, of which the differences (E, P, n_joints) are."""
    squares = differences**2
    distances = np.sqrt(squares.mean(axis=(1, 2)))
    typical = float(np.median(distances))
    names = joint_names or tuple(f"joint {j}" for j in range(squares.shape[-1]))
    most = [names[j] for j in squares.mean(axis=1).argmax(axis=1)]
    places = [
        (f"demonstration {i} by {distances[i]:.2g} (most {most[i]!r})", i, most[i])
        for i in outliers(distances, floor=SAME_PATH)
        if distances[i] > typical and i not in known
    ]
    usual = f"in ranges of the joints, by about {typical:.2g}"
    message = f"paths differ from the median path, {usual}, but"
    remedy = "Is it the same skill, with columns of the same order and unit? Leave it out"
    yield from report_at("episodes", message, remedy, places)


def _cosines(steps: Array, usual: Array) -> Array:
    """Compute cosines between the steps (E, P - 1, n_joints) and usual ones, as vectors."""
    lengths = np.sqrt((steps**2).sum((1, 2)) * (usual**2).sum())
    cosines: Array = (steps * usual).sum((1, 2)) / np.maximum(lengths, 1e-12)
    return cosines


def _stack_paths(episodes: Recordings, robot: Kinematics | None) -> Array:
    """Stack paths (E, P, n_joints), quaternions among them on the side of their mean."""
    paths = np.stack([episode.path for episode in episodes])
    for columns in quaternion_columns(episodes[0].joint_names, robot):
        turns = quaternions.continuous(torch.from_numpy(paths[..., columns]))
        mean = quaternions.continuous(quaternions.mean(turns.movedim(0, 1)))
        along = (turns * mean).sum((1, 2))[:, None, None]
        paths[..., columns] = (turns * quaternions.hemisphere_sign(along)).numpy()
    return paths
