"""Whether recordings and situations can be what they are taken for.

Units, order, clocks, poses, and what is unlike the others: what cannot be is an error, what is
unlikely is one warning that names it, with a number and a remedy. Nothing is mended.
"""

from tpgmm_torch.plausibility.check import check, examine
from tpgmm_torch.plausibility.findings import Finding, Report
from tpgmm_torch.plausibility.shown import Shown, ShownFrame

__all__ = ["Finding", "Report", "Shown", "ShownFrame", "check", "examine"]
