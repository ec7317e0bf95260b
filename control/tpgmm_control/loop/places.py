"""Where in a skill a robot is: the times that explain a posture."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tpgmm_control.loop.locate import NEARBY
from tpgmm_control.sensing.servo import FLOOR
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.robots.kinematics import RobotState
from tpgmm_torch.skills.holding import Holding
from tpgmm_torch.skills.skill import Skill

#: Spacing of the times that are tried, at least [s], and how many there are at most.
SPACING, MOST = 0.04, 4096
#: Mean distance of a displaced robot's place from the present time [s]. Ahead counts twice: of
#: places that look alike, those that leave something out are worse.
DISTANCE = 2.0
#: Log-likelihoods that differ by less are alike: those of the periods of a repeating motion.
ALIKE = 5.0
#: Modes of the likelihood that are tried.
TRIED = 5
#: Gap to the skill's reference in units of what is usual, up to which it explains a posture.
TOLERANCE = 2.0


@dataclass(frozen=True, eq=False)
class Places:
    """The times of a skill that explain robots' postures.

    Parameters
    ----------
    skill : Skill
    begin, end : float
        [s].
    """

    skill: Skill
    begin: float
    end: float

    @property
    def grid(self) -> Array:
        """The times that are tried (G,) [s]."""
        count = min(MOST, max(2, round((self.end - self.begin) / SPACING) + 1))
        return np.linspace(self.begin, self.end, count, dtype=np.float64)

    def find(
        self,
        row: int,
        posture: Array,
        now: float,
        holding: Holding,
        like: Tensor,
        within: tuple[float, float] = (-math.inf, math.inf),
    ) -> float | None:
        """Find the likeliest time that explains a robot's posture, or None.

        Parameters
        ----------
        row : int
            Of the robot, in the flattened batch.
        posture : array of shape (n_joints,)
        now : float
            Its present time: of places that are as likely the nearest is taken [s].
        holding : Holding
            Objects of the batch.
        like : Tensor of shape (..., n_joints)
            Postures of the batch.
        within : tuple of float, optional
            Between which times it is looked for [s].
        """
        one, grid = self._take_robot(row, posture, holding, like), self.grid
        grid = grid[(grid >= within[0]) & (grid <= within[1])]
        if one is None or not len(grid):
            return None
        likelihood = one.compute_log_likelihood(grid)
        apart = grid - now
        distance = np.maximum(2 * apart, -apart)
        there = one.find_modes(
            grid, likelihood - distance / DISTANCE, int(np.abs(apart).argmin())
        )
        if not there:
            return None
        alike = [k for k in there if likelihood[k] > likelihood[there].max() - ALIKE]
        return float(grid[min(alike, key=lambda k: distance[k])])

    def find_start(self, row: int, holding: Holding, like: Tensor) -> float:
        """Find where a robot starts that may stand anywhere: the first of the best places."""
        one = self._take_robot(
            row, as_array(like).reshape(-1, like.shape[-1])[row], holding, like
        )
        if one is None:
            return self.begin
        grid = self.grid
        likelihood = one.compute_log_likelihood(grid)
        # of several, as in a repeating motion, the earliest: others leave something out; but
        # the first half second is left out only where the beginning explains nothing
        there = one.find_modes(grid, likelihood, 0)
        alike = [k for k in there if likelihood[k] > likelihood[there].max() - ALIKE]
        early = 0 in there and grid[min(alike)] - self.begin < 0.5
        return self.begin if early or not there else float(grid[min(alike)])

    def _take_robot(
        self, row: int, posture: Array, holding: Holding, like: Tensor
    ) -> _Robot | None:
        """Take one robot of the batch, as it is observed; None if nothing of it is."""
        batch, kinematics = like.shape[:-1], self.skill.kinematics
        index = tuple(int(k) for k in np.unravel_index(row, batch)) if batch else ()
        with torch.inference_mode():
            joints = like.clone()
            joints[index] = torch.as_tensor(posture).to(like)
            state = kinematics.state(joints if holding.carries else joints[index])
            state = holding.state(state)[index] if holding.carries else state
        frames = {
            name: frame.expand(batch)[index] if frame.batch_shape else frame
            for name, frame in holding.frames.items()
        }
        skill = self.skill.restrict_to(frozenset((*frames, *state.links)))
        if skill is None:
            return None
        mask = torch.zeros(batch, dtype=torch.bool)
        mask[index] = True
        return _Robot(skill.of_robots(mask) if batch else skill, state, frames)


@dataclass(frozen=True, eq=False)
class _Robot:
    """One robot, and the skill as far as it is observed."""

    skill: Skill
    state: RobotState
    frames: Mapping[str, Frame]

    def compute_log_likelihood(self, grid: Array) -> Array:
        """Compute how likely the robot is at times (G,)."""
        with torch.inference_mode():
            times = torch.from_numpy(grid)
            return as_array(self.skill.log_likelihood(times, self.state, self.frames))[0]

    def find_modes(self, grid: Array, score: Array, first: int) -> list[int]:
        """Find one time and the highest modes of a score that explain the posture."""
        found = [first]
        for _ in range(TRIED):
            found.append(int(score.argmax()))
            near = np.abs(grid - grid[found[-1]]) <= NEARBY
            score = np.where(near, -np.inf, score)
        return [k for k in dict.fromkeys(found) if self.explains(float(grid[k]))]

    def explains(self, place: float) -> bool:
        """Tell whether the robot is near the skill's reference at a time."""
        with torch.inference_mode():
            time = torch.as_tensor(place).to(self.state.joints)
            estimate = self.skill.estimate(time, self.state, self.frames)
            std = estimate.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
            gap = (estimate.joints - self.state.joints).abs() / (FLOOR + std)
        return bool(gap.max() <= TOLERANCE)
