"""Read LeRobot data sets, v2.1 or v3.0, as demonstrations."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import Any

from tpgmm_datasets.checks.check import PACKAGE, check_summaries
from tpgmm_datasets.checks.recording_summaries import RecordingSummary
from tpgmm_datasets.conversion import joints as named
from tpgmm_datasets.conversion.assembly import (
    Assembly,
    EventSource,
    FrameSource,
    event_sources,
    frame_sources,
)
from tpgmm_datasets.conversion.commands import report_left_out
from tpgmm_datasets.errors import DatasetError, list_problems
from tpgmm_datasets.events import doubtful_events
from tpgmm_datasets.lerobot.calibration import Calibration, calibrated_units
from tpgmm_datasets.lerobot.columns import ENVIRONMENT, EVENT
from tpgmm_datasets.lerobot.episodes import Relaxed, read_episodes
from tpgmm_datasets.lerobot.hub import local_folder
from tpgmm_datasets.lerobot.layout import Episode, Feature, Layout, open_layout
from tpgmm_datasets.lerobot.statistics import stated_range
from tpgmm_datasets.lerobot.stored_signals import event_features
from tpgmm_datasets.units import Scale, Unit, Units, fits
from tpgmm_torch.checks.report import Finding, Report
from tpgmm_torch.data.demonstrations import Demonstration, check_robot
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.robots.robot import Robot

__all__ = ["iter_lerobot", "load_lerobot"]

#: What helps where values in a unit of their own are out of range.
RAW = (
    "They are 'raw', and robot.drop_limits([...]) has no limits for them; or units='lerobot', "
    "where a gripper's 0 to 100 are its limits"
)


@dataclass(frozen=True)
class Recording:
    """A data set that was opened: its metadata are checked, its rows are not yet read.

    Parameters
    ----------
    episodes : tuple of Episode
        Episodes that are wanted, in order.
    assembly : Assembly
        What a demonstration is made of.
    relax : collection of str
        Checks whose problems leave an episode out, and are warned of.
    findings : tuple of Finding
        What is unlikely about its metadata.
    """

    episodes: tuple[Episode, ...]
    assembly: Assembly
    relax: Collection[str]
    findings: tuple[Finding, ...] = ()

    def demonstrations(self, check: bool = True) -> Iterator[Demonstration]:
        """Read the wanted episodes, one when it is asked for.

        Parameters
        ----------
        check : bool, default=True
            Whether to act on what is implausible about them, after the last.

        Raises
        ------
        DatasetError
            As :func:`load_lerobot`; also if every episode was left out.
        PlausibilityError
            As :func:`load_lerobot`.
        """
        layout, features = self.assembly.layout, self.assembly.features
        policy, summaries = Relaxed(self.relax), list[RecordingSummary]()
        read = 0
        lost: list[DatasetError] = []  # all without the event that a frame is at
        self.assembly.doubtful.clear()
        self.assembly.left_out.clear()
        try:
            for rows in read_episodes(layout, self.episodes, features, policy):
                try:
                    demonstration = self.assembly.demonstration(rows)
                except DatasetError as problem:
                    (lost.append if problem.check == "events" else policy)(problem)
                    continue
                read += 1
                if check:
                    summaries.append(RecordingSummary.of(demonstration))
                yield demonstration
            if lost:
                policy(DatasetError("; ".join(list_problems(lost)), check="events"))
            if self.episodes and not read:
                lost_to = f"{sorted(self.relax)}: {'; '.join(list_problems(policy.problems))}"
                count = f"none of the {len(self.episodes)} episodes is left"
                raise DatasetError(f"{count} by the checks that are relaxed, {lost_to}")
            if check:
                self._report(summaries).act(packages=(PACKAGE,))
        finally:
            policy.warn()

    def check(self) -> Report:
        """Read all episodes, and report what is implausible about them.

        Raises
        ------
        DatasetError
            As :func:`load_lerobot`.
        """
        summaries = [RecordingSummary.of(one) for one in self.demonstrations(check=False)]
        return self._report(summaries)

    def drop_raw_limits(self) -> Recording:
        """Return the same for a robot that knows no limits of "raw" joints."""
        robot, raw = self.assembly.robot, self.assembly.joints.raw
        if not raw or not isinstance(robot, Robot):
            return self
        return replace(self, assembly=replace(self.assembly, robot=robot.drop_limits(raw)))

    def _report(self, summaries: Sequence[RecordingSummary]) -> Report:
        """Report findings and doubtful events."""
        robot, raw = self.assembly.robot, self.assembly.joints.raw
        known = robot if isinstance(robot, Kinematics) else None
        report = check_summaries(summaries, known, raw)
        findings = [*self.findings, *doubtful_events(self.assembly.doubtful, "episode")]
        findings += report_left_out(self.assembly.left_out)
        for one in report:
            own = {*one.names} <= raw and one.check in ("units", "limits")
            findings.append(replace(one, remedy=RAW) if own else one)
        return Report.of(findings, report.subject)


def open_recording(
    path: str | Path,
    *,
    robot: Any = None,
    joints: str | None = None,
    joint_names: Mapping[str, str] | Sequence[str] | None = None,
    units: Units = "auto",
    calibration: Calibration | None = None,
    frames: Mapping[str, FrameSource] | None = None,
    events: Mapping[str, EventSource] | None = None,
    episodes: slice | Sequence[int] | str | None = None,
    rate: float | None = None,
    trim: float | None = None,
    relax: Collection[str] = (),
) -> Recording:
    """Check the metadata of a data set, and find out how to read it.

    Parameters
    ----------
    path, robot, joints, joint_names, units, calibration, frames, events, episodes
        As for :func:`load_lerobot`.
    rate, trim, relax
        As for :func:`load_lerobot`.

    Raises
    ------
    DatasetError
        As :func:`load_lerobot`.
    """
    check_robot(robot)
    policy = Relaxed(relax)
    layout = open_layout(local_folder(path))
    for problem in layout.problems:
        policy(problem)
    policy.warn()
    feature = layout.feature(named.joint_feature(layout, joints))
    if calibration is not None:
        names = feature.names or named.names_of(feature, joint_names, robot)
        units = _calibrate_units(feature, calibration, names, units)
    columns = named.JointColumns.choose(feature, joint_names, units, robot)
    if calibration is not None:
        _check_calibrated(columns)
    chosen = tuple(select_episodes(layout, episodes))
    sources = frame_sources(layout, frames, chosen)
    stored = [feature.key.removeprefix(EVENT) for feature in event_features(layout)]
    detectors = event_sources(events, sources, stored, columns.names)
    assembly = Assembly(layout, columns, sources, detectors, robot, rate, trim)
    # one unit for all episodes: a quiet one does not decide
    if (stated := stated_range(layout.root, feature.key, feature.width)) is not None:
        assembly.joints.values(stated, file="meta/stats.json")
    findings = list[Finding]()
    if joints in (None, "measured"):
        findings += named.commanded_joints(layout, feature.key)
    if frames is None:
        findings += _find_unnamed_frames(layout)
    return Recording(chosen, assembly, policy.names, tuple(findings))


def _find_unnamed_frames(layout: Layout) -> Iterator[Finding]:
    """Report frames that are not read, since their values have no names."""
    objects = layout.features.get(ENVIRONMENT)
    if objects and objects.misnamed:
        message = f"no frame is read of {ENVIRONMENT!r}, {objects.misnamed}"
        remedy = "Say where each is, frames={...} (--frame NAME=FEATURE[0:7])"
        yield Finding("frames", message, remedy, (ENVIRONMENT,))


def _check_calibrated(columns: named.JointColumns) -> None:
    """Check that values without a motor have units."""
    feature = columns.feature
    pairs = zip(feature.names or (), columns.units, strict=False)
    if unknown := [name for name, unit in pairs if unit == "auto"]:
        given = f"units={{{unknown[0]!r}: 'deg', ...}} (--units {unknown[0]}=deg)"
        remedy = f"give their units, {given}; 'raw' for what is no joint"
        message = f"the calibration has no motor for {unknown}: {remedy}"
        raise DatasetError(message, column=feature.key)


def _calibrate_units(
    feature: Feature, calibration: Calibration, names: tuple[str, ...] | None, units: Units
) -> Units:
    """Return units by name: those that are given, else those of the calibration."""
    if not isinstance(units, Mapping) and units != "auto":
        both = "is for all values, and so is a calibration: give one of them, or units by name"
        raise DatasetError(f"units={units!r} {both}")
    if names is None:
        message = "the metadata do not name the values: a calibration needs joint_names=[...]"
        raise DatasetError(message, column=feature.key)
    by_name: dict[str, Unit] = {**calibrated_units(calibration, names)}
    given = {} if isinstance(units, str | Scale) else dict(units)
    keys = given.keys() - {"*"}
    return {n: u for n, u in by_name.items() if not any(fits(key, n) for key in keys)} | given


def select_episodes(
    layout: Layout, episodes: slice | Sequence[int] | str | None
) -> list[Episode]:
    """Select the episodes that are meant, in order of their index, each once.

    Raises
    ------
    DatasetError
        If an index or a task does not exist.
    """
    by_index = {episode.index: episode for episode in layout.episodes}
    available = list(by_index.values())
    if not available:
        raise DatasetError("the set has no episodes", file="meta/info.json")
    if episodes is None:
        return available
    if isinstance(episodes, slice):
        chosen = available[episodes]
        problem = f"{episodes} chooses none of the {len(available)} episodes"
    elif isinstance(episodes, str):
        chosen = [episode for episode in available if episodes in episode.tasks]
        problem = f"no episode has the task {episodes!r}; the tasks are {list(layout.tasks)}"
    else:
        return _select_indices(by_index, sorted({int(index) for index in episodes}))
    if not chosen:
        raise DatasetError(problem)
    return chosen


def _select_indices(by_index: Mapping[int, Episode], wanted: Sequence[int]) -> list[Episode]:
    if missing := [index for index in wanted if index not in by_index]:
        raise DatasetError(f"there are no episodes {missing}; the set has {sorted(by_index)}")
    return [by_index[index] for index in wanted]


def accept_arguments_of[**P, T](
    opener: Callable[P, Recording],
) -> Callable[[Callable[[Recording], T]], Callable[P, T]]:
    """Let a function of a recording take the arguments of what opens one.

    Parameters
    ----------
    opener : callable
        Function whose signature the decorated one then has, for editors and type checkers.
    """

    def decorate(function: Callable[[Recording], T]) -> Callable[P, T]:
        @wraps(function)
        def opening(*args: P.args, **kwargs: P.kwargs) -> T:
            return function(opener(*args, **kwargs))

        returned = signature(function).return_annotation
        shown = signature(opener).replace(return_annotation=returned)
        opening.__signature__ = shown  # type: ignore[attr-defined]
        return opening

    return decorate


@accept_arguments_of(open_recording)
def load_lerobot(recording: Recording) -> list[Demonstration]:
    """Read a LeRobot data set as demonstrations; videos are not looked at.

    Parameters
    ----------
    path : str or Path
        A folder in layout v2.1 or v3.0; ``"OWNER/NAME"``, a set that LeRobot keeps on this
        machine; or ``"hf://datasets/OWNER/NAME"``, one on the Hugging Face hub.
    robot : object with ``joint_names`` and ``state(joints)``, optional
        The demonstrations then have its joints in its order, found by name (also if spelled
        in another way, ``kLeftElbow`` or ``l_elbow.pos`` for ``left_elbow_joint``); values
        of the set that are not its joints are left out. Without a robot all values are
        taken.
    joints : str, optional
        The feature that holds the joints. The default is what was measured
        (``observation.state``, ``state`` and their variants), else what was commanded
        (``action``). Where both have the same joints, the latter are the demonstrations'
        ``commands``; actions that are no postures are left out, with a warning.
    joint_names : mapping or sequence of str, or "robot", optional
        Names instead of the data set's: all of them in order, or name in the set to name of
        the robot's joint for those that differ. ``"robot"``: the values are the robot's joints
        in its order, which a set that names none, or not so that it can be used, needs.
    units : str, Scale, or mapping of name to these, default="auto"
        ``"rad"``, ``"deg"``, ``"m"``, ``"mm"``, ``"raw"`` (taken as it is), ``"lerobot"``
        (degrees, and a gripper's 0 to 100 as the limits of that joint of the robot, else raw)
        or a :class:`Scale`, for all values, or by name or pattern: ``{"*": "deg", "*gripper":
        "raw"}``. Names come first, then later patterns. ``"auto"`` takes the metadata's, else
        assumes radians and refuses what cannot be radians.
    calibration : str, Path or mapping of str to these, optional
        LeRobot's calibration file of the robot, for values from -100 to 100 (grippers: 0 to
        100): they become radians from the middle of each motor's range. Of several arms,
        files by prefix of the names, ``{"left_": ..., "right_": ...}``. ``units`` given by
        name come first.
    frames : mapping of str to str, Path, FramePose, LinkPose, Frame or several, optional
        Where the pose of each frame is: in a feature (its name alone stands for x y z and a
        quaternion w x y z, constant from the first row on; if the feature names the poses
        in it, the one of this name), in a table that was measured apart (``"poses.csv"``, with
        columns ``episode``, ``x``, ``y``, ``z``, and ``yaw`` or ``qw`` to ``qz`` if it is
        turned, and ``time`` if it moves), where a link is at an event (``"r_hand@close"``, a
        :class:`LinkPose`), or given: one, a list with one for each episode that is read, or a
        mapping from the episode's index. The default is every pose that the names of
        ``observation.environment_state`` tell of (``bottle.x`` ... ``bottle.qz``), constant
        if it never changes.
    events : mapping of str to str, Detector or callable, optional
        How events are found, all values of the joint feature given: what
        :func:`~tpgmm_datasets.events.parse_event` takes, as ``"closing:*gripper*"``, or a
        function from the demonstration to a time [s]. Columns ``event.*`` are found by
        themselves, and so are ``close`` and ``open`` (of the gripper on the link's side, known
        by its name) and ``stop`` where a frame is at them. What is found without confidence is
        no event, and named in the warning.
    episodes : slice, sequence of int, or str, optional
        Episodes to read: a slice of all, by index, or those of a task. The default is all.
    rate : float, optional
        Resample to this many steps per second.
    trim : float, optional
        Cut off the start and end where no joint is faster than this [rad/s].
    relax : collection of str, default=()
        Names of checks (:data:`CHECKS`) that shall not raise: episodes that fail one are
        left out with a :class:`DatasetWarning`, those for one reason together.

    Returns
    -------
    list of Demonstration
        In order of the episodes; time starts at 0.

    Raises
    ------
    DatasetError
        With file, episode and column, if the set is incomplete or contradicts itself or the
        arguments.
    PlausibilityError
        If values cannot be what they are taken for (:func:`tpgmm_datasets.check`).

    Warns
    -----
    PlausibilityWarning
        Once, with all that is unlikely about them.

    Examples
    --------
    >>> from tpgmm_datasets import save_lerobot
    >>> import tempfile
    >>> shown = Demonstration([0.0, 0.1, 0.2], [[0.0], [0.5], [1.0]], joint_names=["elbow"])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = save_lerobot([shown], Path(folder) / "bends", fps=10, task="bend the elbow")
    ...     [again] = load_lerobot(path)
    >>> again.joint_names, again.joints[:, 0].tolist()
    (('elbow',), [0.0, 0.5, 1.0])
    """
    return list(recording.demonstrations())


@accept_arguments_of(open_recording)
def iter_lerobot(recording: Recording) -> Iterator[Demonstration]:
    """Read episode by episode, for sets larger than memory.

    The metadata are checked at the call, the rows of an episode when it comes.

    Parameters
    ----------
    path, robot, joints, joint_names, units, calibration, frames, events, episodes
        As for :func:`load_lerobot`.
    rate, trim, relax
        As for :func:`load_lerobot`.

    Yields
    ------
    Demonstration
        In order of the episodes.

    Raises
    ------
    DatasetError
        As :func:`load_lerobot`.
    """
    return recording.demonstrations()
