"""Pictures of the episodes of a LeRobot data set: videos (AV1, H.264, ...) and images."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray
from pyarrow.dataset import dataset, field

from tpgmm_datasets.errors import DatasetError
from tpgmm_datasets.lerobot.files import chunked_files
from tpgmm_datasets.lerobot.layout import Episode, Layout, episode_file
from tpgmm_datasets.lerobot.parquet import read_columns
from tpgmm_vision.poses import Array

Picture = NDArray[np.uint8]
#: How far a picture of a video may be from the time of its row [periods]: below a half, so that
#: no other picture is meant.
OFF_ROW = 0.25
#: Where an episode is in the videos: numbers, and from when to when [s].
PLACE = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
#: Rows with images that are read at a time: what bounds the memory.
IMAGE_ROWS = 16


class EpisodePictures:
    """Read the pictures of cameras, episode by episode, one row at a time.

    Parameters
    ----------
    layout : Layout
        Of the data set, in v2.1 or v3.0.
    keys : sequence of str
        Features of the cameras.

    Raises
    ------
    DatasetError
        If there is no such camera, or the metadata do not say where its videos are.
    """

    def __init__(self, layout: Layout, keys: Sequence[str]) -> None:
        self.layout, self.keys = layout, tuple(keys)
        there = [key for key, feature in layout.features.items() if feature.is_camera]
        if missing := [key for key in keys if key not in there]:
            remedy = "The cell says which camera is meant, in 'key'"
            message = f"the set has no pictures {missing}; its cameras are {there}. {remedy}"
            raise DatasetError(message, file="meta/info.json")
        self.videos = [key for key in keys if layout.features[key].dtype == "video"]
        self._places = _read_places(layout.root, self.videos)

    def read(
        self, episode: Episode, time: Array, rows: Collection[int] | None = None
    ) -> Iterator[tuple[int, dict[str, Picture]]]:
        """Rows of an episode with their pictures, RGB of shape (height, width, 3), by key.

        Parameters
        ----------
        episode : Episode
        time : ndarray of shape (T,)
            Of its rows, from its start [s].
        rows : collection of int, optional
            Which are wanted; by default all.

        Raises
        ------
        DatasetError
            If a video or an image is missing or damaged, or a video does not fit the rows.
        """
        kinds = [self._video if key in self.videos else self._images for key in self.keys]
        pairs = zip(kinds, self.keys, strict=True)
        streams = [read(key, episode, time) for read, key in pairs]
        stop = None if rows is None else max(rows, default=-1) + 1
        for row, pictures in enumerate(islice(zip(*streams, strict=True), stop)):
            if rows is None or row in rows:
                yield row, dict(zip(self.keys, pictures, strict=True))

    def _video(self, key: str, episode: Episode, time: Array) -> Iterator[Picture]:
        layout, period = self.layout, 1 / self.layout.fps
        place: Any
        *place, start, stop = self._places.get((key, episode.index), [0.0, len(time) * period])
        file = episode_file(layout.info, "video_path", episode.index, place, video_key=key)
        where: dict[str, Any] = {"file": file, "episode": episode.index, "column": key}
        if abs(stop - start - len(time) * period) > OFF_ROW * period:
            message = f"the episode takes {stop - start:.6g} s of the video, its rows "
            raise _unlike(f"{message}{len(time)} x {period:.6g} s", where)
        row, at = 0, start
        for at, frame in frames(layout.root / file, start, where):
            if row == len(time):
                raise _unlike(f"the video goes on behind its {row} rows", where)
            off = (at - start - time[row]) / period
            if off > OFF_ROW:
                break
            if off > -OFF_ROW:
                yield frame.to_ndarray(format="rgb24")
                row += 1
                if row == len(time) and place:
                    return  # others follow in the same file
        if row < len(time):
            message = f"no picture is at {start + time[row]:.4f} s of the video, where row "
            raise _unlike(f"{message}{row} is; the last is at {at:.4f} s", where)

    def _images(self, key: str, episode: Episode, time: Array) -> Iterator[Picture]:
        root, count = self.layout.root, 0
        where: dict[str, Any] = {"file": episode.file, "episode": episode.index, "column": key}
        batches = dataset(root / episode.file).to_batches(
            columns=[key], filter=field("episode_index") == episode.index,
            batch_size=IMAGE_ROWS, batch_readahead=1,
        )  # fmt: skip
        for stored in (one for batch in batches for one in batch[key].to_pylist()):
            yield _decode_image(stored, root, where)
            count += 1
        if count != len(time):
            raise _unlike(f"there are {count} images for {len(time)} rows", where)


def _read_places(root: Path, videos: Sequence[str]) -> dict[tuple[str, int], list[Any]]:
    """Read the :data:`PLACE` of episodes in videos of v3.0, by key and episode."""
    places = dict[tuple[str, int], list[Any]]()
    for path in chunked_files(root / "meta" / "episodes"):
        for key in videos:
            columns = [f"videos/{key}/{part}" for part in PLACE]
            table = read_columns(path, root, ["episode_index", *columns])
            for index, *place in zip(*table.to_pydict().values(), strict=True):
                places[key, index] = place
    return places


def _unlike(problem: str, where: dict[str, Any]) -> DatasetError:
    remedy = "Was it cut, or recorded at another rate? Without its video it cannot be tracked"
    return DatasetError(f"{problem}. {remedy}", check="metadata", **where)


def frames(path: Path, start: float, where: dict[str, Any]) -> Iterator[tuple[float, Any]]:
    """Time [s] and frame of a video, from the key frame before ``start`` on."""
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            # what is damaged is an error, not a guess of the decoder's
            stream.codec_context.options = {"err_detect": "explode"}
            base = stream.time_base or Fraction(1)
            container.seek(max(round(start / base) - 1, 0), stream=stream)
            for frame in container.decode(stream):
                if frame.is_corrupt or frame.pts is None:
                    raise ValueError(f"a damaged picture at {frame.time} s")
                yield float(frame.pts * base), frame
    except (av.error.FFmpegError, IndexError, ValueError) as error:
        problem = "damaged, or of a kind that PyAV cannot read" if path.is_file() else "missing"
        message = f"the video is {problem} ({error})"
        raise DatasetError(message, check="missing", **where) from error


def _decode_image(stored: Any, root: Path, where: dict[str, Any]) -> Picture:
    """Decode a picture as LeRobot stores images: bytes of a file, or its path."""
    content, path = (stored or {}).get("bytes"), (stored or {}).get("path")
    file = (root / (path or "")).resolve()
    if content is None and file.is_relative_to(root.resolve()) and file.is_file():
        content = file.read_bytes()
    found = cv2.imdecode(np.frombuffer(content, np.uint8), 1) if content else None
    if found is None:
        message = f"an image is missing or damaged (path {path!r})"
        raise DatasetError(message, check="missing", **where)
    return np.ascontiguousarray(found[..., ::-1])
