"""Names of a data set's signals: what a policy that was learned from it must know."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

from tpgmm_datasets.conversion.assembly import FrameSource, frame_sources
from tpgmm_datasets.conversion.poses import FramePose
from tpgmm_datasets.errors import DatasetError
from tpgmm_datasets.lerobot.columns import ACTION, ENVIRONMENT, STATE
from tpgmm_datasets.lerobot.layout import Feature
from tpgmm_datasets.names import match_names
from tpgmm_datasets.reader import open_recording
from tpgmm_datasets.units import Scale, as_scale, shifted

__all__ = ["CELL", "Signals"]

#: The cell of a set whose objects were tracked.
CELL = "meta/cell.json"
REMEDY = "A policy observes each joint, and gives an action for it"


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
        layout, columns, source = assembly.layout, assembly.joints, assembly.joints.feature
        called = joint_names if isinstance(joint_names, Mapping) else {}
        given = None if called or joint_names is None else columns.names
        state = _renamed(layout.features.get(STATE, source), source, called, given)
        action = layout.features.get(ACTION)
        action = action and _renamed(action, source, called, given)
        environment = layout.features.get(ENVIRONMENT)
        scales = {
            name: scale
            for name, scale in zip(columns.names or (), columns.scales, strict=False)
            if robot is None or name in robot.joint_names
        }
        for feature in (state, action):
            if feature and feature.key != source.key and feature.names and feature.units:
                _check_units(feature, scales)
        places = {
            name: tuple(pose.select(name, environment))
            for name, pose in frame_sources(layout, frames, recording.episodes).items()
            if isinstance(pose, FramePose)
            and environment
            and (pose.feature, pose.rotation, pose.scale) == (ENVIRONMENT, "wxyz", 1)
        }
        cell = layout.root / CELL
        if cell.exists():  # which has the offsets, and a policy adds them
            bare = dict(zip(columns.names or (), columns.units, strict=False))
            scales = {name: as_scale(bare[name], source.key) for name in scales}
        return cls(
            assembly.rate or layout.fps,
            state.names,
            action.names if action else None,
            environment.names if environment else None,
            {n: (s.factor, s.offset) for n, s in scales.items() if s != Scale(1.0)},
            places,
            cell if cell.exists() else None,
        )


def _renamed(
    feature: Feature, source: Feature, called: Mapping[str, str], given: tuple[str, ...] | None
) -> Feature:
    """As somebody calls its values; what names none has the names of the joints in order."""
    names, alike = feature.names, feature.width == source.width
    if feature.misnamed and not (alike and given):
        message = f"its values cannot be distinguished: {feature.misnamed}. {REMEDY}"
        raise DatasetError(message, column=feature.key)
    if alike and (names is None or (given and names == source.names)):
        names = given or source.names
    return replace(feature, names=names and tuple(called.get(name, name) for name in names))


def _check_units(feature: Feature, scales: Mapping[str, Scale]) -> None:
    """Check that other columns of the joints declare the same units, if any."""
    names, units = feature.names or (), feature.units or ()
    matched = match_names(list(scales), names, feature.key, REMEDY)
    own = shifted(units, feature.offsets, feature.key)
    for entry, unit, scale in zip(names, units, own, strict=True):
        joint = matched.get(entry)
        if joint and unit != "raw" and scale != scales[joint]:
            message = f"{entry!r} is in {unit!r}, but {joint!r} was read in another unit"
            raise DatasetError(f"{message}: a policy needs one of both", column=feature.key)
