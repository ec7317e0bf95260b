"""Demonstrations without those that are unlike the others, as the operators see them."""

from tpgmm_torch.training.outlying_demonstrations import drop_outliers

__all__ = ["drop_outliers"]
