"""Track the objects of a recorded LeRobot data set in its own pictures, and write a copy."""

from __future__ import annotations

import html
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tpgmm_datasets.conversion.joints import Names, joint_feature, names_of
from tpgmm_datasets.errors import DatasetError, summed_up
from tpgmm_datasets.lerobot.columns import ENVIRONMENT, with_frames
from tpgmm_datasets.lerobot.episodes import EpisodeRows, Relaxed, read_episodes
from tpgmm_datasets.lerobot.layout import Layout
from tpgmm_datasets.names import match_names
from tpgmm_datasets.reader import open_recording
from tpgmm_datasets.units import Units
from tpgmm_datasets.writer import Column, add_frames
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_vision.cell import Cell
from tpgmm_vision.episodes.report import EpisodeReport, report_page
from tpgmm_vision.episodes.smoothing import Track, smoothed
from tpgmm_vision.episodes.video import EpisodePictures
from tpgmm_vision.poses import Array, pose_matrix, pose_vector
from tpgmm_vision.sources import PoseSource, pose_source

__all__ = ["track_lerobot"]

#: Columns of a tracked set; their names do not begin with "observation.", so that no policy
#: takes them for something that it is given.
SEEN, KNOWN, RESIDUAL = "tracking.seen", "tracking.known", "tracking.residual"
CELL = "meta/cell.json"


