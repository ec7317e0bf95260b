"""One episode under control: time, frames, and the loop that finds references."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Self

from torch import Tensor

from tpgmm_torch import Frame, TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError, ShapeError

__all__ = ["ControlLoop"]


class ControlLoop:
    """A batch of robots that reproduce a skill in step, from its start to its end.

    Parameters
    ----------
    model : TaskParameterizedGMM
        Fitted.
    start : Tensor of shape (B, n_joints)
        Where the robots stand.
    frames : mapping of str to Frame
        Poses of shape (B,).
    period : float
        Seconds from one action to the next.
    largest_gap : float, optional
        How far a joint may stand from its first reference [rad].

    Attributes
    ----------
    frames : dict of str to Frame
        May be replaced as the objects move.
    """

    def __init__(
        self,
        model: TaskParameterizedGMM,
        start: Tensor,
        frames: Mapping[str, Frame],
        period: float,
        largest_gap: float | None = None,
    ) -> None:
        self._begin, self._end = float(model.time_[0]), float(model.time_[-1])
        self._joint_names, self._like = model.kinematics_.joint_names, model.time_
        self._loop = model.synthesis(start)
        self._period, self._tick, self._largest_gap = period, 0, largest_gap
        self.frames = frames

    def step(self, measured: Tensor | None = None) -> Tensor:
        """The references (B, n_joints) of the next action; after the end, the last ones.

        Parameters
        ----------
        measured : Tensor of shape (B, n_joints), optional
            Where the robots stand now, if that shall be q_{t-1}.

        Raises
        ------
        DataError
            If a robot stands too far from its first reference.
        ShapeError
            If the number of robots has changed.
        """
        start = self._loop.reference
        if measured is not None and measured.shape != start.shape:
            raise ShapeError(
                f"the episode began with {len(start)} robots, now there are {len(measured)}: "
                "call reset() between episodes"
            )
        now = self._begin + self._tick * self._period
        if now > self._end + 1e-6 * self._period:  # rounding must not cost the last step
            return start
        instant = self._like.new_tensor(min(now, self._end))
        estimate = self._loop.step(instant, self._frames, measured)
        if self._tick == 0 and self._largest_gap is not None:
            self._check_start(start, estimate.joints, self._largest_gap)
        self._tick += 1
        return self._loop.reference

    @property
    def frames(self) -> Mapping[str, Frame]:
        """Poses of shape (B,)."""
        return self._frames

    @frames.setter
    def frames(self, frames: Mapping[str, Frame]) -> None:
        self._frames = {name: frame.to(self._like) for name, frame in frames.items()}

    def copy(self) -> Self:
        """The same moment, to look ahead from."""
        other = copy.copy(self)
        other._loop = copy.copy(self._loop)  # whose tensors are replaced, never changed
        return other

    def _check_start(self, start: Tensor, wanted: Tensor, largest: float) -> None:
        gap = (wanted - start).abs()
        if not bool((gap > largest).any()):
            return
        row, joint = divmod(int(gap.argmax()), gap.shape[1])
        raise DataError(
            f"joint {self._joint_names[joint]!r} of robot {row} stands at "
            f"{float(start[row, joint]):.4g} rad, but the skill begins at "
            f"{float(wanted[row, joint]):.4g} rad: the order of the state's entries "
            "(--policy.state_names) or their unit (--policy.units) is wrong, or the robot has "
            f"to be brought to the start first. Further than {largest} rad is refused "
            "(--policy.largest_start_gap, null for any)"
        )
