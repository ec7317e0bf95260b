"""How fast the machine multiplies matrices, and how much of that EM needs."""

from collections.abc import Sequence
from functools import cache
from statistics import median

import torch

from benchmarks.timing import seconds

__all__ = ["flops_of_iteration", "peak"]


@cache
def peak(dtype: torch.dtype, size: int = 1024, rounds: int = 7) -> float:
    """Measure operations per second of a product of square matrices, one thread."""
    one = torch.randn(size, size, dtype=dtype, generator=torch.Generator().manual_seed(0))
    result = torch.empty_like(one)
    taken = [seconds(lambda: torch.mm(one, one, out=result)) for _ in range(rounds)]
    return 2 * size**3 / median(taken)


def flops_of_iteration(n_points: int, n_components: int, blocks: Sequence[int]) -> float:
    """Count the operations of an EM iteration, E and M, over all points and components.

    With F = sum_j (D_j (D_j + 1) / 2 + D_j) + 1 packed features (squares and products, the
    coordinates, 1), E is a product (K, F) (F, N), M is one (K, N) (N, F): 4 F K N operations.
    Whatever leaves components out does less than that and may show more than the peak.
    """
    features = sum(width * (width + 1) // 2 + width for width in blocks) + 1
    return 4.0 * features * n_components * n_points
