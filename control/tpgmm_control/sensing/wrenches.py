"""Measured wrenches of links: filtered, whether there is contact, and how old they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from torch import Tensor

from tpgmm_control.sensing.trust import Floats, Mask
from tpgmm_torch import gaussians
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.exceptions import ShapeError, UnknownNameError
from tpgmm_torch.operators import Wrench
from tpgmm_torch.robots.kinematics import RobotState

#: Time constant of the filter of wrenches [s]: above the period of their noise, below that of
#: an arm that bounces.
SMOOTHING_TIME = 0.01
#: For so long a force is on the other side of a threshold before contact begins or ends [s].
DWELL_TIME = 0.02
#: Share of the threshold of contact below which it ends.
RELEASE = 0.5


@dataclass(frozen=True, eq=False)
class WrenchReading:
    """The wrench of one link, of a batch of robots; immutable.

    Parameters
    ----------
    threshold : float
        Size of the force from which on there is contact [N]; it ends at half of it.
    value : array of shape (..., 6)
        Filtered forces [N] and moments [N m].
    contact : bool array of shape (...)
        Whether there is contact.
    changing : array of shape (...)
        For how long the force has been on the other side [s].
    age : array of shape (...)
        Time since the last finite measurement [s]; infinite before the first.
    """

    threshold: float
    value: Array
    contact: Mask
    changing: Floats
    age: Floats

    @classmethod
    def first(cls, threshold: float, batch: Sequence[int]) -> Self:
        """Before anything was measured.

        Parameters
        ----------
        threshold : float
        batch : sequence of int
        """
        zero: Array = np.zeros(tuple(batch))
        return cls(threshold, np.zeros((*batch, 6)), zero > 0, zero, zero + np.inf)

    @property
    def touches(self) -> Mask:
        """Contact, and what may become one: for those who must not wait."""
        return np.asarray(self.contact | (self.changing > 0))

    @property
    def fresh(self) -> Mask:
        """Whether it was measured at this tick."""
        return np.asarray(self.age == 0)

    def update(self, measured: Array, dt: float | Array) -> Self:
        """The reading after a tick.

        Parameters
        ----------
        measured : array of shape (..., 6)
            Not finite for robots without a measurement, which keep what they had.
        dt : float or array of shape (...)
            Since the last tick [s].
        """
        finite = np.asarray(np.isfinite(measured).all(-1))
        share = np.where(np.isinf(self.age), 1.0, 1 - np.exp(-dt / SMOOTHING_TIME))
        step = np.where(finite[..., None], measured - self.value, 0.0)
        value = self.value + share[..., None] * step
        size = np.linalg.norm(value[..., :3], axis=-1)
        other = np.where(self.contact, size < RELEASE * self.threshold, size >= self.threshold)
        changing = np.where(finite, np.where(other, self.changing + dt, 0.0), self.changing)
        turns = changing >= DWELL_TIME
        return replace(
            self,
            value=value,
            contact=np.asarray(self.contact ^ turns),
            changing=np.where(turns, 0.0, changing),
            age=np.where(finite, 0.0, self.age + dt),
        )


@dataclass(frozen=True, eq=False)
class Wrenches:
    """The wrenches of the links of a batch of robots; immutable.

    Parameters
    ----------
    links : tuple of str
        Of the robot.
    batch : tuple of int
        Shape of the batch.
    thresholds : mapping of str to float
        Of contact by link [N], where it is not :class:`Wrench`'s default.
    readings : mapping of str to WrenchReading
        Of links whose wrench was given once.
    """

    links: tuple[str, ...]
    batch: tuple[int, ...]
    thresholds: Mapping[str, float] = field(default_factory=dict)
    readings: Mapping[str, WrenchReading] = field(default_factory=dict)

    def update(self, dt: float | Array, wrenches: Mapping[str, Any] | None) -> Self:
        """The readings after a tick.

        Parameters
        ----------
        dt : float or array of shape (...)
            Since the last tick [s].
        wrenches : mapping of str to array-like of shape (..., 6), optional
            By link; a link that is missing, None, or not finite keeps its last wrench.

        Raises
        ------
        UnknownNameError, ShapeError
            If the robot has no such link, or an array has another shape.
        """
        given = dict(wrenches or {})
        if not given and not self.readings:
            return self
        readings = dict(self.readings)
        for link in dict.fromkeys((*readings, *given)):
            if link not in self.links:
                raise UnknownNameError("link", link, "the robot", self.links)
            known = readings.get(link) or WrenchReading.first(
                self.thresholds.get(link, Wrench.contact), self.batch
            )
            readings[link] = known.update(self._array(link, given.get(link)), dt)
        return replace(self, readings=readings)

    def late(self, timeout: float) -> dict[str, Floats]:
        """Why robots stand, in words: infinite for those whose wrench is missing too long.

        Parameters
        ----------
        timeout : float
            For so long the last one is used [s].
        """
        return {
            f"the wrench of {link!r} is missing or not finite": np.where(robots, np.inf, 0.0)
            for link, reading in self.readings.items()
            if (robots := (reading.age > timeout) & np.isfinite(reading.age)).any()
        }

    def _array(self, link: str, values: Any) -> Array:
        given = values.numpy(force=True) if isinstance(values, Tensor) else values
        array = np.asarray(np.full(6, np.nan) if given is None else given, np.float64)
        if array.shape[-1:] != (6,) or array.shape[:-1] not in ((), self.batch):
            raise ShapeError(
                f"the wrench of {link!r} has shape {(*self.batch, 6)}, forces [N] before "
                f"moments [N m], got {array.shape}"
            )
        return np.broadcast_to(array, (*self.batch, 6))


def wrench_of_efforts(state: RobotState, link: str, efforts: Tensor) -> Tensor:
    """The wrench that a link exerts by its drives' efforts, in place of a sensor.

    The least-squares solution of ``J^T w = tau``. Static friction of the drives appears in it,
    divided by the arms of the levers: 0.5 N m half a metre away is 1 N.

    Parameters
    ----------
    state : RobotState
    link : str
    efforts : Tensor of shape (..., n_joints)
        Torques [N m] and forces [N] of the drives, without those that carry the robot and its
        tool, and accelerate them.

    Returns
    -------
    Tensor of shape (..., 6)

    Examples
    --------
    >>> import torch
    >>> joints, turn = torch.zeros(1), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    >>> slide = torch.tensor([[[0.0], [0.0], [1.0], [0.0], [0.0], [0.0]]])
    >>> state = RobotState(joints, ("tool",), torch.zeros(1, 3), turn, slide)
    >>> wrench_of_efforts(state, "tool", torch.tensor([-8.0])).tolist()
    [0.0, 0.0, -8.0, 0.0, 0.0, 0.0]
    """
    inverse = gaussians.pseudo_inverse(state.jacobian(link))
    return (inverse.mT @ efforts.unsqueeze(-1)).squeeze(-1)