def track_lerobot(
    path: str | Path,
    out: str | Path,
    cell: str | Path,
    robot: Kinematics | None = None,
    *,
    joint_names: Names | None = None,
    units: Units = "auto",
    calibration: Any = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[EpisodeReport]:
    """Find the objects of a cell in the pictures of a data set, and write a copy with them.

    Their poses are put into ``observation.environment_state``, named as in ``cup.x`` ...
    ``cup.qz``; ``tracking.seen`` says where they were measured, ``tracking.known`` where they were
    measured or inferred, ``tracking.residual`` how well [pixels]. The joint offsets of the cell
    are declared beside the units of the joints. The cell is copied to ``meta/cell.json``, and
    ``report.html`` shows what was found.

    Parameters
    ----------
    path : str or Path
        A LeRobot data set (v3.0) with videos or images: its folder.
    out : str or Path
        The folder of the copy; it must not exist.
    cell : str or Path
        The cell file.
    robot : Kinematics, optional
        What its links carry is known while it is covered. A camera on a link needs it.
    joint_names, units, calibration : optional
        As of :func:`tpgmm_datasets.load_lerobot`.
    progress : callable, optional
        Called with the number of rows that are done and of all.

    Returns
    -------
    list of EpisodeReport

    Raises
    ------
    DatasetError
        If the set is damaged, or an object cannot be followed in some episodes; all are named.
        There is no copy then.
    DataError
        If the cell is of another robot, or has no objects.
    """
    folder, text = local_folder(path), read_whole(cell).decode("utf-8")
    layout, found = open_to_copy(folder, Path(out)), read_cell(cell)
    if SEEN in layout.features:
        raise DatasetError(
            f"{path} was tracked already: track the set that it was made from", column=SEEN
        )
    if found.objects:
        with_frames(layout.features.get(ENVIRONMENT), list(found.objects))
    tracker = _Tracker(layout, found, robot)
    offsets = _declared_offsets(layout, found, joint_names, robot)
    recording = open_recording(
        folder, robot=robot, frames={}, joint_names=joint_names, units=units,
        calibration=calibration,
    )  # fmt: skip
    assembly, reports, problems = recording.assembly, list[EpisodeReport](), list[DatasetError]()
    total, done = sum(one.length for one in layout.episodes), 0
    for rows in read_episodes(layout, recording.episodes, assembly.features, Relaxed(())):
        count = partial(progress or _silent, total=total)
        try:
            shown = assembly.demonstration(rows)
            reports.append(tracker.track(rows, shown, lambda row, n=done: count(n + row)))
        except DataError as error:
            known = isinstance(error, DatasetError)
            problems.append(error if known else DatasetError(str(error), episode=rows.episode.index))
        done += len(rows.time)
        count(done)
    if problems:
        raise _untracked(problems, path)
    columns = {
        SEEN: lambda report, name: report.tracks[name].seen,
        KNOWN: lambda report, name: report.tracks[name].known,
        RESIDUAL: lambda report, name: report.residuals[name].astype(np.float32),
    }
    objects = list(reports[0].tracks)
    add_frames(
        folder,
        out,
        {name: {one.index: _frame(one.tracks[name]) for one in reports} for name in objects},
        columns={
            key: Column(
                objects,
                {one.index: np.stack([get(one, n) for n in objects], 1) for one in reports},
            )
            for key, get in columns.items()
        },
        offsets=offsets,
        files={CELL: text, "report.html": report_page(f"{path}, tracked", reports)},
    )
    return reports


def _silent(done: int, total: int) -> None:
    """No progress."""


def _untracked(problems: Sequence[DatasetError], path: str | Path) -> DatasetError:
    """One error for all episodes."""
    episodes = sorted({one.episode for one in problems if one.episode is not None})
    return DatasetError(
        f"objects cannot be followed in episodes {listed(map(str, episodes))}: "
        f"{'; '.join(summed_up(problems))}. Nothing is written. Record these again, or leave them out: lerobot-edit-dataset "
        f"--repo_id {Path(path).name} --root {path} --new_root ... --operation.type "
        f"delete_episodes --operation.episode_indices '{episodes}'"
    )


def _frame(track: Track) -> Frame:
    values = torch.from_numpy(pose_vector(track.poses))
    return Frame(values[:, :3], values[:, 3:])


def _declared_offsets(
    layout: Layout, cell: Cell, joint_names: Names | None, robot: Kinematics | None
) -> dict[str, list[float]]:
    """The joint offsets of a cell for each value of states and actions."""
    if not any(cell.joint_offsets.values()):
        return {}
    declared = {}
    for key in dict.fromkeys((joint_feature(layout), *({ACTION} & layout.features.keys()))):
        names = names_of(layout.feature(key), joint_names, robot) or ()
        matched = match_names(list(cell.joint_offsets), names, key)
        declared[key] = [cell.joint_offsets.get(matched.get(name, ""), 0.0) for name in names]
    return declared


class _Tracker:
    """Follows the objects of a cell through episodes."""

    def __init__(self, layout: Layout, cell: Cell, robot: Kinematics | None) -> None:
        strange = {*cell.joints} - {*(cell.joints if robot is None else robot.joint_names)}
        if strange:
            raise DataError(
                f"the cell was calibrated with a robot that has joints {sorted(strange)}, this "
                f"one has {list(robot.joint_names) if robot else []}: it is the cell of another"
            )
        self.cell, self.robot = cell, robot
        self.cameras = cell.placed()
        self.pictures = EpisodePictures(layout, [one.key for one in self.cameras.values()])
        self.source = pose_source(cell, robot)

    def track(
        self, rows: EpisodeRows, shown: Demonstration, progress: Callable[[int], None]
    ) -> EpisodeReport:
        """Track one episode, looking both ways in time."""
        links = self._links(shown)
        found = self._observed(rows, shown, progress)
        tracks = {}
        for name, (poses, seen, _) in found.items():
            try:
                tracks[name] = smoothed(rows.time, poses, seen, links)
            except DataError as error:
                raise DataError(f"object {name!r}: {error}") from error
        residuals = {name: one[2] for name, one in found.items()}
        report = EpisodeReport(rows.episode.index, rows.time, tracks, residuals)
        self._illustrate(report, rows, links)
        return report

    def _links(self, shown: Demonstration) -> dict[str, Array]:
        """Poses (T, 4, 4) of the robot's links, of its joints as they are."""
        robot = self.robot
        if robot is None or not getattr(robot, "orientation", True):  # tracked points have none
            return {}
        shifts = [self.cell.joint_offsets.get(name, 0.0) for name in robot.joint_names]
        state = robot.state(shown.joints + torch.tensor(shifts, dtype=shown.joints.dtype))
        poses = {link: (state.position(link), state.orientation(link)) for link in robot.links}
        return {link: pose_matrix(torch.cat(pose, -1).numpy()) for link, pose in poses.items()}

    def _observed(
        self, rows: EpisodeRows, shown: Demonstration, progress: Callable[[int], None]
    ) -> dict[str, tuple[Array, Flags, Array]]:
        """By object, in each row: its pose, whether it was seen, and the residual [pixels]."""
        count, names = len(rows.time), shown.joint_names or ()
        found: dict[str, tuple[Array, Flags, Array]] = {}
        self.source.reset()
        pictures = self.pictures.read(rows.episode, rows.time)
        for row, (images, joints) in enumerate(zip(pictures, shown.joints.tolist(), strict=True)):
            for name, one in self.cameras.items() if row == 0 else ():
                one.camera.check(images[one.key], name)
            measured = dict(zip(names, joints, strict=False))
            seen = self.source.poses(images, measured, float(rows.time[row]))
            if self.source.problem:
                raise DataError(f"at {rows.time[row]:.2f} s: {self.source.problem}")
            for name, one in seen.items():
                new = np.tile(np.eye(4), (count, 1, 1)), np.zeros(count, bool), np.zeros(count)
                poses, valid, residuals = found.setdefault(name, new)
                if one.valid:
                    poses[row], valid[row] = pose_matrix(one.pose), True
                    residuals[row] = np.nan_to_num(one.residual)
            progress(row)
        return found

    def _illustrate(
        self, report: EpisodeReport, rows: EpisodeRows, links: Mapping[str, Array]
    ) -> None:
        """Draw the pictures that fit worst."""
        wanted = rows_to_show(report)
        for row, images in enumerate(self.pictures.read(rows.episode, rows.time)):
            if row not in wanted:
                continue
            for name, one in self.cameras.items():
                camera_from_base = _camera_from_base(one, links, row)
                expected = {}
                for key, thing in self.cell.objects.items():
                    pose = report.tracks[key].poses[row] @ inverse(thing.pose)
                    for number, corners in thing.target.corners.items():
                        expected[number] = transformed(camera_from_base @ pose, corners)
