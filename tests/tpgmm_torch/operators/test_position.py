"""Position operators against eqs (4) and (6)."""

from tests.support.operator_battery import OperatorLaws, laws_in_places
from tpgmm_torch import AbsolutePosition, RelativePosition

KINDS = AbsolutePosition, RelativePosition
globals().update(laws_in_places(KINDS, OperatorLaws))
