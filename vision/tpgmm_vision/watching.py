"""Objects as the cameras of a batch of robots see them, from the start of an episode on."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tpgmm_torch.exceptions import DataError
from tpgmm_vision.cell import Cell, check_robot
from tpgmm_vision.poses import Array, mean_pose, pose_matrix, pose_vector
from tpgmm_vision.sources import ObservedPose, pose_source

__all__ = ["Watch"]

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
        cell.placed()
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
        self._unseen: dict[tuple[int, str], float] = {}
        self._recent: dict[tuple[int, str], deque[Array | None]] = {}

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
        elapsed = now - before if self._seen else np.zeros(len(rows))
        self._real, self._times, self._seen = real, now, []
        while len(self.sources) < len(rows):
            self.sources.append(pose_source(self.cell, self._robot))
        for row in rows:
            known = dict(zip(self._robot.joint_names, joints[row].tolist(), strict=True))
            here = {key: stack[row] for key, stack in pictures.items()}
            self._seen.append(self.sources[row].poses(here, known, float(now[row])))
        self.problems = [getattr(self.sources[row], "problem", "") for row in rows]
        for row, name in product(rows, self.names):
            pose, at = self._pose(row, name), (row, name)
            recent = self._recent.setdefault(at, deque(maxlen=RECENT))
            recent.append(None if pose is None else pose_matrix(pose))
            self._unseen[at] = self._unseen.get(at, 0.0) + max(float(elapsed[row]), 0.0)
            if pose is not None:
                self._unseen[at] = 0.0

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

    def _pose(self, row: int, name: str) -> Array | None:
        """The pose (7,) of an object that is seen now; None if it is not."""
        seen = self._seen[row].get(name)
        if seen is None or self.problems[row] or not seen.valid:
            return None
        return seen.pose if np.isfinite(seen.pose).all() else None

    def poses(self) -> dict[str, Array]:
        """Where the objects are seen now (B, 7), NaN where they are not."""
        return self._stacked(self._pose)

    def first(self) -> dict[str, Array]:
        """Where the objects are at the start (B, 7), NaN where they were not seen often yet.

        Raises
        ------
        DataError
            If one is not seen for too long.
        """
        if not any(self.problems) and max(self._unseen.values(), default=0.0) > SEARCH_TIME:
            raise DataError(
                f"{'; '.join(self.missing())}, for {SEARCH_TIME:g} s before the start: bring "
                f"it into view of {list(self.cell.cameras)}"
            )
        return self._stacked(self._mean)

    def _mean(self, row: int, name: str) -> Array | None:
        """The mean of the last poses, where they are enough."""
        recent = [one for one in self._recent[row, name] if one is not None]
        return pose_vector(mean_pose(recent)[0]) if len(recent) >= FIRST else None

    def _stacked(self, pose: Callable[[int, str], Array | None]) -> dict[str, Array]:
        """Poses (B, 7) of the objects."""
        lost = np.full(7, np.nan)
        found = {
            name: [pose(row, name) for row in range(len(self._seen))] for name in self.names
        }
        return {
            name: np.array([lost if one is None else one for one in poses])
            for name, poses in found.items()
        }

    def missing(self) -> list[str]:
        """What an episode cannot begin for, in words."""
        return list(self.ages()) or [
            f"robot {row} does not see {self._why(row, name)}"
            for row, name in self._recent
            if self._mean(row, name) is None
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
        ages = {name: self._unseen.get((row, name), 0.0) for name in self.names}
        return {
            name: f"{self._why(row, name)} is not seen for {age:.2g} s"
            for name, age in ages.items()
            if age >= UNSEEN_TIME
        }

    def _why(self, row: int, name: str) -> str:
        """An object that is not seen, and why not."""
        seen = self._seen[row].get(name)
        reason = "its source does not know it" if seen is None else seen.reason
        return f"{name!r} ({reason})" if reason else repr(name)
