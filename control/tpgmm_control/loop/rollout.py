"""Reproductions within the limits of a robot, or that fade in: a controller by the clock."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial

import torch
from torch import Tensor

from tpgmm_control.loop.controller import Controller
from tpgmm_torch.data.demonstrations import Demonstration, Situation
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.skills.reproduction import Tick, reproduce
from tpgmm_torch.skills.skill import Skill

__all__ = ["rollout"]


def rollout(
    skill: Skill,
    situations: Situation | Demonstration | Iterable[Situation | Demonstration],
    *,
    bounds: MotionBounds | str | None = None,
    blend: float = 0.0,
    candidates: bool = False,
) -> list[Trajectory]:
    """Reproduce a skill in new situations: each reference is the q_{t-1} of the next step.

    Parameters
    ----------
    skill : Skill
        A fitted model's ``skill``, or one that holds others.
    situations : sequence of Situation or Demonstration
        Without a time of its own a situation has the skill's.
    bounds : MotionBounds, "robot" or None, default=None
        Of position, speed, acceleration and jerk; "robot" takes those of the robot and of the
        demonstrations, None takes the estimates for references.
    blend : float, default=0.0
        How long the difference between the start posture and the first reference fades, by a
        minimum-jerk step [s].
    candidates : bool, default=False
        Whether to keep each operator's own estimate.

    Returns
    -------
    list of Trajectory
        In the order of the situations.

    Raises
    ------
    DataError, ShapeError, UnknownNameError, PlausibilityError
        If a situation does not fit the skill, or cannot be what it is taken for.

    Warns
    -----
    PlausibilityWarning
        Once, if references miss via-points, or situations are unlike the demonstrations.
    """
    if bounds is None and blend == 0 and not skill.gates:
        return reproduce(skill, situations, candidates=candidates)
    ticks = partial(_controlled, bounds=bounds, blend=blend)
    return reproduce(skill, situations, candidates=candidates, ticks=ticks)


def _controlled(
    skill: Skill,
    start: Tensor,
    poses: Mapping[str, Frame],
    grid: Sequence[float],
    *,
    bounds: MotionBounds | str | None,
    blend: float,
) -> list[Tick]:
    """As :func:`~tpgmm_torch.skills.reproduction.open_loop`, by a controller."""
    controller = Controller(
        skill,
        start,
        poses,
        clock="even",
        trust=None,
        smoothing=None,
        bounds=bounds,
        blend=blend,
        begin=grid[0],
        end=grid[-1],
        at_rest=False,  # a situation does not say how its robot moves
    )
    batch = controller.reference.ndim - 1
    moving = {name for name, pose in poses.items() if len(pose.batch_shape) > batch}
    found = list[Tick]()
    inferring = torch.is_inference_mode_enabled()
    for k, (now, before) in enumerate(zip(grid, [grid[0], *grid], strict=False)):
        if k == 1:  # what the first step does not record, none does; to ask so takes a third
            inferring = inferring or not found[0][0].requires_grad
        if k and now == before:
            found.append(found[-1])
            continue
        with torch.inference_mode(inferring):
            here = {name: pose[k] if name in moving else pose for name, pose in poses.items()}
            command = controller.step(now - before, frames=here if moving else None)
        found.append((controller.reference, command.estimate, controller.holding))
    return found
