"""One set of checks for recordings, whoever asks: a script, a loader, ``fit``, a command."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from tpgmm_torch.data.demonstrations import Demonstration, check_demonstrations, check_robot
from tpgmm_torch.exceptions import ShapeError
from tpgmm_torch.operators import Operator
from tpgmm_torch.plausibility.clock import check_clock, check_one_clock
from tpgmm_torch.plausibility.findings import Finding, Report
from tpgmm_torch.plausibility.joints import check_joints
from tpgmm_torch.plausibility.likeness import check_freedom, check_likeness
from tpgmm_torch.plausibility.poses import check_poses
from tpgmm_torch.plausibility.summaries import EpisodeSummary
from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["check", "episodes_report", "examine", "learning_report", "summarize", "summarized"]


def check(
    demonstrations: Iterable[Demonstration],
    robot: Kinematics | None = None,
    *,
    strict: bool = False,
) -> Report:
    """Whether recordings can be what they are taken for; nothing is mended.

    Looked at are units, limits of position and speed, the order of unnamed joints, wraps,
    jumps, clipped and stuck values; steps of time, gaps, durations and events; positions,
    orientations and quaternion order of frames; and whether an episode is not like the
    others. Thresholds are such that what is not named is not thereby right.

    Parameters
    ----------
    demonstrations : iterable of Demonstration
        Before or after alignment.
    robot : Kinematics, optional
        Its limits and links say more.
    strict : bool, default=False
        Whether what is unlikely is an error too.

    Returns
    -------
    Report
        Its findings, each with a name, what it is about, a number, and a remedy.

    Raises
    ------
    PlausibilityError
        If something cannot be; with ``strict`` if something is unlikely.
    DataError, ShapeError, UnknownNameError
        If demonstrations do not fit together, or with the robot.

    Warns
    -----
    PlausibilityWarning
        Once, with all that is unlikely.

    Examples
    --------
    >>> import numpy as np
    >>> time = np.linspace(0, 2, 40)
    >>> shown = [Demonstration(time, np.sin(time + n / 9)[:, None]) for n in range(3)]
    >>> print(check(shown))
    3 demonstrations: nothing implausible
    >>> check([Demonstration(1000 * d.time, d.joints) for d in shown], strict=True)
    Traceback (most recent call last):
    tpgmm_torch.exceptions.PlausibilityError: 3 demonstrations: one thing is implausible: ...
    """
    return examine(demonstrations, robot).act("error" if strict else "warn")


def examine(demonstrations: Iterable[Demonstration], robot: Kinematics | None = None) -> Report:
    """What :func:`check` finds, without raising or warning of it.

    Parameters
    ----------
    demonstrations, robot
        As of :func:`check`.

    Raises
    ------
    DataError, ShapeError, UnknownNameError
        If demonstrations do not fit together, or with the robot.
    """
    check_robot(robot)
    return episodes_report(summarize(check_demonstrations(demonstrations), robot), robot)


def episodes_report(
    episodes: Sequence[EpisodeSummary], robot: Kinematics | None = None
) -> Report:
    """What ``examine`` finds in demonstrations that were looked at before.

    Parameters
    ----------
    episodes : sequence of EpisodeSummary
        As :func:`summarize` gives them.
    robot : Kinematics, optional
        In whose order the joints are.
    """
    return Report.of(_findings(episodes, robot), _subject(episodes))


def summarize(
    demonstrations: Sequence[Demonstration], robot: Kinematics | None
) -> list[EpisodeSummary]:
    """What the checks need of demonstrations, with the joints in the robot's order.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
    robot : Kinematics or None

    Raises
    ------
    ShapeError, UnknownNameError
        If a joint of the robot is missing.
    """
    ordered = list(demonstrations)
    if robot is not None:
        for index, demonstration in enumerate(ordered):
            excess = demonstration.n_joints - robot.n_joints
            if excess < 0 or (excess and demonstration.joint_names is None):
                raise ShapeError(
                    f"demonstration {index} has {demonstration.n_joints} joints, the robot has "
                    f"{robot.n_joints}: {robot.joint_names}"
                )
        ordered = [demonstration.reordered(robot.joint_names) for demonstration in ordered]
    return [EpisodeSummary.of(demonstration) for demonstration in ordered]


def summarized(
    batches: Iterable[Sequence[Demonstration]],
    robot: Kinematics | None,
    episodes: list[EpisodeSummary],
) -> Iterator[Sequence[Demonstration]]:
    """Batches as they come, with a look at each demonstration on its way.

    Parameters
    ----------
    batches : iterable of sequence of Demonstration
    robot : Kinematics or None
    episodes : list of EpisodeSummary
        What was seen is appended to it.

    Yields
    ------
    sequence of Demonstration
    """
    for batch in batches:
        episodes += summarize(batch, robot)
        yield batch


def learning_report(
    episodes: Sequence[EpisodeSummary],
    operators: Sequence[Operator],
    kinematics: Kinematics,
    covariance_type: str,
    covariance_shrinkage: float | str = 0.0,
) -> Report:
    """What stands against learning from demonstrations as they are.

    Beyond ``examine``: whether they are on one clock, and whether they are enough.

    Parameters
    ----------
    episodes : sequence of EpisodeSummary
        As :func:`summarize` gives them.
    operators : sequence of Operator
    kinematics : Kinematics
    covariance_type, covariance_shrinkage : str, float or str
        As of the estimator.
    """
    findings = _findings(episodes, kinematics)
    findings += check_one_clock(episodes)
    free = covariance_type in ("full", "tied") and covariance_shrinkage == 0
    findings += check_freedom(len(episodes), operators, kinematics, free)
    return Report.of(findings, _subject(episodes))


def _findings(episodes: Sequence[EpisodeSummary], robot: Kinematics | None) -> list[Finding]:
    return [
        *check_clock(episodes),
        *check_joints(episodes, robot),
        *check_poses(episodes, robot),
        *check_likeness(episodes, robot),
    ]


def _subject(episodes: Sequence[EpisodeSummary]) -> str:
    return f"{len(episodes)} demonstration{'s' if len(episodes) > 1 else ''}"
