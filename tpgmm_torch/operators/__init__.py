"""Candidate projection operators: the rows of the paper's Table I."""

from tpgmm_torch.operators.base import Linearization, Operator
from tpgmm_torch.operators.canonical import Canonical
from tpgmm_torch.operators.orientation import AbsoluteOrientation, RelativeOrientation
from tpgmm_torch.operators.pose import PoseOperator
from tpgmm_torch.operators.position import AbsolutePosition, RelativePosition
from tpgmm_torch.operators.stack import Stack
from tpgmm_torch.operators.wrench import Wrench

__all__ = [
    "AbsoluteOrientation",
    "AbsolutePosition",
    "Canonical",
    "Linearization",
    "Operator",
    "PoseOperator",
    "RelativeOrientation",
    "RelativePosition",
    "Stack",
    "Wrench",
]
