"""The arguments of :func:`tpgmm_datasets.load_lerobot` from a command line's texts."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from tpgmm_datasets.conversion.poses import FramePose
from tpgmm_datasets.events import parse_event
from tpgmm_datasets.lerobot.columns import ENVIRONMENT
from tpgmm_torch.exceptions import DataError

NAME = re.compile(r"[^@\[\]]+")
#: ``FEATURE``, ``FEATURE[7:14]``, ``LINK@EVENT`` or ``LINK@EVENT+x,y,z``; and a table's file.
SOURCE = re.compile(r"([^=@\[\]]+)(?:@[^=@\[\]]+|\[(\d+):(\d+)\])?|.+\.(?:csv|parquet)")


def parse_frames(texts: Sequence[str]) -> dict[str, Any] | None:
    """Parse the argument ``frames``; None without texts.

    Each text is ``NAME``, ``NAME=FEATURE``, ``NAME=FEATURE[7:14]``, ``NAME=POSES.csv``,
    ``NAME=LINK@EVENT`` or ``NAME=LINK@EVENT+x,y,z``; anything else is a DataError.
    """
    frames: dict[str, Any] = {}
    for text in texts:
        name, given, source = (part.strip() for part in text.partition("="))
        match = SOURCE.fullmatch(source) if given else None
        if not NAME.fullmatch(name) or name in frames or bool(given) != bool(match):
            raise DataError(
                f"frame {text!r} is given twice, or is not NAME, NAME=FEATURE, "
                "NAME=FEATURE[7:14], NAME=POSES.csv or NAME=LINK@EVENT"
            )
        frames[name] = _parse_source(match)
    return frames or None


def _parse_source(match: re.Match[str] | None) -> str | FramePose:
    if match is None:
        return FramePose(ENVIRONMENT, constant=None)
    begin, end = match.group(2, 3)
    return FramePose(match[1], slice(int(begin), int(end))) if begin else match[0]


def parse_events(texts: Sequence[str]) -> dict[str, Any] | None:
    """Parse the argument ``events``; None without texts.

    Each text is ``NAME=HOW``, as ``parse_event`` takes HOW; anything else is a
    DataError.
    """
    pairs = _pairs(texts, "event", "NAME=HOW", "close=closing:*gripper*")
    return {name: parse_event(how) for name, how in pairs.items()} or None


def parse_joint_names(texts: Sequence[str]) -> dict[str, str] | list[str] | str | None:
    """Parse the argument ``joint_names``; None without texts.

    The texts are ``STORED=JOINT`` for some, or one of ``NAME,NAME,...`` for all or ``robot``;
    anything else is a DataError.
    """
    if len(texts) == 1 and "=" not in texts[0] and texts[0].strip():
        names = [name.strip() for name in texts[0].split(",")]
        return "robot" if names == ["robot"] else names
    form = "STORED=JOINT (or, of all values, NAME,NAME,... or robot)"
    return _pairs(texts, "joint name", form, "main_elbow=elbow_flex") or None


def _pairs(texts: Sequence[str], kind: str, form: str, example: str) -> dict[str, str]:
    pairs: dict[str, str] = {}
    for text in texts:
        name, _, value = (part.strip() for part in text.partition("="))
        if not name or not value or name in pairs:
            problem = "is given twice" if name in pairs else f"is not {form}"
            raise DataError(f"{kind} {text!r} {problem}, as in {example}")
        pairs[name] = value
    return pairs


def parse_episodes(text: str | None) -> slice | list[int] | str | None:
    """Parse ``"0:10"`` as a slice, ``"0,3,5"`` as a list, else the name of a task."""
    if text is None:
        return None
    if re.fullmatch(r"(-?\d*):(-?\d*)", text):
        start, stop = (int(part) if part else None for part in text.split(":"))
        return slice(start, stop)
    if re.fullmatch(r"\d+(,\d+)*", text):
        return [int(part) for part in text.split(",")]
    return text


def parse_units(texts: Sequence[str]) -> dict[str, Any]:
    """Parse the arguments ``units`` and ``calibration``.

    The texts are one unit for all, and any number of ``JOINT=UNIT`` or ``PATTERN=UNIT`` for
    some; and ``FILE.json`` or ``PREFIX=FILE.json`` for LeRobot's calibration. Anything else is
    a DataError.
    """
    named: dict[str, str] = {}
    calibration: dict[str, str] = {}
    for text in texts:
        name, _, unit = text.rpartition("=")
        kind = calibration if unit.endswith(".json") else named
        if name in kind or text != text.strip("="):
            wanted = "one for all, and JOINT=UNIT or PATTERN=UNIT for some, each once"
            raise DataError(f"units are {wanted}; got {list(texts)}")
        kind[name] = unit
    units: Any = named.get("") or "auto"
    if {*named} - {""}:
        units = {name or "*": unit for name, unit in named.items()}
    return {"units": units, "calibration": calibration or None}
