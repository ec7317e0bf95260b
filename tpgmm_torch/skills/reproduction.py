"""Algorithm 1's synthesis loop: references over a whole time grid, many situations at once.

Nothing is measured, and nothing bounds the references: a skill alone, and what its robots hold.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from numbers import Integral
from typing import Any

import numpy as np
import torch
from sklearn.utils import check_random_state
from torch import Tensor

from tpgmm_torch import gaussians
from tpgmm_torch.data.demonstrations import Demonstration, Situation
from tpgmm_torch.data.frames import Frame, Frames
from tpgmm_torch.data.trajectories import Candidate, Trajectory
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.regression import PART
from tpgmm_torch.skills.holding import Holding
from tpgmm_torch.skills.situations import complete_situations, with_novelty
from tpgmm_torch.skills.skill import Skill
from tpgmm_torch.skills.via_points import ViaPoints

#: Reference, estimate and held objects at a time.
Tick = tuple[Tensor, Estimate, Holding]


def reproduce(
    skill: Skill,
    situations: Situation | Demonstration | Iterable[Situation | Demonstration],
    *,
    candidates: bool = False,
    ticks: Callable[..., Sequence[Tick]] | None = None,
) -> list[Trajectory]:
    """Reproduce a skill in new situations: each reference is the q_{t-1} of the next step.

    Parameters
    ----------
    skill : Skill
    situations : sequence of Situation or Demonstration
        Without a time of its own a situation has the skill's.
    candidates : bool, default=False
        Whether to keep each operator's own estimate.
    ticks : callable, optional
        How references are made, :func:`open_loop` by default.

    Raises
    ------
    DataError, ShapeError, UnknownNameError, PlausibilityError
        If a situation does not fit the skill, or cannot be what it is taken for.
    """
    known = complete_situations(skill, situations)
    trajectories: dict[int, Trajectory] = {}
    for members in _groups(known):
        batch = [known[index] for index in members]
        together = _run_together(skill, batch, candidates, ticks or open_loop)
        trajectories.update(zip(members, together, strict=True))
    done = [trajectories[index] for index in range(len(known))]
    if isinstance(skill, ViaPoints):
        skill.report_misses(known, done).act()
    return with_novelty(skill, known, done)


def open_loop(skill: Skill, start: Tensor, poses: Frames, grid: Sequence[float]) -> list[Tick]:
    """References at the times of a grid, from start postures (..., n_joints) on.

    Parameters
    ----------
    skill : Skill
    start : Tensor of shape (..., n_joints)
    poses : mapping of str to Frame
        Of the batch's shape, with time before it where they move.
    grid : sequence of float
        [s].
    """
    moving = {name for name, pose in poses.items() if len(pose.batch_shape) >= start.ndim}
    here = _poses_at(0, poses, moving)
    holding = Holding.start(skill.kinematics, skill.carried_names, skill.holds, here)
    skill, joints, last = skill.start(start, here), start, None
    done = list[Tick]()
    with ExitStack() as stack:
        for k, now in enumerate(grid):
            if now == last:
                done.append(done[-1])
                continue
            seen = _poses_at(k, poses, moving) if moving else None
            time = start.new_tensor(now)
            holding = holding.advance(time, joints, seen)
            state: Any = joints
            if holding.carries:
                state = holding.state(skill.kinematics.state(joints))
            found = skill.estimate(time, state, holding.frames)
            skill, joints = skill.advance(found), skill.kinematics.retract(found.joints)
            done.append((joints, found, holding))
            last = now
            if k == 0 and not joints.requires_grad:
                # what the first step does not record, none does; to ask so takes a third
                stack.enter_context(torch.inference_mode())
    return done


def _poses_at(k: int, poses: Frames, moving: set[str]) -> dict[str, Frame]:
    """Select the poses at an instant, where they move."""
    return {name: pose[k] if name in moving else pose for name, pose in poses.items()}


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
        If ``n_samples`` is no positive integer, and as :func:`reproduce` does.
    """
    if not isinstance(n_samples, Integral) or n_samples < 1:
        raise DataError(f"n_samples must be an integer of at least 1, got {n_samples!r}")
    [mean] = reproduce(skill, [situation])
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
    candidates: bool,
    ticks: Callable[..., Sequence[Tick]],
) -> list[Trajectory]:
    """Trajectories of B situations of one time grid."""
    time = situations[0].time
    assert time is not None  # they are complete
    frames = _stack_frames(situations)
    start = torch.stack([situation.joints for situation in situations])
    joints, poses = start, frames
    if len(situations) == 1:  # one robot is computed faster without a batch
        joints, poses = start[0], {name: frame[..., 0] for name, frame in frames.items()}
    held = time.clamp(skill.begin, skill.end)  # nothing is extrapolated
    references, estimates, holdings = zip(
        *ticks(skill, joints, poses, held.tolist()), strict=True
    )
    shape = len(time), *start.shape
    whole = _over_time(estimates, shape)
    joints = torch.stack(references).view(shape)
    own: list[Candidate] = []
    if candidates:
        states = torch.cat((start[None], joints[:-1]))
        own = _candidates(skill, held, states, frames, holdings, whole)
    names = skill.kinematics.joint_names
    return [
        Trajectory(time, joints[:, row], whole.covariance[:, row], _row(own, row), names)
        for row in range(len(situations))
    ]


