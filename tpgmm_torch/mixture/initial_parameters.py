"""Initial parameters that the user gives, in place of what would be drawn."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from tpgmm_torch.data.arrays import as_tensor
from tpgmm_torch.em.parameters import Parameters, Standardization
from tpgmm_torch.exceptions import DataError, ShapeError

__all__ = ["InitialParameters"]


@dataclass(frozen=True)
class InitialParameters:
    """Weights, means and covariances as far as they are given; None is to be drawn.

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

    @classmethod
    def checked(
        cls,
        weights: Any,
        means: Any,
        covariances: Any,
        n_components: int,
        widths: Sequence[int],
    ) -> "InitialParameters":
        """Convert array-likes to float64 and check them.

        Raises
        ------
        ShapeError
            If one has another shape than the number of components and the blocks ask for.
        DataError
            If weights are negative or do not add up to 1, or a value is not finite.
        """
        if weights is not None:
            given = _tensor(weights, (n_components,), "weights")
            if bool((given < 0).any()) or abs(float(given.sum()) - 1) > 1e-3:
                raise DataError(f"weights must be positive and add up to 1, got {weights!r}")
            weights = given / given.sum()
        vectors = [(n_components, width) for width in widths]
        matrices = [(n_components, width, width) for width in widths]
        return cls(
            weights,
            _tensors(means, vectors, "means"),
            _tensors(covariances, matrices, "covariances"),
        )

    @property
    def complete(self) -> bool:
        """Whether nothing has to be drawn."""
        return not (self.weights is None or self.means is None or self.covariances is None)

    def standardize(self, units: Standardization) -> "InitialParameters":
        """The same in standardised units, on their device."""
        means, covariances = self.means, self.covariances
        parts = list(zip(units.shifts, units.scales, strict=True))
        if means is not None:
            means = tuple(
                (mean.to(shift) - shift) / scale
                for mean, (shift, scale) in zip(means, parts, strict=True)
            )
        if covariances is not None:
            covariances = tuple(
                covariance.to(scale) / (scale[:, None] * scale)
                for covariance, (_, scale) in zip(covariances, parts, strict=True)
            )
        weights = None if self.weights is None else self.weights.to(units.shifts[0])
        return InitialParameters(weights, means, covariances)

    def over(self, drawn: Parameters | None) -> Parameters:
        """What is given in the place of what was drawn, which may be None if all is given."""
        if self.weights is not None and self.means is not None and self.covariances is not None:
            return Parameters.from_covariances(self.weights, self.means, self.covariances)
        assert drawn is not None
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
