"""Admittance: references of position-controlled robots that move by the error of the force.

Along each axis e of a :class:`~tpgmm_torch.operators.Wrench`, with the expected force f*, its
share of contact k, and the measured force f (0 without contact), the offset d of a link follows

    d' = clip((f* - f) / B, -v, v) - (1 - k) d / T,   -depth <= d <= depth:

admittance control with damping B alone (Seraji, "Adaptive Admittance Control", ICRA 1994),
which lets go where no contact is expected. The link is taken to be ``-d e`` from where it is:
operators of this link then agree on moving it by ``d e``, and others do not change.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import torch
from torch import Tensor

from tpgmm_control.sensing.states import check_positive
from tpgmm_control.sensing.wrenches import Wrenches
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.operators.wrench import ExpectedForce, Wrench
from tpgmm_torch.robots.kinematics import RobotState

__all__ = ["Admittance"]


@dataclass(frozen=True)
class Admittance:
    """How far and how fast references move by the error of a force.

    Parameters
    ----------
    damping : float, default=400.0
        Force per speed, B [N s/m]. The loop is stable while the stiffness of surface, tool and
        drives in series, times the delay of the loop, is well below it: at 7 N/mm and 20 ms
        that is 140 N s/m.
    speed : float, default=0.1
        The most by which an offset changes, v [m/s].
    depth : float, default=0.02
        The largest offset [m]: how wrong the place of a surface may be.
    release : float, default=0.5
        Time constant T in which offsets are given up where no contact is expected [s].

    Raises
    ------
    DataError
        If one of them is not above 0.
    """

    damping: float = 400.0
    speed: float = 0.1
    depth: float = 0.02
    release: float = 0.5

    def __post_init__(self) -> None:
        check_positive(self)


@dataclass(frozen=True, eq=False)
class Offsets:
    """Offsets of links along the axes of their forces; immutable.

    Parameters
    ----------
    settings : Admittance
    values : mapping of Wrench to Tensor of shape (..., n_axes)
        In the directions of positive forces [m].
    """

    settings: Admittance
    values: Mapping[Wrench, Tensor] = field(default_factory=dict)

    def advance(
        self,
        expected: Sequence[ExpectedForce],
        wrenches: Wrenches,
        state: RobotState | None,
        frames: Mapping[str, Frame],
        dt: Tensor,
    ) -> Self:
        """The offsets after a tick.

        Parameters
        ----------
        expected : sequence of ExpectedForce
            Of this tick. Operators that are no longer among them are given up.
        wrenches : Wrenches
            Robots without a fresh one keep their offsets.
        state : RobotState or None
            Of the robots, without offsets, where axes are those of links.
        frames : mapping of str to Frame
        dt : Tensor of shape (...)
            Since the last tick [s]; 0 for robots that are held.
        """
        asked, values, limits = {one.operator: one for one in expected}, {}, self.settings
        for operator in dict.fromkeys((*self.values, *asked)):
            reading = wrenches.readings.get(operator.link)
            if reading is None:
                continue
            force, touches, fresh = (
                torch.from_numpy(array).to(dt.device)
                for array in (reading.value[..., :3], reading.touches, reading.fresh)
            )
            felt = operator.components(force.to(dt), state, frames)
            error, share = -torch.where(touches.unsqueeze(-1), felt, 0.0), 0 * felt[..., :1]
            if operator in asked:
                error = error + asked[operator].force
                share = asked[operator].share.unsqueeze(-1)
            passed = torch.where(fresh, dt, 0.0).unsqueeze(-1)
            before = self.values.get(operator, torch.zeros_like(felt))
            # exact for the release, within speed and depth
            rate = (error / limits.damping).clamp(-limits.speed, limits.speed)
            left = torch.exp(-(1 - share) * passed / limits.release)
            moved = before * left + rate * passed
            values[operator] = moved.clamp(-limits.depth, limits.depth)
        return replace(self, values=values)

    @property
    def active(self) -> bool:
        """Whether some offset is not zero."""
        return any(bool(value.any()) for value in self.values.values())

    def displaced(self, state: RobotState, frames: Mapping[str, Frame]) -> RobotState:
        """The state as operators of poses shall see it.

        Parameters
        ----------
        state : RobotState
            Of the robots alone.
        frames : mapping of str to Frame
        """
        for operator, value in self.values.items():
            axes = operator.directions(state, frames)
            state = state.displace_link(
                operator.link, -(value.unsqueeze(-2) @ axes).squeeze(-2)
            )
        return state
