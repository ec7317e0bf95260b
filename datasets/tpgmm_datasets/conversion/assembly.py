"""From the rows of an episode to a demonstration."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from tpgmm_datasets.conversion.commands import CommandColumns
from tpgmm_datasets.conversion.joints import JointColumns
from tpgmm_datasets.conversion.poses import FramePose, LinkPose, MeasuredPoses
from tpgmm_datasets.conversion.timing import resample, trim
from tpgmm_datasets.errors import DatasetError
from tpgmm_datasets.events import Detector, parse_event, usual_event
from tpgmm_datasets.lerobot import stored_signals as signals
from tpgmm_datasets.lerobot.columns import ENVIRONMENT
from tpgmm_datasets.lerobot.episodes import EpisodeRows
from tpgmm_datasets.lerobot.layout import Episode, Feature, Layout
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.pose_names import pose_groups
from tpgmm_torch.exceptions import DataError

Pose = FramePose | LinkPose | MeasuredPoses | Frame
FrameSource = str | Path | Pose | Sequence[Frame] | Mapping[int, Frame]
Sources = Mapping[str, Pose]
EventSource = str | Detector | Callable[[Demonstration], float]


def frame_sources(
    layout: Layout, frames: Mapping[str, FrameSource] | None, chosen: Sequence[Episode]
) -> dict[str, Pose]:
    """Find where each frame is in the chosen episodes; None stands for those the set names.

    Raises
    ------
    DatasetError
        If a source is of no known kind, or lacks a pose for one of these episodes.
    """
    if frames is None:
        feature = layout.features.get(ENVIRONMENT)
        groups = pose_groups(feature.names) if feature else {}
        return {n: FramePose(ENVIRONMENT, group, constant=None) for n, group in groups.items()}
    wanted = [episode.index for episode in chosen]
    known = {episode.index for episode in layout.episodes}
    return {n: _frame_source(layout, n, one, wanted, known) for n, one in frames.items()}


def _frame_source(
    layout: Layout, name: str, source: Any, wanted: Sequence[int], known: Collection[int]
) -> Pose:
    if isinstance(source, str | Path):
        text, path = str(source), Path(source)
        if text in layout.features:
            return FramePose(text)
        if path.suffix in (".csv", ".parquet") or path.is_file():
            return MeasuredPoses.read(name, path, wanted, known)
        return LinkPose.parse(text) if "@" in text else FramePose(text)
    given = isinstance(source, Pose)
    return source if given else MeasuredPoses.take(name, source, wanted, known)


def event_sources(
    events: Mapping[str, EventSource] | None,
    frames: Sources,
    stored: Collection[str],
    names: Sequence[str] | None,
) -> dict[str, Detector | Callable[[Demonstration], float]]:
    """Choose how each event is found: as given, and where a frame is at one, by its name.

    Parameters
    ----------
    events : mapping of str to str, Detector or callable, or None
        Events that are given.
    frames : mapping of str to FramePose, LinkPose, MeasuredPoses or Frame
        Sources of the frames, some perhaps at other events.
    stored : collection of str
        Events that are there already.
    names : sequence of str or None
        Names of all signals, a gripper's among them.

    Raises
    ------
    DatasetError
        If frames of two links are at an event that each of them has for itself, or the
        signals of a gripper are not known by their names.
    DataError
        If a text is no event.
    """
    sources = {
        name: parse_event(source) if isinstance(source, str) else source
        for name, source in (events or {}).items()
    }
    usual: dict[str, Detector] = {}
    for name, pose in frames.items():
        if not isinstance(pose, LinkPose) or pose.event in (*sources, *stored):
            continue
        event, detector = str(pose.event), _find_usual_event(name, pose, names or ())
        if detector is not None and usual.setdefault(event, detector) != detector:
            another = f"{event!r} of {pose.link!r} is another event than of the other links"
            remedy = f"call it otherwise: events={{'{event}_{pose.link}': 'closing:SIGNAL'}}"
            raise DatasetError(f"frame {name!r}: {another}; {remedy}")
    return sources | usual


def _find_usual_event(frame: str, pose: LinkPose, names: Sequence[str]) -> Detector | None:
    if not isinstance(pose.event, str):
        return None
    try:
        return usual_event(pose.event, pose.link, names)
    except DataError as error:
        message = f"frame {frame!r}: event {pose.event!r} is not in the data set, and {error}"
        raise DatasetError(message) from error


def stored_frames(layout: Layout, sources: Sources, rows: EpisodeRows) -> dict[str, Frame]:
    """Read the frames of an episode that are not at links."""
    frames, where = dict[str, Frame](), rows.episode.where
    for name, source in sources.items():
        if isinstance(source, FramePose):
            feature = layout.feature(source.feature)
            places = source.select(name, feature)
            frames[name] = source.frame(rows.values[feature.key], places, **where)
        elif isinstance(source, MeasuredPoses):
            frames[name] = source.frame(name, rows.time, **where)
        elif isinstance(source, Frame):
            frames[name] = source
    return frames


@dataclass(frozen=True)
class Assembly:
    """Columns and settings that a demonstration is made of.

    Parameters
    ----------
    layout : Layout
        The data set.
    joints : JointColumns
        Where the joints are.
    frames : mapping of str to FramePose, LinkPose, MeasuredPoses or Frame
        Where the pose of each frame is.
    events : mapping of str to Detector or callable
        Detectors, or functions from the demonstration, with all values of the joint feature,
        to a time.
    robot : object with ``joint_names`` and ``state(joints)``, or None
        Gives the order of the joints, and the poses of links.
    rate : float or None
        Steps per second, if it is to be resampled.
    trim : float or None
        Speed below which starts and ends are idle, if they are to be cut off.
    doubtful : list of (int, str, float)
        Events that were looked for and not found with confidence: index of the episode,
        event, confidence.
    left_out : list of (int, str)
        Actions that are no postures: index of the episode, and what they are.

    Raises
    ------
    DatasetError
        If a frame is at a link and there is no robot.
    """

    layout: Layout
    joints: JointColumns
    frames: Mapping[str, Pose]
    events: Mapping[str, Detector | Callable[[Demonstration], float]]
    robot: Any
    rate: float | None
    trim: float | None
    doubtful: list[tuple[int, str, float]] = field(default_factory=list, compare=False)
    left_out: list[tuple[int, str]] = field(default_factory=list, compare=False)

    def __post_init__(self) -> None:
        for name, source in self.frames.items():
            if isinstance(source, LinkPose) and self.robot is None:
                raise DatasetError(f"frame {name!r} is at a link: pass robot= (--robot)")

    @property
    def features(self) -> list[Feature]:
        """Features that have to be read."""
        layout, frames = self.layout, self.frames.values()
        poses = [one for one in frames if isinstance(one, FramePose)]
        objects = map(layout.feature, dict.fromkeys(pose.feature for pose in poses))
        joints = [self.joints.feature]
        joints += [] if self.commands is None else [self.commands.actions.feature]
        flags, wrenches = signals.event_features(layout), signals.wrench_features(layout)
        return [*joints, *objects, *flags, *wrenches]

    @cached_property
    def commands(self) -> CommandColumns | None:
        """Find where the commands of the joints are; None where the set has none."""
        return CommandColumns.find(self.layout, self.joints)

    def _read_commands(self, rows: EpisodeRows, joints: Array) -> Tensor | None:
        """Read the commands of an episode, where they are postures."""
        if self.commands is None:
            return None
        stored = rows.values[self.commands.actions.feature.key]
        commands, kind = self.commands.read(stored, joints, self.joints.names)
        if kind:
            self.left_out.append((rows.episode.index, kind))
        return None if commands is None else torch.from_numpy(commands)

    def demonstration(self, rows: EpisodeRows) -> Demonstration:
        """Convert, find frames and events, cut, resample, and bring into the robot's order."""
        where = rows.episode.where
        joints = self.joints.values(rows.values[self.joints.feature.key], **where)
        demonstration = Demonstration(
            torch.from_numpy(rows.time),
            torch.from_numpy(joints),
            stored_frames(self.layout, self.frames, rows),
            self.joints.names,
            signals.flagged_events(rows),
            wrenches=signals.stored_wrenches(rows),
            commands=self._read_commands(rows, joints),
        )
        demonstration = self._with_events(demonstration, rows)
        if self.trim is not None:
            demonstration = trim(demonstration, self.trim, **where)
        demonstration = self._with_links(demonstration, rows)
        if self.rate is not None:
            demonstration = resample(demonstration, self.rate)
        if self.robot is not None:
            demonstration = demonstration.reorder(self.robot.joint_names)
        return demonstration

    def _with_events(self, demonstration: Demonstration, rows: EpisodeRows) -> Demonstration:
        events = dict(demonstration.events)
        for name, source in self.events.items():
            if isinstance(source, Detector):
                found = source.find(demonstration, self.robot)
                if not found.certain:
                    self.doubtful.append((rows.episode.index, name, found.confidence))
                    continue
                at = found.time
            else:
                at = float(source(demonstration))
            if not 0 <= at <= demonstration.duration:
                whole = f"outside the episode of {demonstration.duration:.6g} s"
                message = f"event {name!r} was found at {at:.6g} s, {whole}"
                raise DatasetError(message, **rows.episode.where)
            events[name] = at
        return replace(demonstration, events=events) if self.events else demonstration

    def _with_links(self, demonstration: Demonstration, rows: EpisodeRows) -> Demonstration:
        frames = dict(demonstration.frames)
        for name, source in self.frames.items():
            if isinstance(source, LinkPose):
                time = source.time(demonstration, **rows.episode.where)
                frames[name] = source.frame(demonstration, self.robot, time)
        return replace(demonstration, frames={name: frames[name] for name in self.frames})
