"""Poses of the objects of a cell from the tags on them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_vision.cell import Cell, CellCamera, camera_poses, check_robot
from tpgmm_vision.detection.estimation import PoseEstimate, View, estimate_pose
from tpgmm_vision.detection.tags import Box, Detections, TagDetector
from tpgmm_vision.detection.tracker import Tracker
from tpgmm_vision.poses import Array, Picture, angle_between, inverse, pose_vector, transform
from tpgmm_vision.sources import ObservedPose
from tpgmm_vision.targets import Target

if TYPE_CHECKING:
    from tpgmm_torch.robots.kinematics import Kinematics


#: A camera was moved if a check is seen this far from where it is [m], so many times in a row.
MOVED, CONFIRMED = 0.005, 3
#: Around a target's last place its tags are looked for this far, in sizes of it in the picture.
REACH = 0.6
#: How much pictures are magnified before tags are looked for.
MAGNIFY = 2


class TagSource:
    """Finds the objects of a cell by their tags: a :class:`~tpgmm_vision.sources.PoseSource`.

    Parameters
    ----------
    cell : Cell
        All its cameras have poses.
    robot : Kinematics, optional
        Needed where a camera is on a link.

    Attributes
    ----------
    problem : str
        Says which camera was moved, by how far; empty if none was.
    estimates : dict of str to PoseEstimate
        Of the objects that the last pictures show.
    detections : dict of str to dict of str to Detections
        Tags in the last pictures, by camera and family.

    Raises
    ------
    DataError
        If the cell is not calibrated, has no objects, or its cameras are on links of a robot
        that is not given or has other joints.
    """

    def __init__(self, cell: Cell, robot: Kinematics | None = None) -> None:
        self._cameras = cell.require_placed_cameras()
        if not cell.objects:
            raise DataError('the cell has no objects: add them to its file under "objects"')
        check_robot(cell, robot)
        self._cell, self._robot = cell, robot
        # in the frame of the object, so that its axis and its height are those of the pose
        self._targets = {
            name: Target(
                {n: transform(inverse(one.pose), c) for n, c in one.target.corners.items()},
                one.target.family,
            )
            for name, one in cell.objects.items()
        }
        tagged: list[Any] = [*cell.objects.values(), *cell.checks.values()]
        families = {one.target.family for one in tagged}
        self._detectors = {family: TagDetector(family, MAGNIFY) for family in families}
        self.reset()

    def reset(self) -> None:
        """Forget what was seen: another episode begins."""
        self.problem = ""
        self.estimates: dict[str, PoseEstimate] = {}
        self.detections: dict[str, dict[str, Detections]] = {}
        self._trackers = {name: Tracker() for name in self._targets}
        self._boxes: dict[str, list[Box] | None] = {}
        self._moved = dict.fromkeys(self._cameras, 0)
        self._problems: dict[str, str] = {}

    def poses(
        self, images: Mapping[str, Picture], joints: Mapping[str, float], time: float
    ) -> dict[str, ObservedPose]:
        """Find the poses of all objects now.

        Parameters
        ----------
        images : mapping of str to ndarray of shape (height, width, 3)
            RGB pictures by the key of the camera, of all cameras of the cell.
        joints : mapping of str to float
            Measured, by the names of the robot's description [rad].
        time : float
            When they were taken [s].

        Raises
        ------
        DataError, UnknownNameError
            If a picture or a joint is missing, or of another size.
        """
        places = camera_poses(self._cell, self._robot, joints)
        for name, one in self._cameras.items():
            if one.key not in images:
                raise UnknownNameError("picture", one.key, "the observation", images)
            one.camera.check(images[one.key], name)
            self.detections[name] = self._detect_tags(name, images[one.key])
        self._check(places)
        found = {name: self._object(name, places, time) for name in self._targets}
        cameras = self._cameras.items()
        self._boxes = {name: self._around(one, places[name]) for name, one in cameras}
        return found

    def _detect_tags(self, name: str, picture: Picture) -> dict[str, Detections]:
        """Tags in a picture: near where they were, or everywhere if that is not all."""
        before, boxes = self.detections.get(name, {}), self._boxes.get(name)
        found = {f: detect(picture, boxes) for f, detect in self._detectors.items()}
        whole = all(found[f].corners.keys() >= one.corners.keys() for f, one in before.items())
        if boxes is None or whole:
            return found
        return {f: detect(picture) for f, detect in self._detectors.items()}

    def _views(self, target: Target, places: Mapping[str, Array]) -> list[View]:
        """Views of a target by all cameras that are where they were."""
        still = [name for name in self._cameras if not self._moved[name]]
        return [self._view(name, target.family, places[name]) for name in still]

    def _view(self, name: str, family: str, place: Array) -> View:
        """View of the tags of a family by a camera that is in some place."""
        seen = self.detections[name][family]
        return View(self._cameras[name].camera, place, seen.corners, seen.covariances)

    def _object(self, name: str, places: Mapping[str, Array], time: float) -> ObservedPose:
        """Measure one object."""
        target, known = self._targets[name], self._cell.objects[name]
        seen = set().union(*(one[target.family].twice for one in self.detections.values()))
        twice = sorted(seen & target.corners.keys())
        reason = f"tag {twice[0]} is seen twice" if twice else "no tag of it is seen"
        views = [] if twice else self._views(target, places)
        found = estimate_pose(views, target, upright=known.upright, height=known.height)
        self.estimates.pop(name, None)
        if found is not None:
            self.estimates[name] = found
        track = self._trackers[name].update(found, time, reason)
        if track is None:
            why = reason if found is None else found.reason
            return ObservedPose(np.full(7, np.nan), np.full((6, 6), np.nan), False, why)
        valid, why = track.valid and not self.problem, self.problem or track.reason
        return ObservedPose(pose_vector(track.pose), track.covariance, valid, why)

    def _check(self, places: Mapping[str, Array]) -> None:
        """Look whether tags that stand still are where they were."""
        for name, one in self._cameras.items():
            if (error := self._check_error(name, one, places[name])) is None:
                continue
            self._moved[name] = self._moved[name] + 1 if error > MOVED else 0
            if not self._moved[name]:
                self._problems.pop(name, None)
            elif self._moved[name] >= CONFIRMED and name not in self._problems:
                self._problems[name] = self._said(name, places[name])
        self.problem = "; ".join(self._problems.values())

    def _check_error(self, name: str, one: CellCamera, place: Array) -> float | None:
        """Measure how far off checks are seen, across the line of sight [m]."""
        errors = []
        for known in self._cell.checks.values():
            seen = self.detections[name][known.target.family].corners
            for number in seen.keys() & known.target.corners.keys():
                points = transform(inverse(place) @ known.pose, known.target.corners[number])
                away = np.linalg.norm(one.camera.project(points) - seen[number], axis=1)
                depth = float(points[:, 2].mean())
                errors.append(float(np.median(away)) * depth / min(one.camera.focal_length))
        return max(errors, default=None)

    def _said(self, name: str, place: Array) -> str:
        """Message about a camera that was moved, as far as it is seen now."""
        by = ""
        for known in self._cell.checks.values():
            view = self._view(name, known.target.family, np.eye(4))
            if found := estimate_pose([view], known.target):
                now = known.pose @ inverse(found.pose)
                far, turn = np.linalg.norm(now[:3, 3] - place[:3, 3]), angle_between(now, place)
                by = f" by {1e3 * far:.0f} mm and {np.degrees(turn):.1f} deg"
        return (
            f"camera {name!r} was moved{by}, or a tag of the checks {list(self._cell.checks)} "
            "was; put it back, or run tpgmm calibrate cell again"
        )

    def _around(self, one: CellCamera, place: Array) -> list[Box] | None:
        """Choose where to look for tags; everywhere (None) unless all objects are seen."""
        seen = [name for name, found in self.estimates.items() if found.valid]
        if len(seen) < len(self._targets):
            return None
        boxes, camera_from_base = [], inverse(place)
        found = [(self._targets[n], e.pose) for n, e in self.estimates.items()]
        found += [(check.target, check.pose) for check in self._cell.checks.values()]
        for target, pose in found:
            corners = np.concatenate(list(target.corners.values()))
            points = transform(camera_from_base @ pose, corners)
            if (points[:, 2] < 0.01).any():
                continue
            pixels = one.camera.project(points)
            low, high = pixels.min(0), pixels.max(0)
            reach = REACH * float((high - low).max()) + 8
            edges = np.round((*(low - reach), *(high + reach)))
            boxes.append(tuple(edges.astype(int).tolist()))
        return boxes
