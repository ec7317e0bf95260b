"""Record episodes with videos by LeRobot's own writer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from numpy.typing import ArrayLike, NDArray

from lerobot_env_bimanual.eyes.rig import IMAGES, Rig
from tpgmm_datasets.lerobot.columns import with_frames
from tpgmm_torch.atomic import replacing
from tpgmm_torch.exceptions import DataError
from tpgmm_vision.cell import write_cell

#: What pictures are stored as: LeRobot's own choice, the other usual codec, no video.
CODECS = {"av1": "libsvtav1", "h264": "h264", "pictures": None}
CELL = "cell.json"


@contextmanager
def recording(
    path: str | Path,
    fps: int,
    joint_names: Sequence[str],
    cameras: Mapping[str, tuple[int, int]],
    cell: Mapping[str, Any],
    *,
    objects: Sequence[str] = (),
    units: Sequence[str] | None = None,
    robot_type: str | None = None,
    codec: str = "av1",
) -> Iterator[Any]:
    """Open a LeRobot data set for recording, with a cell file in it.

    It takes the place of ``path`` when the block ends, as a whole or not at all.

    Parameters
    ----------
    path : str or Path
        The folder; it must not exist.
    fps : int
        Rows per second.
    joint_names : sequence of str
        Of ``observation.state`` and ``action``.
    cameras : mapping of str to (int, int)
        Width and height of the pictures by the names of the cameras.
    cell : mapping
        Content of the cell file, ``cell.json``.
    objects : sequence of str, default=()
        Whose poses are recorded too, in ``observation.environment_state``.
    units : sequence of str, optional
        Of the joints; radians by default. Empty to declare none, as LeRobot does.
    robot_type : str, optional
    codec : {"av1", "h264", "pictures"}, default="av1"

    Yields
    ------
    LeRobotDataset
        Its ``add_frame`` takes what :func:`row` makes, ``save_episode`` ends an episode,
        ``clear_episode_buffer`` forgets one.

    Raises
    ------
    DataError
        If the folder exists, the codec is another, or no episode was saved.

    Examples
    --------
    ::

        with recording("set", 25, names, {"front": (640, 480)}, rig.content()) as opened:
            for joints, reference in motion:
                pictures = rig.pictures(rng)
                opened.add_frame(row("shake the bottle", joints, reference, pictures))
            opened.save_episode()
    """
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets import LeRobotDataset

    if codec not in CODECS:
        raise DataError(f"a codec is one of {list(CODECS)}, got {codec!r}")
    video = CODECS[codec]
    features = _features(list(joint_names), cameras, objects, units, video is not None)
    with replacing(path) as new:
        if Path(path).exists():
            raise DataError(f"{path} exists: remove it, or give another folder")
        opened = LeRobotDataset.create(
            f"local/{Path(path).name}", fps, features, root=new, robot_type=robot_type,
            use_videos=video is not None, streaming_encoding=video is not None,
            rgb_encoder=video and RGBEncoderConfig(vcodec=video),
            encoder_queue_maxsize=0,  # what a full queue does not take would be dropped
        )  # fmt: skip
        try:
            yield opened
        finally:
            if opened.has_pending_frames():
                opened.clear_episode_buffer()
            opened.finalize()
        if not opened.num_episodes:
            raise DataError(f"no episode was saved: there is no {path}")
        write_cell(cell, new / CELL)


@contextmanager
def recording_before(
    env: Any,
    out: str | Path,
    n: int,
    *,
    cameras: str | Sequence[str] = "front",
    size: tuple[int, int] = (640, 480),
    cell: Mapping[str, Any] = MappingProxyType({}),
    tags: Mapping[str, Any] = MappingProxyType({}),
    **options: Any,
) -> Iterator[tuple[Rig, Any]]:
    """Open a set, as :func:`recording` does, for a ``ControlledEnv`` and cameras before it.

    Parameters
    ----------
    env : ControlledEnv
        In which an episode has begun.
    out : str or Path
        The folder.
    n : int
        How many episodes or postures are wanted.
    cameras, size
        As of :func:`~lerobot_env_bimanual.record.record`.
    cell : mapping, optional
        What the cell file has in it beside cameras, objects and joints.
    tags : mapping, optional
        What carries tags, as of :class:`Rig`.
    **options
        Of :func:`recording`.

    Yields
    ------
    rig : Rig
    LeRobotDataset
    """
    if n < 1:
        raise DataError(f"at least one episode is recorded, got n={n}")
    rig: Rig = env.rig(cameras, size, **tags)
    if not rig.views:
        raise DataError("a set with videos needs a camera: --cameras front")
    names = [name + env.suffix for name in env.joint_names]
    sizes = dict.fromkeys(rig.views, size)
    cell = {**rig.content(), **env.cell_of_joints(), **cell}
    with recording(out, env.fps, names, sizes, cell, units=env.units, **options) as opened:
        yield rig, opened
    rig.close()


def _features(
    names: list[str],
    cameras: Mapping[str, tuple[int, int]],
    objects: Sequence[str],
    units: Sequence[str] | None,
    video: bool,
) -> dict[str, Any]:
    """Describe the columns of a set as LeRobot does."""
    joints: dict[str, Any] = {"dtype": "float32", "shape": (len(names),), "names": names}
    units = ["rad"] * len(names) if units is None else list(units)
    joints |= {"info": {"units": units}} if units else {}
    features: dict[str, Any] = {OBS_STATE: joints, ACTION: joints}
    for name, (width, height) in cameras.items():
        shape, axes = (height, width, 3), ["height", "width", "channels"]
        kind = "video" if video else "image"
        features[IMAGES + name] = {"dtype": kind, "shape": shape, "names": axes}
    if objects:
        poses = with_frames(None, list(objects))
        features[OBS_ENV_STATE] = {**poses, "shape": tuple(poses["shape"])}
    return features


def row(
    task: str,
    state: ArrayLike,
    action: ArrayLike,
    pictures: Mapping[str, NDArray[np.uint8]],
    poses: ArrayLike | None = None,
) -> dict[str, Any]:
    """Make a row of a set that is being recorded.

    Parameters
    ----------
    task : str
        What is done, in words.
    state, action : array-like of shape (n_joints,)
        Measured, and the reference for the end of the period, in the declared units.
    pictures : mapping of str to ndarray of shape (height, width, 3)
        RGB, by the names of the cameras.
    poses : array-like of shape (7 * n_objects,), optional
        Of the objects.
    """
    values = {OBS_STATE: state, ACTION: action, OBS_ENV_STATE: poses}
    numbers = {k: np.asarray(v, np.float32) for k, v in values.items() if v is not None}
    return {"task": task, **numbers, **{IMAGES + name: one for name, one in pictures.items()}}
