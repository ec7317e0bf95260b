"""Units of stored values, and how they become radians and metres."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from tpgmm_datasets.errors import DatasetError, UnknownUnitsError
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.pose_names import is_gripper, pose_groups

__all__ = ["Scale"]


@dataclass(frozen=True)
class Scale:
    """``value * factor + offset`` brings a stored value to radians or metres.

    Parameters
    ----------
    factor : float
        Radians (or metres) per stored unit.
    offset : float, default=0
        Radians (or metres) where the stored value is zero.
    stored : tuple of float, optional
        The least and the largest stored value; those beyond are refused.

    Examples
    --------
    >>> Scale.between((-100, 100), (-1.5, 1.5))
    Scale(factor=0.015, offset=0.0)
    >>> Scale.ticks(4096, zero=2048).factor == 2 * math.pi / 4096
    True
    """

    factor: float
    offset: float = 0.0
    stored: tuple[float, float] | None = field(default=None, repr=False, compare=False)

    @classmethod
    def between(cls, stored: tuple[float, float], actual: tuple[float, float]) -> Scale:
        """Map the two ``stored`` values to the two ``actual`` ones."""
        if stored[0] == stored[1]:
            raise DatasetError(f"a stored range needs two different ends, got {stored}")
        factor = (actual[1] - actual[0]) / (stored[1] - stored[0])
        return cls(factor, actual[0] - factor * stored[0])

    @classmethod
    def ticks(cls, per_turn: int, zero: float = 0.0) -> Scale:
        """Map encoder ticks: ``per_turn`` of them are a turn, ``zero`` is the angle 0."""
        return cls(math.tau / per_turn, -zero * math.tau / per_turn)

    @classmethod
    def from_calibration(
        cls,
        range_min: float,
        range_max: float,
        per_turn: int = 4096,
        zero: float | None = None,
        stored: tuple[float, float] = (-100.0, 100.0),
    ) -> Scale:
        """Map values that a calibration normalised, as LeRobot does with motors.

        Parameters
        ----------
        range_min, range_max : float
            The calibration's ends [ticks]; stored as the ends of ``stored``.
        per_turn : int, default=4096
            Ticks of a turn.
        zero : float, optional
            The tick of angle 0; by default the middle of the range.
        stored : tuple of float, default=(-100, 100)
            The normalised range; LeRobot's grippers have (0, 100).
        """
        middle = (range_min + range_max) / 2 if zero is None else zero
        angle = cls.ticks(per_turn, middle)
        ends = [tick * angle.factor + angle.offset for tick in (range_min, range_max)]
        scale = cls.between(stored, (ends[0], ends[1]))
        return cls(scale.factor, scale.offset, (min(stored), max(stored)))


#: Units that can be named; "raw" says that the values are to be taken as they are.
NAMED = {name: Scale(1.0) for name in ("rad", "m", "1", "raw")}
NAMED |= {"deg": Scale(math.pi / 180), "mm": Scale(1e-3)}

#: Units of a pose: position, then quaternion.
POSE_UNITS = ("m", "m", "m", "1", "1", "1", "1")

Unit = str | Scale
Units = Unit | Mapping[str, Unit]

#: A joint is hardly turned further [rad], nor is a recording in degrees smaller.
LARGEST_ANGLE = 4 * math.pi
#: Values that are normalised end at 100 up to this.
ROUNDING = 0.5


def guess_unit(lowest: float, highest: float) -> str:
    """Guess the unit of a joint from its range: ``"rad"``, or what else it may be."""
    largest = max(abs(lowest), abs(highest))
    if largest <= LARGEST_ANGLE:
        return "rad"
    return "deg or normalised" if largest <= 100.5 else "deg" if largest <= 360 else "ticks"


def with_pose_units(names: Sequence[str] | None, units: Sequence[str]) -> tuple[str, ...]:
    """Return ``units`` with those of poses where the names tell of a pose."""
    changed = list(units)
    for group in pose_groups(names).values():
        for position, unit in zip(group, POSE_UNITS, strict=True):
            changed[position] = unit
    return tuple(changed)


def convert(
    values: Array, names: Sequence[str], units: Sequence[Unit], column: str, **where: Any
) -> Array:
    """Bring values to radians and metres.

    Parameters
    ----------
    values : ndarray of shape (T, width)
        As stored.
    names : sequence of str
        How errors call them.
    units : sequence of str or Scale
        One of ``NAMED``, ``"auto"`` or a scale for each.
    column : str
        Where they come from.
    **where
        File and episode, for errors.

    Returns
    -------
    ndarray of float64 of shape (T, width)

    Raises
    ------
    DatasetError
        If a unit is unknown, or "auto" finds values that cannot be radians.
    """
    scales = [as_scale(unit, column) for unit in units]
    if "auto" in units:
        _check_angles(values, names, units, column, where)
    for name, scale, stored in zip(names, scales, values.T, strict=True):
        _check_stored(name, scale, stored, column, where)
    converted: Array = values.astype(np.float64)
    if any(scale != NAMED["raw"] for scale in scales):
        converted = converted * [s.factor for s in scales] + [s.offset for s in scales]
    return converted


def _check_stored(name: str, scale: Scale, values: Array, column: str, where: Any) -> None:
    """Refuse values (T,) beyond the range to which they were normalised."""
    low, high = scale.stored or (-math.inf, math.inf)
    least, most = values.min(), values.max()
    if least < low - ROUNDING or most > high + ROUNDING:
        message = (
            f"{name!r} goes from {least:.4g} to {most:.4g}, but is to be normalised to "
            f"{low:g} ... {high:g}: was it recorded in degrees (use_degrees)? Then "
            "units='deg' (--units deg), without a calibration"
        )
        raise DatasetError(message, column=column, **where)


def _check_angles(
    values: Array, names: Sequence[str], units: Sequence[Unit], column: str, where: Any
) -> None:
    """Refuse "auto" where a value cannot be radians: the joints of a feature have one unit.

    Grippers are of any unit, and say nothing of the others.
    """
    others, large, small = list[str](), list[str](), list[str]()
    only_grippers = True
    for name, unit, low, high in zip(names, units, values.min(0), values.max(0), strict=True):
        span = f"{name!r} (from {low:.4g} to {high:.4g}"
        if unit != "auto":
            others += [f"{name!r} is said to be in {unit!r}"] * _is_angular(unit, name)
        elif max(abs(low), abs(high)) > LARGEST_ANGLE:
            large.append(f"{span}: {guess_unit(low, high)}?)")
            only_grippers &= is_gripper(name)
        else:
            small.append(f"{span}: not either)")
    unsure = large if only_grippers and not others else large + small
    if unsure:
        because = f", because {others[0]} and joints have one unit" if others else ""
        message = (
            f"these values are not radians{because}: {', '.join(unsure)}. Say what they are, "
            "units='lerobot' (arms in degrees, grippers 0 to 100), 'deg' or units={'*': 'deg', "
            "'*gripper': 'raw', name: Scale.from_calibration(...), ...} (commands: --units "
            "lerobot, deg, PATTERN=raw or LeRobot's calibration file; training: "
            "--policy.units); 'raw' takes them as they are"
        )
        raise UnknownUnitsError(message, column=column, **where)


def _is_angular(unit: Unit, name: str) -> bool:
    """Check if a unit says that the joints of the feature, no grippers, are not in radians."""
    scaled = unit == "deg" or (isinstance(unit, Scale) and unit.factor != 1)
    return scaled and not is_gripper(name)


def as_scale(unit: Unit, column: str) -> Scale:
    """Return the scale that a unit stands for.

    Parameters
    ----------
    unit : str or Scale
        One of ``NAMED``, or ``"auto"``, which is taken as it is.
    column : str
        Where the values come from.

    Raises
    ------
    DatasetError
        If it is unknown.
    """
    if isinstance(unit, Scale):
        return unit
    if unit == "auto":
        return NAMED["raw"]
    if unit not in NAMED:
        there = f"{sorted(NAMED)}, 'lerobot', 'auto' and Scale"
        raise DatasetError(f"unit {unit!r} is unknown; there are {there}", column=column)
    return NAMED[unit]


def add_offsets(
    units: Sequence[Unit], offsets: Sequence[float] | None, column: str
) -> list[Scale]:
    """Return the scales that units stand for, with an offset [rad or m] behind each.

    Examples
    --------
    >>> add_offsets(["rad"], [0.1], "action")
    [Scale(factor=1.0, offset=0.1)]
    """
    scales = [as_scale(unit, column) for unit in units]
    pairs = zip(scales, offsets or [0.0] * len(scales), strict=True)
    return [replace(scale, offset=scale.offset + offset) for scale, offset in pairs]


def fits(pattern: str, *names: str) -> bool:
    """Check if a name, with or without LeRobot's ``.pos``, is or matches a ``pattern``."""
    called = {*names, *(name.removesuffix(".pos") for name in names)}
    return pattern in called or any(fnmatchcase(name, pattern) for name in called)


