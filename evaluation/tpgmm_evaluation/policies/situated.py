"""Key poses reached by inverse kinematics, and the mean of the demonstrations."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any, Self

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from scipy.interpolate import CubicSpline
from torch import Tensor

from tpgmm_evaluation.policies.aligned import Aligned
from tpgmm_evaluation.policies.inverse_kinematics import follow_poses
from tpgmm_evaluation.policies.key_poses import Move, find_moves, minimum_jerk_path
from tpgmm_evaluation.policies.planned import Observed, SituatedConfig, SituatedPolicy
from tpgmm_torch import Frame
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.motion.minimum_jerk import minimum_jerk
from tpgmm_torch.robots.robot import Robot

#: For how long the present posture fades into the mean motion [s].
FADE = 1.0
#: Poses per second for which inverse kinematics are solved; between them lies a cubic spline.
SOLVED = 25


def fade_into_mean(start: Tensor, mean: Tensor, usual: Tensor, fps: int) -> Tensor:
    """Return a mean motion (T, n_joints) that begins at ``start`` instead of ``usual``."""
    done = minimum_jerk(torch.arange(len(mean), dtype=torch.float64) / (FADE * fps))
    return mean + (1 - done)[:, None] * (start - usual)


@PreTrainedConfig.register_subclass("mean_demonstration")
@dataclass
class MeanConfig(SituatedConfig):
    """Configuration of :class:`MeanPolicy`."""


class MeanPolicy(SituatedPolicy):
    """Replays the mean of the aligned demonstrations, from the present posture."""

    config_class = MeanConfig
    name = "mean_demonstration"

    def references(self, seen: Observed) -> Tensor:
        """Return the mean, into which the present posture fades within a second."""
        return fade_into_mean(seen.joints, self.mean, self.start, self.config.fps)


@PreTrainedConfig.register_subclass("key_poses")
@dataclass
class KeyPosesConfig(SituatedConfig):
    """Configuration of :class:`KeyPosesPolicy`.

    Parameters
    ----------
    moves : list of dict
        Each a :class:`Move`.
    tolerance : float, optional
        With which they are found, as :func:`find_moves` takes it [m].
    posture : bool, default=False
        Whether the demonstrated posture is sought in the null space; otherwise it is the one
        in which the move begins.
    """

    moves: list[dict[str, Any]] = field(default_factory=list)
    tolerance: float | None = 0.005
    posture: bool = False


class KeyPosesPolicy(SituatedPolicy):
    """Goes from key pose to key pose along minimum-jerk paths, by inverse kinematics of mink.

    What the field would try first: the poses of the hands, seen from the objects, at the
    instants that matter. It looks at the beginning of each move for where its key poses are.
    Coordinates without kinematics, like a gripper, do as in the mean.

    Parameters
    ----------
    config : KeyPosesConfig
        Robot, moves and options.
    **unused
        What else LeRobot passes.
    """

    config_class = KeyPosesConfig
    config: KeyPosesConfig
    name = "key_poses"
    robot: Robot

    def __init__(self, config: KeyPosesConfig, **unused: Any) -> None:
        super().__init__(config)
        self.moves = [Move.from_config(move) for move in config.moves]

    @classmethod
    def fit(cls, aligned: Aligned, **options: Any) -> Self:
        """Find the moves and learn them.

        Parameters
        ----------
        aligned : Aligned
            Demonstrations of a :class:`~tpgmm_torch.Robot`.
        **options
            Of the configuration.

        Raises
        ------
        DataError
            As :func:`find_moves`.
        """
        tolerance = options.get("tolerance", cls.config_class.tolerance)
        moves = [move.config() for move in find_moves(aligned, tolerance)]
        return super().fit(aligned, moves=moves, **options)

    def recipe(self) -> dict[str, Any]:
        """Describe the settings that were chosen or found in the demonstrations."""
        usual = {part.name for part in fields(SituatedConfig)} | {"moves"}
        chosen = [part.name for part in fields(self.config) if part.name not in usual]
        frames = [
            {pose.link: f"{pose.held} in {pose.frame}" if pose.held else pose.frame}
            for move in self.moves
            for at in move.poses
            for pose in at
        ]
        return {**{name: getattr(self.config, name) for name in chosen}, "key_poses": frames}

    @property
    def looks(self) -> tuple[int, ...]:
        """The steps at which moves begin."""
        return tuple(move.look for move in self.moves)

    @property
    def free(self) -> list[int]:
        """The coordinates that move no link, like a gripper."""
        moving = {body.joint for body in self.robot.tree}
        return [i for i in range(self.robot.n_joints) if i not in moving]

    def poses(self, joints: Tensor) -> dict[str, Frame]:
        """Compute the poses of the links at a posture (n_joints,)."""
        state = self.robot.state(joints)
        return {n: Frame(state.position(n), state.orientation(n)) for n in self.robot.links}

    def references(self, seen: Observed) -> Tensor:
        """Plan the move that begins now, and what is left of it until the next."""
        joints, step = seen.joints, seen.step
        move = next(move for move in self.moves if move.look == step)
        fps, length = self.config.fps, move.arrive - move.begin
        start = joints.clamp(self.robot.lower, self.robot.upper)
        count = max(2, round(length * SOLVED / fps) + 1)
        rows: Array = np.linspace(0, length, count).astype(np.float64)
        here = self.poses(start)
        steps = [at - move.begin for at in move.steps]
        targets = move.targets(self.poses(seen.measured), seen.frames, seen.first)
        paths = {
            link: minimum_jerk_path(here[link], poses, steps, rows)
            for link, poses in targets.items()
        }
        mean = self.mean[move.begin :]
        wanted = fade_into_mean(joints, mean, mean[0], fps)
        posture = wanted[np.round(rows).astype(int)] if self.config.posture else start
        rate = (len(rows) - 1) / length * fps
        # what it misses shows in its episodes
        solution = follow_poses(
            self.robot, paths, start, rate=rate, posture=posture, tolerance=math.inf
        )
        spline = CubicSpline(rows, as_array(solution), bc_type="clamped")
        after = np.arange(step, move.end) - move.begin
        references = torch.from_numpy(spline(after.clip(0, length)))
        references[:, self.free] = wanted[after.clip(0)][:, self.free]
        return references
