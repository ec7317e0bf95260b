"""Objects as the cameras of a batch of robots see them, from the start of an episode on."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tpgmm_torch.exceptions import DataError
from tpgmm_vision.cell import Cell, check_robot
from tpgmm_vision.poses import Array, mean_pose, pose_matrix, pose_vector
from tpgmm_vision.sources import ObservedPose, pose_source

#: An object's first pose is the mean of this number of poses, out of so many last pictures:
#: three outvote one that is wrong, and three of ten come where most pictures are lost.
FIRST, RECENT = 3, 10
#: How long objects are looked for before an episode begins [s]: a hand may be in the way.
SEARCH_TIME = 5.0
#: An object that is not seen for so long is worth a message [s].
UNSEEN_TIME = 0.5


class Watch:
    """Where objects are, for each robot of a batch, and for how long they are not seen.

    Parameters
    ----------
    cell : Cell
    robot : Kinematics
        Whose joints are given; where a camera is on a link, it has that link.
    names : sequence of str
        The objects that are needed.

    Attributes
    ----------
    sources : list of PoseSource
        Of the robots.
    problems : list of str
        Why nothing can be trusted that the cameras of a robot see; empty where it can.

    Raises
    ------
    DataError
        If the cell has no such object, is that of another robot, or a camera has no pose.
    """

    def __init__(self, cell: Cell, robot: Any, names: Sequence[str]) -> None:
        if missing := [name for name in names if name not in cell.objects]:
            raise DataError(
                f"the cell has the objects {list(cell.objects)}, not {missing}: add them to "
                "its file, or take poses that are observed otherwise (--policy.cell=none)"
            )
        check_robot(cell, robot)
        cell.require_placed_cameras()
        self.cell, self.names = cell, tuple(names)
        self._robot, self.sources = robot, [pose_source(cell, robot)]
        self.reset()

    def reset(self) -> None:
        """Another episode begins."""
        for source in self.sources:
            source.reset()
        self.problems: list[str] = []
        self._seen: list[dict[str, ObservedPose]] = []
        self._times: Array = np.zeros(1)
        self._real = math.nan
        self._unseen: Array = np.zeros((1, len(self.names)))
        self._recent: deque[Array] = deque(maxlen=RECENT)

    def look(
        self,
        images: Mapping[str, Any],
        joints: Array,
        passed: float | None = None,
        times: Array | None = None,
    ) -> None:
        """Find the objects in the next pictures.

        Parameters
        ----------
        images : mapping of str to ndarray of shape (B, 3, height, width)
            RGB by the key of the camera, as LeRobot gives them: floats from 0 to 1, or uint8.
            Others are not looked at.
        joints : ndarray of shape (B, n_joints)
            By the robot's description [rad].
        passed : float, optional
            Since the last look [s]; by default what a clock says.
        times : ndarray of shape (B,), optional
            When the pictures were taken [s], if that is known.

        Raises
        ------
        DataError
            If a picture is missing, or not what its camera was calibrated for.
        """
        pictures = {one.key: self._pictures(n, images) for n, one in self.cell.cameras.items()}
        real, rows, before = time.monotonic(), range(len(joints)), self._times
        if passed is None:
            passed = float(np.nan_to_num(real - self._real))
        now = np.broadcast_to(before + passed if times is None else times, len(rows))
        elapsed = (now - before if self._seen else np.zeros(len(rows))).clip(0)
        self._real, self._times, self._seen, self.problems = real, now, [], []
        poses = np.full((len(rows), len(self.names), 7), np.nan)
        for row in rows:
            here = {key: stack[row] for key, stack in pictures.items()}
            poses[row] = self._look_for_robot(row, here, joints[row], float(now[row]))
        poses[~np.isfinite(poses).all(-1)] = np.nan
        self._unseen = np.isnan(poses[..., 0]) * (self._unseen + elapsed[:, None])
        self._recent.append(poses)

    def _look_for_robot(
        self, row: int, pictures: Mapping[str, NDArray[np.uint8]], joints: Array, now: float
    ) -> Array:
        """Find the poses (n_names, 7) of objects for a robot, NaN where they are not seen."""
        if row == len(self.sources):
            self.sources.append(pose_source(self.cell, self._robot))
        source, poses = self.sources[row], np.full((len(self.names), 7), np.nan)
        known = dict(zip(self._robot.joint_names, joints.tolist(), strict=True))
        self._seen.append(source.poses(pictures, known, now))
        self.problems.append(getattr(source, "problem", ""))
        for k, name in enumerate(self.names):
            observed = self._seen[row].get(name)
            if observed is not None and observed.valid and not self.problems[row]:
                poses[k] = observed.pose
        return poses

    def _pictures(self, name: str, images: Mapping[str, Any]) -> NDArray[np.uint8]:
        """Pictures (B, height, width, 3) of a camera."""
        camera = self.cell.cameras[name]
        if camera.key not in images:
            raise DataError(
                f"camera {name!r} of the cell takes the pictures {camera.key!r}, there are "
                f"{sorted(images)}: let the robot or the environment have it, say in the cell "
                "which it is, or take poses that are observed otherwise (--policy.cell=none)"
            )
        stack = np.asarray(images[camera.key])
        if stack.ndim != 4 or stack.shape[1] != 3:
            raise DataError(f"{camera.key} has shape (B, 3, height, width), got {stack.shape}")
        if stack.dtype != np.uint8:
            if not (stack.min() >= 0 and stack.max() <= 1):
                raise DataError(f"{camera.key} has values from 0 to 1, or uint8; got others")
            stack = (255 * stack + 0.5).astype(np.uint8)
        stack = np.ascontiguousarray(stack.transpose(0, 2, 3, 1))
        camera.camera.check(stack[0], name)
        return stack

    def poses(self) -> dict[str, Array]:
        """Return the poses of the objects now (B, 7), NaN where they are not seen."""
        return {name: self._recent[-1][:, k] for k, name in enumerate(self.names)}

    def first(self) -> dict[str, Array]:
        """Return the poses at the start (B, 7), NaN where not seen often yet.

        Raises
        ------
        DataError
            If one is not seen for too long.
        """
        if not any(self.problems) and self._unseen.max(initial=0.0) > SEARCH_TIME:
            raise DataError(
                f"{'; '.join(self.missing())}, for {SEARCH_TIME:g} s before the start: bring "
                f"it into view of {list(self.cell.cameras)}"
            )
        rows, called = range(len(self._seen)), enumerate(self.names)
        return {name: np.stack([self._mean(row, k) for row in rows]) for k, name in called}

    def _mean(self, row: int, k: int) -> Array:
        """Average the last poses (7,) of an object, where they are enough."""
        recent = [one[row, k] for one in self._recent if np.isfinite(one[row, k, 0])]
        if len(recent) < FIRST:
            return np.full(7, np.nan)
        return pose_vector(mean_pose(pose_matrix(recent))[0])

    def missing(self) -> list[str]:
        """Reasons why an episode cannot begin, in words."""
        return list(self.ages()) or [
            f"robot {row} does not see {self._why(row, name)}"
            for row in range(len(self._seen))
            for k, name in enumerate(self.names)
            if np.isnan(self._mean(row, k)[0])
        ]

    def ages(self) -> dict[str, Any]:
        """Infinite where a problem keeps robots from moving, by problem [s].

        Of shape (B,), of a single robot a number.
        """
        every = np.array(self.problems)
        return {
            text: np.where(every == text, np.inf, 0.0) if len(every) > 1 else np.inf
            for text in dict.fromkeys(self.problems)
            if text
        }

    def unseen(self, row: int) -> dict[str, str]:
        """Objects that a robot has not seen for a while: for how long, and why.

        A problem stands for all of them, without further words.
        """
        if problem := self.problems[row]:
            return {problem: ""}
        return {
            name: f"{self._why(row, name)} is not seen for {age:.2g} s"
            for name, age in zip(self.names, self._unseen[row], strict=True)
            if age >= UNSEEN_TIME
        }

    def _why(self, row: int, name: str) -> str:
        """Say which object is not seen, and why not."""
        seen = self._seen[row].get(name)
        reason = "its source does not know it" if seen is None else seen.reason
        return f"{name!r} ({reason})" if reason else repr(name)
