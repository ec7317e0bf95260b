"""Stage *reach*: the posture that is wanted, faded in, or the nearest that can be had."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from tpgmm_control.motion.follower import Follower, Seconds
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import TPGMMError
from tpgmm_torch.motion.minimum_jerk import minimum_jerk
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.posture import PostureSearch
from tpgmm_torch.robots.kinematics import RobotState

#: How fast a gap fades in the mean [rad/s or m/s], where that takes less time than a blend;
#: the least share of the blend that it takes.
FADING, SHORTEST = 0.03, 0.1


@dataclass(frozen=True, eq=False)
class Fade:
    """The difference between where robots go on and the estimate, while it fades; immutable.

    Parameters
    ----------
    blend : float
        The longest that it takes [s]; 0 for none.
    gap : Tensor of shape (..., n_joints)
    passed, duration : Tensor of shape (...)
        Time since it began, negative before the gap is known, and how long it takes, at most
        as long as the gap is not known [s].
    over : bool
        Whether nothing is left, for all robots.
    """

    blend: float
    gap: Tensor
    passed: Tensor
    duration: Tensor
    over: bool

    @classmethod
    def start(cls, joints: Tensor, blend: float) -> Self:
        """For robots that begin in postures (..., n_joints)."""
        zero = torch.zeros_like(joints[..., 0])
        passed = zero - 1 if blend > 0 else zero + torch.inf
        return cls(blend, torch.zeros_like(joints), passed, zero + blend, blend <= 0)

    @property
    def done(self) -> Tensor:
        """Robots (...) of which nothing is left."""
        return self.passed >= self.duration

    def again(self, robots: Tensor, longest: float | Tensor | None = None) -> Self:
        """Some robots (...) go on from where their references are.

        Parameters
        ----------
        robots : Tensor of bool of shape (...)
        longest : float or Tensor of shape (...), optional
            The longest that it takes [s], by default ``blend``.
        """
        if longest is None and self.blend <= 0:
            return self
        longest = torch.as_tensor(self.blend if longest is None else longest).to(self.passed)
        return replace(
            self,
            passed=torch.where(robots, -1.0, self.passed),
            duration=torch.where(robots, longest, self.duration),
            over=False,
        )

    def advance(
        self, reference: Tensor, estimate: Tensor, dt: float | Tensor, first: bool
    ) -> tuple[Tensor | None, Self]:
        """Rest of the gap (..., n_joints), None if nothing is left, and the next tick's.

        Parameters
        ----------
        reference, estimate : Tensor of shape (..., n_joints)
            The last reference, and what it fades to.
        dt : float or Tensor of shape (...)
            Since the last tick [s].
        first : bool
            Whether robots begin the skill: that fades for the whole ``blend``.
        """
        if self.over:
            return None, self
        fresh, gap, duration = self.passed < 0, self.gap, self.duration
        if bool(fresh.any()):
            gap = torch.where(
                fresh.unsqueeze(-1), (reference - estimate).nan_to_num(0.0), self.gap
            )
            if not first:
                duration = torch.where(fresh, fading_time(gap, duration), duration)
        passed = torch.where(fresh, 0.0, self.passed + dt)
        left = 1 - minimum_jerk(passed / duration)
        over = not bool((left > 0).any())
        faded = replace(self, gap=gap, passed=passed, duration=duration, over=over)
        return left.unsqueeze(-1) * gap, faded


def nearest(
    search: PostureSearch,
    follower: Follower,
    wanted: Tensor,
    dt: Seconds,
    time: Tensor,
    state: Tensor,
    frames: Mapping[str, Frame],
    estimate: Estimate,
    bounds: tuple[Tensor, Tensor],
    state_at: Callable[[Tensor], RobotState] | None,
    raises: bool,
    binds: Tensor,
) -> tuple[Tensor, PostureSearch]:
    """The nearest postures where an estimate, one linearised step, leads too far.

    Parameters
    ----------
    search : PostureSearch
        Its state.
    follower : Follower
        At the last reference.
    wanted : Tensor of shape (..., n_joints)
        What cannot be followed within bounds by some robot.
    dt : float or array of shape (...)
        Of this tick [s].
    time, state, frames, estimate, bounds, state_at
        As for :meth:`PostureSearch.advance`.
    raises : bool
        Whether errors are raised; else the estimate stands.
    binds : Tensor of bool of shape (...)
        Robots whose estimate is at a limit of position: for speed, acceleration and jerk the
        follower answers.

    Raises
    ------
    TPGMMError
        As the skill does.
    """
    asked = binds & ~follower.fits(wanted, dt) & wanted.isfinite().all(-1)
    try:
        return search.advance(time, state, frames, estimate, bounds, asked, state_at)
    except TPGMMError:
        if raises:
            raise
        return estimate.joints, search


def fading_time(gap: Tensor, blend: float | Tensor) -> Tensor:
    """Compute the seconds (...) in which the gap of robots that go on fades.

    A robot that was held stands a few milliradians from its reference: where it presses on
    something, it should soon press again.

    Parameters
    ----------
    gap : Tensor
        From the reference, shape (..., n) [rad or m].
    blend : float or Tensor of shape (...)
        The longest that it takes [s]; a tenth of it is the shortest.
    """
    longest = torch.as_tensor(blend).to(gap)
    return (gap.abs().amax(-1) / FADING).clamp(SHORTEST * longest, longest)
