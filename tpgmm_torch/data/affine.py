"""General task parameters A, b of Definition 1, where an object's pose would not say enough."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from tpgmm_torch.data.arrays import as_tensor
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError, ShapeError

__all__ = ["Affine"]


class Affine(Frame):
    """Task parameters A, b, where more than a pose lies between local and global coordinates.

    ``x = A X + b`` maps D local coordinates X into a space of n dimensions (Definition 1). It
    takes a frame's place in demonstrations and situations; of the operators,
    :class:`TaskParameters` reads it. A pose is the case ``A = R``, ``b = p``.

    Parameters
    ----------
    linear : array-like of shape (n, D) or (..., n, D)
        Matrix A, of full column rank, so that local coordinates are determined.
    offset : array-like of shape (n,) or (..., n)
        Vector b, in the units of the space that is mapped into.

    Raises
    ------
    ShapeError
        If shapes do not fit together, or D is more than n.
    DataError
        If a value is not finite, or columns of A depend on each other.

    Examples
    --------
    >>> shelf = Affine([[1.0, 0.0], [0.0, 0.5]], [0.2, 0.0])
    >>> shelf.local(torch.tensor([0.75, 0.25]).double()).tolist()
    [0.55, 0.5]
    """

    linear: Tensor
    offset: Tensor

    def __init__(self, linear: Any, offset: Any) -> None:
        linear = as_tensor(linear, "task parameter A")
        offset = as_tensor(offset, "task parameter b").to(linear)
        if linear.ndim < 2 or linear.shape[-1] > linear.shape[-2] or not linear.shape[-1]:
            raise ShapeError(
                "A has shape (..., n, D) with D from 1 to n, so that local coordinates are "
                f"determined; got {tuple(linear.shape)}"
            )
        if offset.shape != linear.shape[:-1]:
            raise ShapeError(
                f"with A of shape {tuple(linear.shape)}, b has shape "
                f"{tuple(linear.shape[:-1])}; got {tuple(offset.shape)}"
            )
        rank = torch.linalg.matrix_rank(linear.detach())
        if bool((rank < linear.shape[-1]).any()):
            raise DataError(
                f"A has rank {int(rank.min())} and {linear.shape[-1]} columns: some of the "
                "local coordinates move nothing, leave them out"
            )
        self._keep(linear, offset)

    def _keep(self, linear: Tensor, offset: Tensor) -> None:
        object.__setattr__(self, "linear", linear)
        object.__setattr__(self, "offset", offset)

    @property
    def position(self) -> Tensor:  # type: ignore[override]
        """There is none: whoever asks needs a pose."""
        raise DataError(
            "task parameters A, b are no pose: a Frame is needed here; of the operators, "
            "TaskParameters takes an Affine"
        )

    @property
    def orientation(self) -> Tensor:  # type: ignore[override]
        """There is none: whoever asks needs a pose."""
        return self.position

    @property
    def batch_shape(self) -> torch.Size:
        """Leading dimensions: () for one A and b, (T,) for one per time step."""
        return self.offset.shape[:-1]

    def local(self, point: Tensor) -> Tensor:
        """``A^+ (x - b)``: points (..., n) in local coordinates (..., D)."""
        return (self.inverse() @ (point - self.offset).unsqueeze(-1))[..., 0]

    def inverse(self) -> Tensor:
        """``A^+ = (A^T A)^-1 A^T``, shape (..., D, n); ``A^-1`` where A is square."""
        return torch.linalg.pinv(self.linear)

    def to(self, *args: Any, **kwargs: Any) -> Affine:
        """A copy on another device or of another dtype, like :meth:`torch.Tensor.to`."""
        return self._from(self.linear.to(*args, **kwargs), self.offset.to(*args, **kwargs))

    def expand(self, batch: Sequence[int]) -> Affine:
        """The same for all of a batch, without copying."""
        n, width = self.linear.shape[-2:]
        return self._from(self.linear.expand(*batch, n, width), self.offset.expand(*batch, n))

    def flatten(self) -> Affine:
        """The leading dimensions as one."""
        n, width = self.linear.shape[-2:]
        return self._from(self.linear.reshape(-1, n, width), self.offset.reshape(-1, n))

    @classmethod
    def _stacked(cls, frames: Sequence[Any]) -> Affine:
        shapes = {tuple(one.linear.shape[-2:]) for one in frames}
        if len(shapes) > 1:
            raise ShapeError(f"situations have A of different shapes: {sorted(shapes)}")
        return cls._from(
            torch.stack([one.linear for one in frames], dim=-3),
            torch.stack([one.offset for one in frames], dim=-2),
        )

    def between(self, lower: Tensor, fraction: Tensor) -> Affine:
        """Between time steps, by straight lines; see :meth:`Frame.between`."""
        lower = lower.to(self.offset.device)
        part = fraction.to(self.offset)[:, None]
        linear = torch.lerp(self.linear[lower], self.linear[lower + 1], part[..., None])
        return self._from(linear, torch.lerp(self.offset[lower], self.offset[lower + 1], part))

    def __getitem__(self, index: Any) -> Affine:
        """Select along the leading dimensions."""
        index = index if isinstance(index, tuple) else (index,)
        linear = self.linear[(*index, slice(None), slice(None))]
        return self._from(linear, self.offset[(*index, slice(None))])

    @classmethod
    def _from(cls, linear: Tensor, offset: Tensor) -> Affine:  # type: ignore[override]
        """Wrap tensors that were checked before."""
        affine = cls.__new__(cls)
        affine._keep(linear, offset)
        return affine

    def __repr__(self) -> str:
        n, width = self.linear.shape[-2:]
        return f"Affine(A: {n} x {width}, b: {n}, batch {tuple(self.batch_shape)})"
