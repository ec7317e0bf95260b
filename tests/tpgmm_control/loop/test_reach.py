"""Fading of a gap."""

import torch

from tests.support.mixtures import assert_close
from tpgmm_control.loop.reach import fading_time


def test_a_small_gap_fades_sooner_than_a_large_one():
    gaps = torch.tensor([[0.0, 0.001], [0.0, -0.0075], [0.02, 0.5]], dtype=torch.float64)
    assert_close(fading_time(gaps, 0.5), [0.05, 0.25, 0.5])
