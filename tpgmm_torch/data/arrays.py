"""How numbers that a user gives become tensors, and tensors arrays of numpy.

Everything given as numpy array, list or tensor is copied once, by default to float64; nothing
is modified in place.
"""

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch.exceptions import DataError
from tpgmm_torch.gaussians import FEW

Array = NDArray[np.float64]


def as_tensor(values: Any, name: str) -> Tensor:
    """Convert what a user gives into a finite floating tensor, without sharing memory.

    Parameters
    ----------
    values : array-like or Tensor
        Floating tensors keep dtype, device and gradient; everything else becomes float64.
    name : str
        How the error message calls it.

    Raises
    ------
    DataError
        If it is not numeric, or holds NaN or infinity (the message says where).
    """
    if isinstance(values, float) and math.isfinite(values):
        return torch.scalar_tensor(values, dtype=torch.float64)
    if isinstance(values, Tensor) and not values.is_complex():
        tensor = (values if values.is_floating_point() else values.double()).clone()
    else:
        try:
            array = np.asarray(values)
            if array.dtype.kind not in "biufO":
                raise TypeError(f"their type is {array.dtype}")
            tensor = torch.from_numpy(array.astype(np.float64))
        except (TypeError, ValueError, OverflowError, RuntimeError) as error:
            raise DataError(f"{name} must be an array of numbers: {error}") from error
    # every tick asks: a sum is quickly had, and is not finite if a number is not
    few = tensor.numel() <= FEW
    total = sum(tensor.reshape(-1).tolist()) if few else tensor.detach().sum().item()
    if not math.isfinite(total):
        _check_finite(tensor, name)
    return tensor


def _check_finite(tensor: Tensor, name: str) -> None:
    places = torch.nonzero(~torch.isfinite(tensor)).tolist()
    if places:
        raise DataError(
            f"{name} holds {len(places)} value(s) that are NaN or infinite, "
            f"the first is {tensor[tuple(places[0])].item()} at index {places[0]}"
        )


def as_array(tensor: Tensor) -> Array:
    """Convert a ``tensor``, without its gradient, to an array of float64."""
    array = tensor.numpy(force=True)
    return array if array.dtype == np.float64 else array.astype(np.float64)
