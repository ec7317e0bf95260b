"""Algorithm 1's synthesis loop: references over a whole time grid, many situations at once."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from numbers import Integral
from typing import Any

import numpy as np
import torch
from sklearn.utils import check_random_state

from tpgmm_torch import gaussians
from tpgmm_torch.control.controller import Controller
from tpgmm_torch.control.holding import Holding
from tpgmm_torch.data.demonstrations import Demonstration, Situation
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.trajectories import Candidate, Trajectory
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.regression import PART
from tpgmm_torch.skills.situations import completed_situations, with_novelty
from tpgmm_torch.skills.skill import Skill
from tpgmm_torch.skills.via_points import ViaPoints

__all__ = ["rollout", "sample"]


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
    known = completed_situations(skill, situations)
    trajectories: dict[int, Trajectory] = {}
    for members in _groups(known):
        batch = [known[index] for index in members]
        together = _run_together(skill, batch, bounds, blend, candidates)
        trajectories.update(zip(members, together, strict=True))
    done = [trajectories[index] for index in range(len(known))]
    if isinstance(skill, ViaPoints):
        skill.missed(known, done).act()
    return with_novelty(skill, known, done)


def sample(
    skill: Skill,
    situation: Situation | Demonstration,
    n_samples: int = 1,
    random_state: int | np.random.RandomState | None = None,
) -> list[Trajectory]:
    """Draw trajectories around the reproduction, ``q_t + L_t z`` with one z for all time.

    Parameters
    ----------
    skill : Skill
    situation : Situation or Demonstration
    n_samples : int, default=1
    random_state : int, RandomState instance or None

    Raises
    ------
    DataError
        If ``n_samples`` is no positive integer, and as :func:`rollout` does.
    """
    if not isinstance(n_samples, Integral) or n_samples < 1:
        raise DataError(f"n_samples must be an integer of at least 1, got {n_samples!r}")
    [mean] = rollout(skill, [situation])
    rng = check_random_state(random_state)
    factor = gaussians.cholesky(mean.covariance, "the covariance of the reproduction")
    draws = torch.from_numpy(rng.standard_normal((n_samples, *mean.joints.shape[1:])))
    moved = (mean.joints + factor @ z for z in draws.to(factor))
    return [replace(mean, joints=skill.kinematics.retract(joints)) for joints in moved]


def _groups(situations: Sequence[Situation]) -> list[list[int]]:
    """Indices of situations that share time grid and frames, and so run as one batch."""
    groups: dict[tuple[bytes, tuple[str, ...]], list[int]] = {}
    for index, situation in enumerate(situations):
        assert situation.time is not None
        key = (situation.time.cpu().numpy().tobytes(), tuple(sorted(situation.frames)))
        groups.setdefault(key, []).append(index)
    return list(groups.values())


def _run_together(
    skill: Skill,
    situations: Sequence[Situation],
    bounds: MotionBounds | str | None,
    blend: float,
    candidates: bool,
) -> list[Trajectory]:
    """Trajectories of B situations of one time grid."""
    time = situations[0].time
    assert time is not None  # they are complete
    frames = _stacked(situations)
    start = torch.stack([situation.joints for situation in situations])
    joints, poses = start, frames
    if len(situations) == 1:  # one robot is computed faster without a batch
        joints, poses = start[0], {name: frame[..., 0] for name, frame in frames.items()}
    held = time.clamp(skill.begin, skill.end)  # nothing is extrapolated
    controller = Controller(
        skill,
        joints,
        poses,
        clock="even",
        trust=None,
        smoothing=None,
        bounds=bounds,
        blend=blend,
        begin=float(held[0]),
        end=float(held[-1]),
        at_rest=False,  # a situation does not say how its robot moves
    )
    references, estimates, holdings = zip(
        *_ticks(controller, held.tolist(), poses), strict=True
    )
    shape = len(time), *start.shape
    whole = _over_time(estimates, shape)
    joints = torch.stack(references).view(shape)
    own: list[Candidate] = []
    if candidates and hasattr(skill, "candidates"):
        states = torch.cat((start[None], joints[:-1]))
        own = _candidates(skill, held, states, frames, holdings, whole)
    names = skill.kinematics.joint_names
    return [
        Trajectory(time, joints[:, row], whole.covariance[:, row], _row(own, row), names)
        for row in range(len(situations))
    ]


def _stacked(situations: Sequence[Situation]) -> dict[str, Frame]:
    """Frames of B situations, (B,) or, if they move, (T, B)."""
    return {
        name: Frame.stack([situation.frames[name] for situation in situations])
        for name in situations[0].frames
    }


def _over_time(estimates: Sequence[Estimate], shape: Sequence[int]) -> Estimate:
    """Estimates (T, B, ...) of T ticks."""
    return Estimate(
        torch.stack([estimate.joints for estimate in estimates]).view(*shape),
        torch.stack([estimate.covariance for estimate in estimates]).view(*shape, -1),
        torch.stack([estimate.activation for estimate in estimates]),
    )


def _row(candidates: Sequence[Candidate], row: int) -> tuple[Candidate, ...]:
    """Candidates of one robot of a batch."""
    return tuple(
        Candidate(one.mean[:, row], one.covariance[:, row], one.share[:, row])
        for one in candidates
    )


def _ticks(
    controller: Controller, grid: Sequence[float], poses: Mapping[str, Frame]
) -> list[tuple[torch.Tensor, Estimate, Holding]]:
    """Reference, estimate and held objects at each time of a grid."""
    batch = controller.reference.ndim - 1
    moving = {name for name, pose in poses.items() if len(pose.batch_shape) > batch}
    found: list[tuple[torch.Tensor, Estimate, Holding]] = []
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


def _candidates(
    skill: Any,
    time: torch.Tensor,
    joints: torch.Tensor,
    frames: Mapping[str, Frame],
    holdings: Sequence[Holding],
    whole: Estimate,
) -> list[Candidate]:
    """Each operator's own estimates (T, B, ...), many instants at once: none needs another."""
    size = max(1, PART // joints.shape[1])
    activation = whole.activation
    if activation.ndim == 2:  # the same for all robots
        activation = activation.unsqueeze(1)
    parts = []
    for now in _stretches(holdings, size):
        estimate = Estimate(whole.joints[now], whole.covariance[now], activation[now])
        holding = _together(holdings[now], _at(frames, now), joints.shape[1:2])
        state = holding.state(skill.kinematics.state(joints[now]))
        at = time[now].unsqueeze(-1)
        parts.append(skill.candidates(at, state, holding.frames, estimate))
    return [
        Candidate(*(torch.cat(field) for field in zip(*map(_fields, over_time), strict=True)))
        for over_time in zip(*parts, strict=True)
    ]


def _stretches(holdings: Sequence[Holding], size: int) -> Iterator[slice]:
    """Up to ``size`` instants each, in which the robots hold the same things."""
    start = 0
    for k in range(1, len(holdings) + 1):
        whole = k == len(holdings) or k - start == size
        if whole or holdings[k].held is not holdings[start].held:
            yield slice(start, k)
            start = k


def _together(
    holdings: Sequence[Holding], frames: Mapping[str, Frame], batch: Sequence[int]
) -> Holding:
    """Several instants (T, B) at which the robots hold the same things."""
    places = dict(frames)
    for name in holdings[0].held:
        each = [holding.frames[name].expand(batch) for holding in holdings]
        places[name] = Frame._from(
            torch.stack([pose.position for pose in each]),
            torch.stack([pose.orientation for pose in each]),
        )
    return replace(holdings[0], frames=places)


def _at(frames: Mapping[str, Frame], now: slice) -> dict[str, Frame]:
    """Frames of shape (B,) or, if they move, (T, B) at some instants."""
    return {name: f[now] if len(f.batch_shape) == 2 else f for name, f in frames.items()}


def _fields(candidate: Candidate) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return candidate.mean, candidate.covariance, candidate.share
