"""Poses of objects: in metres, with unit quaternions (w, x, y, z)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import as_tensor
from tpgmm_torch.exceptions import DataError, ShapeError

__all__ = ["Frame"]

#: Turning a thing by one radian counts as moving it by this distance, half its size [m].
LEVER = 0.2
#: Motion below this is the noise of trackers, of things that stand still [m]; for turns
#: divided by the lever [rad].
STILL = 0.02


@dataclass(frozen=True, eq=False)
class Frame:
    """Pose of an object: the task parameters ``p_t``, ``eps_t`` of the paper's section II-A.

    Parameters
    ----------
    position : array-like of shape (3,) or (..., 3)
        Origin in the base frame [m].
    orientation : array-like of shape (4,) or (..., 4), optional
        Unit quaternion (w, x, y, z); the default is no rotation.

    Raises
    ------
    ShapeError
        If the last dimensions are not 3 and 4 or the leading ones do not match.
    DataError
        If a value is not finite or a quaternion is not of unit norm.

    Examples
    --------
    >>> import torch
    >>> bottle = Frame([0.5, 0.0, 0.0])
    >>> bottle.inverse_transform(torch.tensor([0.75, 0.0, 0.0])).tolist()
    [0.25, 0.0, 0.0]
    >>> Frame([0, 0, 0], [0, 0, 0, 2])
    Traceback (most recent call last):
    tpgmm_torch.exceptions.DataError: a frame's orientation must be a unit quaternion ...
    """

    position: Tensor
    orientation: Tensor
    #: ``"LINK@EVENT"`` where it is a link's own pose at an event, and not an object's.
    at: str | None = field(default=None, init=False, repr=False)

    def __init__(self, position: Any, orientation: Any = None) -> None:
        position = as_tensor(position, "the frame's position")
        if position.ndim == 0 or position.shape[-1] != 3:
            raise ShapeError(
                f"a frame's position has shape (..., 3), got {tuple(position.shape)}"
            )
        if orientation is None:
            unit = quaternions.identity(position.dtype, position.device)
            orientation = unit.expand(*position.shape[:-1], 4)
        else:
            orientation = as_tensor(orientation, "the frame's orientation").to(position)
        expected = (*position.shape[:-1], 4)
        if orientation.shape != expected:
            raise ShapeError(
                f"a frame with position of shape {tuple(position.shape)} needs an orientation "
                f"of shape {expected}, got {tuple(orientation.shape)}"
            )
        norm = torch.linalg.vector_norm(orientation, dim=-1, keepdim=True)
        excess = norm.detach() - 1
        if bool((excess.abs() > 2 * quaternions.DIGITS).any()):
            raise DataError(
                "a frame's orientation must be a unit quaternion (w, x, y, z): a norm is off "
                f"by {excess.abs().max():.3g}, the tolerance is {2 * quaternions.DIGITS:g}"
            )
        # what is of unit norm but for rounding stays as it is, bit for bit
        rounded = excess.abs() <= 4 * torch.finfo(norm.dtype).eps
        norm = norm - torch.where(rounded, excess, 0.0)
        vars(self).update(position=position, orientation=orientation / norm)

    @property
    def batch_shape(self) -> torch.Size:
        """Leading dimensions: () for one pose, (T,) for a pose per time step."""
        return self.position.shape[:-1]

    @property
    def is_single(self) -> bool:
        """True for one pose on the processor of which nothing is differentiated."""
        position, turn = self.position, self.orientation
        plain = position.is_cpu and not (position.requires_grad or turn.requires_grad)
        return plain and position.ndim == 1 and turn.ndim == 1

    def to(self, *args: Any, **kwargs: Any) -> Frame:
        """Copy to another device or dtype, like :meth:`torch.Tensor.to`."""
        parts = (part.to(*args, **kwargs) for part in (self.position, self.orientation))
        moved = self.from_checked(*parts)
        vars(moved).update(at=self.at)
        return moved

    def expand(self, batch: Sequence[int]) -> Frame:
        """Expand one pose to a batch, without copying."""
        return self.from_checked(
            self.position.expand(*batch, 3), self.orientation.expand(*batch, 4)
        )

    def flatten(self) -> Frame:
        """Flatten the leading dimensions into one."""
        return self.from_checked(self.position.reshape(-1, 3), self.orientation.reshape(-1, 4))

    @classmethod
    def stack(cls, frames: Sequence[Frame]) -> Frame:
        """Stack poses of B situations: shape (B,), or (T, B) if any of them moves.

        Parameters
        ----------
        frames : sequence of Frame
            Of shape () or (T,).
        """
        steps = [frame.batch_shape for frame in frames if frame.batch_shape]
        batched = [frame.expand(steps[0] if steps else ()) for frame in frames]
        return cls.from_checked(
            torch.stack([frame.position for frame in batched], dim=-2),
            torch.stack([frame.orientation for frame in batched], dim=-2),
        )

    def between(self, lower: Tensor, fraction: Tensor) -> Frame:
        """Interpolate between time steps: positions linearly, orientations by slerp.

        Parameters
        ----------
        lower : Tensor of int, of shape (N,)
            Time steps, not the last.
        fraction : Tensor of shape (N,)
            Of the way to the next one, in [0, 1].
        """
        lower = lower.to(self.position.device)
        fraction = fraction.to(self.position)
        position, turn = self.position, self.orientation
        return self.from_checked(
            torch.lerp(position[lower], position[lower + 1], fraction[:, None]),
            quaternions.slerp(turn[lower], turn[lower + 1], fraction),
        )

    def resample(self, recorded: Tensor, wanted: Tensor) -> Frame:
        """Resample a moving frame; before the first and after the last time it stands still.

        Parameters
        ----------
        recorded : Tensor of shape (T,)
            When its poses were recorded [s].
        wanted : Tensor of shape (N,)
            Times [s].
        """
        if not self.batch_shape or torch.equal(recorded, wanted):
            return self
        if len(recorded) == 1:
            return self[torch.zeros_like(wanted, dtype=torch.long)]
        right = torch.searchsorted(recorded, wanted).clamp(1, len(recorded) - 1)
        start, end = recorded[right - 1], recorded[right]
        return self.between(right - 1, ((wanted - start) / (end - start)).clamp(0, 1))

    def __getitem__(self, index: Any) -> Frame:
        """Select along the leading dimensions."""
        index = (*index, slice(None)) if isinstance(index, tuple) else (index, slice(None))
        return self.from_checked(self.position[index], self.orientation[index])

    def inverse_transform(self, point: Tensor) -> Tensor:
        """Compute ``R^T (x - p)``: points (..., 3) of the base frame, seen from this frame."""
        turn = quaternions.conjugate(self.orientation)
        return quaternions.rotate(turn, point - self.position)

    def transform(self, point: Tensor) -> Tensor:
        """Compute ``R x + p``: points (..., 3) of this frame, seen from the base frame."""
        return quaternions.rotate(self.orientation, point) + self.position

    def compose(self, inner: Frame) -> Frame:
        """Compute the pose, in the base frame, of what has the pose ``inner`` in this frame."""
        turned = quaternions.product(self.orientation, inner.orientation)
        return self.from_checked(self.transform(inner.position), turned)

    def change(self, other: Frame, distance: float, angle: float) -> Tensor:
        """Measure the change to another pose, in units of a distance and an angle: (...).

        Parameters
        ----------
        other : Frame
            Of a shape that broadcasts with this one's.
        distance, angle : float
            The units [m], [rad]; the larger of both changes counts.
        """
        if self.is_single and other.is_single:  # of few numbers Python is faster
            there, turn = self.position.tolist(), self.orientation.tolist()
            cosine = abs(math.sumprod(turn, other.orientation.tolist()))
            moved = math.dist(there, other.position.tolist()) / distance
            most = max(moved, 2 * math.acos(min(cosine, 1.0)) / angle)
            return torch.tensor(most, dtype=self.position.dtype)
        moved = torch.linalg.vector_norm(other.position - self.position, dim=-1)
        inner = (self.orientation * other.orientation).sum(-1).abs().clamp(max=1)
        return torch.maximum(moved / distance, 2 * torch.acos(inner) / angle)

    def seen_from(self, other: Frame) -> Frame:
        """Express the pose in another frame: ``other.compose(pose.seen_from(other))`` is it."""
        turn = quaternions.conjugate(other.orientation)
        return self.from_checked(
            other.inverse_transform(self.position), quaternions.product(turn, self.orientation)
        )

    @classmethod
    def from_checked(cls, position: Tensor, orientation: Tensor) -> Frame:
        """Wrap tensors that are known to fit, without the checks of the constructor.

        Parameters
        ----------
        position : Tensor of shape (..., 3)
            [m].
        orientation : Tensor of shape (..., 4)
            Unit quaternions (w, x, y, z).
        """
        frame = cls.__new__(cls)
        vars(frame).update(position=position, orientation=orientation)
        return frame


#: Poses of objects by name, one for each or one for each time step.
Frames = Mapping[str, Frame]
