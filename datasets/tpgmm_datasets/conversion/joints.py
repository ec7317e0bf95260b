"""Which values of a data set are the joints, what they are called, and in which unit."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from tpgmm_datasets.errors import DatasetError, DatasetWarning
from tpgmm_datasets.lerobot.columns import ENVIRONMENT
from tpgmm_datasets.lerobot.layout import BOOKKEEPING, Feature, Layout
from tpgmm_datasets.names import NAME_ALL, match_names
from tpgmm_datasets.units import Scale, Unit, Units, add_offsets, as_scale, convert, units_of
from tpgmm_torch.checks.report import Finding

Names = Mapping[str, str] | Sequence[str]
Labels = tuple[str, ...] | None

#: Where the joints are, in order of preference.
MEASURED = ("observation.state", "observation.states", "state", "observation.qpos")
COMMANDED = ("action", "actions")
JOINT_FEATURES = (*MEASURED, *COMMANDED)
#: What releases before 0.4 took for ``joints``; it changes nothing.
OLD_WORDS = ("measured", "commanded")
LEARNED_BESIDE = "can go: commands are learned beside measured joints now"
#: Parts of the names of features that may hold measured joints.
LIKE_JOINTS = re.compile("joint|qpos|proprio|state|position", re.IGNORECASE)


@dataclass(frozen=True)
class JointColumns:
    """The joints of a data set.

    Parameters
    ----------
    feature : Feature
        The column that holds them.
    names : tuple of str or None
        Name of each value: the robot's where it is a joint of it, else the data set's.
    units : tuple of str or Scale
        Unit of each value.
    """

    feature: Feature
    names: tuple[str, ...] | None
    units: tuple[Unit, ...]

    @classmethod
    def choose(cls, feature: Feature, names: Names | None, units: Units, robot: Any) -> Self:
        """Match the values of a feature with what the caller says and with the robot.

        Raises
        ------
        DatasetError
            If a name or unit does not fit.
        """
        final = names_of(feature, names, robot)
        return cls(feature, final, tuple(_choose_units(feature, final, units, robot)))

    @property
    def scales(self) -> list[Scale]:
        """Scales and offsets from stored values to radians or metres."""
        return add_offsets(self.units, self.feature.offsets, self.feature.key)

    @property
    def raw(self) -> set[str]:
        """Names of the values that are taken as they are."""
        named = zip(self.names or (), self.units, strict=False)
        return {name for name, unit in named if unit == "raw"}

    def values(self, stored: np.ndarray[Any, Any], **where: Any) -> np.ndarray[Any, Any]:
        """Convert stored values (T, width) to radians and metres."""
        called = self.feature.names or self.names or self.feature.labels
        values = convert(stored, called, self.units, self.feature.key, **where)
        return values if self.feature.offsets is None else values + self.feature.offsets


def joint_feature(layout: Layout, joints: str | None = None) -> str:
    """Find the feature that holds the joints.

    Parameters
    ----------
    layout : Layout
        Metadata of the data set.
    joints : str, optional
        Its name. The default is the first usual one that there is, measured before commanded.

    Raises
    ------
    DatasetError
        If there is no usual one.
    """
    if joints in layout.features or joints not in (None, *OLD_WORDS):
        return str(joints)
    usual = (key for key in JOINT_FEATURES if key in layout.features)
    key = next((key for key in usual if not layout.features[key].is_camera), None)
    if key is None:
        raise DatasetError(
            f"there are no joints: none of {list(JOINT_FEATURES)} is a column. Say which holds "
            f"them, joints=... (--joints), of {sorted(layout.features)}",
            check="joints",
            file="meta/info.json",
        )
    if joints == "commanded" and key in MEASURED:
        said = f"joints='commanded' (--joints) {LEARNED_BESIDE}"
        warnings.warn(said, DatasetWarning, stacklevel=2)
    return key


def commanded_joints(layout: Layout, key: str) -> Iterator[Finding]:
    """Report that commanded joints are read by default; nothing where ``key`` is measured."""
    if key not in COMMANDED:
        return
    others = [
        other
        for other, feature in layout.features.items()
        if other not in (*JOINT_FEATURES, *BOOKKEEPING, ENVIRONMENT)
        and feature.dtype.startswith("float")
        and (feature.width == layout.features[key].width or LIKE_JOINTS.search(other))
    ]
    hint = f"; {others} may hold them" if others else ""
    yield Finding(
        "joints",
        f"{key!r} is read, commands, as no measured joints have a usual name, {MEASURED}{hint}",
        f"Say which are meant: joints={(others or [key])[0]!r} (--joints)",
        (key, *others),
    )


def names_of(feature: Feature, given: Names | None, robot: Any) -> tuple[str, ...] | None:
    """Name each value: as the robot where it is a joint of it, else as the data set.

    Raises
    ------
    DatasetError
        If they are not distinct, or do not fit what is ``given`` or the robot.
    """
    count = feature.width
    if given == "robot":
        if robot is None:
            raise DatasetError("joint_names='robot' needs a robot", column=feature.key)
        names: tuple[str, ...] | None = tuple(robot.joint_names)
    elif isinstance(given, Mapping) or given is None:
        names = _rename_values(feature, given or {})
    else:
        names = (given,) if isinstance(given, str) else tuple(given)
    if names is not None and not len(names) == len({*names}) == count:
        message = f"joint_names must give {count} different names, got {len(names)}: {names}"
        raise DatasetError(message, column=feature.key)
    return names if robot is None else _match_robot(feature, names, robot)


def _rename_values(feature: Feature, renamed: Mapping[str, str]) -> tuple[str, ...] | None:
    """Return the names of the metadata, some of them replaced."""
    if feature.misnamed:
        message = f"its values cannot be distinguished: {feature.misnamed}. {NAME_ALL}"
        raise DatasetError(message, check="joints", column=feature.key)
    for name in renamed:
        if name not in (feature.names or ()):
            message = f"joint_names has {name!r}; the values are called {feature.names}"
            raise DatasetError(message, column=feature.key)
    return feature.names and tuple(renamed.get(name, name) for name in feature.names)


def _match_robot(feature: Feature, names: Labels, robot: Any) -> tuple[str, ...]:
    if names is None and feature.width == len(robot.joint_names) == 1:
        names = tuple(robot.joint_names)
    if names is None:
        these = f"the robot's {len(robot.joint_names)} joints, {list(robot.joint_names)}"
        message = f"the set does not name its {feature.width} values, nor say which are {these}"
        raise DatasetError(f"{message}. {NAME_ALL}", column=feature.key)
    matched = match_names(robot.joint_names, names, feature.key)
    return tuple(matched.get(name, name) for name in names)


def _choose_units(feature: Feature, named: Labels, units: Units, robot: Any) -> list[Unit]:
    """Choose units: given ones, by the data set's name or the robot's, before declared ones."""
    final = named or feature.labels
    stored = feature.names or final
    declared = feature.units or ("auto",) * feature.width
    chosen = units_of(units, stored, final, robot, feature.key)
    differing, resolved = list[str](), list[Unit]()
    joints = getattr(robot, "joint_names", final)
    for name, joint, given, known in zip(stored, final, chosen, declared, strict=True):
        if _differ(given, known, feature.key):
            differing.append(f"{name!r} in {known!r}, not {given!r}")
        # values of no joint are only seen by functions that find events
        unknown = "auto" if joint in joints else "raw"
        resolved.append(next((unit for unit in (given, known) if unit != "auto"), unknown))
    if differing:
        differ = f"the set declares {', '.join(differing)}; what was given counts"
        warnings.warn(f"column {feature.key!r}: {differ}", DatasetWarning, stacklevel=2)
    return resolved


def _differ(given: Unit, declared: str, column: str) -> bool:
    """Check if a given unit contradicts the declared one."""
    if given == "auto" or declared in ("auto", "raw"):
        return False
    return as_scale(given, column) != as_scale(declared, column)
