"""Corrections of a running skill, in the time of the skill."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import Demonstration, Situation
from tpgmm_torch.data.frames import LEVER
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError, PlausibilityWarning
from tpgmm_torch.skills.reproduction import reproduce
from tpgmm_torch.skills.skill import Skill

__all__ = ["in_skill_time"]

#: Difference of joints that costs as much as twice or half the pace [rad].
JOINTS, SLOPE = 0.1, math.log(2.0)


def in_skill_time(
    model: TaskParameterizedGMM,
    demonstrations: Sequence[Demonstration],
    *,
    max_slope: float = 4.0,
    n_steps: int = 400,
) -> list[Demonstration]:
    """Bring what a person showed into the time of a skill, to fit it with the demonstrations.

    What is shown may be the whole skill or a segment, that in which a person took over. It
    begins where the skill, reproduced with its frames, is most like its beginning, and ends
    where it is most like its end, in joints and in poses of links; of places that explain
    both, those count at which it is about as fast as the skill. In between time is linear:
    what differs in the middle is the correction.

    Parameters
    ----------
    model : TaskParameterizedGMM
        Fitted.
    demonstrations : sequence of Demonstration
        Each of at least two time steps, on a clock of its own.
    max_slope : float, default=4.0
        How many times slower or faster than the skill a person may be.
    n_steps : int, default=400
        At how many instants of the skill, at most, they are compared; the cost is their square.

    Returns
    -------
    list of Demonstration
        With times from ``time_[0]`` to ``time_[-1]``, or within.

    Raises
    ------
    DataError, ShapeError, UnknownNameError, NotFittedError
        If the demonstrations do not fit the model.

    Examples
    --------
    >>> time = torch.linspace(0, 2, 101, dtype=torch.float64)
    >>> shown = [Demonstration(time, (time**2 * end)[:, None]) for end in (0.9, 1.0, 1.1)]
    >>> model = TaskParameterizedGMM(n_components=6).fit(shown)
    >>> segment = Demonstration(time[:51], (time[25:76] ** 2)[:, None])
    >>> [placed] = in_skill_time(model, [segment])
    >>> round(float(placed.time[0]), 1), round(float(placed.time[-1]), 1)
    (0.5, 1.5)
    """
    skill: Any = model.skill
    shown = enumerate(demonstrations)
    return [_placed(skill, one, number, max_slope, n_steps) for number, one in shown]


def _placed(
    skill: Skill, shown: Demonstration, number: int, max_slope: float, n_steps: int
) -> Demonstration:
    kinematics, grid = skill.kinematics, skill.time
    if len(shown) < 2:
        raise DataError(f"demonstration {number} has one time step: it shows no motion")
    shown = shown.reorder(kinematics.joint_names)
    count = min(n_steps, max(len(grid), 2))
    time = torch.linspace(float(grid[0]), float(grid[-1]), count, dtype=grid.dtype)
    situation = Situation(shown.joints[0], Situation.of(shown).frames, time)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PlausibilityWarning)  # a correction begins anywhere
        [reproduced] = reproduce(skill, [situation])
    path, ends = (
        _features(skill, joints) for joints in (reproduced.joints, shown.joints[[0, -1]])
    )
    begin, end = (((path - one) ** 2).mean(axis=1) for one in ends)
    instants = as_array(time)
    lasts = instants[None, :] - instants[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.log(lasts / shown.duration)
    possible = np.abs(slope) <= math.log(max_slope)
    if not possible.any():
        raise DataError(
            f"demonstration {number} lasts {shown.duration:.4g} s, more than {max_slope:g} "
            "times as long or short as any part of the skill of "
            f"{instants[-1] - instants[0]:.4g} s"
        )
    cost = begin[:, None] + end[None, :] + (slope / SLOPE) ** 2
    first, last = np.unravel_index(np.where(possible, cost, np.inf).argmin(), cost.shape)
    scale = float((instants[last] - instants[first]) / shown.duration)
    begun = float(shown.time[0])

    def clock(instant: Any) -> Any:
        return instants[first] + scale * (instant - begun)

    events = {name: clock(instant) for name, instant in shown.events.items()}
    holds = shown.holds
    if holds is not None:
        holds = tuple(hold.retime(clock) for hold in holds)
    return replace(shown, time=clock(shown.time), events=events, holds=holds)


def _features(skill: Skill, joints: torch.Tensor) -> Array:
    """Joints and positions of links (T, D), in units of what counts as a difference."""
    state = skill.kinematics.state(joints)
    positions = [state.position(link) / LEVER for link in skill.kinematics.links]
    return as_array(torch.cat([state.joints, *positions], dim=-1) / JOINTS)
