"""Candidate projection operators: the rows of the paper's Table I."""

from tpgmm_torch.operators.base import Linearization, Operator, Reference
from tpgmm_torch.operators.canonical import Canonical
from tpgmm_torch.operators.orientation import AbsoluteOrientation, RelativeOrientation
from tpgmm_torch.operators.position import AbsolutePosition, RelativePosition
from tpgmm_torch.operators.stack import Stack
from tpgmm_torch.operators.task_parameters import TaskParameters

__all__ = [
    "AbsoluteOrientation",
    "AbsolutePosition",
    "Canonical",
    "Linearization",
    "Operator",
    "Reference",
    "RelativeOrientation",
    "RelativePosition",
    "Stack",
    "TaskParameters",
]
