"""Pictures for calibrations: of folders, videos and LeRobot data sets."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from tpgmm_datasets.lerobot.episodes import Relaxed, read_episodes
from tpgmm_datasets.reader import Recording
from tpgmm_torch.exceptions import DataError
from tpgmm_vision.cell import CellCamera
from tpgmm_vision.detection.tags import grey
from tpgmm_vision.episodes.video import EpisodePictures, Picture
from tpgmm_vision.poses import Array

__all__ = ["board_pictures", "slow_postures"]

#: Pictures of a video that are looked at, and postures of a recording.
FRAMES, POSTURES = 200, 60
#: A joint that turns slower moves by less than 0.2 deg in the 20 ms that a picture may be late
#: [rad/s].
SLOW = 0.2
#: Joints nearer to one another are the same posture [rad].
SAME = np.radians(2.0)


def board_pictures(source: Path) -> dict[str, NDArray[np.uint8]]:
    """Grey pictures by name: of a folder, or evenly of a video.

    Raises
    ------
    DataError
        If there are none.
    """
    found = dict[str, NDArray[np.uint8]]()
    if source.is_dir():
        for file in sorted(source.iterdir()):
            picture = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
            if picture is not None:
                found[file.name] = picture
    else:
        try:
            with av.open(str(source)) as container:
                step = max(container.streams.video[0].frames // FRAMES, 1)
                for number, frame in enumerate(container.decode(video=0)):
                    if number % step == 0:
                        found[f"frame {number}"] = grey(frame.to_ndarray(format="rgb24"))
        except (av.error.FFmpegError, IndexError) as error:
            raise DataError(f"{source} is no folder, video or data set ({error})") from error
    if not found:
        raise DataError(f"there are no pictures in {source}")
    return found


def slow_postures(
    recording: Recording,
    cameras: Mapping[str, CellCamera],
    progress: Callable[[int, int], None],
    most: int = POSTURES,
) -> tuple[Array, dict[str, list[Picture]]]:
    """Joints and pictures where a robot moves slowly, at postures that differ most.

    Parameters
    ----------
    recording : Recording
    cameras : mapping of str to CellCamera
    progress : callable
        Called with how many rows were read and how many there are.
    most : int, default=60
        Postures at most.

    Returns
    -------
    joints : ndarray of shape (n, n_joints)
        [rad]
    pictures : dict of str to list of n ndarray
        By camera.
    """
    assembly, keys = recording.assembly, {name: one.key for name, one in cameras.items()}
    reader = EpisodePictures(assembly.layout, list(keys.values()))
    rows = list(
        read_episodes(assembly.layout, recording.episodes, assembly.features, Relaxed(()))
    )
    tables = [assembly.demonstration(one).joints.double().numpy() for one in rows]
    speeds = [
        np.abs(np.gradient(table, one.time, axis=0)).max(1) if len(table) > 1 else np.zeros(1)
        for table, one in zip(tables, rows, strict=True)
    ]
    joints, speed = np.concatenate(tables), np.concatenate(speeds)
    slow = np.flatnonzero(speed <= max(SLOW, np.sort(speed)[min(most, len(speed)) - 1]))
    chosen = slow[spread(joints[slow], most)]
    pictures: dict[str, list[Picture]] = {name: [] for name in cameras}
    wanted, at = set(chosen.tolist()), 0
    for one in rows:
        last = max((k for k in wanted if k < at + len(one.time)), default=-1)
        for k, images in enumerate(reader.read(one.episode, one.time), at):
            progress(k + 1, len(joints))
            if k in wanted:
                for name, key in keys.items():
                    pictures[name].append(images[key])
            if k >= last:
                break
        at += len(one.time)
    progress(len(joints), len(joints))
    return joints[chosen], pictures


def spread(points: Array, most: int) -> NDArray[np.int_]:
    """Indices, in ascending order, of points (n, d) that are far from one another."""
    chosen, distance = [0], np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < most and distance.max() > SAME:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.unique(chosen)
