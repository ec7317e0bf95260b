"""Track the objects of a recorded LeRobot data set in its own pictures, and write a copy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from tpgmm_datasets.conversion.assembly import Assembly
from tpgmm_datasets.conversion.joints import joint_feature, names_of
from tpgmm_datasets.errors import DatasetError, list_problems
from tpgmm_datasets.lerobot import columns as kept
from tpgmm_datasets.lerobot.episodes import EpisodeRows, Relaxed, read_episodes
from tpgmm_datasets.lerobot.hub import local_folder
from tpgmm_datasets.lerobot.layout import Layout
from tpgmm_datasets.names import match_names
from tpgmm_datasets.reader import open_recording
from tpgmm_datasets.writer import Column, add_frames, open_to_copy
from tpgmm_torch.atomic import read_whole
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_vision.camera import Camera
from tpgmm_vision.cell import Cell, camera_poses, read_cell
from tpgmm_vision.episodes.report import EpisodeReport, drawn, report_page
from tpgmm_vision.episodes.smoothing import Track
from tpgmm_vision.episodes.video import EpisodePictures
from tpgmm_vision.poses import Array, inverse, pose_matrix, pose_vector, transform
from tpgmm_vision.sources import pose_source

__all__ = ["track_lerobot"]


def track_lerobot(
    path: str | Path,
    out: str | Path,
    cell: str | Path,
    robot: Kinematics | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
    **reading: Any,
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
    progress : callable, optional
        Called with the number of rows that are done and of all.
    **reading
        ``joint_names``, ``units`` and ``calibration`` of :func:`tpgmm_datasets.load_lerobot`.

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
    folder, content, known = local_folder(path), read_whole(cell).decode(), read_cell(cell)
    layout = open_to_copy(folder, Path(out))
    if kept.SEEN in layout.features:
        raise DatasetError(f"{path} was tracked: track the set that it was made from")
    kept.with_frames(layout.features.get(kept.ENVIRONMENT), list(known.objects))
    tracker = _Tracker(layout, known, robot, progress)
    assembly = open_recording(folder, robot=robot, frames={}, **reading).assembly
    offsets = _offsets(layout, known, robot, reading.get("joint_names"))
    reports = tracker.track_all(layout, assembly)
    names, files = list(reports[0].tracks), {"meta/cell.json": content}
    files["report.html"] = report_page(f"{path}, tracked", reports)
    frames: dict[str, dict[int, Frame]] = {name: {} for name in names}
    parts = {kept.SEEN: "seen", kept.KNOWN: "known", kept.RESIDUAL: "residuals"}
    columns = {key: Column(names, {}) for key in parts}
    for one in reports:
        for name in names:
            poses = pose_vector(one.tracks[name].poses)
            frames[name][one.index] = Frame(poses[:, :3], poses[:, 3:])
        for key, part in parts.items():
            values = [getattr(one.tracks[name], part) for name in names]
            columns[key].values[one.index] = np.stack(values, 1)
    add_frames(folder, out, frames, columns=columns, offsets=offsets, files=files)
    return reports


def _offsets(layout: Layout, cell: Cell, robot: Any, called: Any) -> dict[str, list[float]]:
    """Return the joint offsets of a cell for each value of states and actions."""
    declared, given = dict[str, list[float]](), cell.joint_offsets
    keys = {joint_feature(layout), kept.ACTION} & layout.features.keys()
    for key in keys if any(given.values()) else ():
        names = names_of(layout.feature(key), called, robot) or ()
        matched = match_names(list(given), names, key)
        declared[key] = [given.get(matched.get(name, ""), 0.0) for name in names]
    return declared


class _Tracker:
    """Follows the objects of a cell through episodes."""

    def __init__(self, layout: Layout, cell: Cell, robot: Any, progress: Any) -> None:
        self.cell, self.robot, self.source = cell, robot, pose_source(cell, robot)
        cameras = cell.require_placed_cameras().values()
        self.pictures = EpisodePictures(layout, [one.key for one in cameras])
        self.progress, self.done = progress or (lambda done, total: None), 0
        self.total = sum(episode.length for episode in layout.episodes)

    def track_all(self, layout: Layout, assembly: Assembly) -> list[EpisodeReport]:
        """Track all episodes, and refuse a set with episodes that cannot be tracked."""
        reports, problems = list[EpisodeReport](), list[DatasetError]()
        for rows in read_episodes(layout, layout.episodes, assembly.features, Relaxed(())):
            try:
                reports.append(self.track(rows, assembly.demonstration(rows)))
            except DatasetError as problem:
                problems.append(problem)
        if problems:
            folder = layout.root
            episodes = sorted({one.episode for one in problems if one.episode is not None})
            raise DatasetError(
                f"objects cannot be followed in episodes {episodes}: "
                f"{'; '.join(list_problems(problems))}. Nothing was written. Record them "
                f"again, or leave them out: lerobot-edit-dataset --repo_id {folder.name} "
                f"--root {folder} --new_root NEW --operation.type delete_episodes "
                f"--operation.episode_indices '{episodes}'"
            )
        return reports

    def track(self, rows: EpisodeRows, shown: Demonstration) -> EpisodeReport:
        """Track one episode, looking both ways in time."""
        names, report = shown.joint_names or (), EpisodeReport(rows.episode.index)
        shifts = torch.tensor([self.cell.joint_offsets.get(name, 0.0) for name in names])
        joints = shown.joints + shifts if names else shown.joints
        named = [dict(zip(names, row, strict=False)) for row in joints.tolist()]
        detected = self._measure(rows, named, report)
        hands = self._hands(joints)
        for name, track in report.tracks.items():
            try:
                track.smooth(hands)
            except DataError as error:
                message = f"object {name!r}: {error}"
                raise DatasetError(message, episode=report.index) from error
        wanted = report.rows_to_show()
        for row, images in self.pictures.read(rows.episode, rows.time, wanted):
            for name, place in camera_poses(self.cell, self.robot, named[row]).items():
                one = self.cell.cameras[name]
                expected = self._expect_corners(report, row, one.camera, place)
                said = f"row {row}, {rows.time[row]:.2f} s, {name}: {wanted[row]}"
                seen = detected[row].get(name, {})
                report.pictures.append((said, drawn(images[one.key], seen, expected)))
        return report

    def _measure(
        self, rows: EpisodeRows, joints: Sequence[Mapping[str, float]], report: EpisodeReport
    ) -> list[dict[str, dict[int, Array]]]:
        """Put what the source measures into tracks; corners that it saw, by row and camera."""
        corners = list[dict[str, dict[int, Array]]]()
        self.source.reset()
        for row, images in self.pictures.read(rows.episode, rows.time):
            now, source = float(rows.time[row]), self.source
            for name, one in source.poses(images, joints[row], now).items():
                track = report.tracks.setdefault(name, Track(rows.time))
                track.reasons[row] = one.reason
                if one.valid:
                    estimate = getattr(source, "estimates", {}).get(name)
                    track.poses[row], track.seen[row] = pose_matrix(one.pose), True
                    track.residuals[row] = getattr(estimate, "residual", 0)
            if source.problem:
                raise DatasetError(f"at {now:.2f} s {source.problem}", episode=report.index)
            corners.append({
                name: {number: c for one in found.values() for number, c in one.corners.items()}
                for name, found in getattr(source, "detections", {}).items()
            })  # fmt: skip
            self.done += 1
            self.progress(self.done, self.total)
        return corners

    def _hands(self, joints: torch.Tensor) -> dict[str, Array]:
        """Poses (T, 4, 4) of the robot's links."""
        robot = self.robot
        if robot is None or not getattr(robot, "orientation", True):  # tracked points have none
            return {}
        state = robot.state(joints.to(robot.lower))
        poses = torch.cat((state.positions, state.orientations), -1).double().numpy()
        return dict(zip(robot.links, pose_matrix(poses).swapaxes(0, 1), strict=True))

    def _expect_corners(
        self, report: EpisodeReport, row: int, camera: Camera, place: Array
    ) -> dict[int, Array]:
        """Predict the pixels of the tags that do not look away from a camera."""
        expected = dict[int, Array]()
        for name, thing in self.cell.objects.items():
            pose = inverse(place) @ report.tracks[name].poses[row] @ inverse(thing.pose)
            for number, corners in thing.target.corners.items():
                points = transform(pose, corners)
                pixels = camera.project(points)
                if cv2.contourArea(pixels.astype(np.float32), True) > 0 < points[:, 2].min():
                    expected[number] = pixels
        return expected
