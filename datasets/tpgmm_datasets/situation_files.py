"""Situations written as JSON: a start posture and object poses each."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tpgmm_torch.atomic import read_whole
from tpgmm_torch.data.demonstrations import Situation
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError

__all__ = ["read_situations"]

#: What a situation may have beside its start and its frames.
TIMES = ("time", "frames_time")


def read_situations(path: str | Path, joint_names: Sequence[str]) -> list[Situation]:
    """Read a JSON list of situations.

    Each is an object with ``joints``, a list of numbers or an object from joint names to
    numbers [rad or m]; ``frames``, an object from names to ``{"position": [x, y, z],
    "orientation": [w, x, y, z]}``, the orientation optional, or to task parameters
    ``{"A": rows, "b": [...]}``, all also one per time step; and optionally ``time`` and
    ``frames_time``, lists of seconds: when references are wanted, and when the poses of frames
    that move were recorded.

    Parameters
    ----------
    path : str or Path
        The file.
    joint_names : sequence of str
        Order of the joints, ``model.kinematics_.joint_names``.

    Raises
    ------
    DataError
        If it is not such a file; the message says which situation is meant.

    Examples
    --------
    >>> import tempfile
    >>> text = '[{"joints": {"elbow": 0.5}, "frames": {"cup": {"position": [0.4, 0, 0]}}}]'
    >>> with tempfile.NamedTemporaryFile("w", suffix=".json", delete_on_close=False) as file:
    ...     _ = file.write(text)
    ...     file.close()
    ...     [situation] = read_situations(file.name, ["elbow"])
    >>> situation.frames["cup"].position.tolist()
    [0.4, 0.0, 0.0]
    """
    path = Path(path)
    try:
        items = json.loads(read_whole(path))
    except OSError as error:
        absent = isinstance(error, FileNotFoundError)
        message = f"there is no file {path}" if absent else f"{path} cannot be read: {error}"
        raise DataError(message) from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path} is not JSON: {error}") from error
    if not isinstance(items, list) or not items:
        raise DataError(f"{path} is to hold a list of situations, [{{'joints': ...}}, ...]")
    situations = []
    for number, item in enumerate(items):
        try:
            situations.append(_situation(item, joint_names))
        except (DataError, UnknownNameError) as error:
            raise DataError(f"{path}, situation {number}: {error}") from error
    return situations


def _situation(item: Any, joint_names: Sequence[str]) -> Situation:
    _check_keys(item, "a situation", required={"joints"}, optional={"frames", *TIMES})
    frames = item.get("frames", {})
    if not isinstance(frames, dict):
        raise DataError(f"'frames' maps names to poses, got {frames!r}")
    poses: dict[str, Frame] = {}
    for name, pose in frames.items():
        _check_keys(pose, f"frame {name!r}", required={"position"}, optional={"orientation"})
        poses[name] = Frame(pose["position"], pose.get("orientation"))
    joints, times = item["joints"], {name: item.get(name) for name in TIMES}
    if isinstance(joints, Mapping):
        for name in joints:
            if name not in joint_names:
                raise UnknownNameError("joint", name, "the model", joint_names)
    situation = Situation(joints, poses, **times).reorder(joint_names)
    if len(situation.joints) != len(joint_names):
        wanted = f"the model has {len(joint_names)} joints: {list(joint_names)}"
        raise ShapeError(f"'joints' has {len(situation.joints)} values, {wanted}")
    return situation


def _check_keys(item: Any, what: str, required: set[str], optional: set[str]) -> None:
    allowed = sorted(required | optional)
    if not isinstance(item, dict):
        raise DataError(f"{what} is an object with {allowed}, got {item!r}")
    for key in required - item.keys():
        raise DataError(f"{what} lacks {key!r}")
    for key in item.keys() - required - optional:
        raise DataError(f"{what} has {key!r}, which is not among {allowed}")
