"""Where EM starts as far as the user says it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from tpgmm_torch.data.arrays import as_tensor
from tpgmm_torch.em.block_gaussians import Parameters, Standardization
from tpgmm_torch.exceptions import DataError, ShapeError

__all__ = ["GivenStart"]


@dataclass(frozen=True)
class GivenStart:
    """What is known of the start, in place of what would be drawn; None is unknown.

    Parameters
    ----------
    weights : Tensor of shape (K,) or None
    means : tuple of Tensor of shape (K, D_j) or None
        One per block.
    covariances : tuple of Tensor of shape (K, D_j, D_j) or None
        One per block.
    """

    weights: Tensor | None
    means: tuple[Tensor, ...] | None
    covariances: tuple[Tensor, ...] | None

    @property
    def complete(self) -> bool:
        """Whether nothing has to be drawn."""
        return not (self.weights is None or self.means is None or self.covariances is None)

    @classmethod
    def checked(
        cls,
        weights: Any,
        means: Any,
        covariances: Any,
        n_components: int,
        widths: Sequence[int],
    ) -> "GivenStart":
        """Convert array-likes to float64 and check them.

        Raises
        ------
        ShapeError
            If one has another shape than the number of components and the blocks ask for.
        DataError
            If weights are negative or do not add up to 1, or a value is not finite.
        """
        first = [(n_components, width) for width in widths]
        second = [(n_components, width, width) for width in widths]
        given = None if weights is None else _tensor(weights, (n_components,), "weights")
        if given is not None and (
            bool((given < 0).any()) or abs(float(given.sum()) - 1) > 1e-3
        ):
            raise DataError(f"weights must be positive and add up to 1, got {weights!r}")
        return cls(
            None if given is None else given / given.sum(),
            _tensors(means, first, "means"),
            _tensors(covariances, second, "covariances"),
        )

    def standardize(self, units: Standardization) -> "GivenStart":
        """The same in standardised units, on their device."""
        means, covariances = self.means, self.covariances
        parts = list(zip(units.shifts, units.scales, strict=True))
        if means is not None:
            means = tuple(
                (m.to(shift) - shift) / scale
                for m, (shift, scale) in zip(means, parts, strict=True)
            )
        if covariances is not None:
            covariances = tuple(
                c.to(scale) / (scale[:, None] * scale)
                for c, (_, scale) in zip(covariances, parts, strict=True)
            )
        weights = None if self.weights is None else self.weights.to(units.shifts[0])
        return GivenStart(weights, means, covariances)

    def over(self, drawn: Parameters) -> Parameters:
        """The drawn start with what is given in its place."""
        return Parameters.from_covariances(
            drawn.weights if self.weights is None else self.weights,
            drawn.means if self.means is None else self.means,
            drawn.covariances if self.covariances is None else self.covariances,
        )


def _tensor(values: Any, shape: tuple[int, ...], name: str) -> Tensor:
    tensor = as_tensor(values, name).detach().double()
    if tensor.shape != shape:
        raise ShapeError(f"{name} must have shape {shape}, got {tuple(tensor.shape)}")
    return tensor


def _tensors(
    values: Any, shapes: Sequence[tuple[int, ...]], name: str
) -> tuple[Tensor, ...] | None:
    if values is None:
        return None
    if len(values) != len(shapes):
        raise ShapeError(
            f"{name} must hold one array per block, {len(shapes)}; it holds {len(values)}"
        )
    return tuple(
        _tensor(value, shape, f"{name}[{block}]")
        for block, (value, shape) in enumerate(zip(values, shapes, strict=True))
    )
