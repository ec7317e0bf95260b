"""Demonstrations for the page: the generated skill, and files that are uploaded."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from functools import cache
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from tpgmm_datasets.bottle.skill import BottleShaking, upper_body
from tpgmm_datasets.reader import load_lerobot
from tpgmm_datasets.tables import demonstrations_from_frame, read_table
from tpgmm_datasets.text import parse_frames
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.robots.kinematics import Kinematics

#: Demonstrations, and the robot that gave them if it is known.
Recorded = tuple[list[Demonstration], Kinematics | None]

#: A LeRobot data set's description, in its folder.
DESCRIPTION = "meta/info.json"
#: Of an archive, unpacked [bytes]: a small one can hold more than a disk does.
MOST_BYTES = 2 * 1024**3


@cache
def generate_bottle() -> Recorded:
    """Generate demonstrations of shaking a bottle; once, as that takes a while."""
    return BottleShaking(rate=25).demonstrations(5, 0), upper_body()


def read_uploads(
    files: Sequence[str | Path], robot: Kinematics | None = None, frames: Sequence[str] = ()
) -> list[Demonstration]:
    """Read the demonstrations in uploaded files.

    Parameters
    ----------
    files : sequence of str or Path
        One ``.zip`` of the folder of a LeRobot data set; or tables, ``.csv`` or ``.parquet``,
        as :func:`~tpgmm_datasets.tables.demonstrations_from_frame` reads them. A table
        without the column ``episode`` is one demonstration.
    robot : Kinematics, optional
        Gives the order of the joints.
    frames : sequence of str
        Poses in a LeRobot data set, as ``tpgmm fit --frame`` takes them.

    Raises
    ------
    DataError
        If these are no such files.
    """
    paths = sorted(path for path in map(Path, files) if not path.name.startswith("."))
    suffixes = [path.suffix.lower() for path in paths]
    if suffixes == [".zip"]:
        return _read_archive(paths[0], robot, parse_frames(frames) or {})
    if not paths or not {*suffixes} <= {".csv", ".parquet"}:
        names = ", ".join(path.name for path in paths) or "no file"
        raise DataError(
            "give one .zip of a LeRobot data set's folder, or tables (.csv, .parquet); got "
            f"{names}"
        )
    tables = map(demonstrations_from_frame, map(read_table, paths))
    return list(chain.from_iterable(tables))


def _read_archive(
    archive: Path, robot: Kinematics | None, frames: dict[str, Any]
) -> list[Demonstration]:
    with TemporaryDirectory() as place:
        folder = _unpack(archive, Path(place))
        for one in map(str, frames.values()):
            if one.endswith((".csv", ".parquet")):
                raise DataError(f"{one} is not in the set: tpgmm dataset add-frames")
        return load_lerobot(folder, robot=robot, frames=frames or None)


def _unpack(archive: Path, place: Path) -> Path:
    """Unpack a zip archive, and return the folder of the one data set in it."""
    try:
        with zipfile.ZipFile(archive) as opened:
            size = sum(entry.file_size for entry in opened.infolist())
            if size > MOST_BYTES:
                raise DataError(
                    f"{archive.name} unpacks to {size / 1e9:.1f} GB; at most "
                    f"{MOST_BYTES / 1e9:.1f} GB are taken. Leave its videos out: they are not "
                    "read, or give the folder: tpgmm app FOLDER"
                )
            opened.extractall(place)  # keeps names with ".." inside the folder
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, OSError) as error:
        raise DataError(f"{archive.name} cannot be unpacked: {error}") from error
    found = sorted(path.parents[1] for path in place.rglob(DESCRIPTION))
    if len(found) != 1:
        raise DataError(
            f"{archive.name} holds {len(found) or 'no'} LeRobot data sets, not one: there are "
            f"{len(found)} files {DESCRIPTION}"
        )
    return found[0]
