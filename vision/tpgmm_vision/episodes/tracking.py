"""Track the objects of a recorded LeRobot data set in its own pictures, and write a copy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from tpgmm_datasets.conversion.joints import Names, joint_feature, names_of
from tpgmm_datasets.errors import DatasetError, summed_up
from tpgmm_datasets.lerobot.columns import ACTION, ENVIRONMENT, with_frames
from tpgmm_datasets.lerobot.episodes import EpisodeRows, Relaxed, read_episodes
from tpgmm_datasets.lerobot.hub import local_folder
from tpgmm_datasets.lerobot.layout import Layout
from tpgmm_datasets.names import match_names
from tpgmm_datasets.reader import open_recording
from tpgmm_datasets.units import Units
from tpgmm_datasets.writer import Column, add_frames, open_to_copy
from tpgmm_torch.atomic import read_whole
from tpgmm_torch.checks.report import listed
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_vision.cell import Cell, read_cell
from tpgmm_vision.detection.tag_source import camera_poses
from tpgmm_vision.detection.tags import TagDetector
from tpgmm_vision.episodes.report import EpisodeReport, drawn, report_page
from tpgmm_vision.episodes.smoothing import Track, smoothed
from tpgmm_vision.episodes.video import EpisodePictures, Picture
from tpgmm_vision.poses import Array, inverse, pose_matrix, pose_vector, transformed
from tpgmm_vision.sources import ObservedPose, pose_source

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
    ``cup.qz``; ``tracking.seen`` says where they were measured, ``tracking.known`` where they
    were measured or inferred, ``tracking.residual`` how well [pixels]. The joint offsets of the
    cell are declared beside the units of the joints. The cell is copied to ``meta/cell.json``,
    and ``report.html`` shows what was found.

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
    assembly, reports, problems = (
        recording.assembly,
        list[EpisodeReport](),
        list[DatasetError](),
    )
    total, done = sum(one.length for one in layout.episodes), 0
    for rows in read_episodes(layout, recording.episodes, assembly.features, Relaxed(())):
        before = done

        def advance(row: int, before: int = done) -> None:
            if progress is not None:
                progress(before + row, total)

        try:
            reports.append(tracker.track(rows, assembly.demonstration(rows), advance))
        except DatasetError as error:
            problems.append(error)
        except DataError as error:
            problems.append(DatasetError(str(error), episode=rows.episode.index))
        done += len(rows.time)
        advance(len(rows.time), before)
    if problems:
        raise _untracked(problems, path)
    objects = list(reports[0].tracks)
    frames = {
        name: {one.index: _frame(one.tracks[name]) for one in reports} for name in objects
    }
    add_frames(
        folder, out, frames, columns=_columns(reports, objects), offsets=offsets,
        files={CELL: text, "report.html": report_page(f"{path}, tracked", reports)},
    )  # fmt: skip
    return reports


def _columns(reports: Sequence[EpisodeReport], objects: Sequence[str]) -> dict[str, Column]:
    """What is stored beside the poses."""
    values: dict[str, dict[int, Any]] = {SEEN: {}, KNOWN: {}, RESIDUAL: {}}
    for one in reports:
        tracks = [one.tracks[name] for name in objects]
        residuals = [one.residuals[name] for name in objects]
        values[SEEN][one.index] = np.stack([track.seen for track in tracks], 1)
        values[KNOWN][one.index] = np.stack([track.known for track in tracks], 1)
        values[RESIDUAL][one.index] = np.stack(residuals, 1).astype(np.float32)
    return {key: Column(objects, by_episode) for key, by_episode in values.items()}


def _untracked(problems: Sequence[DatasetError], path: str | Path) -> DatasetError:
    """One error for all episodes."""
    episodes = sorted({one.episode for one in problems if one.episode is not None})
    return DatasetError(
        f"objects cannot be followed in episodes {listed([*map(str, episodes)])}: "
        f"{'; '.join(summed_up(problems))}. Nothing was written. Record these episodes again, "
        f"or leave them out: lerobot-edit-dataset --repo_id {Path(path).name} --root {path} "
        "--new_root NEW --operation.type delete_episodes --operation.episode_indices "
        f"'{episodes}'"
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


def _repeated(now: ObservedPose, last: ObservedPose | None) -> bool:
    """Whether a source repeats for a moment what it measured before, and is less certain."""
    if last is None or not np.array_equal(now.pose, last.pose):
        return False
    return bool(np.trace(now.covariance) > np.trace(last.covariance))


class _Tracker:
    """Follows the objects of a cell through episodes."""

    def __init__(self, layout: Layout, cell: Cell, robot: Kinematics | None) -> None:
        self.cell, self.robot = cell, robot
        self.cameras = cell.placed()
        self.pictures = EpisodePictures(layout, [one.key for one in self.cameras.values()])
        self.source = pose_source(cell, robot)
        families = {one.target.family for one in cell.objects.values()}
        self.detectors = [TagDetector(family) for family in families]

    def track(
        self, rows: EpisodeRows, shown: Demonstration, progress: Callable[[int], None]
    ) -> EpisodeReport:
        """Track one episode, looking both ways in time."""
        joints = self._joints(shown)
        report = EpisodeReport(rows.episode.index, rows.time)
        measured = self._measured(rows, joints, report, progress)
        links = self._links(joints)
        for name, (poses, seen) in measured.items():
            try:
                report.tracks[name] = smoothed(rows.time, poses, seen, links)
            except DataError as error:
                because = "" if seen.any() else f": {report.reasons[name][-1]}"
                raise DataError(f"object {name!r}: {error}{because}") from error
        wanted = report.rows_to_show()
        pictures = self.pictures.read(rows.episode, rows.time)
        for row, images in enumerate(islice(pictures, max(wanted, default=-1) + 1)):
            if row in wanted:
                self._draw(report, row, images, joints[row], wanted[row])
        return report

    def _joints(self, shown: Demonstration) -> list[dict[str, float]]:
        """Joints of the robot's description in each row, by name."""
        names = shown.joint_names or ()
        shifts = torch.tensor([self.cell.joint_offsets.get(name, 0.0) for name in names])
        values = shown.joints + shifts if names else shown.joints
        return [dict(zip(names, row, strict=False)) for row in values.tolist()]

    def _links(self, joints: Sequence[Mapping[str, float]]) -> dict[str, Array]:
        """Poses (T, 4, 4) of the robot's links."""
        robot = self.robot
        if robot is None or not getattr(robot, "orientation", True):  # tracked points have none
            return {}
        values = [[row[name] for name in robot.joint_names] for row in joints]
        state = robot.state(torch.tensor(values).to(robot.lower))
        poses = {link: (state.position(link), state.orientation(link)) for link in robot.links}
        return {
            link: pose_matrix(torch.cat(pose, -1).double().numpy())
            for link, pose in poses.items()
        }

    def _measured(
        self,
        rows: EpisodeRows,
        joints: Sequence[Mapping[str, float]],
        report: EpisodeReport,
        progress: Callable[[int], None],
    ) -> dict[str, tuple[Array, Any]]:
        """By object its poses (T, 4, 4), and whether it was seen in each row (T,)."""
        count, found = len(rows.time), dict[str, tuple[Array, Any]]()
        last = dict[str, ObservedPose]()
        self.source.reset()
        for row, images in enumerate(self.pictures.read(rows.episode, rows.time)):
            poses = self.source.poses(images, joints[row], float(rows.time[row]))
            if self.source.problem:
                raise DataError(f"at {rows.time[row]:.2f} s {self.source.problem}")
            estimates = getattr(self.source, "estimates", {})
            for name, one in poses.items():
                if name not in found:
                    found[name] = np.tile(np.eye(4), (count, 1, 1)), np.zeros(count, bool)
                    report.residuals[name] = np.zeros(count)
                report.reasons.setdefault(name, []).append(one.reason)
                if one.valid and not _repeated(one, last.get(name)):
                    found[name][0][row], found[name][1][row] = pose_matrix(one.pose), True
                    if name in estimates:
                        report.residuals[name][row] = estimates[name].residual
                    last[name] = one
            progress(row)
        return found

    def _draw(
        self,
        report: EpisodeReport,
        row: int,
        images: Mapping[str, Picture],
        joints: Mapping[str, float],
        caption: str,
    ) -> None:
        """Add the pictures of a row with the corners that are seen and that are expected."""
        places = camera_poses(self.cell, self.robot, joints)
        for name, one in self.cameras.items():
            seen = dict[int, Array]()
            for detector in self.detectors:
                seen |= detector(images[one.key]).corners
            expected = dict[int, Array]()
            for key, thing in self.cell.objects.items():
                pose = (
                    inverse(places[name]) @ report.tracks[key].poses[row] @ inverse(thing.pose)
                )
                for number, corners in thing.target.corners.items():
                    points = transformed(pose, corners)
                    pixels = one.camera.project(points)
                    # what looks away from the camera is not seen
                    if (
                        cv2.contourArea(pixels.astype(np.float32), True)
                        > 0
                        < points[:, 2].min()
                    ):
                        expected[number] = pixels
            said = f"row {row}, {report.time[row]:.2f} s, {name}: {caption}"
            picture = drawn(images[one.key], one.camera, seen, expected)
            report.pictures.append((said, picture))
