"""Algorithm 1's synthesis loop: references over a whole time grid, many situations at once."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from tpgmm_torch.demonstrations import Frame, Situation
from tpgmm_torch.regression import Estimate, Regression
from tpgmm_torch.trajectories import Candidate, Trajectory

__all__ = ["minimum_jerk", "rollout", "stacked"]


def minimum_jerk(fraction: Tensor) -> Tensor:
    """Minimum-jerk step from 0 at fraction 0 to 1 at fraction 1, flat at both ends."""
    u = fraction.clamp(0, 1)
    return u**3 * (10 - 15 * u + 6 * u**2)


def rollout(
    regression: Regression,
    situations: Sequence[Situation],
    blend: float,
    keep_limits: bool,
    candidates: bool,
) -> list[Trajectory]:
    """Closed kinematic loop: each reference is the state q_{t-1} of the next step.

    Parameters
    ----------
    regression : Regression
    situations : sequence of Situation
        With time grids.
    blend : float
        Seconds over which the difference between the start posture and the first reference
        fades out.
    keep_limits : bool
        Whether references respect the robot's limits of position and speed.
    candidates : bool
        Whether to keep each operator's own estimate.

    Returns
    -------
    list of Trajectory
        In the order of the situations.
    """
    results: dict[int, Trajectory] = {}
    for members in _groups(situations):
        batch = [situations[index] for index in members]
        time = batch[0].time
        assert time is not None  # the estimator fills it in
        references, estimates = _loop(regression, batch, time, blend, keep_limits, candidates)
        covariance = torch.stack([estimate.covariance for estimate in estimates])
        alone = [
            tuple(torch.stack(parts) for parts in zip(*map(_fields, over_time), strict=True))
            for over_time in zip(*(estimate.candidates for estimate in estimates), strict=True)
        ]
        for row, index in enumerate(members):
            results[index] = Trajectory(
                time,
                references[:, row],
                covariance[:, row],
                tuple(Candidate(*(part[:, row] for part in parts)) for parts in alone),
                regression.kinematics.joint_names,
            )
    return [results[index] for index in range(len(situations))]


def _loop(
    regression: Regression,
    batch: Sequence[Situation],
    time: Tensor,
    blend: float,
    keep_limits: bool,
    candidates: bool,
) -> tuple[Tensor, list[Estimate]]:
    kinematics = regression.kinematics
    frames = {name: stacked([s.frames[name] for s in batch]) for name in batch[0].frames}
    start = torch.stack([situation.joints for situation in batch])
    reference, gap = start, torch.zeros_like(start)
    fade = torch.zeros_like(time) if blend == 0 else 1 - minimum_jerk((time - time[0]) / blend)
    references, estimates = [], []
    for k, now in enumerate(time):
        poses = {name: f[k] if f.position.ndim == 3 else f for name, f in frames.items()}
        bounds = None
        if keep_limits:
            reach = kinematics.velocity * (now - time[k - 1]) if k else torch.inf
            low, high = reference - reach, reference + reach
            # a start beyond a limit comes back as fast as the speed allows; the bounds are
            # those of the estimate, to which the fading gap comes on top
            bounds = (
                torch.minimum(torch.maximum(kinematics.lower, low), high) - fade[k] * gap,
                torch.maximum(torch.minimum(kinematics.upper, high), low) - fade[k] * gap,
            )
        estimate = regression.step(now, kinematics.state(reference), poses, candidates, bounds)
        if k == 0:
            gap = start - estimate.joints
        reference = kinematics.retract(estimate.joints + fade[k] * gap)
        references.append(reference)
        estimates.append(estimate)
    return torch.stack(references), estimates


def _groups(situations: Sequence[Situation]) -> list[list[int]]:
    """Indices of situations that share time grid and frames, and so run as one batch."""
    groups: dict[tuple[bytes, tuple[str, ...]], list[int]] = {}
    for index, situation in enumerate(situations):
        assert situation.time is not None
        key = (situation.time.cpu().numpy().tobytes(), tuple(sorted(situation.frames)))
        groups.setdefault(key, []).append(index)
    return list(groups.values())


def stacked(frames: Sequence[Frame]) -> Frame:
    """One frame of shape (B,), or (T, B) if any of the frames moves.

    Parameters
    ----------
    frames : sequence of Frame
        B frames of shape () or (T,).
    """
    steps = [len(frame.position) for frame in frames if frame.batch_shape]
    shape = (steps[0],) if steps else ()
    return Frame(
        torch.stack([f.position.expand(*shape, 3) for f in frames], dim=-2),
        torch.stack([f.orientation.expand(*shape, 4) for f in frames], dim=-2),
    )


def _fields(candidate: Candidate) -> tuple[Tensor, Tensor, Tensor]:
    return candidate.mean, candidate.covariance, candidate.share