def units_of(
    units: Units, stored: Sequence[str], final: Sequence[str], robot: Any, column: str
) -> list[Unit]:
    """Choose the unit of each value, ``"auto"`` where none is given.

    Names come before patterns, of which later ones come first, and all of them before ``"*"``.

    Parameters
    ----------
    units : str, Scale or mapping of str to these
        For all, or by name or pattern. ``"lerobot"`` stands for degrees, and for a gripper's 0
        to 100: the limits of that joint where the robot has them, else ``"raw"``.
    stored, final : sequence of str
        What the values are called in the data set and by the robot.
    robot : object with ``joint_names``, or None
        Its ``lower`` and ``upper`` limits are looked at.
    column : str
        Where the values come from.

    Raises
    ------
    DatasetError
        If a name or a pattern fits no value.

    Examples
    --------
    >>> units_of({"*": "lerobot", "lift": "mm"}, ("pan", "lift", "jaw.pos"), ("a", "b", "c"),
    ...          None, "action")
    ['deg', 'mm', 'raw']
    """
    given = units if isinstance(units, Mapping) else {"*": units}
    called = list(zip(stored, final, strict=True))
    fitting = {key: _find_places(key, called) for key in given}
    if unknown := [key for key, places in fitting.items() if not places]:
        there = f"which fit no value; they are called {list(dict.fromkeys(stored))}"
        raise DatasetError(f"units names {unknown}, {there}", column=column)
    chosen: list[Unit] = ["auto"] * len(final)
    for key in sorted(given, key=lambda key: 2 if key in {*stored, *final} else key != "*"):
        for place in fitting[key]:
            chosen[place] = _resolve_lerobot(given[key], *called[place], robot)
    return chosen


def _find_places(pattern: str, called: Sequence[tuple[str, str]]) -> list[int]:
    return [i for i, names in enumerate(called) if fits(pattern, *names)]


def _resolve_lerobot(unit: Unit, stored: str, name: str, robot: Any) -> Unit:
    """Replace ``"lerobot"`` by the unit in which LeRobot's motors give a value."""
    if unit != "lerobot":
        return unit
    if not is_gripper(stored) and not is_gripper(name):
        return "deg"
    limits = (getattr(robot, key, ()) for key in ("joint_names", "lower", "upper"))
    ranges = {joint: (float(a), float(b)) for joint, a, b in zip(*limits, strict=False)}
    low, high = ranges.get(name, (0, math.inf))
    if math.isinf(high - low):
        return "raw"
    return replace(Scale.between((0, 100), (low, high)), stored=(0.0, 100.0))
