"""Demonstrations on one clock: what the baselines learn from that replay or generalise them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from tpgmm_datasets import describe_lerobot, load_lerobot
from tpgmm_torch import Demonstration
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.alignment.base import retime
from tpgmm_torch.robots import Kinematics


@dataclass(frozen=True, eq=False)
class Aligned:
    """The references of demonstrations on their mean clock.

    Parameters
    ----------
    robot : Kinematics
        Whose joints the references are.
    fps : int
        Time steps per second.
    demonstrations : sequence of Demonstration
        Of one length, with the joint references in the robot's order.
    starts : Tensor of shape (N, n_joints)
        The measured postures in which they began.
    state_names, action_names, environment_names : tuple of str
        Of the entries of the data set's features.
    """

    robot: Kinematics
    fps: int
    demonstrations: tuple[Demonstration, ...]
    starts: Tensor
    state_names: tuple[str, ...]
    action_names: tuple[str, ...]
    environment_names: tuple[str, ...]

    @classmethod
    def read(cls, path: Path, robot: Kinematics, n: int, synchronous: bool = False) -> Aligned:
        """Read the first ``n`` episodes of a LeRobot data set.

        Parameters
        ----------
        path : Path
            Its folder.
        robot : Kinematics
            With the joints that it names.
        n : int
            How many episodes.
        synchronous : bool, default=False
            Whether the episodes run on one clock as they are.
        """
        info = describe_lerobot(path)
        names = {column.key: tuple(column.names or ()) for column in info.columns}
        commanded, measured = (
            load_lerobot(path, robot=robot, joints=joints, episodes=range(n))
            for joints in ("action", "observation.state")
        )
        fps = round(info.fps)
        aligned = (
            _extend_to_longest(commanded)
            if synchronous
            else _on_mean_clock(commanded, robot, fps)
        )
        return cls(
            robot,
            fps,
            tuple(aligned),
            torch.stack([demonstration.joints[0] for demonstration in measured]),
            names["observation.state"],
            names["action"],
            names["observation.environment_state"],
        )

    @property
    def mean(self) -> Tensor:
        """The mean reference at each time step, shape (T, n_joints)."""
        return torch.stack([d.joints for d in self.demonstrations]).mean(0)


def _extend_to_longest(demonstrations: Sequence[Demonstration]) -> list[Demonstration]:
    """Extend demonstrations to the length of the longest, by their last posture."""
    longest = max(demonstrations, key=len)
    extended = []
    for shown in demonstrations:
        rows = torch.arange(len(longest)).clamp(max=len(shown) - 1)
        frames = {n: f[rows] if f.batch_shape else f for n, f in shown.frames.items()}
        extended.append(
            Demonstration(
                longest.time, shown.joints[rows], frames, shown.joint_names, shown.events
            )
        )
    return extended


def _on_mean_clock(
    demonstrations: Sequence[Demonstration], robot: Kinematics, fps: int
) -> list[Demonstration]:
    """Warp demonstrations onto one another, at the mean of corresponding instants."""
    if len(demonstrations) == 1:
        return list(demonstrations)
    warping = DynamicTimeWarping(robot=robot).fit(demonstrations)
    clock = warping.time_.numpy()
    mean = np.mean(warping.paths_, axis=0)
    grid = np.arange(np.floor((mean[-1] - mean[0]) * fps + 1e-6) + 1) / fps
    at = np.interp(grid + mean[0], mean, clock)
    return [
        retime(shown, np.interp(at, clock, path), torch.from_numpy(grid))
        for path, shown in zip(warping.paths_, demonstrations, strict=True)
    ]
