"""Demonstrations of unequal duration brought onto one clock."""

from tpgmm_torch.alignment.base import Alignment
from tpgmm_torch.alignment.dynamic_time_warping import (
    DynamicTimeWarping,
    LinearTimeNormalization,
)

__all__ = ["Alignment", "DynamicTimeWarping", "LinearTimeNormalization"]
