"""Poses of frames at run time, found in the pictures of a cell's cameras."""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch.data.pose_names import is_gripper
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.persistence import decode, encode
from tpgmm_torch.robots import Kinematics, Robot
from tpgmm_vision.cell import Cell, cell_from, read_cell
from tpgmm_vision.poses import angle_between, mean_pose, pose_matrix, pose_vector
from tpgmm_vision.sources import ObservedPose, PoseSource, pose_source

__all__ = ["Eyes", "cell_of", "differences", "shifted"]

log = logging.getLogger(__name__)

#: An object's first pose is the mean of this number of poses out of so many last pictures:
#: three outvote one that is wrong, and three of ten come where most pictures are lost.
FIRST, RECENT = 3, 10
#: How long objects are looked for before an episode begins [s]: a hand may be in the way.
SEARCH_TIME = 5.0
#: An object that is not seen for so long is worth a line in the log [s].
UNSEEN_TIME = 0.5
#: Differences between cells that are not worth telling [m, rad].
SAME_PLACE, SAME_ANGLE = 5e-4, math.radians(0.05)


def cell_of(given: Mapping[str, Any] | str) -> Cell:
    """The cell of a file, or of its content."""
    return read_cell(given) if isinstance(given, str) else cell_from(given)


class Eyes:
    """What the cameras of a cell see, for each robot of a batch.

    Parameters
    ----------
    cell : Cell
    robot : Kinematics
        Of the policy.
    frame_names : sequence of str
        The frames that the policy reads. Those that are objects of the cell are found.

    Attributes
    ----------
    names : list of str
        The frames that are found.
    features : dict of str to PolicyFeature
        The pictures that are needed.

    Raises
    ------
    DataError
        If the cell is that of another robot, or a camera has no pose.
    """

    def __init__(self, cell: Cell, robot: Kinematics, frame_names: Sequence[str]) -> None:
        ours, theirs = (
            {name for name in names if not is_gripper(name)}
            for names in (robot.joint_names, cell.joints)
        )
        if not (ours <= theirs or theirs <= ours):
            raise DataError(
                f"the cell is that of a robot with the joints {list(cell.joints)}, the "
                f"policy's has {list(robot.joint_names)}: --policy.cell=... takes another cell"
            )
        self._cell, self._joint_names = cell, robot.joint_names
        self._robot = _with_links(robot, cell)
        self.names = [name for name in frame_names if name in cell.objects]
        self.features = {
            one.key: PolicyFeature(FeatureType.VISUAL, (3, one.camera.height, one.camera.width))
            for one in cell.placed().values()
        }
        self._sources: list[PoseSource] = []
        self.reset()

    def reset(self) -> None:
        """Another episode begins."""
        for source in self._sources:
            source.reset()
        self._real = math.nan
        self._times: Any = np.zeros(1)
        self._seen: list[dict[str, ObservedPose]] = []
        self._unseen: dict[tuple[int, str], float] = {}
        self._recent: dict[tuple[int, str], deque[Any]] = {}
        self._waiting: list[str] = []

    def look(
        self, batch: Mapping[str, Any], joints: Tensor, passed: float | None, stamps: Any = None
    ) -> None:
        """Find the objects in the pictures of an observation.

        Parameters
        ----------
        batch : mapping of str to Tensor
            Pictures (B, 3, height, width), uint8, or floats from 0 to 1.
        joints : Tensor of shape (B, n_joints)
            Of the robot's description [rad].
        passed : float or None
            Since the last look [s]; None for what a clock says.
        stamps : Tensor of shape (B, 1), optional
            When the pictures were taken [s].

        Raises
        ------
        DataError
            If a picture is missing, or not what its camera was calibrated for.
        """
        real, rows, measured = time.monotonic(), len(joints), joints.numpy(force=True)
        if passed is None:
            passed = 0.0 if math.isnan(self._real) else real - self._real
        before = np.broadcast_to(self._times, rows)
        self._times = before + passed if stamps is None else np.ravel(stamps.numpy(force=True))
        elapsed = self._times - before if self._seen else np.zeros(rows)
        self._real = real
        pictures = {
            one.key: self._pictures(batch, name, rows)
            for name, one in self._cell.cameras.items()
        }
        while len(self._sources) < rows:
            self._sources.append(pose_source(self._cell, self._robot))
        self._seen = []
        for row, source in enumerate(self._sources[:rows]):
            known = dict(zip(self._joint_names, measured[row].tolist(), strict=True))
            images = {key: stack[row] for key, stack in pictures.items()}
            found = source.poses(images, known, float(self._times[row]))
            self._seen.append({name: found[name] for name in self.names if name in found})
            for name in self.names:
                seen, at = self._pose(row, name), (row, name)
                recent = self._recent.setdefault(at, deque(maxlen=RECENT))
                recent.append(None if seen is None else pose_matrix(seen))
                self._unseen[at] = 0.0 if seen is not None else (
                    self._unseen.get(at, 0.0) + float(elapsed[row])
                )  # fmt: skip

    def _pictures(self, batch: Mapping[str, Any], name: str, rows: int) -> NDArray[np.uint8]:
        """Pictures (B, height, width, 3) of a camera."""
        camera = self._cell.cameras[name]
        stack = batch.get(camera.key)
        if stack is None:
            there = sorted(key for key in batch if "image" in key)
            raise DataError(
                f"the policy looks through camera {name!r}, {camera.key}, and the observation "
                f"has the pictures {there}: let the robot or the environment have this camera, "
                "say by --rename_map which one it is, or take poses that are observed "
                "otherwise, --policy.cell=none"
            )
        if stack.ndim != 4 or len(stack) != rows or stack.shape[1] != 3:
            raise DataError(
                f"{camera.key} has shape ({rows}, 3, height, width), got {tuple(stack.shape)}"
            )
        if stack.dtype != torch.uint8:
            if not bool((stack.amin() >= 0) & (stack.amax() <= 1)):
                raise DataError(f"{camera.key} holds values beyond 0 to 1, or NaN")
            stack = (255 * stack + 0.5).to(torch.uint8)
        pictures = np.ascontiguousarray(stack.numpy(force=True).transpose(0, 2, 3, 1))
        camera.camera.check(pictures[0], name)
        return pictures

    def _pose(self, row: int, name: str) -> Any:
        """The pose (7,) of an object that is seen now; None if it is not."""
        seen = self._seen[row].get(name)
        fine = seen is not None and seen.valid and np.isfinite(seen.pose).all()
        return seen.pose if fine and seen is not None and not self._problem(row) else None

    def _problem(self, row: int) -> str:
        """Why nothing that a robot's cameras see can be trusted."""
        return getattr(self._sources[row], "problem", "")

    def poses(self) -> dict[str, Tensor]:
        """Where the objects are seen now (B, 7), NaN where they are not."""
        lost, rows = np.full(7, np.nan), range(len(self._seen))
        every = {name: [self._pose(row, name) for row in rows] for name in self.names}
        return {
            name: torch.from_numpy(np.array([lost if one is None else one for one in seen]))
            for name, seen in every.items()
        }

    def first(self) -> dict[str, Tensor] | None:
        """Where the objects are at the beginning (B, 7); None while some are looked for.

        Raises
        ------
        DataError
            If one is not seen for too long.
        """
        seen = {
            at: [one for one in last if one is not None] for at, last in self._recent.items()
        }
        waits = [at for at, poses in seen.items() if len(poses) < FIRST]
        held = self.ages()
        if not (waits or held):
            return {
                name: torch.from_numpy(np.stack([
                    pose_vector(mean_pose(seen[row, name])[0]) for row in range(len(self._seen))
                ]))
                for name in self.names
            }  # fmt: skip
        reasons = [*held] or [
            f"robot {row} does not see {self._why(row, n)}" for row, n in waits
        ]
        if not held and max(self._unseen[at] for at in waits) > SEARCH_TIME:
            raise DataError(
                f"after {SEARCH_TIME:g} s {'; '.join(reasons)}: bring it into view of "
                f"{list(self._cell.cameras)}, or take poses that are observed otherwise, "
                "--policy.cell=none"
            )
        if (waiting := [*held] or [str(at) for at in waits]) != self._waiting:
            log.info("holding before the start: %s", "; ".join(reasons))
        self._waiting = waiting
        return None

    def _why(self, row: int, name: str) -> str:
        """An object that is not seen, and why not."""
        seen = self._seen[row].get(name)
        reason = "its source does not know it" if seen is None else seen.reason
        return f"{name!r} ({reason})" if reason else repr(name)

    def ages(self) -> dict[str, Any]:
        """Infinite ages, for a controller, by problems that keep robots from moving."""
        problems = [self._problem(row) for row in range(len(self._seen))]
        return {
            text: np.array([math.inf if one == text else 0.0 for one in problems])
            for text in dict.fromkeys(problems)
            if text
        }

    def unseen(self, row: int) -> dict[str, str]:
        """Objects that a robot has not seen for a while: since when, and why."""
        ages = {name: self._unseen.get((row, name), 0.0) for name in self.names}
        return {
            name: f"{self._why(row, name)} is not seen for {age:.2g} s"
            for name, age in ages.items()
            if age >= UNSEEN_TIME
        }


