"""The minimum-jerk step: its ends, its symmetry, its rest."""

import numpy as np
import torch

from tests.support.mixtures import assert_close
from tpgmm_torch.motion.minimum_jerk import minimum_jerk


def test_minimum_jerk_goes_from_zero_to_one():
    ends = torch.tensor([-1.0, 0.0, 0.5, 1.0, 2.0], dtype=torch.float64)
    assert minimum_jerk(ends).tolist() == [0.0, 0.0, 0.5, 1.0, 1.0]


def test_minimum_jerk_is_at_rest_at_both_ends():
    u = torch.tensor([0.0, 1.0], dtype=torch.float64, requires_grad=True)
    value = minimum_jerk(u)
    for _ in range(2):
        [value] = torch.autograd.grad(value.sum(), u, create_graph=True)
        assert_close(value.detach(), np.zeros(2))