def _over_time(estimates: Sequence[Estimate], shape: Sequence[int]) -> Estimate:
    """Estimates (T, B, ...) of T ticks."""
    return Estimate(
        torch.stack([estimate.joints for estimate in estimates]).view(*shape),
        torch.stack([estimate.covariance for estimate in estimates]).view(*shape, -1),
        torch.stack([estimate.activation for estimate in estimates]),
    )


def _stack_frames(situations: Sequence[Situation]) -> dict[str, Frame]:
    """Frames of B situations, (B,) or, if they move, (T, B)."""
    return {
        name: Frame.stack([situation.frames[name] for situation in situations])
        for name in situations[0].frames
    }


def _row(candidates: Sequence[Candidate], row: int) -> tuple[Candidate, ...]:
    """Candidates of one robot of a batch."""
    return tuple(
        Candidate(*(part[:, row] for part in vars(one).values())) for one in candidates
    )


def _candidates(
    skill: Skill,
    time: torch.Tensor,
    joints: torch.Tensor,
    frames: Frames,
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
        here = {n: f[now] if len(f.batch_shape) == 2 else f for n, f in frames.items()}
        holding = _together(holdings[now], here, joints.shape[1:2])
        state = holding.state(skill.kinematics.state(joints[now]))
        at = time[now].unsqueeze(-1)
        parts.append(skill.candidates(at, state, holding.frames, estimate))
    several = [[vars(one).values() for one in own] for own in zip(*parts, strict=True)]
    return [Candidate(*map(torch.cat, zip(*fields, strict=True))) for fields in several]


def _stretches(holdings: Sequence[Holding], size: int) -> Iterator[slice]:
    """Up to ``size`` instants each, in which the robots hold the same things."""
    start = 0
    for k in range(1, len(holdings) + 1):
        whole = k == len(holdings) or k - start == size
        if whole or holdings[k].held is not holdings[start].held:
            yield slice(start, k)
            start = k


def _together(holdings: Sequence[Holding], frames: Frames, batch: Sequence[int]) -> Holding:
    """Several instants (T, B) at which the robots hold the same things."""
    places = dict(frames)
    for name in holdings[0].held:
        each = [holding.frames[name].expand(batch) for holding in holdings]
        places[name] = Frame.from_checked(
            torch.stack([pose.position for pose in each]),
            torch.stack([pose.orientation for pose in each]),
        )
    return replace(holdings[0], frames=places)
