"""Pictures for calibrations: of boards, and of postures in LeRobot data sets."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tpgmm_datasets.lerobot.episodes import Relaxed, read_episodes
from tpgmm_datasets.reader import Recording
from tpgmm_torch.exceptions import DataError
from tpgmm_vision.detection.tags import grey
from tpgmm_vision.episodes.video import EpisodePictures, Picture, frames
from tpgmm_vision.poses import Array

#: Pictures of a longer video, up to twice as many, and postures of a recording; in so many at
#: least the robot may move faster than it should.
FRAMES, POSTURES, LEAST_POSTURES = 40, 60, 15
#: A joint that turns slower moves by less than 0.2 deg in the 20 ms that a picture may be late
#: [rad/s].
SLOW = 0.2
#: Joints nearer to one another are the same posture [rad].
SAME = float(np.radians(2.0))


def board_pictures(source: Path) -> dict[str, Picture]:
    """Grey pictures by name: all of a folder, or evenly those of a video.

    Raises
    ------
    DataError
        If there is no picture in it.
    """
    found, step = dict[str, Picture](), 1
    if source.is_dir():
        read = ((file.name, cv2.imread(str(file), 0)) for file in sorted(source.iterdir()))
        found = {name: picture for name, picture in read if picture is not None}
    for number, (_, frame) in enumerate(frames(source, 0.0, {}) if source.is_file() else ()):
        if number % step == 0:
            found[f"frame {number}"] = grey(frame.to_ndarray(format="rgb24"))
        if len(found) == 2 * FRAMES:
            found, step = dict([*found.items()][::2]), 2 * step
    if not found:
        raise DataError(f"{source} is no folder of pictures and no video")
    return found


def slow_postures(
    recording: Recording, keys: Mapping[str, str]
) -> tuple[Array, Iterator[dict[str, Picture]]]:
    """Postures where a robot moves slowly, those that differ most, and pictures there.

    Parameters
    ----------
    recording : Recording
    keys : mapping of str to str
        Features of cameras by their names.

    Returns
    -------
    joints : ndarray of shape (n, n_joints)
        [rad]
    pictures : iterator of dict
        Of each posture the pictures by the names of cameras.
    """
    assembly = recording.assembly
    layout, features = assembly.layout, assembly.features
    rows = list(read_episodes(layout, recording.episodes, features, Relaxed(())))
    reader = EpisodePictures(layout, list(keys.values()))
    tables = [assembly.demonstration(one).joints.double().numpy() for one in rows]
    speed = np.concatenate([
        np.abs(np.gradient(table, one.time, axis=0)).max(1) if len(table) > 1 else [0.0]
        for table, one in zip(tables, rows, strict=True)
    ])  # fmt: skip
    joints = np.concatenate(tables)
    slow = np.flatnonzero(speed <= max(SLOW, np.sort(speed)[:LEAST_POSTURES][-1]))
    chosen = slow[spread(joints[slow], POSTURES)].tolist()

    def pictures() -> Iterator[dict[str, Picture]]:
        first = 0
        for one in rows:
            wanted = [k - first for k in chosen if 0 <= k - first < len(one.time)]
            for _, shown in reader.read(one.episode, one.time, wanted):
                yield {name: shown[key] for name, key in keys.items()}
            first += len(one.time)

    return joints[chosen], pictures()


def spread(points: Array, most: int, same: float = SAME) -> NDArray[np.int_]:
    """Indices, in ascending order, of points (n, d) that are far from one another.

    Points nearer than ``same`` to one that was taken are not.
    """
    chosen = [0]
    distance = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < most and distance.max() > same:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.unique(chosen)
