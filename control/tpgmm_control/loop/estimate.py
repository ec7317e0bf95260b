"""Stage *estimate*: what the skill says at the time of each robot."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch.exceptions import TPGMMError
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.robots.kinematics import RobotState
from tpgmm_torch.skills.holding import Holding
from tpgmm_torch.skills.skill import Skill


def estimate(
    skill: Skill,
    time: Tensor,
    joints: Tensor | RobotState,
    holding: Holding,
    bounds: tuple[Tensor, Tensor] | None,
    last: Estimate | None,
) -> Estimate:
    """The skill's estimate; not finite for robots for which it has none.

    Parameters
    ----------
    skill : Skill
    time : Tensor of shape () or (...)
        [s].
    joints : Tensor of shape (..., n_joints), or RobotState
        The state q_{t-1}, with what the robots hold.
    holding : Holding
        Objects, and which of them the robots hold.
    bounds : tuple of two Tensor of shape (n_joints,), optional
        The lowest and the highest joints allowed.
    last : Estimate, optional
        Of the last tick; without it, as in the first tick, errors are raised.

    Raises
    ------
    TPGMMError
        As the skill does.
    """
    state: Any = joints
    if isinstance(joints, RobotState):
        joints = joints.joints
    try:
        return skill.estimate(time, state, holding.frames, bounds)
    except TPGMMError:
        if last is None:
            raise
    # one robot's failure is not its batch's
    batch = joints.shape[:-1]
    found = torch.full_like(joints, torch.nan)
    covariance = last.covariance.expand(*joints.shape, -1).clone()
    activation = last.activation.expand(*batch, -1).clone()
    for index in np.ndindex(*batch):
        frames = {name: frame.expand(batch)[index] for name, frame in holding.frames.items()}
        now = time[index] if time.ndim else time
        try:
            one = skill.estimate(now, state[index], frames, bounds)
        except TPGMMError:
            continue
        found[index], covariance[index] = one.joints, one.covariance
        activation[index] = one.activation
    return Estimate(found, covariance, activation)


def choose(where: Tensor, one: Estimate, other: Estimate) -> Estimate:
    """One estimate for some robots, the other for the rest.

    Parameters
    ----------
    where : Tensor of bool of shape (...)
        For which robots the first.
    one, other : Estimate
    """
    mask = where.unsqueeze(-1)
    return Estimate(
        torch.where(mask, one.joints, other.joints),
        torch.where(mask.unsqueeze(-1), one.covariance, other.covariance),
        torch.where(mask, one.activation, other.activation),
    )
