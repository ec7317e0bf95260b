"""Names of a data set's signals: what a policy that was learned from it must know."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from tpgmm_datasets.conversion.assembly import FrameSource, frame_sources
from tpgmm_datasets.conversion.joints import JointColumns
from tpgmm_datasets.conversion.poses import FramePose
from tpgmm_datasets.errors import DatasetError
from tpgmm_datasets.lerobot.columns import ACTION, ENVIRONMENT, STATE
from tpgmm_datasets.lerobot.layout import Feature
from tpgmm_datasets.names import match_names
from tpgmm_datasets.reader import open_recording
from tpgmm_datasets.units import Scale, add_offsets

#: The cell of a set whose objects were tracked.
CELL = "meta/cell.json"
REMEDY = "A policy observes each joint, and gives an action for it"

#: Of values; and what makes radians or metres of them, by name.
Names = tuple[str, ...] | None
Scales = dict[str, Scale]


@dataclass(frozen=True)
class Signals:
    """Names, units and rate of states and actions.

    Parameters
    ----------
    fps : float
        Steps per second of the demonstrations.
    state_names, action_names, environment_names : tuple of str or None
        Entries of ``observation.state`` (of the joints' feature, if that is missing), of
        ``action`` and of ``observation.environment_state``; None where the set does not name
        them.
    units : mapping of str to (float, float)
        Factor and offset that bring a stored value to radians or metres, by joint; those
        that are left out are so stored. Without the joints' offsets, if there is a cell.
    frames : mapping of str to tuple of int
        Where frames are in ``observation.environment_state``, as position and quaternion
        (w, x, y, z) in metres.
    cell : Path, optional
        The file of the cell in whose pictures the objects were tracked.
    """

    fps: float
    state_names: tuple[str, ...] | None
    action_names: tuple[str, ...] | None
    environment_names: tuple[str, ...] | None
    units: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    frames: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    cell: Path | None = None

    @classmethod
    def of(
        cls,
        path: str | Path,
        robot: Any = None,
        *,
        frames: Mapping[str, FrameSource] | None = None,
        joint_names: Mapping[str, str] | Sequence[str] | None = None,
        **options: Any,
    ) -> Self:
        """Read the metadata of a data set.

        Parameters
        ----------
        path, robot, frames, joint_names, **options
            What :func:`load_lerobot` was given; frames at links are left out. Entries are
            called as ``joint_names`` says.

        Raises
        ------
        DatasetError
            If the data set cannot be read, or states and actions have different units.
        """
        options["joint_names"] = joint_names
        recording = open_recording(path, robot=robot, **options)
        assembly = recording.assembly
        layout, columns = assembly.layout, assembly.joints
        features = {STATE: columns.feature, **layout.features}
        scales = _select_scales(columns, columns.scales, robot)
        names = _name_entries(features, columns, joint_names, scales)
        cell = layout.root / CELL
        if cell.exists():  # which has the offsets, and a policy adds them
            bare = add_offsets(columns.units, None, columns.feature.key)
            scales = _select_scales(columns, bare, robot)
        sources = frame_sources(layout, frames, recording.episodes)
        environment = layout.features.get(ENVIRONMENT)
        return cls(
            assembly.rate or layout.fps,
            names[STATE],
            names.get(ACTION),
            environment.names if environment else None,
            {n: (s.factor, s.offset) for n, s in scales.items() if s != Scale(1.0)},
            _locate_frames(sources, environment) if environment else {},
            cell if cell.exists() else None,
        )


def _select_scales(columns: JointColumns, scales: Sequence[Scale], robot: Any) -> Scales:
    """Select the scales of the robot's joints, of all values without a robot."""
    names = columns.names or ()
    joints = names if robot is None else robot.joint_names
    return {n: scale for n, scale in zip(names, scales, strict=False) if n in joints}


def _locate_frames(sources: dict[str, Any], environment: Feature) -> dict[str, tuple[int, ...]]:
    """Locate frames that the environment's values hold as position and quaternion."""
    stored = {name: pose for name, pose in sources.items() if isinstance(pose, FramePose)}
    form = ENVIRONMENT, "wxyz", 1
    return {
        name: tuple(pose.select(name, environment))
        for name, pose in stored.items()
        if (pose.feature, pose.rotation, pose.scale) == form
    }


def _name_entries(
    features: Mapping[str, Feature], columns: JointColumns, joint_names: Any, scales: Scales
) -> dict[str, Names]:
    """Name the entries of states and actions as ``joint_names`` says, and check their units."""
    if joint_names is None or (joint_names and isinstance(joint_names, Mapping)):
        given, called = None, joint_names or {}
    else:
        given, called = columns.names, {}
    names = {}
    for key in sorted(features.keys() & {STATE, ACTION}, reverse=True):  # states first
        entries = _find_names(features[key], columns.feature, given)
        names[key] = entries and tuple(called.get(name, name) for name in entries)
        if features[key].key != columns.feature.key:
            _check_units(features[key], names[key], scales)
    return names


def _find_names(feature: Feature, source: Feature, given: Names) -> Names:
    """Find the names of values; those without names are the joints in order."""
    alike = feature.width == source.width
    if feature.misnamed and not (alike and given):
        message = f"its values cannot be distinguished: {feature.misnamed}. {REMEDY}"
        raise DatasetError(message, column=feature.key)
    if alike and feature.names in (None, source.names):
        return given or source.names
    return feature.names


def _check_units(feature: Feature, names: Names, scales: Scales) -> None:
    """Check that another column of the joints declares the same units, if any."""
    if not names or not feature.units:
        return
    matched = match_names(list(scales), names, feature.key, REMEDY)
    declared = add_offsets(feature.units, feature.offsets, feature.key)
    for entry, unit, scale in zip(names, feature.units, declared, strict=True):
        joint = matched.get(entry)
        if joint and unit != "raw" and scale != scales[joint]:
            message = f"{entry!r} is in {unit!r}, but {joint!r} was read in another unit"
            raise DatasetError(f"{message}: a policy needs one of both", column=feature.key)
