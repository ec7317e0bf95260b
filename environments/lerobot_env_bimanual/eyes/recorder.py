"""Record episodes with videos as LeRobot does, with its own writer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lerobot_env_bimanual.eyes.rig import IMAGES
from tpgmm_datasets.lerobot.columns import with_frames
from tpgmm_torch.atomic import replacing
from tpgmm_torch.exceptions import DataError
from tpgmm_vision.cell import write_cell

__all__ = ["CODECS", "Recorder"]

#: What pictures are stored as: LeRobot's own choice, the other usual codec, no video.
CODECS = {"av1": "libsvtav1", "h264": "h264", "pictures": None}
CELL = "cell.json"


class Recorder:
    """A LeRobot data set that is being recorded, with a cell file in it.

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

    Raises
    ------
    DataError
        If the folder exists, or the codec is another.

    Examples
    --------
    ::

        with Recorder("set", 25, names, {"front": (640, 480)}, rig.content()) as recorder:
            for row in rows:
                recorder.add(row.joints, row.reference, rig.pictures(rng), "shake the bottle")
            recorder.save()
    """

    def __init__(
        self,
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
    ) -> None:
        if codec not in CODECS:
            raise DataError(f"a codec is one of {list(CODECS)}, got {codec!r}")
        self.path, self.fps, self.cell = Path(path), int(fps), cell
        self.robot_type, self.codec = robot_type, codec
        names = list(joint_names)
        units = ["rad"] * len(names) if units is None else list(units)
        joints = {
            "dtype": "float32", "shape": (len(names),), "names": names,
            "info": {"units": units},
        }  # fmt: skip
        kind = "image" if CODECS[codec] is None else "video"
        self._features: dict[str, Any] = {"observation.state": joints, "action": joints}
        for name, (width, height) in cameras.items():
            self._features[IMAGES + name] = {
                "dtype": kind,
                "shape": (height, width, 3),
                "names": ["height", "width", "channels"],
            }
        if objects:
            poses = with_frames(None, list(objects))
            self._features["observation.environment_state"] = {
                **poses, "shape": tuple(poses["shape"]),
            }  # fmt: skip
        self.episodes = self._rows = 0

    def __enter__(self) -> Self:
        from lerobot.configs.video import RGBEncoderConfig
        from lerobot.datasets import LeRobotDataset

        with ExitStack() as stack:
            new = stack.enter_context(replacing(self.path))
            if self.path.exists():
                raise DataError(f"{self.path} exists: remove it, or give another folder")
            codec = CODECS[self.codec]
            self._set: Any = LeRobotDataset.create(
                f"local/{self.path.name}",
                self.fps,
                self._features,
                root=new,
                robot_type=self.robot_type,
                use_videos=codec is not None,
                rgb_encoder=codec and RGBEncoderConfig(vcodec=codec),
                streaming_encoding=codec is not None,
                encoder_queue_maxsize=0,  # what a full queue does not take would be dropped
            )
            self._new = new
            self._closing = stack.pop_all()
        return self

    def add(
        self,
        state: ArrayLike,
        action: ArrayLike,
        pictures: Mapping[str, NDArray[np.uint8]],
        task: str,
        poses: ArrayLike | None = None,
    ) -> None:
        """Add a row.

        Parameters
        ----------
        state, action : array-like of shape (n_joints,)
            Measured, and the reference for the end of the period, in the declared units.
        pictures : mapping of str to ndarray of shape (height, width, 3)
            RGB, by the names of the cameras.
        task : str
            What is done, in words.
        poses : array-like of shape (7 * n_objects,), optional
            Of the objects.
        """
        row: dict[str, Any] = {IMAGES + name: one for name, one in pictures.items()}
        row |= {"observation.state": np.asarray(state, np.float32), "task": task}
        row["action"] = np.asarray(action, np.float32)
        if poses is not None:
            row["observation.environment_state"] = np.asarray(poses, np.float32)
        self._set.add_frame(row)
        self._rows += 1

    def save(self) -> None:
        """End the episode, and keep it."""
        self._set.save_episode()
        self.episodes, self._rows = self.episodes + 1, 0

    def discard(self) -> None:
        """Forget the rows since the last episode."""
        if self._rows:
            self._set.clear_episode_buffer()
            self._rows = 0

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._closing:
            self.discard()
            self._set.finalize()
            if kind is None:
                if not self.episodes:
                    raise DataError(f"no episode was saved: there is no {self.path}")
                write_cell(self.cell, self._new / CELL)
            else:
                raise error  # type: ignore[misc]
