"""Algorithm 1's synthesis loop: references over a whole time grid, many situations at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from tpgmm_torch.data.demonstrations import Situation
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.trajectories import Candidate, Trajectory
from tpgmm_torch.regression.regression import PART, Estimate, Regression

__all__ = ["Synthesis", "minimum_jerk", "rollout", "stacked"]


def minimum_jerk(fraction: Tensor) -> Tensor:
    """Minimum-jerk step from 0 at fraction 0 to 1 at fraction 1, flat at both ends.

    Parameters
    ----------
    fraction : Tensor
        Of any shape; beyond 0 and 1 the step is over.

    Examples
    --------
    >>> minimum_jerk(torch.tensor([-1.0, 0.5, 1.0])).tolist()
    [0.0, 0.5, 1.0]
    """
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
        frames = {name: stacked([s.frames[name] for s in batch]) for name in batch[0].frames}
        start = torch.stack([situation.joints for situation in batch])
        loop = Synthesis(regression, start, blend, keep_limits)
        references, estimates = [start], []
        for k, now in enumerate(time):
            estimates.append(loop.step(now, _at(frames, k)))
            references.append(loop.reference)
        joints = torch.stack(references)
        found = Estimate(
            torch.stack([estimate.joints for estimate in estimates]),
            torch.stack([estimate.covariance for estimate in estimates]),
            torch.stack([estimate.activation for estimate in estimates]),
        )
        alone = _alone(regression, time, joints[:-1], frames, found) if candidates else ()
        for row, index in enumerate(members):
            results[index] = Trajectory(
                time,
                joints[1:, row],
                found.covariance[:, row],
                tuple(Candidate(*(part[:, row] for part in parts)) for parts in alone),
                regression.kinematics.joint_names,
            )
    return [results[index] for index in range(len(situations))]


class Synthesis:
    """The loop of Algorithm 1's synthesis, one control tick at a time, for a batch of robots.

    Each reference is the state q_{t-1} of the next step, unless a measured one is given.

    Parameters
    ----------
    regression : Regression
    start : Tensor of shape (..., n_joints)
        The start postures.
    blend : float
        Seconds over which the difference between the start posture and the first reference
        fades out.
    keep_limits : bool
        Whether references respect the robot's limits of position and speed.

    Attributes
    ----------
    reference : Tensor of shape (..., n_joints)
        The last reference; the start posture before the first step.
    """

    def __init__(
        self, regression: Regression, start: Tensor, blend: float, keep_limits: bool
    ) -> None:
        self.regression, self.blend, self.keep_limits = regression, blend, keep_limits
        self.reference, self._gap = start, torch.zeros_like(start)
        self._first: Tensor | None = None
        self._last: Tensor | None = None

    def step(
        self,
        now: Tensor,
        frames: Mapping[str, Frame],
        measured: Tensor | None = None,
        candidates: bool = False,
    ) -> Estimate:
        """Find the next ``reference``; instants must increase.

        Parameters
        ----------
        now : Tensor
            Scalar [s].
        frames : mapping of str to Frame
            Object poses now.
        measured : Tensor of shape (..., n_joints), optional
            In place of the last reference q_{t-1}. Speed is that of the references anyhow.
        candidates : bool, default=False
            Whether to return each operator's own estimate too.

        Returns
        -------
        Estimate
            Without the fading gap, which only the reference has.
        """
        kinematics, last = self.regression.kinematics, self.reference
        gap = self._fading(now)
        bounds = None
        if self.keep_limits:
            low, high = kinematics.lower, kinematics.upper
            if self._last is not None:
                reach = kinematics.velocity * (now - self._last)
                # a start beyond a limit comes back as fast as the speed allows
                low = torch.minimum(torch.maximum(low, last - reach), last + reach)
                high = torch.maximum(torch.minimum(high, last + reach), last - reach)
            # they are those of the estimate, to which the fading gap comes on top
            bounds = (low, high) if gap is None else (low - gap, high - gap)
        joints = last if measured is None else measured
        if candidates:
            state = kinematics.state(joints)
            estimate = self.regression.step(now, state, frames, candidates, bounds)
        else:
            estimate = self.regression.tick(now, joints, frames, bounds)
        if self._last is None:
            self._first, self._gap = now, last - estimate.joints
            gap = self._fading(now)
        self._last = now
        joints = estimate.joints if gap is None else estimate.joints + gap
        self.reference = kinematics.retract(joints)
        return estimate

    def _fading(self, now: Tensor) -> Tensor | None:
        """What is left of the difference at the start; None once it is nothing."""
        if self._first is None or now - self._first >= self.blend:
            return None
        return (1 - minimum_jerk((now - self._first) / self.blend)) * self._gap


def _alone(
    regression: Regression,
    time: Tensor,
    joints: Tensor,
    frames: Mapping[str, Frame],
    found: Estimate,
) -> list[tuple[Tensor, ...]]:
    """Each operator's own estimates, (T, B, ...), of which no instant needs another's."""
    size = max(1, PART // joints.shape[1])
    activation = found.activation
    if activation.ndim == 2:  # the same for all robots
        activation = activation.unsqueeze(1)
    parts = []
    for k in range(0, len(time), size):
        now = slice(k, k + size)
        estimate = Estimate(found.joints[now], found.covariance[now], activation[now])
        state = regression.kinematics.state(joints[now])
        at = time[now].unsqueeze(-1)
        parts.append(regression.candidates(at, state, _at(frames, now), estimate))
    return [
        tuple(torch.cat(fields) for fields in zip(*map(_fields, over_time), strict=True))
        for over_time in zip(*parts, strict=True)
    ]


def _at(frames: Mapping[str, Frame], now: int | slice) -> dict[str, Frame]:
    """Frames of shape (B,) or, if they move, (T, B) at some instants."""
    return {name: f[now] if f.position.ndim == 3 else f for name, f in frames.items()}


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
