"""Algorithm 1's synthesis loop: references over a whole time grid, many situations at once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import torch

from tpgmm_torch.control.controller import Controller
from tpgmm_torch.control.holding import Holding
from tpgmm_torch.data.demonstrations import Situation
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.data.trajectories import Candidate, Trajectory
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.regression.conditioning import Conditioning
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.regression import PART, Regression

__all__ = ["rollout"]


def rollout(
    regression: Regression,
    situations: Sequence[Situation],
    skill_time: torch.Tensor,
    blend: float,
    bounds: MotionBounds | None,
    candidates: bool,
    holds: Sequence[Hold] = (),
    via: Conditioning | None = None,
) -> list[Trajectory]:
    """Closed kinematic loop: each reference is the state q_{t-1} of the next step.

    Parameters
    ----------
    regression : Regression
        What is asked for the joints at each step.
    situations : sequence of Situation
        With time grids.
    skill_time : Tensor of shape (T,)
        From when to when the skill lasts [s]: what comes before or after is held.
    blend : float
        How long the difference between the start posture and the first reference fades [s].
    bounds : MotionBounds or None
        What references keep within.
    candidates : bool
        Whether to keep each operator's own estimate.
    holds : sequence of Hold, default=()
        From when to when links hold objects.
    via : Conditioning, optional
        Via-points through which they pass.

    Returns
    -------
    list of Trajectory
        In the order of the situations.
    """
    trajectories: dict[int, Trajectory] = {}
    for members in _groups(situations):
        batch = [situations[index] for index in members]
        together = _run_together(
            regression, batch, skill_time, blend, bounds, candidates, holds, via
        )
        trajectories.update(zip(members, together, strict=True))
    return [trajectories[index] for index in range(len(situations))]


def _groups(situations: Sequence[Situation]) -> list[list[int]]:
    """Indices of situations that share time grid and frames, and so run as one batch."""
    groups: dict[tuple[bytes, tuple[str, ...]], list[int]] = {}
    for index, situation in enumerate(situations):
        assert situation.time is not None
        key = (situation.time.cpu().numpy().tobytes(), tuple(sorted(situation.frames)))
        groups.setdefault(key, []).append(index)
    return list(groups.values())


def _run_together(
    regression: Regression,
    situations: Sequence[Situation],
    skill_time: torch.Tensor,
    blend: float,
    bounds: MotionBounds | None,
    candidates: bool,
    holds: Sequence[Hold],
    via: Conditioning | None,
) -> list[Trajectory]:
    """Trajectories of B situations of one time grid."""
    time = situations[0].time
    assert time is not None  # the estimator fills it in
    frames = {
        name: Frame.stack([situation.frames[name] for situation in situations])
        for name in situations[0].frames
    }
    start = torch.stack([situation.joints for situation in situations])
    alone = len(situations) == 1  # one robot is sooner computed without a batch
    poses = {name: frame[..., 0] if alone else frame for name, frame in frames.items()}
    moving = {name for name, frame in frames.items() if len(frame.batch_shape) == 2}
    held = time.clamp(skill_time[0], skill_time[-1])  # nothing is extrapolated
    grid = held.tolist()
    controller = Controller(
        regression,
        start[0] if alone else start,
        poses,
        begin=grid[0],
        end=grid[-1],
        blend=blend,
        holds=holds,
        bounds=bounds,
        via=via,
        at_rest=False,  # a situation does not say how its robot moves
    )
    references: list[torch.Tensor] = []
    estimates: list[Estimate] = []
    holdings: list[Holding] = []
    inferring = torch.is_inference_mode_enabled()
    for k, now in enumerate(grid):
        if k == 1:  # what the first step does not record, none does; to ask so takes a third
            inferring = inferring or not references[0].requires_grad
        if k and now == grid[k - 1]:
            estimates.append(estimates[-1])
            references.append(references[-1])
            holdings.append(holdings[-1])
            continue
        with torch.inference_mode(inferring):
            here = {name: pose[k] if name in moving else pose for name, pose in poses.items()}
            dt = now - grid[k - 1] if k else 0.0
            command = controller.step(dt, frames=here if moving else None)
            estimates.append(command.estimate)
            references.append(controller.reference)
            holdings.append(controller.holding)
    whole = Estimate(
        torch.stack([estimate.joints for estimate in estimates]).view(len(grid), *start.shape),
        torch.stack([estimate.covariance for estimate in estimates]).view(
            len(grid), *start.shape, -1
        ),
        torch.stack([estimate.activation for estimate in estimates]),
    )
    joints = torch.stack(references).view(len(grid), *start.shape)
    own: list[Candidate] = []
    if candidates:
        states = torch.cat((start[None], joints[:-1]))
        own = _candidates(regression, held, states, frames, holdings, whole)
    return [
        Trajectory(
            time,
            joints[:, row],
            whole.covariance[:, row],
            tuple(
                Candidate(one.mean[:, row], one.covariance[:, row], one.share[:, row])
                for one in own
            ),
            regression.kinematics.joint_names,
        )
        for row in range(len(situations))
    ]


def _candidates(
    regression: Regression,
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
        state = holding.state(regression.kinematics.state(joints[now]))
        at = time[now].unsqueeze(-1)
        parts.append(regression.candidates(at, state, holding.frames, estimate))
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