def _with_links(robot: Kinematics, cell: Cell) -> Kinematics:
    """The robot with the links that carry cameras."""
    if not (missing := [link for link in cell.links if link not in robot.links]):
        return robot
    if not isinstance(robot, Robot):
        raise DataError(
            f"cameras of the cell are on the links {missing}, and the policy knows no robot: "
            "learn it with one, --policy.robot=..."
        )
    found: Kinematics = decode(encode(robot) | {"links": [*robot.links, *missing]})
    return found


def differences(learned: Cell, now: Cell) -> list[str]:
    """What is another one in the cell than in that which a policy was learned with."""
    told = []
    for kind in ("cameras", "objects", "checks"):
        old, new = getattr(learned, kind), getattr(now, kind)
        told += [f"{kind} {list(a)} are {b}" for a, b in (
            (old.keys() - new, "missing"), (new.keys() - old, "new")) if a]  # fmt: skip
        for name in old.keys() & new:
            called = f"{kind.removesuffix('s')} {name!r}"
            before, after = old[name].pose, new[name].pose
            if before is not None and after is not None:
                moved = float(np.linalg.norm(before[:3, 3] - after[:3, 3]))
                turned = angle_between(before, after)
                if moved > SAME_PLACE or turned > SAME_ANGLE:
                    told.append(
                        f"{called} was moved by {1e3 * moved:.1f} mm and "
                        f"{math.degrees(turned):.2f} deg"
                    )
            one, other = learned.content[kind][name], now.content[kind][name]
            keys = sorted({*one, *other} - {"pose", "report"})
            if changed := [key for key in keys if one.get(key) != other.get(key)]:
                told.append(f"{called} has another {' and '.join(changed)}")
    shifts = shifted(learned, now).items()
    told += [f"joint {n!r} is offset by {math.degrees(x):+.2f} deg more" for n, x in shifts]
    return told


def shifted(learned: Cell, now: Cell) -> dict[str, float]:
    """By how much the offsets of joints are larger [rad], where they differ."""
    old, new = learned.joint_offsets, now.joint_offsets
    shifts = {name: new.get(name, 0.0) - old.get(name, 0.0) for name in {*old, *new}}
    return {name: shift for name, shift in sorted(shifts.items()) if shift}
