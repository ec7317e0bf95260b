"""A running skill: Algorithm 1's synthesis, one control tick at a time."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, Self

import torch
from torch import Tensor

from tpgmm_torch.control.holding import Holding
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.exceptions import ShapeError
from tpgmm_torch.motion.minimum_jerk import minimum_jerk
from tpgmm_torch.regression.regression import Estimate, Regression
from tpgmm_torch.robots.kinematics import RobotState

__all__ = ["Controller"]


class Controller:
    """A batch of robots that reproduce a skill in step, from its beginning to its end.

    Each reference is the state q_{t-1} of the next step, unless a measured one is given. The
    difference between the start posture and the first estimate fades out by a minimum-jerk
    step. After the end the last reference is held.

    Parameters
    ----------
    regression : Regression
        What is asked for the joints at each step.
    joints : array-like of shape (..., n_joints)
        The start postures.
    frames : mapping of str to Frame, optional
        Poses of the objects until others are given, of shapes that broadcast with the batch.
    begin, end : float
        When the skill begins and ends [s].
    blend : float
        How long the difference at the start fades [s].
    keep_limits : bool
        Whether references respect the robot's limits of position and speed.
    holds : sequence of Hold, default=()
        From when to when links hold objects.

    Attributes
    ----------
    time : float
        Of the last step [s]; the beginning before the first one.
    reference : Tensor of shape (..., n_joints)
        The last reference; the start posture before the first step.
    holding : Holding
        What the robots hold, and where objects were last free.
    estimate : Estimate or None
        What the last reference was made from: it is without the fading difference.

    Raises
    ------
    ShapeError, DataError
        If the postures do not fit the robot.
    """

    def __init__(
        self,
        regression: Regression,
        joints: Any,
        frames: Mapping[str, Frame] | None = None,
        *,
        begin: float,
        end: float,
        blend: float = 0.0,
        keep_limits: bool = True,
        holds: Sequence[Hold] = (),
    ) -> None:
        self.time, self._begin, self._end = begin, begin, end
        self.reference = regression.kinematics.joint_tensor(joints)
        self.estimate: Estimate | None = None
        self._regression, self._blend, self._keep_limits = regression, blend, keep_limits
        self._like = regression.kinematics.lower
        self.holding = Holding.start(
            regression.kinematics, regression.operators, holds, self._converted(frames or {})
        )
        self._gap = torch.zeros_like(self.reference)

    @property
    def finished(self) -> bool:
        """Whether the end has been reached: further steps hold the last reference."""
        return self.estimate is not None and self.time >= self._end

    def step(
        self,
        dt: float,
        joints: Tensor | None = None,
        frames: Mapping[str, Frame] | None = None,
        told: Mapping[str, str | None] | None = None,
    ) -> Estimate:
        """Find the next ``reference``.

        Parameters
        ----------
        dt : float
            Seconds since the last step. The first step is at the beginning, whatever it is.
        joints : Tensor of shape (..., n_joints), optional
            Where the robots stand, in place of the last reference as q_{t-1}. Limits of speed
            are those of the references anyhow.
        frames : mapping of str to Frame, optional
            Poses of the objects from now on.
        told : mapping of str to str or None, optional
            Which link holds an object from now on, None if it is free from now on: in place
            of the holds that the skill began with.

        Returns
        -------
        Estimate
            What the reference was made from.

        Raises
        ------
        ShapeError
            If there are more or fewer robots than at the start.
        """
        last = self.reference
        if joints is not None and joints.shape != last.shape:
            raise ShapeError(
                f"the skill began with joints of shape {tuple(last.shape)}, now there are "
                f"{tuple(joints.shape)}: begin it anew for other robots"
            )
        time = self.time if self.estimate is None else self.time + dt
        if self.estimate is not None and time > self._end + 1e-6 * dt:  # but for rounding
            self.time = self._end
            return self.estimate
        time = min(time, self._end)
        gap = self._fading(time)
        bounds = self._bounds(dt, gap) if self._keep_limits else None
        now, joints = self._like.new_tensor(time), last if joints is None else joints
        seen = None if frames is None else self._converted(frames)
        self.holding = self.holding.advance(time, joints, seen, told)
        at: Tensor | RobotState = joints
        if self.holding.carries:
            at = self.holding.state(self._regression.kinematics.state(joints))
        estimate = self._regression.tick(now, at, self.holding.frames, bounds)
        if self.estimate is None:
            self._gap = last - estimate.joints
            gap = self._fading(time)
        references = estimate.joints if gap is None else estimate.joints + gap
        self.reference = self._regression.kinematics.retract(references)
        self.time, self.estimate = time, estimate
        return estimate

    def copy(self) -> Self:
        """The same moment, to look ahead from."""
        return copy.copy(self)  # its tensors are replaced, never changed

    def _fading(self, time: float) -> Tensor | None:
        """What is left of the difference at the start; None once it is nothing."""
        if self._blend <= 0 or time - self._begin >= self._blend:
            return None
        passed = self._like.new_tensor((time - self._begin) / self._blend)
        return (1 - minimum_jerk(passed)) * self._gap

    def _bounds(self, dt: float, gap: Tensor | None) -> tuple[Tensor, Tensor]:
        """Limits of position, and of speed since the last reference, on the estimate."""
        kinematics = self._regression.kinematics
        low, high = kinematics.lower, kinematics.upper
        if self.estimate is not None:
            # a start beyond a limit comes back as fast as the speed allows
            reach = kinematics.velocity * dt
            slowest, fastest = self.reference - reach, self.reference + reach
            low, high = low.clamp(slowest, fastest), high.clamp(slowest, fastest)
        # the fading difference comes on top of the estimate
        return (low, high) if gap is None else (low - gap, high - gap)

    def _converted(self, frames: Mapping[str, Frame]) -> dict[str, Frame]:
        return {name: frame.to(self._like) for name, frame in frames.items()}
