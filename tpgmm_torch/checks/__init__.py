"""Checks of demonstrations and situations: units, limits, clocks, distance from those learned.

What cannot be is an error, what is unlikely one warning that names it, with a number and a
remedy. ``tpgmm_datasets.check`` looks at recordings in much more detail.
"""

from tpgmm_torch.checks.report import Finding, Report
from tpgmm_torch.checks.summary import FrameSummary, Region, TrainingSummary
from tpgmm_torch.checks.training import EpisodeSummary, check

__all__ = [
    "EpisodeSummary", "Finding", "FrameSummary", "Region", "Report", "TrainingSummary",
    "check",
]  # fmt: skip
