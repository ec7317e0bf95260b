"""Demonstrations of unequal duration brought onto one clock.

Transformers in scikit-learn's sense on lists of demonstrations. What they return can be
fitted as it is; without alignment, demonstrations are fitted on their own clocks.
"""

from tpgmm_torch.alignment.base import Alignment
from tpgmm_torch.alignment.dynamic_time_warping import DynamicTimeWarping
from tpgmm_torch.alignment.piecewise_linear import EventAlignment, LinearTimeNormalization

__all__ = ["Alignment", "DynamicTimeWarping", "EventAlignment", "LinearTimeNormalization"]
