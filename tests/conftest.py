"""What holds for all tests: the same examples in every run, and one thread per worker."""

import numpy as np
import pytest
import torch
from hypothesis import settings

settings.register_profile("reproducible", deadline=None, derandomize=True)
settings.load_profile("reproducible")

torch.set_num_threads(1)


@pytest.fixture
def clusters():
    """Three anisotropic clusters, unequal columns, (300, 5)."""
    rng = np.random.RandomState(0)
    parts = [rng.randn(100, 5) @ rng.randn(5, 5) + 4 * rng.randn(5) for _ in range(3)]
    return np.concatenate(parts) * [1.0, 10.0, 0.1, 1.0, 3.0] + [0.0, 100.0, 0.0, -5.0, 0.0]
