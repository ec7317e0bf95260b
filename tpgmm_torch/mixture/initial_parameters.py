"""Initial parameters that the user gives, in place of what would be drawn."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from tpgmm_torch.data.arrays import as_tensor
from tpgmm_torch.em.parameters import Parameters
from tpgmm_torch.exceptions import DataError, ShapeError

__all__ = ["InitialParameters"]


@dataclass(frozen=True)
class InitialParameters:
    """Weights, means and covariances in units of the data; None is to be drawn.

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
        device: torch.device | str = "cpu",
    ) -> "InitialParameters":
        """Convert array-likes to float64 on a device, and check them.

        Raises
        ------
        ShapeError
            If one has another shape than the number of components and the blocks ask for.
        DataError
            If weights are negative or do not add up to 1, or a value is not finite.
        """

        def tensor(values: Any, shape: tuple[int, ...], name: str) -> Tensor:
            found = as_tensor(values, name).detach().to(device, torch.float64)
            if found.shape != shape:
                raise ShapeError(f"{name} must have shape {shape}, got {tuple(found.shape)}")
            return found

        def tensors(values: Any, n_axes: int, name: str) -> tuple[Tensor, ...] | None:
            if values is None:
                return None
            if len(values) != len(widths):
                raise ShapeError(
                    f"{name} must hold one array per block, {len(widths)}; "
                    f"it holds {len(values)}"
                )
            return tuple(
                tensor(value, (n_components, *[width] * n_axes), f"{name}[{block}]")
                for block, (value, width) in enumerate(zip(values, widths, strict=True))
            )

        if weights is not None:
            given = tensor(weights, (n_components,), "weights")
            if bool((given < 0).any()) or abs(float(given.sum()) - 1) > 1e-3:
                raise DataError(f"weights must be positive and add up to 1, got {weights!r}")
            weights = given / given.sum()
        return cls(weights, tensors(means, 1, "means"), tensors(covariances, 2, "covariances"))

    @property
    def complete(self) -> bool:
        """Whether nothing has to be drawn."""
        return not (self.weights is None or self.means is None or self.covariances is None)

    def over(self, drawn: Parameters | None) -> Parameters:
        """What is given in the place of what was drawn, which is None if all is given."""
        weights, means, covariances = self.weights, self.means, self.covariances
        if drawn is not None:
            weights = drawn.weights if weights is None else weights
            means = drawn.means if means is None else means
            covariances = drawn.covariances if covariances is None else covariances
        assert weights is not None
        assert means is not None
        assert covariances is not None
        return Parameters.from_covariances(weights, means, covariances)
