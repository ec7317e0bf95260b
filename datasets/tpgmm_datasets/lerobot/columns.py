"""Which columns a demonstration becomes: the schema of the sets that this project writes.

``observation.state``
    The joints q_t.
``observation.environment_state``
    The frames, seven values each: x y z [m], then the unit quaternion w x y z; named
    ``bottle.x`` ... ``bottle.qz``.
``tracking.seen``, ``tracking.known``, ``tracking.residual``
    By object: whether its pose was measured in a picture; measured or inferred; how well
    [pixels].
``observation.wrench.<link>``
    Forces [N] and moments [N m] that a link exerts, at its origin, in the base frame.
``event.<name>``
    True at the one step nearest to the event.
``action``
    The joint reference: as given, else the next joints q_{t+1}, the last repeated.
``timestamp``, ``frame_index``, ``episode_index``, ``index``, ``task_index``
    As in every LeRobot set.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from tpgmm_datasets.errors import DatasetError
from tpgmm_datasets.lerobot.layout import BOOKKEEPING, Feature
from tpgmm_datasets.units import POSE_UNITS, with_pose_units
from tpgmm_torch.data.arrays import as_array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.pose_names import POSE_PARTS

Array = np.ndarray[Any, Any]
#: A column as ``info.json`` declares it; all of them; and the values of columns.
Entry = dict[str, Any]
Features = dict[str, Entry]
Columns = dict[str, Array]

STATE, ENVIRONMENT, ACTION = "observation.state", "observation.environment_state", "action"
EVENT, WRENCH = "event.", "observation.wrench."
#: Of the values of a wrench.
WRENCH_PARTS, WRENCH_UNITS = ("fx", "fy", "fz", "tx", "ty", "tz"), ("N",) * 3 + ("N m",) * 3
#: Of sets in whose pictures objects were tracked. They do not begin with "observation.": no
#: policy shall take them for something that it is given.
SEEN, KNOWN, RESIDUAL = "tracking.seen", "tracking.known", "tracking.residual"
#: What joints of demonstrations are in: the last is a coordinate's own scale.
JOINT_UNITS = ("rad", "m", "raw")
#: Fraction of a period by which the time of a step may be off the grid of ``fps``.
TIME_TOLERANCE = 0.01


def features_of(
    demonstrations: Sequence[Demonstration], dtype: str, units: Mapping[str, str] | None = None
) -> Features:
    """Declare demonstrations for ``info.json``; parameters as of ``save_lerobot``.

    Raises
    ------
    DatasetError
        If they have no joints, a name cannot be stored, or ``units`` name something else.
    """
    first = demonstrations[0]
    joints = _declare_joints(first, dtype, units or {})
    features = {STATE: joints}
    if first.frames:
        features[ENVIRONMENT] = with_frames(None, list(first.frames), dtype)
    for link in first.wrenches:
        features[WRENCH + link] = _vector(dtype, 6, WRENCH_PARTS, WRENCH_UNITS)
    for event in sorted({event for item in demonstrations for event in item.events}):
        if "/" in event or not event:
            raise DatasetError(f"LeRobot stores no column named {EVENT + event!r}: rename it")
        features[EVENT + event] = {"dtype": "bool", "shape": [1], "names": None}
    features[ACTION] = joints
    for key in BOOKKEEPING:
        features[key] = {"dtype": "int64", "shape": [1], "names": None}
    features["timestamp"]["dtype"] = "float32"
    return features


def _declare_joints(shown: Demonstration, dtype: str, units: Mapping[str, str]) -> Entry:
    """Declare the joints, in radians where no unit is given."""
    width, names = shown.n_joints, shown.joint_names
    if width == 0:
        raise DatasetError("demonstrations without joints cannot be stored: LeRobot needs them")
    for name, unit in units.items():
        if name not in (names or ()) or unit not in JOINT_UNITS:
            known = f"their units in demonstrations {list(JOINT_UNITS)}"
            joints = f"the joints are {names and list(names)}"
            raise DatasetError(f"units gives {name!r} the unit {unit!r}; {joints}, {known}")
    listed = [units.get(name, "rad") for name in names or ("",) * width]
    return _vector(dtype, width, names, with_pose_units(names, listed))


def with_frames(old: Feature | None, frames: Sequence[str], dtype: str = "float32") -> Entry:
    """Declare ``observation.environment_state``, with frames behind the old values.

    Raises
    ------
    DatasetError
        If one of the frames is there already.
    """
    names = [f"{frame}.{part}" for frame in frames for part in POSE_PARTS]
    units = POSE_UNITS * len(frames)
    if old is not None:
        before = old.names or tuple(map(str, range(old.width)))
        if {*before} & {*names}:
            raise DatasetError(f"of frames {frames} some are in the set", column=ENVIRONMENT)
        names, units = [*before, *names], (*(old.units or ("",) * old.width), *units)
        dtype = "float64" if old.dtype == "float64" else dtype
    return _vector(dtype, len(names), names, units)


def _vector(dtype: str, width: int, names: Sequence[str] | None, units: Sequence[str]) -> Entry:
    names = None if names is None else list(names)
    return {"dtype": dtype, "shape": [width], "names": names, "info": {"units": list(units)}}


def demonstration_columns(
    demonstration: Demonstration, number: int, features: Mapping[str, Any], fps: float
) -> dict[str, Array]:
    """Return the values of one episode by column, each of shape (T, width).

    ``number`` is how errors call the demonstration. Time starts at 0 in the set.

    Raises
    ------
    DatasetError
        If time does not follow ``fps``, or a value does not fit into the column's type.
    """
    steps = len(demonstration)
    grid = _check_grid(demonstration, number, fps)
    joints = as_array(demonstration.joints)
    sent = demonstration.commands
    actions = np.concatenate((joints[1:], joints[-1:])) if sent is None else as_array(sent)
    columns: dict[str, Array] = {STATE: joints, ACTION: actions}
    if demonstration.frames:
        first = features[ENVIRONMENT]["names"][:: len(POSE_PARTS)]
        order = [demonstration.frame(name.removesuffix(".x")) for name in first]
        poses = [pose_values(frame, steps) for frame in order]
        columns[ENVIRONMENT] = np.concatenate(poses, axis=1)
    for link, wrench in demonstration.wrenches.items():
        columns[WRENCH + link] = as_array(wrench)
    columns |= {k: _flag_event(demonstration, k, fps) for k in features if k.startswith(EVENT)}
    columns["timestamp"] = grid[:, None]
    columns["frame_index"] = np.arange(steps)[:, None]
    keys = [key for key in features if key in columns]
    return {key: _cast(columns[key], features[key]["dtype"], key, number) for key in keys}


def _check_grid(demonstration: Demonstration, number: int, fps: float) -> Array:
    """Return the times of steps at ``fps`` from 0, if the demonstration has these."""
    grid: Array = np.arange(len(demonstration)) / fps
    time = as_array(demonstration.time - demonstration.time[0])
    off = np.abs(time - grid)
    if off.max() > TIME_TOLERANCE / fps:
        at = int(off.argmax())
        raise DatasetError(
            f"demonstration {number} is not sampled at {fps:g} Hz: step {at} is at "
            f"{time[at]:.6g} s instead of {grid[at]:.6g} s. Resample it, "
            "tpgmm_datasets.resample(demonstration, fps)"
        )
    return grid


def action_column(commanded: Demonstration, number: int, features: Features) -> Columns:
    """Return the column ``action``, as the joints of ``commanded``."""
    feature = features[ACTION]
    if commanded.n_joints != feature["shape"][0]:
        counts = f"{feature['shape'][0]} joints and actions of {commanded.n_joints} values"
        raise DatasetError(f"demonstration {number} has {counts}")
    return {ACTION: _cast(as_array(commanded.joints), feature["dtype"], ACTION, number)}


def frame_columns(
    values: Array, frames: Mapping[str, Frame], features: Mapping[str, Any], number: int
) -> dict[str, Array]:
    """Return the column of :func:`with_frames`: the old values (T, width), then the poses."""
    poses = [pose_values(frame, len(values)) for frame in frames.values()]
    joined = np.concatenate([values, *poses], axis=1)
    return {ENVIRONMENT: _cast(joined, features[ENVIRONMENT]["dtype"], ENVIRONMENT, number)}


def pose_values(frame: Frame, rows: int) -> Array:
    """Return position and quaternion of a frame at each row, shape (rows, 7)."""
    pose = np.concatenate([as_array(frame.position), as_array(frame.orientation)], axis=-1)
    return np.broadcast_to(pose, (rows, len(POSE_PARTS)))


def _flag_event(demonstration: Demonstration, column: str, fps: float) -> Array:
    event = column.removeprefix(EVENT)
    flag = np.zeros((len(demonstration), 1), dtype=bool)
    if event in demonstration.events:
        since = demonstration.events[event] - float(demonstration.time[0])
        flag[min(round(since * fps), len(flag) - 1)] = True
    return flag


def _cast(values: Array, dtype: str, key: str, number: int) -> Array:
    with np.errstate(over="ignore"):
        cast: Array = values.astype(dtype)
    if not np.isfinite(cast).all():
        message = f"demonstration {number} has values beyond the range of {dtype}"
        raise DatasetError(message, column=key)
    return cast


def feature_table(columns: Mapping[str, Array], features: Mapping[str, Any]) -> pa.Table:
    """Make the rows of one episode, in the arrow types that LeRobot uses."""
    arrays = {}
    for key, feature in features.items():
        values = np.ascontiguousarray(columns[key]).reshape(-1)
        width = feature["shape"][0]
        kind = "bool_" if feature["dtype"] == "bool" else feature["dtype"]
        flat = pa.array(values, type=getattr(pa, kind)())
        arrays[key] = flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width)
    return pa.table(arrays)
