"""LeRobot's calibration files: how a robot's motors were normalised when it was recorded.

A file is a JSON object of motors by name, each with ``id``, ``drive_mode``, ``homing_offset``,
``range_min`` and ``range_max`` (the ends of its range, in ticks). Values of a recording run
from -100 to 100 over that range, those of grippers from 0 to 100.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tpgmm_datasets.errors import DatasetError
from tpgmm_datasets.names import match_names
from tpgmm_datasets.units import Scale
from tpgmm_torch.atomic import read_whole

#: One file, or one for the motors of each arm by what stands before their names: ``left_``.
Calibration = str | Path | Mapping[str, str | Path]

FIELDS = ("drive_mode", "range_min", "range_max")
REMEDY = (
    "Two arms have a file each, by what stands before their names: calibration={'left_': ..., "
    "'right_': ...} (--units left_=FILE.json). Else name the values as the motors are, "
    "joint_names=..., or give the units of each"
)


def calibrated_units(calibration: Calibration, names: tuple[str, ...]) -> dict[str, Scale]:
    """Read the scales of recorded values that a calibration tells.

    The angle 0 is the middle of a motor's range, as in LeRobot's degrees.

    Parameters
    ----------
    calibration : str, Path or mapping of str to these
        A file, or files by prefix of the motors' names.
    names : tuple of str
        Names of the recorded values, ``shoulder_pan.pos`` for the motor ``shoulder_pan``.

    Returns
    -------
    dict of str to Scale
        By recorded name; values that are no motor's are left out.

    Raises
    ------
    DatasetError
        If it is no file, a file cannot be read or is no calibration, or a motor is not among
        the names.

    Examples
    --------
    >>> import tempfile
    >>> motor = {"id": 1, "drive_mode": 0, "range_min": 0, "range_max": 2048}
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "arm.json"
    ...     written = file.write_text(json.dumps({"elbow_flex": motor}))
    ...     calibrated_units(file, ("elbow_flex.pos",))["elbow_flex.pos"].stored
    (-100.0, 100.0)
    """
    files = calibration if isinstance(calibration, Mapping) else {"": calibration}
    motors: dict[str, Scale] = {}
    for prefix, file in files.items():
        if not isinstance(file, str | Path):
            wanted = "the path of LeRobot's JSON file, or several by prefix"
            raise DatasetError(f"a calibration is {wanted}; got {calibration!r}")
        motors |= {f"{prefix}{name}": _scale(name, motor, file) for name, motor in _read(file)}
    matched = match_names(list(motors), names, "calibration", REMEDY, "the motor")
    return {value: motors[name] for value, name in matched.items()}


def _read(file: str | Path) -> list[tuple[str, Any]]:
    try:
        content = json.loads(read_whole(file))
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(f"the calibration cannot be read: {error}", file=file) from error
    if not isinstance(content, dict) or not content:
        raise DatasetError("a calibration is a JSON object of motors", file=file)
    return list(content.items())


def _scale(name: str, motor: Any, file: str | Path) -> Scale:
    fields = [motor.get(field) for field in FIELDS] if isinstance(motor, dict) else []
    whole = [value for value in fields if type(value) is int]
    if len(whole) < len(FIELDS) or whole[1] >= whole[2]:
        message = f"motor {name!r} needs whole numbers {[*FIELDS]} and a range, got {motor!r}"
        raise DatasetError(message, file=file)
    drive_mode, low, high = whole
    stored = (0.0, 100.0) if "gripper" in name else (-100.0, 100.0)
    if drive_mode:
        message = (
            f"motor {name!r} has the drive mode {drive_mode}. Whether LeRobot turned it round "
            f"depends on its bus: say units={{{name!r}: Scale.from_calibration({low}, {high}, "
            f"stored={stored})}} for Dynamixel, stored={stored[::-1]} for Feetech, and leave "
            "the motor out of the file"
        )
        raise DatasetError(message, file=file)
    return Scale.from_calibration(low, high, stored=stored)
